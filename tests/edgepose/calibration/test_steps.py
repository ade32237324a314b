"""Headings from some steps straight ahead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration import SensorHold, WeakMotionError
from edgepose.errors import CalibrationError
from edgepose.formats.recordings.registry import read_recording
from tests.support.walkers import HEADINGS, WALK_S, walker

REAL = Path(__file__).parents[2] / "data" / "real" / "mtw-walk.npz"


def upright(moving: list[SensorHold]) -> np.ndarray:
    return np.stack([sensor.quat[0] for sensor in moving])


def apart_deg(offset: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.degrees(np.angle(np.exp(1j * (offset - wanted))))


def test_steps_of_a_simulated_wearer():
    moving = walker()
    reset = cal.headings_from_steps(moving, upright(moving))
    assert np.abs(apart_deg(reset.offset, -HEADINGS)).max() < 1.5
    assert reset.error_deg.max() < 6.0
    assert reset.warnings == []


def test_steps_of_a_real_wearer():
    """The sensors share a north, but that of the right forearm is disturbed, as is that of the hand."""
    everything = cal.hold_from_recording(read_recording(REAL))
    straight = cal.check_hold(cal.trim(everything, 1.0, 5.0)).orientation
    turned = [
        s._replace(quat=rot.quat_multiply(rot.quat_about_z(heading), s.quat))
        for s, heading in zip(everything, HEADINGS, strict=True)
    ]
    straight = rot.quat_multiply(rot.quat_about_z(HEADINGS), straight)
    reset = cal.headings_from_steps(cal.trim(turned, 3.0, 9.5), straight, must_stop=False)
    forward = np.angle(np.mean(np.exp(1j * (reset.offset + HEADINGS))))
    error_deg = np.abs(apart_deg(reset.offset + HEADINGS, forward))
    assert error_deg.mean() < 5.0
    assert np.delete(error_deg, 1).max() < 6.0
    assert error_deg[1] < 12.0
    assert reset.warnings[0] == "the wearer did not stand still after the steps: headings are less certain"
    with pytest.raises(WeakMotionError, match="did not stand still after the steps"):
        cal.headings_from_steps(cal.trim(turned, 3.0, 9.5), straight)


@pytest.mark.parametrize(
    ("wearer", "text"),
    [
        ({"distance_m": 0.2}, r"the distance of 0\.2 m is too short; .* two or three calm steps"),
        ({"distance_m": -1.4}, "the wearer walked backwards"),
        ({"turn_deg": 40.0}, "the wearer turned by 40 deg"),
        ({"stand_s": (0.0, 2.0)}, "did not stand still before the steps"),
        ({"stand_s": (2.0, 0.0)}, "did not stand still after the steps"),
        ({"lifted_deg": 40.0}, r"another pose after them: right_forearm \(40 deg\)"),
        (
            {"drift": 3.0},
            r"the displacement of left_forearm \(.*\) does not fit the others \(in m: .*\); let",
        ),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_refused_steps(wearer, text):
    moving = walker(**wearer)
    with pytest.raises(WeakMotionError, match=text):
        cal.headings_from_steps(moving, upright(walker()))


@pytest.mark.parametrize(
    "silent_s", [(1.8, 5.2), (0.5, 6.5), (0.3, 1.99), (5.05, 6.9)], ids=["walk", "most", "stand", "end"]
)
def test_a_sensor_that_is_silent_beyond_an_edge_of_the_steps_is_refused(silent_s):
    moving = walker()
    sends = (moving[3].time_s < silent_s[0]) | (moving[3].time_s > silent_s[1])
    upright_before = upright(moving)
    moving[3] = SensorHold(*(column[sends] for column in moving[3][:-1]), moving[3].name)
    with pytest.raises(CalibrationError, match="silent during the steps: right_lower_leg for"):
        cal.headings_from_steps(moving, upright_before)


def test_rounded_times_do_not_reach_beyond_the_samples():
    """The end of this recording is a rounding error before that of the last interval looked at."""
    moving = [
        SensorHold(*(column[:208] for column in s._replace(time_s=0.1 + s.time_s)[:-1]), s.name)
        for s in walker()
    ]
    with pytest.raises(WeakMotionError, match=r"the distance of 0\.0 m is too short"):
        cal.headings_from_steps(moving, upright(moving))


def test_lost_samples_are_refused():
    moving = walker()
    during = moving[3].time_s < 2.0 + WALK_S / 2
    later = moving[3].time_s > 2.3 + WALK_S / 2
    moving[3] = SensorHold(*(column[during | later] for column in moving[3][:-1]), moving[3].name)
    with pytest.raises(CalibrationError, match=r"silent during the steps: right_lower_leg for 0\.3\d s"):
        cal.headings_from_steps(moving, upright(moving))
    moving[3] = moving[3]._replace(acc=np.full_like(moving[3].acc, np.nan))
    with pytest.raises(CalibrationError, match="no acceleration from right_lower_leg"):
        cal.headings_from_steps(moving, upright(moving))
