"""A network's poses as the prior: what they and the accelerations say together."""

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.analysis import metrics
from edgepose.placements import BONES, PLACEMENTS
from edgepose.pose import CONTACTS
from edgepose.sip.bodies import sensor_points
from edgepose.sip.energy import WITH_NETWORK, second_difference
from edgepose.sip.measurements import Measurements
from edgepose.sip.network_prior import NetworkPrior, missing_for_network
from edgepose.sip.parameterisation import network_rig
from edgepose.sip.prior import load_prior
from edgepose.sip.residuals import concatenate
from edgepose.sip.solve import Settings, solve
from edgepose.sip.translation import pelvis_path
from edgepose.skeleton import default_body, forward_kinematics, global_rotations, standing_pelvis_position

BODY = default_body()
JOINTS = np.array([1, 2, 3, 6, 9, 12, 13, 14, 16, 17])
FRAMES = 240
T = np.arange(FRAMES) / 60.0


def walker():
    """Legs that swing by 25 degrees while a foot stands, and the path of the pelvis: rotations, positions."""
    angles = np.zeros((FRAMES, 24, 3))
    swing = np.sin(2.0 * np.pi * T)
    angles[:, 1, 0], angles[:, 2, 0] = -0.45 * swing, 0.45 * swing
    angles[:, 16, 2], angles[:, 17, 2] = -1.2, 1.2
    local = rot.rotvec_to_matrix(angles)
    joints = forward_kinematics(local, BODY.offsets)[1]
    foot = np.where(np.diff(swing, append=swing[-1]) > 0.0, 7, 8)  # the one that moves back
    steps = -np.diff(joints, axis=0)[np.arange(FRAMES - 1), foot[:-1]]
    start = standing_pelvis_position(BODY.offsets)
    return local, start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), foot


def measured(local, path):
    points = sensor_points(BODY, PLACEMENTS)
    rotations, joints = forward_kinematics(local, points.offsets, path)
    bones = rotations[:, points.bones]
    places = joints[:, points.bones] + np.einsum("tsij,sj->tsi", bones, points.points)
    valid = np.ones((FRAMES, 6), bool)
    valid[[0, -1]] = False
    return Measurements(PLACEMENTS, T, 60.0, bones, second_difference(places, 60.0), valid, ~valid)


def expected(local, deviation, place=None):
    orientation = global_rotations(local)[:, JOINTS]
    return NetworkPrior(JOINTS, local, orientation, np.sqrt(3.0) / deviation * np.ones((FRAMES, 10)), place)


def solved(measurements, network, method="sip"):
    points = sensor_points(BODY, PLACEMENTS)
    rig = network_rig(load_prior(), BONES)
    return concatenate(list(solve(measurements, Settings(method, rig, points, WITH_NETWORK, 30, network))))


def test_accelerations_mend_what_the_network_is_unsure_of():
    local, path, _ = walker()
    errors = np.zeros((FRAMES, 24, 3))
    errors[:, 1:3, 0] = 0.2 * np.sin(4.0 * np.pi * T)[:, None]  # 11 degrees, at 2 Hz
    wrong = rot.rotvec_to_matrix(errors) @ local
    # The shanks are measured, so a network's knees undo the errors of the hips.
    wrong[:, 4:6] = rot.rotvec_to_matrix(-errors[:, 1:3])
    before = metrics.sip_error(wrong, local).mean()
    assert before == pytest.approx(3.6, abs=0.3)
    measurements = measured(local, path)
    unsure = solved(measurements, expected(wrong, 0.2))
    assert metrics.sip_error(unsure.rotations, local).mean() < 0.2 * before
    sure = solved(measurements, expected(wrong, 0.005))
    hips = [global_rotations(r)[:, [1, 2]] for r in (sure.rotations, wrong)]
    assert np.degrees(rot.geodesic_angle(*hips)).mean() < 0.6


@pytest.mark.parametrize("method", ["sop", "sip"])
def test_right_poses_stay_and_extremities_rest(method):
    local, path, _ = walker()
    solution = solved(measured(local, path), expected(local, 0.2), method)
    assert metrics.sip_error(solution.rotations, local).max() < 0.1
    at_rest = np.tile(np.eye(3), (FRAMES, 2, 1, 1))
    np.testing.assert_allclose(solution.rotations[:, [10, 22]], at_rest, atol=1e-6)


def test_contacts_make_the_path():
    local, path, foot = walker()
    place = np.zeros((FRAMES, len(CONTACTS) + 3))
    place[np.arange(FRAMES), foot - 7] = 1.0
    # The velocity head is wrong by half: contacts count more.
    place[:, 7:] = 0.5 * np.gradient(path, 1.0 / 60.0, axis=0)
    solution = solved(measured(local, path), expected(local, 0.2, place))
    found = pelvis_path(solution, BODY.offsets, 60.0, place)
    way = np.linalg.norm(path[-1] - path[0])
    assert way > 2.0
    assert np.linalg.norm((found.translation - path)[-1]) < 0.05 * way
    np.testing.assert_array_equal(found.contacts, place[:, :7].astype(np.float32))
    assert pelvis_path(solution, BODY.offsets, 60.0).contacts is None


def test_standing_on_biased_sensors_moves_nothing():
    local = np.tile(np.eye(3), (FRAMES, 24, 1, 1))
    place = np.zeros((FRAMES, 10))
    place[:, :4] = 1.0
    place[:, 9] = 0.05  # m/s
    solution = solved(measured(local, np.zeros((FRAMES, 3))), expected(local, 0.1, place))
    biased = solution._replace(acceleration=solution.acceleration + np.array([0.1, -0.2, 0.1]))
    found = pelvis_path(biased, BODY.offsets, 60.0, place).translation
    assert np.abs(found - standing_pelvis_position(BODY.offsets)).max() < 0.02


def test_parts_of_a_prior_and_missing_sensors():
    local, path, _ = walker()
    part = expected(local, 0.1, np.arange(10.0 * FRAMES).reshape(FRAMES, 10)).part(slice(5, 9))
    assert [len(column) for column in part[1:]] == [4] * 4
    assert part.place[0, 0] == 50.0
    measurements = measured(local, path)
    assert missing_for_network(measurements) == []
    measurements.valid[:, 2] = False
    assert missing_for_network(measurements) == ["left_lower_leg"]
    assert missing_for_network(measurements._replace(names=("chest", *PLACEMENTS[1:]))) == [
        "left_forearm",
        "left_lower_leg",
    ]
