import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.analysis import metrics
from edgepose.skeleton import PARENTS, PREDICTED, UNOBSERVED

OFFSETS = np.random.default_rng(1).normal(size=(24, 3)) * 0.2


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return Rotation.random(count * 24, random_state=rng).as_matrix().reshape(count, 24, 3, 3)


def root_aligned_by_scipy(pose: np.ndarray) -> tuple[list[Rotation], np.ndarray]:
    """Global rotations and positions, relative to the pelvis, one joint after the other."""
    turns, places = [Rotation.from_matrix(pose[0])], [OFFSETS[0]]
    for j in range(1, 24):
        parent = PARENTS[j]
        turns.append(turns[parent] * Rotation.from_matrix(pose[j]))
        places.append(places[parent] + turns[parent].apply(OFFSETS[j]))
    back = turns[0].inv()
    return [back * turn for turn in turns], back.apply(np.array(places) - places[0])


@pytest.mark.parametrize(
    ("joints", "function"),
    [
        ((1, 2, 16, 17), metrics.sip_error),
        (PREDICTED, metrics.joint_angle_error),
        (UNOBSERVED, lambda p, t: metrics.joint_angle_error(p, t, UNOBSERVED)),
    ],
)
def test_angles_against_scipy(joints, function):
    predicted, true = random_poses(5, 2), random_poses(5, 3)
    expected = []
    for p, t in zip(predicted, true, strict=True):
        a, b = root_aligned_by_scipy(p)[0], root_aligned_by_scipy(t)[0]
        expected.append(np.mean([np.rad2deg((a[j].inv() * b[j]).magnitude()) for j in joints]))
    np.testing.assert_allclose(function(predicted, true), expected)


def test_positions_against_scipy():
    predicted, true = random_poses(5, 2), random_poses(5, 3)
    expected = []
    for p, t in zip(predicted, true, strict=True):
        a, b = root_aligned_by_scipy(p)[1], root_aligned_by_scipy(t)[1]
        expected.append(100 * np.linalg.norm(a - b, axis=1).mean())
    np.testing.assert_allclose(metrics.position_error(predicted, true, OFFSETS), expected)


def test_known_turns_give_known_angles():
    true = np.tile(np.eye(3), (3, 24, 1, 1))
    predicted = true.copy()
    predicted[:, 16] = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    # The left shoulder is one of four; it takes the elbow along, one of fifteen, whose bone has a sensor.
    np.testing.assert_allclose(metrics.sip_error(predicted, true), 20 / 4)
    np.testing.assert_allclose(metrics.joint_angle_error(predicted, true), 2 * 20 / 15)
    np.testing.assert_allclose(metrics.joint_angle_error(predicted, true, UNOBSERVED), 20 / 10)


def test_root_does_not_count():
    true = random_poses(4, 5)
    turned = true.copy()
    turned[:, 0] = random_poses(4, 6)[:, 0]
    assert metrics.sip_error(turned, true).max() < 1e-5
    assert metrics.position_error(turned, true, OFFSETS).max() < 1e-9


def test_jitter_of_a_known_motion():
    # A bone of 1 m that turns at w rad/s has a jerk of w^3 m/s^3 at its end and none elsewhere.
    rate, w = 1000.0, 2.0
    offsets = np.zeros((24, 3))
    offsets[15] = [1.0, 0.0, 0.0]  # The head; 12, its parent, turns.
    local = np.tile(np.eye(3), (50, 24, 1, 1))
    local[:, 12] = Rotation.from_rotvec(np.outer(np.arange(50) * w / rate, [0, 0, 1])).as_matrix()
    values = metrics.jitter(local, offsets, rate)
    assert values.shape == (47,)
    np.testing.assert_allclose(values, w**3 / 1000 / 24, rtol=1e-3)


def test_summary_and_table():
    predicted, true = random_poses(6, 7), random_poses(6, 8)
    result = metrics.summary(predicted, true, OFFSETS, 60.0)
    assert list(result) == list(metrics.LABELS)
    values = metrics.sip_error(predicted, true)
    assert result["sip_error_deg"] == pytest.approx((values.mean(), values.std(), 6))
    assert result["jitter_km_s3"].frames == 3
    table = metrics.format_table({"BiRNN": result, "SIP": metrics.summary(true, true, OFFSETS, 60.0)})
    head, birnn, sip, note = table.splitlines()
    assert head.split("  ")[0] == "method"
    assert all(heading in head and len(heading) <= 16 for heading in metrics.HEADINGS.values())
    assert len({len(line) for line in (head, birnn, sip)}) == 1
    assert len(head) <= 110
    assert birnn.split("  ")[1].strip() == f"{values.mean():.2f} ± {values.std():.2f}"
    assert sip.split()[:4] == ["SIP", "0.00", "±", "0.00"]
    assert note.startswith("mean ± deviation over 6 frames; ")


def test_table_of_unlike_methods():
    long, short = metrics.summary(random_poses(6, 7), random_poses(6, 8), OFFSETS, 60.0), {}
    short["sip_error_deg"] = metrics.measure([1.0, 3.0])
    head, first, second, note = metrics.format_table({"a method": long, "b": short}).splitlines()
    assert head.split()[-1] == "frames"
    assert first.split()[-1] == "6"
    assert second.split() == ["b", "2.00", "±", "1.00", "-", "-", "-", "-", "-", "2"]
    assert note.startswith("mean ± deviation; ")
    assert list(metrics.HEADINGS) == list(metrics.LABELS)


def test_too_short_for_jitter():
    result = metrics.summary(random_poses(3, 1), random_poses(3, 2), OFFSETS, 60.0)
    assert result["jitter_km_s3"].frames == 0
    assert np.isnan(result["jitter_km_s3"].mean)


def test_different_lengths_are_refused():
    with pytest.raises(ValueError, match="expected two"):
        metrics.sip_error(random_poses(1, 1), random_poses(5, 1))
