"""x-io x-IMU3: ASCII, binary and multiplexed messages over a serial line.

Layouts are in docs/ximu3.md. Orientation and inertial messages come separately, with the same time stamp if
they belong to the same instant: these two become one Sample. There is no checksum, so contents are checked
for plausibility.
"""

from __future__ import annotations

import struct
from math import degrees, isfinite, radians

from firmware_protocols import rotation
from firmware_protocols._numbers import plausible
from firmware_protocols._recent import BoundedDict
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.pairing import MessagePairer
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample, Vector3, unit_quaternion, z_up

FRAMES = ("NWU", "ENU", "NED")
"""Inertial frames that the device can use; NWU is its default."""

MAX_MESSAGE = 1024
"""Length limit of a message, bytes without the closing line feed."""

_END, _ESC, _ESC_END, _ESC_ESC = 0x0A, 0xDB, 0xDC, 0xDD
_MUX, _COMMAND = ord("^"), ord("{")
_MAX_DEPTH = 2
_MAX_TAIL = 256  # more than the longest message that is searched for after a corrupted one

_FLOATS = {"I": (6,), "Q": (4,), "R": (9,), "A": (3,), "L": (3, 7), "E": (3, 7), "M": (3,), "T": (1,)}
_ORIENTATIONS = frozenset("QRALE")
_SKIPPED = "HUSYCBWONF"
_JSON = "{"
_BINARY = {
    (0x80 + ord(letter), 9 + 4 * count): (letter, struct.Struct(f"<xQ{count}f"))
    for letter, counts in _FLOATS.items()
    for count in counts
}
_STARTS = frozenset(ord(letter) + high for letter in _FLOATS for high in (0, 0x80)) | {_MUX}

# Without a checksum, only implausible values reveal a corrupted message.
_MAX_RATE, _MAX_FORCE = 10_000.0, 250.0  # deg/s, g
_MAX_STEP_US = 10_000_000
_MAG_AGE_US, _TEMPERATURE_AGE_US = 100_000, 2_000_000

_DEG = radians(1.0)

_Message = tuple[int, str, int, tuple[float, ...]]  # sensor, letter, time, values


