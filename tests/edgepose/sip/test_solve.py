"""Whole recordings: poses that are known, sensors that fail, chunks, processes."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.analysis import metrics
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS, SITES
from edgepose.sip import residuals as report
from edgepose.sip import solve as module
from edgepose.sip.bodies import sensor_points
from edgepose.sip.energy import Weights, second_difference
from edgepose.sip.measurements import Measurements
from edgepose.sip.parameterisation import hinge_rig, smpl_rig
from edgepose.sip.prior import load_prior
from edgepose.sip.solve import Settings, chunks, solve
from edgepose.sip.translation import pelvis_path
from edgepose.skeleton import default_body, forward_kinematics, global_rotations, local_from_global
from edgepose_export.mocap import read_motion, resample

CLIP = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
BODY = default_body()


@pytest.fixture(scope="module")
def motion():
    """Four seconds of walking that the prior has not seen: local rotations and the pelvis' path."""
    whole = resample(read_motion(CLIP), 60.0)
    return local_from_global(whole.rotations)[60:300], whole.translation[60:300] - whole.translation[60]


def measured(motion, names=PLACEMENTS, noise=0.0):
    """What sensors on the default body measure."""
    local, path = motion
    points = sensor_points(BODY, names)
    rotations, joints = forward_kinematics(local, points.offsets, path)
    bones = rotations[:, points.bones]
    places = joints[:, points.bones] + np.einsum("tsij,sj->tsi", bones, points.points)
    rng = np.random.default_rng(4)
    shape = places.shape
    valid = np.ones(shape[:2], bool)
    valid[[0, -1]] = False
    return Measurements(
        tuple(names),
        np.arange(len(local)) / 60.0,
        60.0,
        bones @ rot.rotvec_to_matrix(np.deg2rad(noise) * rng.normal(size=(1, *shape[1:]))),
        second_difference(places, 60.0) + 0.1 * noise * rng.normal(size=shape),
        valid,
        np.zeros(shape[:2], bool),
    )


def settings(names=PLACEMENTS, method="sip", hinges=False, weights=None, evaluations=30):
    points = sensor_points(BODY, names)
    prior = load_prior()
    rig = hinge_rig(prior) if hinges else smpl_rig(prior, points.bones)
    return Settings(method, rig, points, weights or Weights(), evaluations)


def solved(measurements, **words):
    how = settings(measurements.names, **words)
    return report.concatenate(list(solve(measurements, how)))


def test_dense_sensors_without_noise_give_the_poses_back(motion):
    local, path = (column[:60] for column in motion)
    exact = Weights(mahal=1e-8, limits=0.0)
    solution = solved(measured((local, path), tuple(SITES)), weights=exact)
    # Spine joints between two sensors share one turn as the prior likes; all bones with a sensor are found.
    estimate, truth = (global_rotations(r) for r in (solution.rotations, local))
    bones = list(SITES.values())
    assert np.degrees(rot.geodesic_angle(estimate[:, bones], truth[:, bones])).max() < 0.1
    limbs = [1, 2, 4, 5, 13, 14, 16, 17, 18, 19]
    assert np.degrees(rot.geodesic_angle(solution.rotations[:, limbs], local[:, limbs])).max() < 0.1


@pytest.fixture(scope="module")
def noisy(motion):
    """The same with six sensors and noise, by each method."""
    measurements = measured(motion, noise=1.0)
    return {
        "sop": solved(measurements, method="sop"),
        "sip": solved(measurements),
        "hinges": solved(measurements, hinges=True),
    }


def test_acceleration_tells_what_orientation_does_not(motion, noisy):
    """SIP's table 2: SIP is best, then SIP-M, then SOP."""
    errors = {name: metrics.sip_error(s.rotations, motion[0]).mean() for name, s in noisy.items()}
    assert errors["sip"] < 0.8 * errors["hinges"] < 0.9 * errors["sop"]
    assert errors["sip"] < 12.0
    places = {
        name: metrics.position_error(s.rotations, motion[0], BODY.offsets).mean() for name, s in noisy.items()
    }
    assert places["sip"] < 0.8 * places["sop"]


