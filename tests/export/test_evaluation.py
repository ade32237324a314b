from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose.analysis import metrics
from edgepose.errors import EdgeposeError
from edgepose.inference.engine import StreamEngine, WindowEngine
from edgepose.placements import BONES
from edgepose.skeleton import PREDICTED, UNOBSERVED, default_body, global_rotations
from edgepose_export.evaluation import baselines
from edgepose_export.evaluation import evaluate as evaluation
from edgepose_export.evaluation.evaluate import Mode, run_archive
from edgepose_export.mocap import read_motion, resample
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import Take, read_take
from edgepose_export.training.description import describe

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"
BIRNN = NetworkShape("birnn", 8, "global-6d", "passed")
RNN = BIRNN._replace(kind="rnn")


def made_up(wearers, frames, seed=1):
    orientation, acceleration = (x[0].numpy() for x in wearers(1, frames, seed))
    pose = Rotation.random(frames * 24, random_state=seed).as_matrix().reshape(frames, 24, 3, 3)
    return Take("made up", orientation, acceleration, pose.astype(np.float32), "free")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    path = tmp_path_factory.mktemp("evaluation") / "walk.npz"
    motion = resample(read_motion(WALK))
    np.savez(path, **recording_arrays(motion, virtual_imus(motion, default_body()), "free"))
    return read_take(path)


def run(engine, take):
    outputs = [engine.push(*row) for row in zip(range(10**6), take.orientation, take.acceleration)]  # noqa: B905
    return np.array([one.rotations for some in [*outputs, engine.finish()] for one in some])


@pytest.mark.parametrize(
    ("past", "future", "frames"),
    [(4, 2, 40), (0, 0, 5), (20, 5, 12), (3, 9, 8), (9, 3, 8), (2, 1, evaluation.BATCH + 9), (4, 2, 1)],
)
def test_window_is_what_a_run_computes(tiny, wearers, past, future, frames):
    module, take = tiny(BIRNN), made_up(wearers, frames)
    expected = run(WindowEngine(module, past, future), take)
    got = run_archive(module, [take], Mode("window", past, future))[0]
    assert got.shape == (frames, 24, 3, 3)
    np.testing.assert_allclose(got, expected, atol=3e-5)


@pytest.mark.parametrize(("shape", "future", "frames"), [(BIRNN, 3, 30), (BIRNN, 9, 4), (RNN, 0, 30)])
def test_stream_is_what_a_run_computes(tiny, wearers, shape, future, frames):
    module, take = tiny(shape), made_up(wearers, frames)
    expected = run(StreamEngine(module, 0, future), take)
    got = run_archive(module, [take], Mode("stream", 0, future))[0]
    np.testing.assert_allclose(got, expected, atol=3e-5)


@pytest.mark.parametrize(("shape", "future"), [(BIRNN, 3), (RNN, 0)])
def test_takes_side_by_side_are_as_each_alone(tiny, wearers, shape, future):
    module, mode = tiny(shape), Mode("stream", 0, future)
    takes = [made_up(wearers, frames, seed) for seed, frames in enumerate((12, 2, 30, 30, 1))]
    for got, take in zip(run_archive(module, takes, mode), takes, strict=True):
        np.testing.assert_allclose(got, run_archive(module, [take], mode)[0], atol=3e-5)


def test_offline_is_the_whole_take(tiny, walk):
    module = tiny(BIRNN)
    with torch.no_grad():
        expected = module(torch.tensor(walk.orientation)[None], torch.tensor(walk.acceleration)[None])[0][0]
    np.testing.assert_allclose(run_archive(module, [walk], Mode("offline"))[0], expected, atol=1e-6)


def test_modes():
    about = {"kind": "birnn", "past": 20, "future": 5}
    names = [str(mode) for mode in evaluation.modes_of(about)]
    assert names == ["online, window (20, 5)", "online, stream (5 future)", "offline, whole take"]
    names = [str(mode) for mode in evaluation.modes_of({"kind": "rnn", "past": 0, "future": 0})]
    assert names == ["online, step by step", "offline, whole take"]


