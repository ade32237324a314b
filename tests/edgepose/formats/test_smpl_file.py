import pickle
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from edgepose.errors import EdgeposeError
from edgepose.formats.smpl_model import read_smpl
from edgepose.skeleton import PARENTS, default_body, forward_kinematics


def made_up(height=1.8):
    """Laid out like an SMPL model: joints of a made-up body, two vertices around each of them."""
    rng = np.random.default_rng(5)
    offsets = default_body(height, "male").offsets + rng.normal(scale=0.003, size=(24, 3))
    joints = forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), offsets, [0.01, -0.2, 0.03])[1]
    delta = rng.normal(scale=0.05, size=(24, 3)) * [1, 0, 1]
    crown = np.array([0.0, joints[15, 1] + 0.13, 0.0])
    crown_and_sole = np.stack([crown, crown - [0, height, 0]])
    regressor = np.zeros((24, 50))
    regressor[:, :24] = regressor[:, 24:48] = 0.5 * np.eye(24)
    kintree = np.array([PARENTS, range(24)], np.int64).astype(np.uint32)
    return {
        "J": joints,
        "J_regressor": regressor,
        "v_template": np.concatenate([joints + delta, joints - delta, crown_and_sole]),
        "kintree_table": kintree,
        "f": np.zeros((5, 3), np.uint32),
        "bs_type": "lrotmin",
    }


def check(body, model):
    want = model["J"][1:] - model["J"][list(PARENTS[1:])]
    assert not body.offsets[0].any()
    np.testing.assert_allclose(body.offsets[1:], want, atol=1e-12)
    assert body.height_m == pytest.approx(1.8)
    default = default_body()
    for sensor, bone in ((0, 20), (1, 21), (2, 7), (3, 8)):
        ratio = np.linalg.norm(body.offsets[bone]) / np.linalg.norm(default.offsets[bone])
        np.testing.assert_allclose(body.sensors[sensor], default.sensors[sensor] * ratio)
    assert body.sensors.shape == (6, 3)
    assert np.all(np.linalg.norm(body.sensors[4:], axis=1) > 0.04)


def write_npz(path, model):
    np.savez(path, **model)
    return path


def write_pickle(path, model, protocol=2):
    path.write_bytes(pickle.dumps(model, protocol))
    return path


def without(model, *names):
    return {key: value for key, value in model.items() if key not in names}


# --- files that are read ---


@pytest.mark.parametrize("left_out", [(), ("J",), ("J_regressor", "kintree_table")])
def test_npz(tmp_path, left_out):
    model = made_up()
    check(read_smpl(write_npz(tmp_path / "m.npz", without(model, *left_out))), model)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("left_out", ["J", "J_regressor"])
def test_pickle_of_every_protocol(tmp_path, protocol, left_out):
    model = made_up()
    check(read_smpl(write_pickle(tmp_path / "m.pkl", without(model, left_out), protocol)), model)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix", "csc_array", "csr_array"])
def test_sparse_regressor(tmp_path, kind, protocol):
    model = made_up()
    sparse = getattr(scipy.sparse, kind)(model["J_regressor"])
    file = write_pickle(tmp_path / "m.pkl", {**without(model, "J"), "J_regressor": sparse}, protocol)
    check(read_smpl(str(file)), model)


def test_arrays_in_column_order_and_of_other_types(tmp_path):
    model = made_up()
    model["J"] = np.round(model["J"], 2)
    for other in (np.asfortranarray(model["J"]), model["J"].astype(">f8"), model["J"].tolist()):
        check(read_smpl(write_pickle(tmp_path / "m.pkl", {**model, "J": other})), model)
    single = read_smpl(write_pickle(tmp_path / "m.pkl", {**model, "J": model["J"].astype(np.float32)}))
    np.testing.assert_allclose(single.offsets[4], model["J"][4] - model["J"][1], atol=1e-6)


