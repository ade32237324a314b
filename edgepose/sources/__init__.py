"""Where samples come from. A source is a context manager to iterate over once; it yields batches of samples.

    with open_source(port="/dev/ttyUSB0") as source:
        for now_s, samples in source:
            ...

`now_s` is the time on the source's clock up to which everything has been delivered. Live: Unix time, taken
once at the start and carried on by the monotonic clock, so that it never jumps; a batch comes at least every
20 ms, empty if need be. Files: their own times.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample

Batch = tuple[float, list[ImuSample]]

POLL_S = 0.02
"""Longest time between two batches of a live source, seconds."""


class Counters(NamedTuple):
    """What has come in so far, for the summary at the end.

    Attributes:
        packets: good packets or samples.
        lost: packets missing from the devices' counts.
        bad: pieces of the stream that were no valid packet.
        unknown: good packets of ids that belong to no placement.
    """

    packets: int = 0
    lost: int = 0
    bad: int = 0
    unknown: int = 0


class Source(AbstractContextManager["Source"], Protocol):
    """See the module's text."""

    @property
    def counters(self) -> Counters:
        """What has come in so far."""

    @property
    def damage(self) -> str | None:
        """One line for the user if something was wrong with the input although the rest of it was
        delivered."""

    def __iter__(self) -> Iterator[Batch]:
        """Batches, in order.

        Raises:
            EdgeposeError: the input ended in an error; all that was good has been yielded before.
        """


def open_source(
    *,
    port: str | None = None,
    baud: int = 115200,
    file: Path | str | None = None,
    realtime: bool = False,
    protocol: str = "auto",
) -> Source:
    """The source that the options ask for; nothing is opened before it is entered.

    Args:
        port: serial port.
        baud: its speed, bit/s.
        file: recording (.csv, .npz, "-" for CSV on stdin) or raw serial capture (.bin, .raw).
        realtime: deliver a file at its own pace.
        protocol: what a port or a raw capture speaks; "auto" and "native" are known.

    Raises:
        EdgeposeError: no input or two, or a protocol or kind of file that is not known.
    """
    if protocol not in ("auto", "native"):
        raise EdgeposeError(f"unknown protocol {protocol!r}; known are auto and native")
    if (port is None) == (file is None):
        raise EdgeposeError("give one input: --port or --file")
    if port is not None:
        # pyserial is not needed to read files.
        from edgepose.sources.serial_port import SerialSource

        return SerialSource(port, baud)
    from edgepose.sources.files import CaptureSource, RecordingSource

    path = Path(str(file))
    if path.suffix.lower() in (".bin", ".raw"):
        return CaptureSource(path, realtime)
    if path.suffix.lower() in (".csv", ".npz") or str(path) == "-":
        return RecordingSource(path, realtime)
    raise EdgeposeError(
        f"{path}: unknown kind of file; recordings end in .csv or .npz, raw serial captures in .bin or .raw"
    )
