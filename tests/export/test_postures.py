from pathlib import Path

import numpy as np
import pytest
import torch

from edgepose.placements import BONES, ROOT
from edgepose.skeleton import JOINTS, PARENTS, default_body
from edgepose_export.dataset import read_take, root_relative_pose
from edgepose_export.mocap import read_motion, resample
from edgepose_export.postures import DEVIATION, IMPOSSIBLE, SWAY_HZ, moved, other_postures
from edgepose_export.synthesis import recording_arrays, virtual_imus

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def take_of(motion, folder):
    """What training reads of a motion: one sequence."""
    path = folder / "take.npz"
    np.savez(path, **recording_arrays(motion, virtual_imus(motion, default_body()), ""))
    take = read_take(path)
    relative = root_relative_pose(torch.from_numpy(take.pose))
    return tuple(
        x[None] for x in (torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration), relative)
    )


@pytest.fixture(scope="module")
def walk():
    return resample(read_motion(WALK))


@pytest.fixture(scope="module")
def batch(walk, tmp_path_factory):
    return take_of(walk, tmp_path_factory.mktemp("walk"))


def local(relative):
    """Local rotations (B, T, 23, 3, 3) of all joints but the pelvis."""
    return relative[:, :, list(PARENTS[1:])].mT @ relative[:, :, 1:]


def test_sensors_measure_what_they_would_on_a_body_in_that_posture(walk, batch, tmp_path):
    orientation, acceleration, relative = other_postures(batch, 2.0, generator(3))
    rotations = walk.rotations[:, :1] @ relative[0].double().numpy()
    expected = take_of(walk._replace(rotations=rotations), tmp_path)
    torch.testing.assert_close(orientation, expected[0], atol=1e-4, rtol=0)
    torch.testing.assert_close(relative, expected[2], atol=1e-4, rtol=0)
    # Second differences of float32 places.
    assert (acceleration - expected[1]).norm(dim=-1).max() < 0.02
    assert (acceleration - batch[1]).norm(dim=-1).mean() > 0.2


def test_size_of_the_postures_is_that_of_the_table(batch):
    many = tuple(x[:, :120].expand(300, *x[:, :120].shape[1:]) for x in batch)
    turned = local(many[2]).mT @ local(other_postures(many, 1.0, generator())[2])
    angle = (turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0).mul(0.5).clamp(-1, 1).arccos()
    got = angle.square().mean(dim=(0, 1)).sqrt()
    # Deviations of a constant part and of a sine of 0.8 and 0.6 times the table's.
    expected = (0.8**2 + 0.6**2 / 2) ** 0.5 * DEVIATION[1:].norm(dim=-1)
    still = DEVIATION[1:].norm(dim=-1) == 0
    torch.testing.assert_close(got[~still], expected[~still], rtol=0.12, atol=0)
    assert got[still].max() < 1e-3
    assert {JOINTS[1 + i] for i in still.nonzero().flatten()} == {
        f"{side}_{name}" for side in ("left", "right") for name in ("ankle", "foot", "wrist", "hand")
    }


def test_postures_sway_slowly_and_the_pelvis_stays(batch):
    orientation, _, relative = other_postures(batch, 1.0, generator(1))
    assert torch.equal(orientation[:, :, ROOT], batch[0][:, :, ROOT])
    assert torch.equal(relative[:, :, 0], batch[2][:, :, 0])
    turned = local(batch[2]).mT @ local(relative)
    step = turned[:, :-1].mT @ turned[:, 1:]
    angle = (step.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0).mul(0.5).clamp(-1, 1).arccos()
    fastest = 2 * np.pi * SWAY_HZ / 60 * 0.6 * 4 * DEVIATION.norm(dim=-1).max()
    assert angle.max() < fastest


def test_the_seam_of_two_takes_gives_no_blow(batch):
    """The second half is another pose at once; what is measured there is what was, but for the posture."""
    orientation, acceleration, relative = (x.clone() for x in batch)
    half = orientation.shape[1] // 2
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    relative[:, half:, 1:] = turn @ relative[:, half:, 1:]
    orientation[:, :, :ROOT] = orientation[:, :, ROOT:] @ relative[:, :, list(BONES[:ROOT])]
    jumping = (orientation, acceleration, relative)
    got = other_postures(jumping, 3.0, generator(2))[1]
    assert (got - acceleration).norm(dim=-1).max() <= IMPOSSIBLE
    same = moved(jumping, relative)
    torch.testing.assert_close(same[0], orientation, atol=1e-5, rtol=0)
    assert torch.equal(same[1], acceleration)
