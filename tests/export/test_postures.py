from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, default_body
from edgepose_export.mocap import read_motion, resample
from edgepose_export.synthesis.posture_variation import AFTER, BEFORE, DEVIATION, SWAY_HZ, vary_bodies
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import Batch, read_take, tape

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def take_of(motion, folder):
    """What training reads of a motion: one sequence."""
    path = folder / "take.npz"
    np.savez(path, **recording_arrays(motion, virtual_imus(motion, default_body()), ""))
    packed = tape([read_take(path)])
    return packed.at(torch.arange(len(packed.relative))[None])


@pytest.fixture(scope="module")
def walk():
    return resample(read_motion(WALK))


@pytest.fixture(scope="module")
def batch(walk, tmp_path_factory):
    return take_of(walk, tmp_path_factory.mktemp("walk"))


def one_take(batch):
    return torch.zeros(batch[0].shape[:2], dtype=torch.long)


def inner(part):
    return part[:, BEFORE : part.shape[1] - AFTER]


def turns(before, after):
    """Rotation vectors (B, T, 24, 3), degrees, of joints against what they were, about their own axes."""

    def local(relative):
        joints = relative[:, :, list(PARENTS[1:])].mT @ relative[:, :, 1:]
        return torch.cat([relative[:, :, :1], joints], dim=2).double()

    turn = (local(before).mT @ local(after)).numpy()
    vectors = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec(degrees=True)
    return vectors.reshape(*turn.shape[:-1])


def test_sensors_measure_what_they_would_on_a_body_in_that_posture(walk, batch, tmp_path):
    orientation, acceleration, relative, place = vary_bodies(batch, one_take(batch), 2.0, None, generator(3))
    whole = batch[2].clone()
    whole[:, BEFORE : whole.shape[1] - AFTER] = relative
    rotations = walk.rotations[:, :1] @ whole[0].double().numpy()
    expected = take_of(walk._replace(rotations=rotations), tmp_path)
    torch.testing.assert_close(orientation, inner(expected[0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(relative, inner(expected[2]), atol=1e-4, rtol=0)
    torch.testing.assert_close(place, inner(batch.place), atol=0, rtol=0, equal_nan=True)
    # At the ends of this take the posture begins and ends at once.
    inside = slice(3, -3)
    error = (acceleration - inner(expected[1]))[:, inside]
    assert error.norm(dim=-1).max() < 0.02  # second differences of float32 places
    assert (acceleration - inner(batch[1])).norm(dim=-1).mean() > 0.2


def test_every_frame_of_a_sequence_is_that_of_a_longer_one(batch):
    """What comes out has whole accelerations at both ends."""
    many = Batch(*(part[:, 10:80] for part in batch))
    long = vary_bodies(many, one_take(many), 1.0, None, generator(4))
    # The same postures, begun eleven frames later, do not exist; the same frames, ended earlier, do.
    short = Batch(*(part[:, :-20] for part in many))
    for got, expected in zip(vary_bodies(short, one_take(short), 1.0, None, generator(4)), long, strict=True):
        torch.testing.assert_close(got, expected[:, : got.shape[1]], atol=2e-3, rtol=0, equal_nan=True)


def test_turns_are_those_of_the_table(batch):
    many = Batch(*(part[:, :93].expand(1200, *part[:, :93].shape[1:]) for part in batch))
    after = vary_bodies(many, one_take(many), 1.0, None, generator())[2]
    # Postures sway slowly: neighbouring frames say the same.
    got = np.sqrt(np.square(turns(inner(many[2])[:, ::8], after[:, ::8])).mean(axis=(0, 1)))
    expected = np.rad2deg(DEVIATION.numpy())
    np.testing.assert_allclose(got, expected, rtol=0.08, atol=0.05)
    still = {JOINTS[i] for i in np.flatnonzero(expected.max(axis=1) == 0)}
    ends = {f"{side}_{name}" for side in ("left", "right") for name in ("ankle", "foot", "wrist", "hand")}
    assert still == ends | {"pelvis"}
    knee, elbow = JOINTS.index("left_knee"), JOINTS.index("right_elbow")
    assert got[knee, 0] < 0.05 < got[knee, 1]
    assert got[elbow, 1] < 0.05 < got[elbow, 0]


def test_postures_sway_slowly_and_the_pelvis_stays(batch):
    orientation, _, relative, _ = vary_bodies(batch, one_take(batch), 1.0, None, generator(1))
    assert torch.equal(orientation[:, :, ROOT], inner(batch[0])[:, :, ROOT])
    assert torch.equal(relative[:, :, 0], inner(batch[2])[:, :, 0])
    course = turns(inner(batch[2]), relative)[0][:, DEVIATION.any(dim=-1).numpy()]
    assert SWAY_HZ < 1.0
    speed = np.linalg.norm(np.diff(course, axis=0), axis=-1) * 60.0
    # Median and largest speed, deg/s: still, and as fast as 3 deviations at the highest frequency.
    assert 0.1 < np.median(speed) < 15.0
    assert speed.max() < 2 * np.pi * SWAY_HZ * 0.6 * 2**0.5 * 3 * np.rad2deg(
        float(DEVIATION.norm(dim=-1).max())
    )
    assert np.ptp(course, axis=0).max() > 2.0


@pytest.mark.parametrize("jump_deg", [1.0, 3.0, 90.0])
def test_the_seam_of_two_takes_gives_no_blow(batch, jump_deg):
    """From one frame to the next another take goes on in another pose."""
    orientation, acceleration, relative, place = (part.clone() for part in batch)
    take, half = one_take(batch), orientation.shape[1] // 2
    take[:, half:] = 1
    turn = torch.from_numpy(Rotation.from_euler("x", jump_deg, degrees=True).as_matrix()).float()
    relative[:, half:, 1:] = turn @ relative[:, half:, 1:]
    orientation[:, :, :ROOT] = orientation[:, :, ROOT:] @ relative[:, :, list(BONES[:ROOT])]
    got = vary_bodies(Batch(orientation, acceleration, relative, place), take, 2.0, None, generator(2))[1]
    change = (got - inner(acceleration)).norm(dim=-1)[0]
    near = slice(half - BEFORE - 2, half - BEFORE + 3)
    elsewhere = torch.cat([change[: near.start], change[near.stop :]])
    assert change[near].max() < 1.5 * elsewhere.max()
