"""Base classes of decoders: counters, and the search for frames with start bytes on a noisy line."""

from __future__ import annotations

import re
from abc import abstractmethod
from typing import ClassVar

from firmware_protocols.base import Decoder
from firmware_protocols.sample import Counters, Sample

NOTHING = (None,) * 5
"""Quantities of an empty sample."""


class Receiver(Decoder):
    """A decoder with counters.

    Attributes:
        counters: counts of everything decoded so far.
    """

    def __init__(self) -> None:
        """Create the decoder."""
        self.counters = Counters()
        self._in_sync = True

    def _count_bad(self) -> list[Sample]:
        """Count a piece of input that is no valid packet; return no samples."""
        self.counters.bad += 1
        self._in_sync = False
        return []

    def _count_good(self) -> None:
        """Count the end of a corrupted stretch, if there was one, at a valid packet."""
        if not self._in_sync:
            self._in_sync = True
            self.counters.resyncs += 1

    def _emit(self, sample: Sample, samples: list[Sample]) -> None:
        """Append a sample unless it is empty."""
        # The first test, which nearly all samples end, is there because it is cheap.
        if sample.quat is None and sample[2:] == NOTHING:
            self.counters.skipped += 1
        else:
            self.counters.packets += 1
            samples.append(sample)


class StreamDecoder(Receiver):
    """Decoder for a byte stream that may be split anywhere, start anywhere and contain noise.

    After a false frame the search continues one byte after its start: a start byte can occur inside a
    payload, and a false length must not swallow the good frames after it.
    """

    _START: ClassVar[re.Pattern[bytes]]
    """Pattern of the start of a frame; at the end of the data, it must match every beginning of it."""

    _PADDING: ClassVar[bytes] = b""
    """Bytes that are allowed between frames."""

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._rest = b""  # the beginning of an incomplete frame
        self._at = 0  # its offset in the stream
        self._bad_end = 0  # offset in the stream of the end of the last bad piece

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream, in order of arrival."""
        self.counters.bytes += len(data)
        buffer = self._rest + data
        end = len(buffer)
        at = 0
        samples: list[Sample] = []
        while at < end:
            match = self._START.search(buffer, at)
            start = match.start() if match else end
            if start > at:
                self._noise(buffer[at:start], self._at + at)
                at = start
                continue
            length = self._length(buffer, at)
            if length > end - at or not length:
                # An incomplete frame, unless its bytes so far rule that out.
                if self._possible(buffer, at, length):
                    break
                length = -1
            intact = self._intact(buffer, at, length) if length > 0 else None
            if intact:
                self._count_good()
                self._message(buffer[at : at + length], samples)
                at += length
                continue
            if intact is None:
                self._noise(buffer[at : at + 1], self._at + at)
            else:
                self._bad_frame(self._at + at, self._at + at + length)
            at += 1
        self._rest = buffer[at:]
        self._at += at
        return samples

    @abstractmethod
    def _length(self, buffer: bytes, at: int) -> int:
        """Return the length of the frame at an offset; 0 if more bytes are needed; negative if it is none."""

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        """Return whether a frame can begin at an offset; a length of 0 is not known yet."""
        return True

    @abstractmethod
    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        """Return whether the checksum is right; None if `_possible` could have ruled the frame out.

        None counts as noise, as it does when `_possible` sees it: counters must not depend on the chunking.
        """

    @abstractmethod
    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        """Append the samples of an intact frame."""

    def _bad_frame(self, start: int, end: int) -> None:
        # Count a bad frame and the false ones inside it once.
        if self._in_sync or start >= self._bad_end:
            self.counters.bad += 1
            self._bad_end = end
        self._in_sync = False

    def _noise(self, data: bytes, start: int) -> None:
        if self._in_sync:
            padding = len(data) - len(data.lstrip(self._PADDING)) if self._PADDING else 0
            if padding == len(data):
                return
            start += padding
            data = data[padding:]
            self.counters.bad += 1
        # Bytes after a bad piece belong to it, up to the next good frame.
        self._bad_end = max(self._bad_end, start + len(data))
        self._in_sync = False
