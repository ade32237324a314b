"""Recordings, raw captures and CAN logs as a whole, in memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import recording_from_samples
from edgepose.formats.recordings.registry import salvage_recording
from edgepose.imu import ImuSample, Recording
from edgepose.sources import Source, open_source
from edgepose.sources.replay import is_recording
from edgepose.sources.sensor_map import read_map


def read_file(path: Path, protocol: str = "auto", sensors: Path | None = None) -> Recording:
    """Read the good part of a recording, a raw capture or a log of a CAN bus.

    Args:
        path: the file, or the folder of a session.
        protocol: of a capture or a log.
        sensors: map of devices to placements, for captures, logs and sessions.

    Raises:
        EdgeposeError: it cannot be read, or nothing in it is good.
    """
    if is_recording(path):
        return salvage_recording(path, None if sensors is None else read_map(sensors).serial_numbers())
    problems: list[str] = []
    with open_source(file=path, protocol=protocol, sensors=sensors) as source:
        rows = list(_samples(source, problems))
        # File names need not be valid text.
        metadata = {"source": os.fsencode(path.name).decode(errors="replace")} | dict(source.metadata)
    recording = recording_from_samples(rows, metadata, name=str(path), salvage=True)
    problems += [recording.damage] if recording.damage else []
    return recording._replace(damage="; ".join(dict.fromkeys(problems)) or None)


def _samples(source: Source, problems: list[str]) -> Iterator[ImuSample]:
    """Yield the samples of a capture or a log; an error ends them and is added to the problems."""
    try:
        yield from chain.from_iterable(batch.samples for batch in source)
    except EdgeposeError as error:
        problems.append(str(error))
    if source.damage and not any(source.damage in problem for problem in problems):
        problems.append(source.damage)