class Ximu3Decoder(Receiver):
    """Decoder for a byte stream that may be split anywhere, start anywhere and contain noise.

    A Sample has the time of its orientation and inertial messages. If one of them is lost (or not switched
    on), the other becomes a sample by itself once a later message arrives. Magnetometer and temperature have
    times of their own: a reading is added to the next sample, once, if it is at most 0.1 s (temperature: 2 s)
    old.

    `sensor` is 0 for the device on the line itself, the channel byte for multiplexed messages, and
    outer << 8 | inner for a channel of a channel.
    """

    WRAP_US = 1 << 64

    def __init__(self, frame: str = "NWU") -> None:
        """Create the decoder.

        Raises:
            ValueError: frame is not one of FRAMES.
        """
        if frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(FRAMES)}, not {frame!r}")
        super().__init__()
        self._ned = frame == "NED"
        self._pairing = MessagePairer(self.counters)
        self._rest = b""
        self._has_channels = False
        self._time: BoundedDict[int, int] = BoundedDict()
        self._suspect: BoundedDict[int, int] = BoundedDict()
        self._mag: BoundedDict[int, tuple[int, Vector3]] = BoundedDict()
        self._temperature: BoundedDict[int, tuple[int, float]] = BoundedDict()

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream."""
        self.counters.bytes += len(data)
        *messages, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-MAX_MESSAGE - 1 :]
        samples: list[Sample] = []
        for message in messages:
            if message:
                samples += self._line(message)
        return samples

    def flush(self) -> list[Sample]:
        """Return the samples that still wait for their partner, at the end of a recording."""
        return self._add_slow(self._pairing.flush())

    def _line(self, line: bytes) -> list[Sample]:
        message = _parse(line) if len(line) <= MAX_MESSAGE else None
        samples = self._take(message) if message is not None else None
        if samples is None:
            self._count_bad()
            return self._trailing_samples(line[-_MAX_TAIL:])
        self._count_good()
        if message is not None and not message[1] and message[0] not in self._time:
            # These letters may have any length. If there is no time to compare with, the line may be noise.
            return self._trailing_samples(line[-_MAX_TAIL:])
        return samples

    def _trailing_samples(self, line: bytes) -> list[Sample]:
        """Return the samples of a good message that directly follows a corrupted one, without a line feed."""
        for start in range(1, len(line) - 9):
            if line[start] not in _STARTS:
                continue
            # Without its two leading bytes a message of a channel looks like one of the device on the line.
            if self._has_channels and line[start] != _MUX:
                continue
            message = _parse(line[start:])
            if message is None or message[1] in ("", _JSON):
                continue
            # There is no checksum, so the time must fit, too.
            last = self._time.get(message[0])
            if last is None or not 0 <= message[2] - last <= _MAX_STEP_US:
                continue
            samples = self._take(message)
            if samples is not None:
                self._count_good()
                return samples
        return []

    def _take(self, message: _Message) -> list[Sample] | None:
        """Return the samples completed by a message; None if its content is impossible."""
        sensor, letter, time_us, v = message
        if letter == "I":  # first and with positional arguments: this is the hot path
            if max(map(abs, v[:3])) > _MAX_RATE or max(map(abs, v[3:])) > _MAX_FORCE:
                return None
            if not self._time_fits(sensor, time_us):
                return None
            acc = (v[3] * STANDARD_G, v[4] * STANDARD_G, v[5] * STANDARD_G)
            gyr = (v[0] * _DEG, v[1] * _DEG, v[2] * _DEG)
            return self._add_slow(self._pairing.add(Sample(sensor, time_us, None, acc, gyr), False))
        if letter in _ORIENTATIONS:
            return self._take_orientation(message)
        if letter in ("", _JSON):
            last = self._time.get(sensor)
            if not letter and last is not None and abs(time_us - last) > _MAX_STEP_US:
                return None
            self.counters.skipped += 1
            return []
        if not plausible(v) or not self._time_fits(sensor, time_us):
            return None
        if letter == "M":
            if sensor in self._mag:
                self.counters.skipped += 1
            self._mag[sensor] = (time_us, (v[0], v[1], v[2]))
        else:
            if sensor in self._temperature:
                self.counters.skipped += 1
            self._temperature[sensor] = (time_us, v[0])
        return []

    def _take_orientation(self, message: _Message) -> list[Sample] | None:
        """Do what `_take` does for messages with an orientation, which may have an acceleration, too."""
        sensor, letter, time_us, v = message
        has_acc = letter in "LE"
        if has_acc:
            if max(map(abs, v[-3:])) > _MAX_FORCE:
                return None
            if len(v) == 3:
                # Newer firmware sends these without an orientation; inertial messages have the same content.
                self.counters.skipped += 1
                return []
        if letter == "Q" or has_acc:
            quat = unit_quaternion(v[0], v[1], v[2], v[3])
        else:
            quat = rotation.from_matrix(v) if letter == "R" else _from_degrees(*v)
        if quat is None or not self._time_fits(sensor, time_us):
            return None
        upright = z_up(quat) if self._ned else quat
        acc: Vector3 | None = None
        if has_acc:
            x, y, z = v[4:7] if letter == "L" else rotation.rotate_back(quat, (v[4], v[5], v[6]))
            a, b, c = rotation.rotate_back(upright, (0.0, 0.0, 1.0))
            acc = ((x + a) * STANDARD_G, (y + b) * STANDARD_G, (z + c) * STANDARD_G)
        return self._add_slow(self._pairing.add(Sample(sensor, time_us, upright, acc), True))

    def _time_fits(self, sensor: int, time_us: int) -> bool:
        """Return whether a time can follow the last one; a jump is a restart if a second message agrees."""
        last = self._time.get(sensor)
        if last is not None and not -_MAX_STEP_US <= time_us - last <= _MAX_STEP_US:
            suspect = self._suspect.get(sensor)
            if suspect is None or not 0 <= time_us - suspect <= _MAX_STEP_US:
                self._suspect[sensor] = time_us
                return False
            self.counters.restarts += 1
        self._time[sensor] = time_us
        if self._suspect:
            self._suspect.pop(sensor, None)
        if sensor:
            self._has_channels = True
        return True

    def _add_slow(self, samples: list[Sample]) -> list[Sample]:
        """Add magnetic field and temperature to samples, where available."""
        if not samples or not (self._mag or self._temperature):
            return samples
        result = []
        for sample in samples:
            time_us = sample.time_us
            assert time_us is not None
            mag = self._mag.pop(sample.sensor, None)
            temperature = self._temperature.pop(sample.sensor, None)
            if mag is not None and abs(time_us - mag[0]) <= _MAG_AGE_US:
                sample = sample._replace(mag=mag[1])
            if temperature is not None and abs(time_us - temperature[0]) <= _TEMPERATURE_AGE_US:
                sample = sample._replace(temperature=temperature[1])
            result.append(sample)
        return result


def _from_degrees(roll: float, pitch: float, yaw: float) -> Quaternion | None:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll), degrees; None if an angle is out of its range."""
    if abs(roll) <= 180.1 and abs(pitch) <= 90.1 and abs(yaw) <= 360.1:
        return rotation.from_yaw_pitch_roll(yaw * _DEG, pitch * _DEG, roll * _DEG)
    return None


