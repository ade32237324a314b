"""What decoders share: counting good and bad, and finding frames with start bytes on a bad line."""

from __future__ import annotations

import re
from abc import abstractmethod
from typing import ClassVar

from firmware_protocols.base import Decoder
from firmware_protocols.sample import Counters, Sample

NOTHING = (None,) * 5
"""Quantities of a sample that has none."""


class Receiver(Decoder):
    """A decoder that counts what comes.

    Attributes:
        counters: what has been seen so far.
    """

    def __init__(self) -> None:
        """Start with nothing seen."""
        self.counters = Counters()
        self._in_sync = True

    def _count_bad(self) -> list[Sample]:
        """Something came that is no valid packet."""
        self.counters.bad += 1
        self._in_sync = False
        return []

    def _count_good(self) -> None:
        """A valid packet came."""
        if not self._in_sync:
            self._in_sync = True
            self.counters.resyncs += 1

    def _emit(self, sample: Sample, samples: list[Sample]) -> None:
        """Append a sample, if there is anything in it."""
        if sample[2:] == NOTHING:
            self.counters.skipped += 1
        else:
            self.counters.packets += 1
            samples.append(sample)


class StreamDecoder(Receiver):
    """Samples out of a byte stream that may be cut anywhere, start anywhere and contain noise.

    After a frame that turns out to be none, the search goes on one byte after its start: a start byte can
    occur inside a payload, and a false length must not swallow the good frames behind it.
    """

    _START: ClassVar[re.Pattern[bytes]]
    """Where a frame can start; has to match its first byte alone at the end of the data."""

    _PADDING: ClassVar[bytes] = b""
    """Bytes that are allowed between frames."""

    def __init__(self) -> None:
        """Start with nothing seen."""
        super().__init__()
        self._rest = b""  # the frame under way
        self._at = 0  # place of its first byte in the stream
        self._bad_end = 0  # place in the stream where the last bad piece ends

    def feed(self, data: bytes) -> list[Sample]:
        """Samples completed by the next bytes of the stream, in the order they came."""
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
                # A frame under way, unless what there is of it cannot be one.
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
        """Length of the whole frame at a place; 0 if more bytes are needed to tell; negative if none."""

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        """If the end of the buffer can be the beginning of a frame; a length of 0 is not known yet."""
        return True

    @abstractmethod
    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        """If the checksum is good; None if the structure is none, wherever `_possible` may have seen that."""

    @abstractmethod
    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        """Append what an intact frame holds."""

    def _bad_frame(self, start: int, end: int) -> None:
        # False frames inside a bad one are part of it.
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
        # Bytes behind a bad piece belong to it until something good comes.
        self._bad_end = max(self._bad_end, start + len(data))
        self._in_sync = False