def test_pickle_written_by_python_2(tmp_path):
    # Python 2 writes an array's bytes as a str, with the module names of its day.
    joints = made_up()["J"].astype("<f8")

    def text(s):
        return b"U" + bytes([len(s)]) + s.encode("latin1")

    data = joints.tobytes()
    file = tmp_path / "m.pkl"
    file.write_bytes(
        b"\x80\x02}" + text("J") + b"cnumpy.core.multiarray\n_reconstruct\n"
        b"cnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x18K\x03\x86cnumpy\ndtype\n" + text("f8") + b"K\x00K\x01\x87R"
        b"(K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        b"\x89T" + len(data).to_bytes(4, "little") + data + b"tbs."
    )  # fmt: skip
    body = read_smpl(file)
    np.testing.assert_allclose(body.offsets[1:], joints[1:] - joints[list(PARENTS[1:])])
    assert body.height_m == pytest.approx(1.8, abs=0.05)  # no vertices: from the bones


@pytest.fixture
def chumpy(monkeypatch):
    """A module with the name and the pickled form of chumpy's array, for writing only."""

    class Ch:
        def __init__(self, x):
            self.x, self._dirty_vars, self._itr = x, {"x"}, None

    ch = types.ModuleType("chumpy.ch")
    Ch.__module__, Ch.__qualname__, ch.Ch = "chumpy.ch", "Ch", Ch
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", ch)
    return Ch


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_chumpy_arrays(tmp_path, monkeypatch, chumpy, protocol):
    model = made_up()
    wrapped = {
        **without(model, "J"),
        "v_template": chumpy(model["v_template"]),
        "shapedirs": chumpy(np.ones(3)),
    }
    file = write_pickle(tmp_path / "m.pkl", wrapped, protocol)
    monkeypatch.delitem(sys.modules, "chumpy.ch")
    monkeypatch.delitem(sys.modules, "chumpy")
    check(read_smpl(file), model)
    assert "chumpy" not in sys.modules


# --- files that are refused ---


