"""What decoders of streams with start bytes share: frames on a bad line, lost packets, rotations."""

from __future__ import annotations

import re
from math import isfinite
from typing import ClassVar

from firmware_protocols.rotation import from_matrix, from_yaw_pitch_roll, to_yaw_pitch_roll
from firmware_protocols.sample import Counters, Quaternion, Sample, Vector3, unit_quaternion


class StreamDecoder:
    """Samples out of a byte stream that may be cut anywhere, start anywhere and contain noise.

    After a frame that turns out to be none, the search goes on one byte after its start: a start byte can
    occur inside a payload, and a false length must not swallow the good frames behind it.

    Attributes:
        counters: what has been seen so far.
    """

    WRAP_US: ClassVar[int]
    """Sample.time_us starts again at 0 after this many microseconds."""

    _START: ClassVar[re.Pattern[bytes]]
    """Where a frame can start; has to match its first byte alone at the end of the data."""

    _PADDING: ClassVar[bytes] = b""
    """Bytes that are allowed between frames."""

    def __init__(self) -> None:
        """Start with nothing seen."""
        self.counters = Counters()
        self._rest = b""  # the frame under way
        self._at = 0  # place of its first byte in the stream
        self._in_sync = True
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
                if not self._in_sync:
                    self._in_sync = True
                    self.counters.resyncs += 1
                self._message(buffer[at : at + length], samples)
                at += length
                continue
            if intact is None:
                self._noise(buffer[at : at + 1], self._at + at)
            else:
                self._bad(self._at + at, self._at + at + length)
            at += 1
        self._rest = buffer[at:]
        self._at += at
        return samples

    def _length(self, buffer: bytes, at: int) -> int:
        """Length of the whole frame at a place; 0 if more bytes are needed to tell; negative if none."""
        raise NotImplementedError

    def _possible(self, buffer: bytes, at: int, length: int) -> bool:
        """If the end of the buffer can be the beginning of a frame; a length of 0 is not known yet."""
        return True

    def _intact(self, buffer: bytes, at: int, length: int) -> bool | None:
        """If the checksum is good; None if the structure is none, wherever `_possible` may have seen that."""
        raise NotImplementedError

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        """Append what an intact frame holds."""
        raise NotImplementedError

    def _give(self, sample: Sample, samples: list[Sample]) -> None:
        if sample[2:] == _NOTHING:
            self.counters.skipped += 1
        else:
            self.counters.packets += 1
            samples.append(sample)

    def _bad(self, start: int, end: int) -> None:
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


_NOTHING = (None,) * 5


# --- counters of the devices ----------------------------------------------------------------------

# A counter can be believed if the pause between two packets is too short for it to go around at the highest
# rate (2 kHz: 33 s) and the step is no larger than that rate allows, plus some for a coarse clock.
_MAX_PAUSE_US = 30_000_000
_MIN_PERIOD_US = 500
_SLACK = 64
_LATE_US = 1_000_000
_MAX_STEP = 1000  # without a clock


class Sequence:
    """Counts what is missing in the 16 bit packet counters of the sensors on a line."""

    def __init__(self, counters: Counters, wrap_us: int) -> None:
        """Count into `counters`; device clocks wrap at `wrap_us`."""
        self._counters = counters
        self._wrap_us = wrap_us
        self._last: dict[int, tuple[int, int | None]] = {}  # count, time by sensor

    def is_new(self, sensor: int, count: int, time_us: int | None) -> bool:
        """If a packet is none that came before; losses are counted."""
        last_count, last_us = self._last.get(sensor, (count - 1, time_us))
        step = (count - last_count) & 0xFFFF
        back = -step & 0xFFFF
        if time_us is None or last_us is None:
            pause = None
            late = back <= _SLACK
            believable = step <= _MAX_STEP
        else:
            half = self._wrap_us // 2
            pause = (time_us - last_us + half) % self._wrap_us - half
            late = -_LATE_US <= pause <= 0 and back <= _SLACK
            believable = (
                -_LATE_US <= pause <= _MAX_PAUSE_US and step <= _SLACK + max(pause, 0) // _MIN_PERIOD_US
            )
        if late:
            self._counters.late += 1
            return False
        self._last[sensor] = (count, time_us)
        if believable:
            # A step of 0 with a new time is a sensor that does not count.
            self._counters.lost += max(step - 1, 0)
        else:
            self._counters.restarts += 1
        return True


# --- quantities -----------------------------------------------------------------------------------


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion | None:
    """Quaternion of Rz(yaw) Ry(pitch) Rx(roll), radians; None if they are no numbers."""
    return from_yaw_pitch_roll(yaw, pitch, roll) if isfinite(roll + pitch + yaw) else None


def to_euler(quat: Quaternion) -> Vector3:
    """Roll, pitch, yaw in radians of Rz(yaw) Ry(pitch) Rx(roll)."""
    yaw, pitch, roll = to_yaw_pitch_roll(quat)
    return (roll, pitch, yaw)


def matrix_quaternion(m: tuple[float, ...]) -> Quaternion | None:
    """Quaternion of a rotation matrix, row after row; None if it is none."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = m
    if not all(-1.1 <= value <= 1.1 for value in m):  # NaN is not either
        return None
    det = xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    return unit_quaternion(*from_matrix(m)) if abs(det - 1) <= 0.1 else None


def finite(vector: tuple[float, ...], scale: float = 1.0) -> Vector3 | None:
    """A vector times a scale; None if it holds NaN or infinity."""
    x, y, z = vector
    if not isfinite(x + y + z):
        return None
    return (x * scale, y * scale, z * scale)