def test_hinges_bend_about_one_axis(noisy):
    knees = rot.matrix_to_rotvec(noisy["hinges"].rotations[:, [4, 5]])
    assert np.abs(knees[..., 0]).max() > 0.3
    np.testing.assert_allclose(knees[..., 1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(noisy["hinges"].rotations[:, 3], np.eye(3)[None].repeat(240, 0), atol=1e-12)


def test_the_path_follows_the_walker(motion, noisy):
    path = motion[1]
    found = pelvis_path(noisy["sip"], BODY.offsets, 60.0).translation
    way = np.linalg.norm(path[-1] - path[0])
    assert way > 2.5
    moved = found - found[0]
    assert np.linalg.norm(moved[-1] - path[-1]) < 0.25 * way
    assert np.abs(moved[:, 1] - path[:, 1]).max() < 0.06
    assert found[0, 1] == pytest.approx(0.97, abs=0.1)  # the pelvis of someone who stands


def test_a_still_wearer_stays_where_they_are(motion):
    local, path = motion
    still = np.repeat(local[:1], 120, axis=0), np.repeat(path[:1], 120, axis=0)
    found = pelvis_path(solved(measured(still)), BODY.offsets, 60.0).translation
    assert np.linalg.norm(found - found[0], axis=1).max() < 0.02


# --- sensors that fail --------------------------------------------------------------------------------------


def test_a_sensor_that_is_missing_for_a_while(motion, noisy):
    measurements = measured(motion, noise=1.0)
    gone = slice(100, 130)
    valid, held = measurements.valid.copy(), measurements.held.copy()
    orientation, acceleration = measurements.orientation.copy(), measurements.acceleration.copy()
    valid[gone.start - 1 : gone.stop + 1, 2], held[gone, 2] = False, True
    acceleration[gone, 2] = 1e3  # must not count
    share = np.linspace(0.0, 1.0, 32)[1:-1]
    ends = rot.matrix_to_quat(orientation[[99, 130], 2])
    orientation[gone, 2] = rot.quat_to_matrix(rot.slerp(ends[0], ends[1], share))
    solution = solved(
        measurements._replace(valid=valid, held=held, orientation=orientation, acceleration=acceleration)
    )
    errors = metrics.sip_error(solution.rotations, motion[0])
    before = metrics.sip_error(noisy["sip"].rotations, motion[0])
    outside = np.r_[0:90, 140:240]
    assert errors[outside].mean() < before[outside].mean() + 1.0
    assert errors[gone].mean() < 25.0
    assert not report.misfits(solution, measurements)
    lines = report.table(solution, measurements._replace(held=held)).splitlines()
    assert lines[4].split()[0] == "left_lower_leg"
    assert lines[4].split()[-1] == "30"


def test_no_acceleration_at_all_is_what_orientation_says(motion):
    measurements = measured(motion, noise=1.0)
    blind = measurements._replace(valid=np.zeros_like(measurements.valid))
    sip, sop = solved(blind), solved(measurements, method="sop")
    assert np.degrees(rot.geodesic_angle(sip.rotations, sop.rotations)).max() < 0.5
    assert np.isnan(sip.acceleration).all()
    assert np.isfinite(pelvis_path(sip, BODY.offsets, 60.0).translation).all()


def test_swapped_sensors_are_told(motion):
    measurements = measured(motion, noise=1.0)
    order = [2, 1, 0, 3, 4, 5]  # left forearm and left lower leg
    swapped = measurements._replace(
        orientation=measurements.orientation[:, order], acceleration=measurements.acceleration[:, order]
    )
    assert not report.misfits(solved(measurements), measurements)
    told = report.misfits(solved(swapped), swapped)
    assert told
    assert all("check that it is worn where its name says" in line for line in told)
    assert {line.split()[0] for line in told} & {"left_forearm", "left_lower_leg"}


@pytest.mark.parametrize("names", [("left_forearm", "right_lower_leg", "head"), PLACEMENTS[:5], tuple(SITES)])
@pytest.mark.parametrize("frames", [1, 2, 3, 61])
def test_any_sensors_and_any_number_of_frames(motion, names, frames):
    local, path = motion
    measurements = measured((local[:frames], path[:frames]), names)
    valid = measurements.valid.copy()
    valid[[0, -1]] = False
    solution = solved(measurements._replace(valid=valid))
    assert solution.rotations.shape == (frames, 24, 3, 3)
    estimate = global_rotations(solution.rotations)[:, measurements.bones]
    angles = np.degrees(rot.geodesic_angle(estimate, measurements.orientation))
    assert angles.max() < 25.0
    assert pelvis_path(solution, BODY.offsets, 60.0).translation.shape == (frames, 3)


def test_no_frame_is_an_error(motion):
    empty = measured((motion[0][:3], motion[1][:3]))
    empty = empty._replace(**{k: getattr(empty, k)[:0] for k in empty._fields if k not in ("names", "rate")})
    with pytest.raises(EdgeposeError, match="no frame in which all sensors report"):
        list(solve(empty, settings()))


def test_headings_do_not_matter(motion):
    """Exponential coordinates of the pelvis are singular at a full turn; no heading comes near."""
    turns = rot.rotation_about_axis("y", np.linspace(0.0, 4.0 * np.pi, len(motion[0])))
    orientation = measured(motion).orientation
    measurements = measured(motion)._replace(orientation=turns[:, None] @ orientation)
    measurements = measurements._replace(valid=np.zeros_like(measurements.valid))
    spun = solved(measurements)
    plain = solved(measured(motion)._replace(valid=measurements.valid))
    assert np.degrees(rot.geodesic_angle(spun.rotations[:, 1:], plain.rotations[:, 1:])).max() < 0.5
    assert np.degrees(rot.geodesic_angle(spun.rotations[:, 0], turns @ plain.rotations[:, 0])).max() < 0.5


# --- chunks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [0, 1, 59, 60, 61, 900, 901, 1740, 1741, 100_000])
def test_chunks_cover_all_frames_and_overlap(frames):
    parts = chunks(frames)
    assert parts[0].start == 0
    assert parts[-1].stop == frames
    for before, after in pairwise(parts):
        assert before.stop - after.start == module.OVERLAP
    assert max(part.stop - part.start for part in parts) <= module.CHUNK


def test_chunks_and_processes_give_the_poses_of_the_whole(motion, noisy, monkeypatch):
    monkeypatch.setattr(module, "CHUNK", 140)
    measurements = measured(motion, noise=1.0)
    seen = []
    parts = list(solve(measurements, settings(), 1, lambda *args: seen.append(args)))
    assert len(parts) == 3
    together = report.concatenate(parts)
    assert together.rotations.shape == (240, 24, 3, 3)
    angles = np.degrees(rot.geodesic_angle(together.rotations, noisy["sip"].rotations))
    assert angles.mean() < 1.0
    steps = np.degrees(rot.geodesic_angle(together.rotations[1:], together.rotations[:-1]))
    whole = np.degrees(rot.geodesic_angle(noisy["sip"].rotations[1:], noisy["sip"].rotations[:-1]))
    assert steps.max() < whole.max() + 1.0  # no jump where chunks meet
    assert {args[0] for args in seen} == {1, 2, 3}
    assert {args[1] for args in seen} == {3}
    others = report.concatenate(list(solve(measurements, settings(), jobs=2)))
    np.testing.assert_allclose(others.rotations, together.rotations, atol=1e-9)


def test_the_search_ends_where_it_is_told(motion):
    seen = []
    list(solve(measured(motion, noise=1.0), settings(evaluations=3), 1, lambda *args: seen.append(args)))
    costs = [cost for _, _, _, cost in seen]
    assert len(costs) <= 15 + 2
    assert costs[-1] < costs[-2]
