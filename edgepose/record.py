"""Live samples, bytes or CAN frames to a file, so that at most the last second is lost when the power goes.

What cannot be written bit by bit goes through a journal next to it that can: `walk.npz` through
`walk.part.csv`, `walk.blf` through `walk.part.log`. Both are recordings that everything else reads.
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
from edgepose.placements import PLACEMENTS
from edgepose.sources import Batch, Source
from edgepose.sources.replay import CAPTURES
from edgepose.utils.durable_files import replace_file
from edgepose.utils.growing_files import DurableAppender
from edgepose.utils.output_targets import check_output

CAN_LOGS = (".asc", ".blf", ".log")
"""Endings of the CAN logs that are written; of .trc, python-can's writer would drop the CAN FD frames."""

_JOURNALS = {".npz": ".part.csv", ".asc": ".part.log", ".blf": ".part.log"}


class Output(NamedTuple):
    """A recording under way.

    Attributes:
        files: that grow.
        samples: takes those that came together.
        raw: takes what came together on a line: arrival in Unix time, seconds, and bytes or CAN messages.
        finish: called when the files are closed and something is in them.
    """

    files: list[DurableAppender]
    samples: Callable[[list[ImuSample]], None]
    raw: Callable[[float, Any], None]
    finish: Callable[[], None]


@dataclass
class RecordSummary:
    """Counts of a recording.

    Attributes:
        samples: of each sensor, in the order of PLACEMENTS.
        seconds: on the source's clock, from the first sample on.
        error: what ended it early, if anything did.
    """

    samples: list[int] = field(default_factory=lambda: [0] * len(PLACEMENTS))
    seconds: float = 0.0
    error: EdgeposeError | None = None


