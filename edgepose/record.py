"""Recording of live samples, bytes or CAN frames to a file; a power cut loses at most the last second.

Formats that cannot be written piece by piece are written to a journal next to the file first: `walk.npz` to
`walk.part.csv`, `walk.blf` to `walk.part.log`. A journal is itself a recording that all commands read.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, Literal, NamedTuple, TextIO, cast

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.csv import csv_header, csv_row
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.raw_capture import times_header, times_path, times_row
from edgepose.formats.recordings.registry import salvage_recording
from edgepose.imu import ImuSample
from edgepose.placements import SENSORS
from edgepose.sinks.output_files import check_output
from edgepose.sources import Batch, Source
from edgepose.sources.replay import CAPTURES
from edgepose.utils.durable_files import replace_file
from edgepose.utils.growing_files import DurableAppender

CAN_LOGS = (".asc", ".blf", ".log")
"""Endings of the CAN logs that can be written; .trc is missing: python-can would drop the CAN FD frames."""

_JOURNALS = {".npz": ".part.csv", ".asc": ".part.log", ".blf": ".part.log"}


class Output(NamedTuple):
    """A recording in progress.

    Attributes:
        files: the growing files.
        samples: writes the samples of a batch.
        raw: writes data of a line: arrival in Unix time, seconds, and bytes or a CAN message.
        finish: called once the files are closed, if anything was written.
    """

    files: list[DurableAppender]
    samples: Callable[[list[ImuSample]], None]
    raw: Callable[[float, Any], None]
    finish: Callable[[], None]


@dataclass
class RecordSummary:
    """Counts of a recording.

    Attributes:
        samples: number of samples of each sensor, in the order of SENSORS.
        seconds: time on the source's clock since the first sample.
        error: the error that ended the recording early, if any.
    """

    samples: list[int] = field(default_factory=lambda: [0] * len(SENSORS))
    seconds: float = 0.0
    error: EdgeposeError | None = None


def kind(path: str) -> Literal["samples", "port", "bus"]:
    """Return what a recording of this name holds: samples, or the raw data of a port or of a bus.

    Raises:
        EdgeposeError: unknown ending.
    """
    suffix = Path(path).suffix.lower()
    if suffix in CAPTURES:
        return "port"
    if suffix in CAN_LOGS:
        return "bus"
    if suffix in (".csv", ".npz") or path == "-":
        return "samples"
    raise EdgeposeError(
        f"{path}: unknown kind of recording; names end in .csv or .npz (samples), {' or '.join(CAPTURES)} "
        f"(bytes of a port), {', '.join(CAN_LOGS)} (frames of a CAN bus)"
    )


def growing(path: str) -> Path | None:
    """Return the journal of a recording; None if the recording itself grows."""
    journal = None if path == "-" else _journal(Path(path))
    return None if journal == Path(path) else journal


def check_free(path: str, overwrite: bool) -> None:
    """Check that no existing recording would be lost.

    Args:
        path: the new recording.
        overwrite: whether an existing recording may be replaced.

    Raises:
        EdgeposeError: the recording or its journal exists already, or cannot be written.
    """
    if path == "-":
        return
    target, journal = Path(path), _journal(Path(path))
    companions = [times_path(target)] if kind(path) == "port" else []
    for file in (target, *companions):
        check_output(file, "the recording", (*CAPTURES, *CAN_LOGS, ".csv", ".npz", ".times"), overwrite)
    if journal != target and os.path.lexists(journal) and not overwrite:
        to = "npz" if target.suffix.lower() == ".npz" else "csv"
        raise EdgeposeError(
            f"{journal} is left from a recording that was cut short; convert it with  edgepose convert "
            f"{journal} --to {to} --out DIR  and delete it, or give --overwrite"
        )


def open_output(path: str, metadata: Mapping[str, str], overwrite: bool = True) -> Output:
    """Start a recording; its file appears with the first samples.

    Args:
        path: file to write, whose name determines the content, see `kind`; "-" is CSV on standard output.
        metadata: written to the file if the format can hold it.
        overwrite: whether an existing recording may be replaced.

    Raises:
        EdgeposeError: the file cannot be written.
    """
    content = kind(path)
    if content == "port":
        return _open_capture(Path(path), metadata, overwrite)
    if content == "bus":
        return _open_can_log(Path(path), overwrite)
    return _open_samples(path, metadata, overwrite)


def record(
    source: Source,
    output: Output,
    seconds: float = inf,
    on_batch: Callable[[RecordSummary], None] = lambda summary: None,
    stopped: Callable[[], bool] = lambda: False,
) -> RecordSummary:
    """Record a source to its end, for some seconds, or until `stopped`.

    Everything that came before an error or the stop is written. The summary keeps an error for the caller to
    report.

    Args:
        source: the source to record.
        output: the recording, closed at the end. If no data came, no file appears and none is replaced.
        seconds: length of the recording on the source's clock.
        on_batch: called after each batch.
        stopped: called after each batch; true ends the recording.
    """
    summary = RecordSummary()
    start_s = None
    written = False
    try:
        for batch in source:
            written |= _write(output, batch)
            for sample in batch.samples:
                summary.samples[sample.sensor] += 1
            if start_s is None and batch.samples:
                start_s = batch.samples[0].time_s
            summary.seconds = 0.0 if start_s is None else max(0.0, batch.now_s - start_s)
            on_batch(summary)
            if summary.seconds >= seconds or stopped():
                break
    except EdgeposeError as error:
        summary.error = error
    finally:
        for file in output.files:
            try:
                file.close()
            except EdgeposeError as error:
                summary.error = summary.error or error
    if not written:
        return summary
    try:
        output.finish()
    except EdgeposeError as error:
        summary.error = summary.error or error
    return summary


def _write(output: Output, batch: Batch) -> bool:
    """Write a batch; return whether it held anything to write."""
    if batch.samples:
        output.samples(batch.samples)
    for arrival_s, piece in batch.raw:
        output.raw(arrival_s, piece)
    return bool(batch.samples or (batch.raw and output.raw is not _ignore))


# --- kinds of recordings ------------------------------------------------------------------------------------


def _open_samples(path: str, metadata: Mapping[str, str], overwrite: bool) -> Output:
    journal = path if path == "-" else str(_journal(Path(path)))
    header = csv_header(metadata).encode()
    file = DurableAppender(journal, "samples", header, overwrite=overwrite, follow=journal == path)

    def write(samples: list[ImuSample]) -> None:
        file.add("".join(map(csv_row, samples)).encode())

    def finish() -> None:
        if journal != path:
            _convert_journal(
                Path(path), Path(journal), lambda part: write_npz(part, salvage_recording(journal)), overwrite
            )

    return Output([file], write, _ignore, finish)


def _open_capture(path: Path, metadata: Mapping[str, str], overwrite: bool) -> Output:
    times = times_path(path)
    bytes_file = DurableAppender(str(path), "bytes", b"", end=b"", overwrite=overwrite)
    try:
        header = times_header(metadata).encode()
        times_file = DurableAppender(str(times), "arrival times", header, overwrite=overwrite)
    except EdgeposeError:
        bytes_file.close()
        raise
    end = 0

    def write(arrival_s: float, data: bytes) -> None:
        nonlocal end
        end += len(data)
        bytes_file.add(data)
        times_file.add(times_row(arrival_s, end).encode())

    return Output([bytes_file, times_file], _ignore, write, lambda: None)


def _open_can_log(path: Path, overwrite: bool) -> Output:
    import can

    from edgepose.sources.can_log import write_log

    journal = _journal(path)
    file = DurableAppender(str(journal), "CAN frames", b"", overwrite=overwrite, follow=journal == path)
    writer = can.CanutilsLogWriter(cast(TextIO, _TextFile(file)))

    def write(arrival_s: float, message: can.Message) -> None:
        # Arrival instead of the adapter's clock, which may start anywhere: replays must yield the same times.
        message.timestamp = arrival_s
        writer.on_message_received(message)

    def convert(part: Path) -> None:
        try:
            with can.CanutilsLogReader(journal) as reader:
                write_log(part, reader)
        except OSError:
            raise
        # python-can's writers raise arbitrary exceptions.
        except Exception as error:
            raise EdgeposeError(f"{path}: python-can cannot write it: {error}") from None

    def finish() -> None:
        if journal != path:
            _convert_journal(path, journal, convert, overwrite)

    return Output([file], _ignore, write, finish)


class _TextFile:
    """The part of the text file interface that python-can's log writer uses."""

    def __init__(self, file: DurableAppender) -> None:
        self._file = file

    def write(self, text: str) -> None:
        self._file.add(text.encode())

    def flush(self) -> None:
        """Do nothing: the file flushes itself."""


def _ignore(*_: Any) -> None:
    """Discard data that this kind of recording does not hold."""


def _convert_journal(path: Path, journal: Path, write: Callable[[Path], None], overwrite: bool) -> None:
    """Convert a journal to the recording, and delete it."""
    try:
        replace_file(path, write, "recording", overwrite=overwrite)
    except (EdgeposeError, MemoryError) as error:
        problem = str(error) or f"{path}: not enough memory"
        raise EdgeposeError(
            f"{problem}; the complete recording is in {journal}, which edgepose convert reads"
        ) from None
    journal.unlink()


def _journal(path: Path) -> Path:
    """Return the file that grows during a recording: a journal, or the recording itself."""
    ending = _JOURNALS.get(path.suffix.lower())
    return path if ending is None else path.with_suffix(ending)