def test_measures_are_over_all_frames_of_all_takes(wearers):
    takes = [made_up(wearers, frames, seed) for frames, seed in ((20, 1), (9, 2))]
    guess = made_up(wearers, 20, 3).pose.astype(float)
    methods = {"a guess": lambda takes: [guess[: len(take.pose)] for take in takes]}
    table = evaluation.summarise(evaluation.collect(takes, methods))
    offsets = default_body().offsets
    parts = [metrics.per_frame(guess[: len(t.pose)], t.pose.astype(float), offsets, 60.0) for t in takes]
    assert set(table) == {"a guess"}
    for key in metrics.LABELS:
        assert table["a guess"][key] == metrics.measure(np.concatenate([part[key] for part in parts]))
    assert table["a guess"]["sip_error_deg"].frames == 29


# --- baselines ----------------------------------------------------------------------------------------------


def errors(poses, take):
    return metrics.joint_angle_error(poses, take.pose.astype(float), PREDICTED).max()


def all_baselines(take, learnt):
    return {name: method(take, learnt) for name, method in baselines.METHODS.items()}


def moving(wearers, frames=50):
    """A take whose poses a test still has to fill in."""
    rng = np.random.default_rng(3)
    vectors = np.cumsum(rng.normal(scale=0.03, size=(frames, 6, 3)), axis=0)
    orientation = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 6, 3, 3)
    return made_up(wearers, frames)._replace(orientation=orientation)


def test_mean_pose_is_right_for_who_never_moves(wearers):
    take = moving(wearers)
    pose = np.tile(take.pose[:1], (50, 1, 1, 1)).astype(float)
    pose[:, 0] = take.orientation[:, 5]
    take = take._replace(pose=pose)
    got = baselines.METHODS["mean pose"](take, baselines.learn([take]))
    assert errors(got, take) < 1e-3
    np.testing.assert_allclose(got[:, 0], take.orientation[:, 5])


def test_interpolation_is_right_for_who_moves_so(wearers):
    take = moving(wearers)
    take = take._replace(pose=baselines.interpolated(take))
    learnt = baselines.learn([take])
    got = all_baselines(take, learnt)
    assert errors(got["measured bones, others interpolated"], take) < 1e-5
    assert errors(got["measured bones, others interpolated + mean offsets"], take) < 1e-3
    np.testing.assert_allclose(learnt.offsets, np.tile(np.eye(3), (24, 1, 1)), atol=1e-6)


def test_interpolation_with_offsets_is_right_for_who_is_off_so(wearers):
    take = moving(wearers)
    offsets = np.tile(np.eye(3), (24, 1, 1))
    turns = np.random.default_rng(1).normal(scale=0.3, size=(10, 3))
    offsets[list(UNOBSERVED)] = Rotation.from_rotvec(turns).as_matrix()
    take = take._replace(pose=baselines.interpolated(take, offsets))
    got = all_baselines(take, baselines.learn([take]))
    assert errors(got["measured bones, others interpolated + mean offsets"], take) < 1e-3
    assert errors(got["measured bones, others interpolated"], take) > 5


def test_interpolated_bones_lie_between_their_sensors(walk):
    world = global_rotations(baselines.interpolated(walk))
    np.testing.assert_allclose(world[:, list(BONES)], walk.orientation, atol=1e-5)
    half = Rotation.from_matrix(world[:, 0]).inv() * Rotation.from_matrix(world[:, 1])
    whole = Rotation.from_matrix(world[:, 0]).inv() * Rotation.from_matrix(world[:, 4])
    np.testing.assert_allclose(half.as_rotvec() * 2, whole.as_rotvec(), atol=1e-5)
    for joint, parent in ((7, 4), (10, 4), (8, 5), (20, 18), (22, 18), (23, 19)):
        np.testing.assert_allclose(world[:, joint], world[:, parent], atol=1e-6)


def test_measured_bones_with_the_mean_pose_are_right_for_who_moves_only_those(wearers):
    take = moving(wearers)
    pose = Rotation.random(24, random_state=4).as_matrix()
    take = take._replace(pose=baselines.with_measured_bones(take, pose))
    world = global_rotations(take.pose)
    np.testing.assert_allclose(world[:, list(BONES)], take.orientation, atol=1e-6)
    got = all_baselines(take, baselines.learn([take]))["measured bones, others' mean local pose"]
    assert errors(got, take) < 1e-3


