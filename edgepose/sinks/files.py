"""Sinks of files by kind, also where the file is a device or a pipe."""

from __future__ import annotations

from collections.abc import Callable

from edgepose.sinks import Sink
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.sinks.spooled import SpooledSink
from edgepose.skeleton import Body
from edgepose.utils.output_targets import is_stream


def csv_sink(
    path: str,
    rotations: str,
    std: bool = False,
    translation: bool = False,
    *,
    overwrite: bool,
    stopped: Callable[[], bool],
) -> Sink:
    """See `CsvSink`."""
    return CsvSink(path, rotations, std, translation, overwrite=overwrite, stopped=stopped)


def npz_sink(
    path: str, rate: float, translation: bool = False, *, overwrite: bool, stopped: Callable[[], bool]
) -> Sink:
    """See `NpzSink`; a device or pipe gets the file when it is whole."""
    if path != "-" and is_stream(path):
        return SpooledSink(path, lambda part: NpzSink(part, rate, translation), stopped)
    return NpzSink(path, rate, translation, overwrite=overwrite)


def bvh_sink(path: str, rate: float, body: Body, *, overwrite: bool, stopped: Callable[[], bool]) -> Sink:
    """See `BvhSink`; a device or pipe gets the file when it is whole."""
    if path != "-" and is_stream(path):
        return SpooledSink(path, lambda part: BvhSink(part, rate, body), stopped)
    return BvhSink(path, rate, body, overwrite=overwrite)
