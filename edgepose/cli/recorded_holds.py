"""The samples of a recording for a calibration, and the hold in it."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path

from edgepose import calibration
from edgepose.calibration import Hold
from edgepose.cli.options.recording_time import RecordingTime
from edgepose.config import SourceConfig
from edgepose.errors import CalibrationError, EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.orientation.stage import OrientationStage
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.sources import Device, open_source
from edgepose.sources.replay import is_recording

_log = logging.getLogger(__name__)

Notify = Callable[[str], None]
"""Shows a line to the user."""

END_S = 0.1
"""Longest time from the last sample of a recording to its end, seconds."""


def read_holds(
    source: SourceConfig, orient: OrientationStage, names: Sequence[str]
) -> tuple[Hold, str | None, Mapping[int, Device]]:
    """Return all samples of a recording or a raw capture, its damage, and the devices that sent them.

    Recordings hold the sensors of the rig with these names, and perhaps further ones.
    """
    path = source.file
    assert path is not None
    if is_recording(path):
        without = [name for name in PLACEMENTS if name not in names]
        recording = read_recording(path, _serial_numbers(source.sensors), salvage=True, without=without)
        orient.names = [name for name in SENSORS if name in recording.sensors and name not in without]
        everything = (
            calibration.hold_from_recording(recording, orient.names)
            if orient.passes
            else calibration.hold_from_samples(orient(list(iter_samples(recording))), orient.names)
        )
        return everything, recording.damage, {}
    orient.names = names
    with open_source(**dataclasses.replace(source, realtime=False).arguments()) as opened:
        everything = calibration.hold_from_samples(
            chain.from_iterable(orient(batch.samples) for batch in opened), names
        )
        return everything, opened.damage, opened.devices


def _serial_numbers(sensors: Path | None) -> Mapping[int, str] | None:
    """Return placements by serial number from a sensor map."""
    if sensors is None:
        return None
    from edgepose.sources.sensor_map import read_map

    return read_map(sensors).serial_numbers()


def hold_in(
    name: str, read: tuple[Hold, str | None], at: RecordingTime | None, seconds: float, notify: Notify
) -> tuple[Hold, Hold, float]:
    """Return the usable sensors of a recording, their hold, and its start on the recording's clock, seconds.

    A sensor besides the six that is silent during the hold is left out. That, and damage, is logged.
    """
    everything, damage = read
    if damage:
        _log.warning("%s", damage)
    first, last = extent(everything)
    six = [sensor for sensor in everything if sensor.name in PLACEMENTS]
    start = calibration.stillest_start(six, seconds) if at is None else at.on_clock(first)
    if at is not None and not first - 1e-6 <= start <= last - seconds + END_S:
        raise EdgeposeError(
            f"{name}: it does not contain {seconds:g} s from {start:g} s on; it lasts from {first:.2f} to "
            f"{last:.2f} s, choose --from and --hold within that"
        )
    why = "" if at is not None else ", the first of the stillest parts"
    notify(f"{name}: hold from {start:.2f} to {start + seconds:.2f} s{why}.")
    hold = calibration.trim(everything, start, start + seconds)
    calibration.check_covered([s for s in hold if s.name in PLACEMENTS], start, start + seconds)
    usable = []
    for sensor in hold:
        try:
            calibration.check_covered([sensor], start, start + seconds)
            usable.append(sensor.name)
        except CalibrationError as error:
            _log.warning("%s; the calibration does without it", error)
    return [s for s in everything if s.name in usable], [s for s in hold if s.name in usable], start


def extent(everything: Hold) -> tuple[float, float]:
    """Return the times of the first and the last sample of all sensors; 0 if there are none."""
    times = [sensor.time_s for sensor in everything if len(sensor.time_s)]
    return min((t.min() for t in times), default=0.0), max((t.max() for t in times), default=0.0)
