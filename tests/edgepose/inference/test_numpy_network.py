"""The network in numpy: the same results as the TorchScript module of the archive, which it reads as data."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import ModelError
from edgepose.inference import archive, numpy_network
from edgepose.inference.engine import EngineInput, MultiWearerEngine, StreamEngine, WindowEngine, as_runtime
from edgepose.inference.loading import load
from edgepose.inference.model import Model
from edgepose_export.evaluation.real_wearers import FOLDER, read_walker
from edgepose_export.networks.shape import NetworkShape

TILT = NetworkShape("birnn", 8, "global-6d", "passed", "tilt", smoothing=0.6, place=True)
SHAPES = [
    TILT,
    TILT._replace(kind="rnn"),
    TILT._replace(place=False, smoothing=0.0, measured="predicted"),
    TILT._replace(kind="rnn", place=False, normalisation="root", acceleration=False),
    TILT._replace(hidden=16),  # its weights come in blocks
]
FUTURE = {"birnn": 2, "rnn": 0}


@pytest.fixture(scope="module", params=SHAPES, ids=lambda shape: "-".join(map(str, shape)))
def both(request, tmp_path_factory, write_archive):
    """The networks of one archive, in torch and in numpy, and the shape."""
    info = archive.read_info(write_archive(tmp_path_factory.mktemp("archive") / "small.pt", request.param))
    return archive.load(info, trust=True), numpy_network.load(info), request.param


def frames(wearers, count, length, seed=1):
    return tuple(x.numpy() for x in wearers(count, length, seed))


def same(one, two):
    for a, b in zip(one, two, strict=True):
        if a is None or b is None:
            assert a is b
            continue
        assert a.dtype == b.dtype == np.float32
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)


def runtimes(both):
    module, network, shape = both
    return [as_runtime(each, shape.place) for each in (module, network)]


def test_streams(both, wearers):
    """Frame by frame and several at once, with what is left at the end."""
    orientation, acceleration = frames(wearers, 3, 9)
    future, states = FUTURE[both[2].kind], []
    for runtime in runtimes(both):
        state, results = runtime.start(3, future), []
        for t in range(4):
            result, state = runtime.stream(orientation[:, t], acceleration[:, t], state)
            results.append(result)
        result, state = runtime.stream_many(orientation[:, 4:], acceleration[:, 4:], state)
        states.append([*results, result, runtime.drain(state)])
    for one, two in zip(*states, strict=True):
        same(one, two)
    assert sum(result.rotations.shape[1] for result in states[1]) == 9


def test_windows(both, wearers):
    orientation, acceleration = frames(wearers, 2, 6)
    for index in (0, 3, 5):
        same(*(runtime.window(orientation, acceleration, index) for runtime in runtimes(both)))


@pytest.mark.parametrize("place", [False, True])
def test_engines(both, wearers, place):
    """Several wearers, who begin and pause when they like, and one wearer in windows."""
    module, network, shape = both
    place = place and shape.place
    orientation, acceleration = frames(wearers, 2, 8)
    future = FUTURE[shape.kind]

    def outputs(module):
        engine = MultiWearerEngine(module, 3, future, 2, place=place)
        window = WindowEngine(module, 3, future, place=place)
        done = []
        for t in range(8):
            inputs = {
                w: EngineInput((w, t), orientation[w, t], acceleration[w, t])
                for w in range(2)
                if w == 0 or t % 3
            }
            for found in engine.push(inputs).values():
                done += found
            done += window.push(t, orientation[0, t], acceleration[0, t])
        return done + engine.finish(0) + engine.finish(1) + window.finish()

    found = [outputs(each) for each in (module, network)]
    assert len(found[0]) == 8 + 5 + 8
    for one, two in zip(*found, strict=True):
        assert one.frame == two.frame
        assert one.warming_up == two.warming_up
        assert (one.place is None) == (not place)
        same((one.rotations, one.std, one.place), (two.rotations, two.std, two.place))


def test_an_upside_down_pelvis_counts_as_not_turned(both, wearers):
    orientation, acceleration = frames(wearers, 1, 4)
    orientation[:, :, 5] = np.diag([-1.0, -1.0, 1.0])
    same(*(runtime.window(orientation, acceleration, 3) for runtime in runtimes(both)))


@pytest.mark.parametrize("path", archive.bundled_archives(), ids=lambda path: path.stem)
def test_bundled_archives(path):
    """On a real wearer, who walks: random orientations are further from the training data than any pose."""
    info = archive.read_info(path)
    walker = read_walker(FOLDER).take
    orientation, acceleration = walker.orientation[None, 300:600], walker.acceleration[None, 300:600]
    future, results = info.metadata["future"], []
    for module in (archive.load(info), numpy_network.load(info)):
        runtime = as_runtime(module, archive.has_place(info.metadata))
        result, state = runtime.stream_many(orientation, acceleration, runtime.start(1, future))
        results.append([result, runtime.drain(state)])
    for one, two in zip(*results, strict=True):
        same(one, two)


def test_an_archive_without_an_index_of_its_weights_says_what_to_do(tmp_path):
    with zipfile.ZipFile(archive.find_archive("rnn")) as file, zipfile.ZipFile(tmp_path / "a.pt", "w") as new:
        for entry in file.infolist():
            if not entry.filename.endswith("/extra/weights.json"):
                new.writestr(entry, file.read(entry))
    info = archive.read_info(tmp_path / "a.pt")
    with pytest.raises(ModelError, match=r"no weights\.json.*: export it again"):
        numpy_network.load(info)


# --- choice of the runtime ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory, write_archive):
    return write_archive(tmp_path_factory.mktemp("archive") / "small.pt", TILT)


def test_models_need_no_trust_in_numpy(made, wearers):
    with pytest.raises(ModelError, match="is not known"):
        Model(made)
    model = Model(made, runtime="numpy")
    assert (model.runtime, model.precision) == ("numpy", "f32")
    with pytest.raises(ModelError, match=r"numpy runs in f32 only, not in fp16"):
        Model(made, runtime="numpy", precision="fp16")
    inputs = tuple(array[0] for array in frames(wearers, 1, 70))
    poses = Model(made, trust=True, precision="f32").poses(*inputs)
    np.testing.assert_allclose(model.poses(*inputs), poses, rtol=0, atol=1e-5)


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None  # any import of it fails
from edgepose.cli import main
main()
"""


