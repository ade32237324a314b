"""Inputs of `edgepose solve`: a recording of any sensors with orientations, and the sensors' mounting."""

from __future__ import annotations

from pathlib import Path

from edgepose.calibration import Calibration
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.registry import read_sensors
from edgepose.imu import Recording
from edgepose.placements import SITES
from edgepose.sip.measurements import SensorMount, mounts, mounts_from_hold
from edgepose.sources.replay import is_recording
from edgepose.sources.whole_file import read_file

DEFAULT_HOLD_S = 4.0


def read(path: Path, calibration: Calibration) -> Recording:
    """Read the sensors of a file, any of SITES, with orientations from the calibration's filter.

    Raw captures and logs of CAN buses hold the six placements; their protocol is detected.

    Raises:
        EdgeposeError: no such recording, or it allows no orientations.
    """
    recording = read_sensors(path, tuple(SITES)) if is_recording(path) else read_file(path)
    if not recording.sensors:
        raise EdgeposeError(f"{path}: the recording has no samples")
    if calibration.filter == "none":
        return recording
    others = [name for name in recording.sensors if name not in calibration.sensors]
    if others:
        raise EdgeposeError(
            f"{path}: the calibration was made with --filter {calibration.filter}, without "
            f"{', '.join(others)}: calibrate again with all sensors, or use orientations that they send"
        )
    from edgepose.orientation import OrientationEstimator

    orienter = OrientationEstimator(calibration.filter, magnetometer=calibration.north)
    oriented = recording_from_samples(
        orienter.orient(list(iter_samples(recording))), recording.metadata, name=str(path)
    )
    return oriented._replace(damage=recording.damage)


def mounted(
    path: Path, recording: Recording, calibration: Calibration, hold_from_s: float | None
) -> dict[str, SensorMount]:
    """Return the mounting of each sensor of a recording, by name.

    Mountings of sensors that the calibration does not know come from its pose,
    which the wearer holds in this recording: at `hold_from_s` on its clock, or, if the calibration was made
    from this very file, at the time of its hold.

    Raises:
        EdgeposeError: the time of the hold is unknown, or a sensor has too few samples in it.
    """
    known = {name: mount for name, mount in mounts(calibration).items() if name in recording.sensors}
    others = [name for name in recording.sensors if name not in known]
    if not others:
        return known
    about = calibration.metadata
    seconds = _number(about.get("hold_s")) or DEFAULT_HOLD_S
    start = hold_from_s
    if start is None and about.get("source") == str(path):
        start = _number(about.get("from_s"))
    if start is None:
        raise EdgeposeError(
            f"{path}: the calibration does not know {', '.join(others)}; say with --hold-from when the "
            f"wearer starts to hold its {calibration.pose} pose in this recording"
        )
    return known | mounts_from_hold(recording, calibration, others, start, start + seconds)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