def _parse(line: bytes) -> _Message | None:
    """Return the message in a line without line feed; its letter is empty if it is not for a Sample."""
    sensor = depth = start = 0
    while line[start] == _MUX:
        if depth == _MAX_DEPTH or len(line) < start + 3:
            return None
        sensor = sensor << 8 | line[start + 1]
        depth += 1
        start += 2
    if start:
        line = line[start:]
    first = line[0]
    if first >= 0x80:
        if _ESC in line:
            pieces = line.split(b"\xdb")
            unstuffed = bytearray(pieces[0])
            for piece in pieces[1:]:
                if piece[:1] == b"\xdc":
                    unstuffed.append(_END)
                elif piece[:1] == b"\xdd":
                    unstuffed.append(_ESC)
                else:
                    return None
                unstuffed += piece[1:]
            line = bytes(unstuffed)
        known = _BINARY.get((first, len(line)))
        if known is not None:
            letter, layout = known
            time_us, *values = layout.unpack(line)
            # A sum of a few binary32 values cannot overflow, so it is finite only if all of them are.
            return (sensor, letter, time_us, tuple(values)) if isfinite(sum(values)) else None
        if len(line) >= 9 and chr(first - 0x80) in _SKIPPED:
            return (sensor, "", int.from_bytes(line[1:9], "little"), ())
        return None
    if first == _COMMAND:
        # JSON: the answer to a command.
        return (sensor, _JSON, 0, ()) if line.rstrip()[-1:] == b"}" else None
    name, *fields = line.rstrip(b"\r").split(b",")
    letter = name.decode("latin-1")
    counts = _FLOATS.get(letter)
    try:
        time_us = int(fields[0])
        if counts is None:
            return (sensor, "", time_us, ()) if letter in _SKIPPED and len(letter) == 1 else None
        values = [float(field) for field in fields[1:]]
    except (ValueError, IndexError):
        return None
    if len(values) not in counts or not 0 <= time_us < 1 << 64 or b"_" in line or not isfinite(sum(values)):
        return None
    return (sensor, letter, time_us, tuple(values))


# --- for simulation -------------------------------------------------------------------------------


def encode_message(
    letter: str, time_us: int, values: tuple[float, ...], *, sensor: int = 0, ascii: bool = False
) -> bytes:
    """Return the bytes of one message, line feed included.

    Args:
        letter: type of the message, one of those with numbers.
        time_us: device clock.
        values: in the device's units.
        sensor: 0 for the device itself, else its channel or outer << 8 | inner channel.
        ascii: text with four decimals instead of binary32.

    Raises:
        ValueError: a value cannot be sent.
    """
    if (
        len(values) not in _FLOATS.get(letter, ())
        or not all(map(isfinite, values))
        or not 0 <= sensor < 1 << 16
    ):
        raise ValueError(f"cannot send {letter!r} {values} of sensor {sensor}")
    if not 0 <= time_us < 1 << 64:
        raise ValueError(f"time must be from 0 to 2^64 - 1, not {time_us}")
    prefix = b"".join(bytes([_MUX, byte]) for byte in (sensor >> 8, sensor & 0xFF) if byte)
    if b"\n" in prefix:
        raise ValueError("channel 10 cannot be used: it is the line feed")
    if ascii:
        return prefix + ",".join([letter, str(time_us), *(f"{x:.4f}" for x in values)]).encode() + b"\r\n"
    try:
        body = struct.pack(f"<BQ{len(values)}f", 0x80 + ord(letter), time_us, *values)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"cannot send {values}: {error}") from None
    return prefix + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\n", b"\xdb\xdc") + b"\n"


def encode(sample: Sample, *, ascii: bool = False, frame: str = "NWU") -> bytes:
    """Return the messages of a sample: temperature, magnetometer, inertial, quaternion, those that it has.

    Raises:
        ValueError: the sample has no time, only one of acceleration and angular rate, or a value that cannot
            be sent.
    """
    time_us = sample.time_us
    if time_us is None:
        raise ValueError("an x-IMU3 message needs a time")
    if (sample.acc is None) != (sample.gyr is None):
        raise ValueError("an inertial message needs both acceleration and angular rate")
    if frame not in FRAMES:
        raise ValueError(f"frame must be one of {', '.join(FRAMES)}, not {frame!r}")
    parts: list[tuple[str, tuple[float, ...]]] = []
    if sample.temperature is not None:
        parts.append(("T", (sample.temperature,)))
    if sample.mag is not None:
        parts.append(("M", sample.mag))
    if sample.acc is not None and sample.gyr is not None:
        parts.append(("I", (*map(degrees, sample.gyr), *(x / STANDARD_G for x in sample.acc))))
    if sample.quat is not None:
        # z_up is its own inverse, up to the sign of the quaternion.
        parts.append(("Q", z_up(sample.quat) if frame == "NED" else sample.quat))
    return b"".join(
        encode_message(letter, time_us, values, sensor=sample.sensor, ascii=ascii) for letter, values in parts
    )


PROTOCOL = Protocol(
    name="ximu3",
    transport="bytes",
    default_bitrate=115200,
    description="x-io x-IMU3, ASCII and binary; ids are channels of multiplexed messages",
    decoder=Ximu3Decoder,
    encoder=uncounted(encode),
    single_device=True,
    setup="quaternion and inertial messages",
)