def test_a_run_without_torch(made, wearer, tmp_path, command):
    """`auto` says that numpy runs, and the poses are those of torch in f32."""
    words = ["run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", made]
    by_torch, by_numpy = tmp_path / "torch.npz", tmp_path / "numpy.npz"
    result = command(*words, "--trust", "--precision", "f32", "--npz", by_torch)
    assert result.returncode == 0, result.stderr
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, *map(str, words), "--npz", by_numpy],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr.startswith("PyTorch is not installed: running with numpy\nrunning ")
    assert "in f32 with numpy; Ctrl-C ends" in result.stderr
    with np.load(by_torch) as expected, np.load(by_numpy) as got:
        np.testing.assert_allclose(got["poses"], expected["poses"], rtol=0, atol=1.7e-5)  # 0.001 deg
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, *map(str, words), "--runtime", "torch", "--csv", "-"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1
    assert "PyTorch is not installed: install it, or use --runtime numpy\n" in result.stderr
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, "bench"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert (
        result.stderr == "edgepose: this needs PyTorch, which is not installed; see docs/guide/install.md\n"
    )


# --- hostile archives ---------------------------------------------------------------------------------------


def rewritten(source: Path, path: Path, change) -> Path:
    """The archive with files changed by a function of name and content; None leaves a file out."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            content = change(entry.filename, old.read(entry))
            if content is not None:
                new.writestr(entry.filename, content, compress_type=entry.compress_type)
    return path


def weight_file(source: Path, name: str) -> str:
    with zipfile.ZipFile(source) as file:
        index = next(entry for entry in file.namelist() if entry.endswith("/extra/weights.json"))
        return json.loads(file.read(index))[name]["file"]


def in_index(change):
    """A function of a file that changes the index of weights."""

    def changed(name, content):
        if not name.endswith("/weights.json"):
            return content
        index = json.loads(content)
        return json.dumps(change(index))

    return changed


def in_metadata(**changes):
    def changed(name, content):
        if not name.endswith("/edgepose.json"):
            return content
        return json.dumps(json.loads(content) | changes)

    return changed


NAME = "forward1.state.weight"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (in_index(lambda index: []), r"weights\.json is no object"),
        (in_index(lambda index: {k: v for k, v in index.items() if k != NAME}), f"{NAME} is missing"),
        (in_index(lambda index: index | {NAME: 5}), f"{NAME} is missing"),
        (
            in_index(lambda index: index | {NAME: index["inputs1.weight"]}),
            r"does not have the shape \(8, 32\)",
        ),
        (in_index(lambda index: index | {NAME: {"file": "data.pkl", "shape": [8, 32]}}), "the size of"),
        (in_index(lambda index: index | {NAME: {"file": "../x", "shape": [8, 32]}}), "no item named"),
        (in_index(lambda index: index | {NAME: {"file": [1], "shape": [8, 32]}}), "no item named"),
        (in_index(lambda index: index | {"": "/etc/"} | {NAME: {"shape": [8, 32]}}), "no item named"),
        (lambda name, content: b"{" if name.endswith("weights.json") else content, "cannot be read"),
        (lambda name, content: b"[" * 9999 if name.endswith("weights.json") else content, "cannot be read"),
        (lambda name, content: b" " * 70_000 if name.endswith("weights.json") else content, "a large one"),
        (lambda name, content: None if name.endswith("weights.json") else content, "export it again"),
        (in_metadata(hidden=10**6), "hidden units"),
        (in_metadata(hidden=True), "hidden units"),
        (in_metadata(hidden=9), "missing or does not have the shape"),
        (in_metadata(joints=["pelvis"]), "its joints"),
        (in_metadata(joints=["left_hip"] * 10), "its joints"),
        (in_metadata(joints=[["left_hip"]]), "its joints"),
        (in_metadata(joints=7), "its joints"),
        (in_metadata(joints=["left_hip"]), "missing or does not have the shape"),
        (in_metadata(smoothing=float("nan")), "its smoothing"),
        (in_metadata(smoothing="much"), "its smoothing"),
        (in_metadata(kind="wavenet"), "numpy runs networks with kind rnn or birnn, not 'wavenet'"),
        (in_metadata(targets="\x1b[31m"), "with targets global-6d, not"),
        (in_metadata(precision="int8"), "with precision f32, not 'int8'"),
    ],
)
def test_hostile_archives(made, tmp_path, change, message):
    path = rewritten(made, tmp_path / "small.pt", change)
    with pytest.raises(ModelError, match=message) as caught:
        numpy_network.load(archive.read_info(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-4], "the size of"),
        (lambda content: content + bytes(4), "the size of"),
        (lambda content: content[:-4] + np.float32(np.nan).tobytes(), "a NaN or an infinite number"),
        (lambda content: np.float32(np.inf).tobytes() + content[4:], "a NaN or an infinite number"),
    ],
)
def test_hostile_weights(made, tmp_path, damage, message):
    file = weight_file(made, NAME)
    path = rewritten(
        made,
        tmp_path / "small.pt",
        lambda name, content: damage(content) if name.endswith(f"/{file}") else content,
    )
    with pytest.raises(ModelError, match=message):
        numpy_network.load(archive.read_info(path))


def test_compressed_weights_are_not_unpacked(made, tmp_path):
    """A small file must not become a large one."""
    file, path = weight_file(made, NAME), tmp_path / "small.pt"
    with zipfile.ZipFile(made) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            packed = zipfile.ZIP_DEFLATED if entry.filename.endswith(f"/{file}") else zipfile.ZIP_STORED
            new.writestr(entry.filename, old.read(entry), compress_type=packed)
    with pytest.raises(ModelError, match="the size of"):
        numpy_network.load(archive.read_info(path))


@pytest.mark.parametrize("packing", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("file", ["edgepose.json", "weights.json"])
def test_damage_in_a_compressed_description(made, tmp_path, packing, file):
    path = tmp_path / "small.pt"
    with zipfile.ZipFile(made) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            packed = packing if entry.filename.endswith(file) else zipfile.ZIP_STORED
            new.writestr(entry.filename, old.read(entry), compress_type=packed)
        (entry,) = (entry for entry in new.infolist() if entry.filename.endswith(file))
    content = bytearray(path.read_bytes())
    start = entry.header_offset + 30 + len(entry.filename) + 20
    content[start : start + 40] = bytes(255 - byte for byte in content[start : start + 40])
    path.write_bytes(content)
    with pytest.raises(ModelError, match=str(path)):
        numpy_network.load(archive.read_info(path))


def test_a_networks_nan_is_reported(made, tmp_path):
    """Weights that are finite can still overflow."""
    file = weight_file(made, "ends.dense.weight")
    path = rewritten(
        made,
        tmp_path / "small.pt",
        lambda name, content: (
            np.full(len(content) // 4, 3e38, np.float32).tobytes() if name.endswith(f"/{file}") else content
        ),
    )
    inputs = np.tile(np.eye(3), (9, 6, 1, 1)), np.full((9, 6, 3), 9.0)
    with np.errstate(all="ignore"), pytest.raises(ModelError, match="NaN or infinite"):
        Model(path, runtime="numpy").poses(*inputs)


# --- archives of older exports ------------------------------------------------------------------------------

OLD = Path(__file__).parents[2] / "data" / "archives" / "first-format.pt"


def test_archives_of_older_exports_run_as_they_did():
    """The file was exported, and its results computed, before archives had an index of their weights."""
    info = archive.read_info(OLD)
    module = load(info, True, "torch", "f32").module
    engine = StreamEngine(module, 0, 2, place=True)
    with np.load(OLD.with_suffix(".npz")) as data:
        arrays = dict(data)
    outputs = []
    for t in range(6):
        outputs += engine.push(t, arrays["orientation"][0, t], arrays["acceleration"][0, t])
    outputs += engine.finish()
    for name in ("rotations", "std", "place"):
        got = np.stack([getattr(output, name) for output in outputs])
        np.testing.assert_allclose(got, arrays[name][0], rtol=0, atol=1e-5)
    with pytest.raises(ModelError, match=r"no weights\.json, .*: export it again"):
        load(info, False, "numpy", "auto")