class Calls:
    """Pickles into a call."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize("place", ["value", "key", "instead", "in J"])
def test_code_in_a_pickle_is_not_run(tmp_path, protocol, place):
    victim = tmp_path / "victim"
    evil = Calls(Path.touch, victim)
    content = {
        "value": {**made_up(), "extra": evil},
        "key": {evil: 1, **made_up()},
        "instead": evil,
        "in J": {**made_up(), "J": np.array([evil], dtype=object)},
    }[place]
    file = write_pickle(tmp_path / "m.pkl", content, protocol)
    with pytest.raises(
        EdgeposeError, match=r"asks for (pathlib|builtins|__builtin__)\S*, which .* was not run"
    ):
        read_smpl(file)
    assert not victim.exists()
    # The file does do harm where it is trusted.
    pickle.loads(file.read_bytes())
    assert victim.exists()


@pytest.mark.parametrize(
    ("code", "named"),
    [
        (b"cos\nsystem\n(S'touch victim'\ntR.", "os.system"),
        (b"c__builtin__\neval\n(S'1'\ntR.", "__builtin__.eval"),
        (b"cnumpy\nload\n(S'x'\ntR.", "numpy.load"),
        (b"cnumpy.core.multiarray\nfromfile\n.", "numpy.core.multiarray.fromfile"),
        (b"cscipy.sparse\nload_npz\n.", "scipy.sparse.load_npz"),
        (b"cchumpyx\nCh\n.", "chumpyx.Ch"),
        (b"\x80\x04\x8c\x0cscipy.sparse\x94\x8c\x0ecsc_matrix.dot\x94\x93.", "scipy.sparse.csc_matrix.dot"),
    ],
)
def test_the_refused_class_is_named(tmp_path, monkeypatch, code, named):
    monkeypatch.chdir(tmp_path)
    Path("m.pkl").write_bytes(code)
    with pytest.raises(EdgeposeError, match=f"asks for {named},"):
        read_smpl("m.pkl")
    assert not Path("victim").exists()


def test_a_pickle_cannot_change_what_it_names(tmp_path):
    # Sets attributes on the classes themselves: (class) (None, {"__init__": 1}) BUILD.
    for what in (
        b"cscipy.sparse\ncsc_matrix\n",
        b"cnumpy\nndarray\n",
        b"c_codecs\nencode\n",
        b"cchumpy.ch\nCh\n",
    ):
        (tmp_path / "m.pkl").write_bytes(what + b"(N(S'__init__'\nI1\ndtb.")
        with pytest.raises(EdgeposeError):
            read_smpl(tmp_path / "m.pkl")
    model = made_up()
    check(read_smpl(write_pickle(tmp_path / "m.pkl", model)), model)
    assert scipy.sparse.csc_matrix(np.eye(2)).nnz == 2


@pytest.mark.parametrize(
    "content", [b"", b"PK", b"PK\x03\x04 no archive", b"hello, world\n", b"\x80\x02}q\x00(U\x01J", b"N."]
)
def test_not_a_model_file(tmp_path, content):
    file = tmp_path / "m.pkl"
    file.write_bytes(content)
    with pytest.raises(EdgeposeError, match=r"m\.pkl: "):
        read_smpl(file)


def test_no_file(tmp_path):
    with pytest.raises(EdgeposeError, match=r"none\.npz: cannot be read"):
        read_smpl(tmp_path / "none.npz")


@pytest.mark.parametrize("write", [write_npz, write_pickle])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: without(m, "J", "J_regressor"), "needs J, or J_regressor and v_template"),
        (lambda m: without(m, "J", "v_template"), "needs J, or J_regressor and v_template"),
        (lambda m: {**m, "J": m["J"][:22]}, r"J has shape \(22, 3\)"),
        (lambda m: {**m, "J": m["J"][:, :2]}, r"J has shape \(24, 2\)"),
        (
            lambda m: {**without(m, "J"), "J_regressor": m["J_regressor"][:, 1:]},
            r"J_regressor has shape \(24, 49\)",
        ),
        (lambda m: {**m, "v_template": m["v_template"][:, :2]}, r"v_template has shape \(50, 2\)"),
        (lambda m: {**m, "v_template": m["v_template"][:0]}, r"v_template has shape \(0, 3\)"),
        (lambda m: {**m, "J": np.where(np.arange(24)[:, None] == 7, np.nan, m["J"])}, "J contains NaN"),
        (lambda m: {**m, "v_template": m["v_template"] * np.inf}, "v_template contains NaN or infinity"),
        (lambda m: {**m, "J": np.full((24, 3), "x")}, "J is not an array of numbers"),
        (lambda m: {**m, "J": m["J"] * 1000, "v_template": m["v_template"] * 1000}, "metres"),
        (lambda m: {**m, "J": np.zeros((24, 3))}, "coincides with its parent"),
        (lambda m: {**m, "J": m["J"] + 1e201 * np.eye(24, 3)}, "J contains 1e.201, which no body has"),
        (lambda m: {**m, "J": m["J"] + 2.0 * np.eye(24, 3, -9)}, "joint 11 is 2.* m from its parent"),
        (lambda m: {**m, "kintree_table": m["kintree_table"][:, ::-1]}, "order of joints"),
        (lambda m: {**m, "kintree_table": np.zeros((2, 55), int)}, "not SMPL-H or SMPL-X"),
    ],
)
def test_wrong_content_is_named(tmp_path, write, change, message):
    with np.errstate(invalid="ignore"):
        file = write(tmp_path / "m.npz", change(made_up()))
    with pytest.raises(EdgeposeError, match=message):
        read_smpl(file)


def test_npz_with_pickled_objects_is_refused(tmp_path):
    victim = tmp_path / "victim"
    file = tmp_path / "m.npz"
    np.savez(file, J=np.array([Calls(Path.touch, victim)], dtype=object))
    with pytest.raises(EdgeposeError, match="not a readable SMPL model"):
        read_smpl(file)
    assert not victim.exists()


@pytest.mark.parametrize(
    "change",
    [
        {"indices": np.array([99] * 48)},
        {"indices": np.array([-1] * 48)},
        {"indptr": np.arange(7)},
        {"indptr": np.arange(51) * 5},
        {"indptr": np.arange(51) * 0.5},
        {"data": np.ones((4, 12))},
        {"data": None},
        {"_shape": (24, 10**9)},
    ],
)
def test_broken_sparse_matrices_are_refused(tmp_path, change):
    model = without(made_up(), "J")
    sparse = scipy.sparse.csc_matrix(model["J_regressor"])
    sparse.__dict__.update(change)
    with pytest.raises(EdgeposeError, match="J_regressor"):
        read_smpl(write_pickle(tmp_path / "m.pkl", {**model, "J_regressor": sparse}))
