"""Samples from recordings and from raw captures of a serial port."""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import inf
from pathlib import Path
from types import TracebackType

from edgepose.clock import CaptureClock
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.recording import Recording, read_recording, samples
from edgepose.sources import Batch, Counters
from edgepose.sources.native_stream import NativeStream

_SLICE_S = 0.01
_CHUNK = 1 << 16


class RecordingSource:
    """A CSV or NPZ recording."""

    def __init__(self, path: Path, realtime: bool) -> None:
        """Nothing is read yet.

        Args:
            path: the file.
            realtime: deliver it at its own pace.
        """
        self._path = path
        self._realtime = realtime
        self._recording: Recording | None = None
        self._packets = 0

    @property
    def counters(self) -> Counters:
        """What has come in so far."""
        return Counters(self._packets)

    @property
    def damage(self) -> str | None:
        """What is wrong with the end of the file."""
        return self._recording.damage if self._recording else None

    def __enter__(self) -> RecordingSource:
        """Read the file.

        Raises:
            EdgeposeError: it is no recording.
        """
        self._recording = read_recording(self._path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    def __iter__(self) -> Iterator[Batch]:
        """All samples in time order, a hundredth of a second at a time."""
        assert self._recording is not None, "the source has not been entered"
        for batch in _batches(samples(self._recording), self._realtime):
            self._packets += len(batch[1])
            yield batch


class CaptureSource:
    """The bytes of a serial port in a file; device time is the clock."""

    def __init__(self, path: Path, realtime: bool) -> None:
        """Nothing is opened yet.

        Args:
            path: the file.
            realtime: deliver it at its own pace.
        """
        self._path = path
        self._realtime = realtime
        self._stream = NativeStream(str(path))

    @property
    def counters(self) -> Counters:
        """What has come in so far."""
        return self._stream.counters

    @property
    def damage(self) -> str | None:
        """Always None: a capture may start and end anywhere."""
        return None

    def __enter__(self) -> CaptureSource:
        """Check that the file can be read.

        Raises:
            EdgeposeError: it cannot.
        """
        try:
            with self._path.open("rb"):
                return self
        except OSError as error:
            raise EdgeposeError(f"{self._path}: cannot read it: {error.strerror}") from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""

    def __iter__(self) -> Iterator[Batch]:
        """All samples in the order of the file.

        Raises:
            EdgeposeError: the file cannot be read to its end, or there is no packet in it.
        """
        yield from _batches(self._samples(), self._realtime)
        if not self.counters.packets:
            raise EdgeposeError(
                f"{self._path}: not one native packet of sensor ids 0 to 5 in {self._stream.byte_count} "
                "bytes; is it a raw serial capture?"
            )

    def _samples(self) -> Iterator[ImuSample]:
        clock = CaptureClock()
        try:
            with self._path.open("rb") as file:
                while data := file.read(_CHUNK):
                    yield from self._stream.feed(data, clock.time)
        except OSError as error:
            raise EdgeposeError(f"{self._path}: cannot read it: {error.strerror}") from None


def _batches(rows: Iterator[ImuSample], realtime: bool) -> Iterator[Batch]:
    """Samples in slices of time; `now_s` is that of the newest sample, or goes on with the clock where
    realtime is asked for."""
    now_s = end_s = -inf
    batch: list[ImuSample] = []
    offset_s = 0.0
    for sample in rows:
        if end_s == -inf:
            now_s, end_s = sample.time_s, sample.time_s + _SLICE_S
            offset_s = sample.time_s - time.monotonic()
        while sample.time_s >= end_s:
            if realtime:
                time.sleep(max(0.0, end_s - offset_s - time.monotonic()))
                now_s = end_s
            yield now_s, batch
            batch = []
            # Nothing is said about a pause unless its time really passes.
            end_s = end_s + _SLICE_S if realtime else sample.time_s + _SLICE_S
        batch.append(sample)
        now_s = max(now_s, sample.time_s)
    if batch:
        yield now_s, batch