def test_frozen_pose_is_the_straight_one(wearers):
    take = moving(wearers)
    got = all_baselines(take, baselines.learn([take]))["frozen calibration pose"]
    np.testing.assert_allclose(got[:, 0], take.orientation[:, 5])
    take = take._replace(pose=got)
    world = global_rotations(got)
    # Seen from the pelvis the arms hang, everything else is as in the T-pose.
    seen = np.swapaxes(world[:, :1], -1, -2) @ world
    np.testing.assert_allclose(seen[:, 16] @ [1, 0, 0], np.tile([0, -1, 0], (50, 1)), atol=1e-6)
    np.testing.assert_allclose(seen[:, 1], np.tile(np.eye(3), (50, 1, 1)), atol=1e-6)


def test_nearest_neighbours_find_poses_that_were_seen(walk):
    """Each frame stands in the training takes eight times: its neighbours are its copies."""
    learnt = baselines.learn([walk] * 8)
    assert errors(baselines.nearest(walk, learnt), walk) < 1e-2


def test_baselines_need_no_more_memory_for_more_takes(walk, monkeypatch):
    monkeypatch.setattr(baselines, "MOST_FRAMES", 300)
    few, many = baselines.learn([walk]), baselines.learn(iter([walk] * 40))
    assert len(few.inputs) == 119
    assert 150 <= len(many.inputs) == len(many.poses) <= 300
    # Evenly spread: every sixteenth frame of 40 times 119.
    inputs = np.tile(few.inputs, (40, 1))
    stride = round(len(inputs) / len(many.inputs))
    np.testing.assert_array_equal(many.inputs, inputs[::stride])
    np.testing.assert_allclose(many.mean_pose, few.mean_pose, atol=1e-9)
    np.testing.assert_allclose(many.offsets, few.offsets, atol=1e-9)


# --- folders of takes --------------------------------------------------------------------------------------


def test_tables_of_a_folder(tmp_path, tiny, walk):
    motion = resample(read_motion(WALK))
    arrays = recording_arrays(motion, virtual_imus(motion, default_body()), "free")
    for name in ("01_01", "07_01", "02_01"):
        (tmp_path / name[:2]).mkdir()
        np.savez(tmp_path / name[:2] / f"{name}.npz", **arrays)
    methods = evaluation.archive_methods(tiny(RNN), [Mode("offline")])
    methods |= evaluation.baseline_methods(baselines.learn(evaluation.takes_of(tmp_path, "train")))
    columns = evaluation.columns_of_parts(methods, tmp_path, ("cmu-02", "all"))
    tables = {part: evaluation.summarise(rows) for part, rows in columns.items()}
    assert list(tables) == ["cmu-02", "all"]
    for table, frames in zip(tables.values(), (119, 357), strict=True):
        assert len(table) == 7
        for row in table.values():
            assert set(row) == set(metrics.LABELS)
            assert row["sip_error_deg"].frames == frames
            assert np.isfinite([value.mean for value in row.values()]).all()
    for name in ("s_008_1_1", "tennis_KangTennisF16"):
        np.savez(tmp_path / f"{name}.npz", **arrays)
    parts = ("sports", "tennis", "basketball")
    sports = evaluation.columns_of_parts(methods, tmp_path, parts)
    for name in methods:
        errors = [sports[part][name]["sip_error_deg"] for part in ("basketball", "tennis")]
        np.testing.assert_array_equal(sports["sports"][name]["sip_error_deg"], np.concatenate(errors))
    with pytest.raises(EdgeposeError, match="no recording of the part 'bandai-styles'"):
        evaluation.columns_of_parts(methods, tmp_path, ["bandai-styles"])


def test_description_of_takes(walk):
    licenses = (
        "CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu), free for all use",
        "Bandai-Namco Research Motiondataset, CC BY-NC 4.0",
    )
    takes = [(f"{i}", len(walk.pose)) for i in range(3)]
    about = describe((*licenses, licenses[0]), ("cmu", "bandai-namco", "cmu"), takes)
    assert about["free"] == {"cmu": True, "bandai-namco": False}
    assert about["summary"] == (
        "Bandai-Namco Research Motiondataset and CMU Graphics Lab Motion Capture Database"
    )
    assert about["licenses"] == sorted(licenses)
    assert about["takes"] == 3
    assert about["hours"] == pytest.approx(3 * 119 / 60 / 3600)
