"""Stretches of recordings."""

from __future__ import annotations

from pathlib import Path

from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData


def part(recording: Recording, start_s: float, end_s: float) -> Recording:
    """A stretch of a recording."""

    def cut(data: SensorData) -> SensorData:
        rows = (data.time_s >= start_s) & (data.time_s < end_s)
        return SensorData(*(None if column is None else column[rows] for column in data))

    return Recording({name: cut(data) for name, data in recording.sensors.items()}, recording.metadata)


def write_part(file: Path, start_s: float, end_s: float, out: Path) -> Path:
    """Writes a stretch of a recording to a file of its own."""
    write_npz(out, part(read_recording(file), start_s, end_s))
    return out
