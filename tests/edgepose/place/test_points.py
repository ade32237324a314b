"""Points of the body that may touch something."""

import numpy as np
import pytest

from edgepose.place.points import NEVER_BELOW, POINTS, BodyPoints
from edgepose.pose import CONTACTS
from edgepose.rotations import rotvec_to_matrix
from edgepose.skeleton import JOINTS, default_body, forward_kinematics, grounded_pelvis_position

STRAIGHT = np.tile(np.eye(3), (24, 1, 1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_are_those_of_forward_kinematics(dtype):
    body = default_body(1.63)
    pose = rotvec_to_matrix(np.random.default_rng(3).normal(0.0, 0.7, (24, 3))).astype(dtype)
    rotations, joints = forward_kinematics(pose, body.offsets)
    expected = joints[[JOINTS.index(name) for name in POINTS]] - joints[0]
    for side in (0, 1):
        expected[side] += rotations[4 + side] @ [0.0, body.offsets[10][1], 0.0]
    points = BodyPoints(body)
    # Twice, because the buffers of a call are those of the next one.
    points.positions(STRAIGHT)
    np.testing.assert_allclose(points.positions(pose), expected, atol=1e-6)


def test_contacts_come_first():
    assert POINTS[: len(CONTACTS)] == CONTACTS


@pytest.mark.parametrize("height_m", [1.2, 1.75, 2.1])
def test_a_wearer_who_stands_straight_stands_on_soles(height_m):
    body = default_body(height_m)
    points = BodyPoints(body)
    positions = points.positions(STRAIGHT)
    clearances = [positions[i][1] - points.skin[i] for i in NEVER_BELOW]
    standing = -grounded_pelvis_position(STRAIGHT, body.offsets)[1]
    assert min(clearances) == pytest.approx(standing, abs=1e-9)
    assert sorted(np.argsort(clearances)[:2]) == [0, 1]
