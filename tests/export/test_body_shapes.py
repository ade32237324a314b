"""Training on bodies of other sizes and proportions."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edgepose.placements import BONES, PLACEMENTS, ROOT
from edgepose.skeleton import JOINTS, Body, default_body, forward_kinematics
from edgepose_export.mocap import Motion, read_motion, resample
from edgepose_export.synthesis.body_shapes import (
    LENGTHS,
    LEVERS,
    STATURES,
    Shapes,
    draw_shapes,
    levers_of,
)
from edgepose_export.synthesis.posture_variation import AFTER, BEFORE, vary_bodies
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import Batch, read_take, root_relative_pose

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def walk() -> Motion:
    return resample(read_motion(WALK))


def sequence(motion: Motion, body: Body, folder: Path) -> Batch:
    """One sequence as training reads it of a motion of a body, with random contacts and velocities."""
    path = folder / "take.npz"
    np.savez(path, **recording_arrays(motion, virtual_imus(motion, body), ""))
    take = read_take(path)
    place = torch.rand(1, len(take.pose), 10, generator=generator())
    pose = root_relative_pose(torch.from_numpy(take.pose))[None]
    return Batch(
        torch.from_numpy(take.orientation)[None], torch.from_numpy(take.acceleration)[None], pose, place
    )


def inner(part: torch.Tensor) -> torch.Tensor:
    return part[:, BEFORE : part.shape[1] - AFTER]


def one_take(batch: Batch) -> torch.Tensor:
    return torch.zeros(batch.orientation.shape[:2], dtype=torch.long)


def test_levers_reach_from_the_pelvis_to_the_sensors(walk: Motion) -> None:
    body = default_body()
    rotations, joints = forward_kinematics(walk.rotations[:5], body.offsets)
    points = joints[:, list(BONES)] + np.einsum("tsij,sj->tsi", rotations[:, list(BONES)], body.sensors)
    got = np.einsum("tjxy,ijy->tix", rotations, LEVERS.double().numpy())
    np.testing.assert_allclose(got, points, atol=1e-6)


@pytest.mark.parametrize(
    "other", [Body(default_body().offsets * 0.83, default_body().sensors * 0.83, 1.45), "f"]
)
def test_sensors_measure_what_they_would_on_another_body(
    walk: Motion, tmp_path: Path, other: Body | str
) -> None:
    """The pelvis of the other body moves in proportion to its legs."""
    small = default_body(1.55, "female")
    sensors = small.sensors + np.random.default_rng(0).normal(scale=0.03, size=(6, 3))
    body = small._replace(sensors=sensors) if isinstance(other, str) else other
    scale = 0.8 if isinstance(other, str) else 0.83
    before = sequence(walk, default_body(), tmp_path)
    levers = levers_of(torch.tensor(body.offsets).float(), torch.tensor(body.sensors).float())
    got = vary_bodies(before, one_take(before), 0.0, Shapes(levers[None], torch.tensor([scale])), generator())
    expected = sequence(walk._replace(translation=scale * walk.translation), body, tmp_path)
    size = inner(expected.acceleration).norm(dim=-1).mean()
    error = (got.acceleration - inner(expected.acceleration)).norm(dim=-1)
    assert error[:, 3:-3].max() < 0.02 * size
    assert (got.acceleration - inner(before.acceleration)).norm(dim=-1).mean() > 0.1 * size
    for part in ("orientation", "relative"):
        torch.testing.assert_close(getattr(got, part), inner(getattr(expected, part)), rtol=0, atol=1e-5)
    torch.testing.assert_close(got.place[..., 7:], scale * inner(before.place)[..., 7:])
    assert torch.equal(got.place[..., :7], inner(before.place)[..., :7])


def test_bodies_that_do_not_differ_change_nothing(walk: Motion, tmp_path: Path) -> None:
    before = sequence(walk, default_body(), tmp_path)
    for shapes in (None, draw_shapes(1, 0.0, 0.0, generator())):
        got = vary_bodies(before, one_take(before), 0.0, shapes, generator())
        for part in ("acceleration", "relative", "place"):
            assert torch.equal(getattr(got, part), inner(getattr(before, part)))
        torch.testing.assert_close(got.orientation, inner(before.orientation), rtol=0, atol=1e-6)


def test_statures_stay_within_their_limits() -> None:
    shapes = draw_shapes(4000, 0.08, 0.0, generator())
    stature = default_body().height_m * shapes.scale
    assert STATURES[0] == pytest.approx(stature.min().item(), abs=1e-3)
    assert STATURES[1] == pytest.approx(stature.max().item(), abs=1e-3)
    assert shapes.scale.log().std().item() == pytest.approx(0.08, rel=0.1)
    torch.testing.assert_close(shapes.levers, shapes.scale[:, None, None, None] * LEVERS)


def test_proportions_are_those_of_the_table() -> None:
    shapes = draw_shapes(4000, 0.0, 1.0, generator())
    sensor, bone = PLACEMENTS.index("left_forearm"), JOINTS.index("left_shoulder")
    upper_arm = shapes.levers[:, sensor, bone].norm(dim=-1) / LEVERS[sensor, bone].norm()
    assert upper_arm.log().std().item() == pytest.approx(LENGTHS["elbow"], rel=0.1)
    right = shapes.levers[:, sensor + 1, bone + 1].norm(dim=-1) / LEVERS[sensor + 1, bone + 1].norm()
    torch.testing.assert_close(upper_arm, right)
    # Sensors shift along their segments more than across them.
    shift = (shapes.levers[:, sensor, BONES[sensor]] - LEVERS[sensor, BONES[sensor]]).std(dim=0)
    np.testing.assert_allclose(shift, [0.031, 0.012, 0.012], rtol=0.1)
    pelvis = (shapes.levers[:, ROOT, 0] - LEVERS[ROOT, 0]).std(dim=0)
    np.testing.assert_allclose(pelvis, [0.012, 0.03, 0.012], rtol=0.1)
    # Longer legs carry the pelvis further.
    shank, thigh = JOINTS.index("left_knee"), JOINTS.index("left_hip")
    leg = PLACEMENTS.index("left_lower_leg")
    thighs = shapes.levers[:, leg, thigh].norm(dim=-1)
    assert np.corrcoef(thighs, shapes.scale)[0, 1] > 0.6
    assert shapes.scale.std().item() == pytest.approx(0.04 / 2**0.5, rel=0.1)
    assert shank in LEVERS[leg].any(dim=-1).nonzero()