def kind(path: str) -> Literal["samples", "port", "bus"]:
    """What a recording of this name takes: samples, what comes from a port, or what comes over a bus.

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
    """The file that grows beside a recording until it is whole, if it is another."""
    journal = None if path == "-" else _journal(Path(path))
    return None if journal == Path(path) else journal


def check_free(path: str, overwrite: bool) -> None:
    """Make sure that no recording is lost.

    Args:
        path: of the new one.
        overwrite: whether one that is there already may be replaced.

    Raises:
        EdgeposeError: one is there, whole or its journal, or it cannot be written.
    """
    if path == "-":
        return
    there, journal = Path(path), _journal(Path(path))
    beside = [times_path(there)] if kind(path) == "port" else []
    for file in (there, *beside):
        check_output(file, "the recording", (*CAPTURES, *CAN_LOGS, ".csv", ".npz", ".times"), overwrite)
    if journal != there and os.path.lexists(journal) and not overwrite:
        to = "npz" if there.suffix.lower() == ".npz" else "csv"
        raise EdgeposeError(
            f"{journal} is of a recording that was cut short; keep it with  edgepose convert {journal} "
            f"--to {to} --out DIR  and delete it, or give --overwrite"
        )


def open_output(path: str, metadata: Mapping[str, str], overwrite: bool = True) -> Output:
    """Start a recording; its file appears with the first samples.

    Args:
        path: its name says what it takes, see `kind`; "-" is CSV on standard output.
        metadata: goes into it, where it has a place for that.
        overwrite: whether it may take the place of one that is there already.

    Raises:
        EdgeposeError: it cannot be written.
    """
    takes = kind(path)
    if takes == "port":
        return _capture(Path(path), metadata, overwrite)
    if takes == "bus":
        return _can_log(Path(path), overwrite)
    return _samples(path, metadata, overwrite)


def record(
    source: Source,
    output: Output,
    seconds: float = inf,
    on_batch: Callable[[RecordSummary], None] = lambda summary: None,
    stopped: Callable[[], bool] = lambda: False,
) -> RecordSummary:
    """Write what a source gives, to its end, for some seconds, or until `stopped`.

    What came before an error or the stop is written. An error is kept in the summary for the caller to
    report.

    Args:
        source: the source.
        output: where to; closed at the end. Nothing appears, and nothing is replaced, if nothing came.
        seconds: length of the recording on the source's clock.
        on_batch: called after each batch.
        stopped: asked after each batch whether to end.
    """
    summary = RecordSummary()
    start_s = None
    something = False
    try:
        for batch in source:
            something |= _write(output, batch)
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
    if not something:
        return summary
    try:
        output.finish()
    except EdgeposeError as error:
        summary.error = summary.error or error
    return summary


def _write(output: Output, batch: Batch) -> bool:
    """Write a batch, and whether there was something to keep in it."""
    if batch.samples:
        output.samples(batch.samples)
    for arrival_s, piece in batch.raw:
        output.raw(arrival_s, piece)
    return bool(batch.samples or (batch.raw and output.raw is not _ignore))


# --- kinds --------------------------------------------------------------------------------------------------


def _samples(path: str, metadata: Mapping[str, str], overwrite: bool) -> Output:
    journal = path if path == "-" else str(_journal(Path(path)))
    header = csv_header(metadata).encode()
    file = DurableAppender(journal, "samples", header, overwrite=overwrite, follow=journal == path)

    def take(samples: list[ImuSample]) -> None:
        file.add("".join(map(csv_row, samples)).encode())

    def finish() -> None:
        if journal != path:
            _finish(
                Path(path), Path(journal), lambda part: write_npz(part, salvage_recording(journal)), overwrite
            )

    return Output([file], take, _ignore, finish)


def _capture(path: Path, metadata: Mapping[str, str], overwrite: bool) -> Output:
    times = times_path(path)
    bytes_file = DurableAppender(str(path), "bytes", b"", end=b"", overwrite=overwrite)
    try:
        header = times_header(metadata).encode()
        times_file = DurableAppender(str(times), "arrival times", header, overwrite=overwrite)
    except EdgeposeError:
        bytes_file.close()
        raise
    end = 0

    def take(arrival_s: float, data: bytes) -> None:
        nonlocal end
        end += len(data)
        bytes_file.add(data)
        times_file.add(times_row(arrival_s, end).encode())

    return Output([bytes_file, times_file], _ignore, take, lambda: None)


def _can_log(path: Path, overwrite: bool) -> Output:
    import can

    journal = _journal(path)
    file = DurableAppender(str(journal), "CAN frames", b"", overwrite=overwrite, follow=journal == path)
    writer = can.CanutilsLogWriter(cast(TextIO, _TextFile(file)))

    def take(arrival_s: float, message: can.Message) -> None:
        # The adapter's own clock may start anywhere; decoding it again has to give the same times.
        message.timestamp = arrival_s
        writer.on_message_received(message)

    def convert(part: Path) -> None:
        try:
            with can.CanutilsLogReader(journal) as reader, can.Logger(part) as log:
                for message in reader:
                    log.on_message_received(message)
        except OSError:
            raise
        # The writers of the formats fail in many ways.
        except Exception as error:
            raise EdgeposeError(f"{path}: python-can cannot write it: {error}") from None

    def finish() -> None:
        if journal != path:
            _finish(path, journal, convert, overwrite)

    return Output([file], _ignore, take, finish)


class _TextFile:
    """As much of a text file as python-can's writer of logs needs."""

    def __init__(self, file: DurableAppender) -> None:
        self._file = file

    def write(self, text: str) -> None:
        self._file.add(text.encode())

    def flush(self) -> None:
        """The file does that itself."""


def _ignore(*_: Any) -> None:
    """What this kind does not keep."""


def _finish(path: Path, journal: Path, write: Callable[[Path], None], overwrite: bool) -> None:
    """Make the recording of its journal."""
    try:
        replace_file(path, write, "recording", overwrite=overwrite)
    except (EdgeposeError, MemoryError) as error:
        why = str(error) or f"{path}: not enough memory"
        raise EdgeposeError(
            f"{why}; the recording is whole in {journal}, edgepose convert reads it"
        ) from None
    journal.unlink()


def _journal(path: Path) -> Path:
    """The file that grows while this one is recorded; often itself."""
    ending = _JOURNALS.get(path.suffix.lower())
    return path if ending is None else path.with_suffix(ending)
