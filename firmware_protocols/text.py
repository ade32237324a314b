"""Text lines with numbers: one decoder for all sketches and loggers that print their readings.

A `Pattern` describes the lines and the meaning of their numbers; docs/text.md shows how to write one in a
TOML file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from math import degrees, isfinite, nan, sqrt

from firmware_protocols import rotation
from firmware_protocols._numbers import number, vector
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Encode, Protocol
from firmware_protocols.sample import Quaternion, Sample, Vector3, unit_quaternion, z_up
from firmware_protocols.text_pattern import (
    ACC,
    ANGLES,
    DAY_US,
    GYR,
    MAG,
    PATTERNS,
    UNITS,
    Pattern,
    columns_of,
    find_columns,
)

MAX_LINE = 512
"""Length limit of a line, bytes."""


class TextDecoder(Receiver):
    """Decoder for a stream of text lines that may be split anywhere, start anywhere and contain noise.

    Lines that do not match the pattern are skipped. Text has no checksum, so wrong digits are not detected.
    Numbers may have a decimal comma, unless that separates the columns, and a clock may follow a date.
    """

    WRAP_US = 1 << 64

    def __init__(self, pattern: Pattern | str) -> None:
        """Create the decoder.

        Args:
            pattern: a pattern, or its name in PATTERNS.

        Raises:
            ValueError: no pattern has that name.
        """
        if isinstance(pattern, str):
            if pattern not in PATTERNS:
                raise ValueError(f"pattern must be one of {', '.join(PATTERNS)}, not {pattern!r}")
            pattern = PATTERNS[pattern]
        super().__init__()
        self.pattern = pattern
        self.WRAP_US = pattern.wraps_at_us
        self._regex = re.compile(pattern.regex, re.ASCII) if pattern.regex is not None else None
        self._layout = None
        if pattern.header is not None:
            self._layout = find_columns(pattern, columns_of(pattern.header, pattern.separator))
        self._names = {
            name
            for wanted in pattern.columns.values()
            for name in ([wanted] if isinstance(wanted, str) else wanted)
        }
        # The first line may lack its beginning and still have the right number of columns.
        self._skip_first = self._layout is not None
        self._scales = {quantity: pattern.scale(quantity) for quantity in UNITS}
        self._clock = pattern.units.get("time") == "clock"
        self._decimal_comma = pattern.regex is not None or "," not in pattern.separator
        self._ned = pattern.frame == "NED"
        self._rest = b""
        self._too_long = False
        self._line_number = self._unread = 0
        self._first_unread = ""

    @property
    def refused(self) -> str | None:
        """Lines that match the pattern but hold something else, if these are most lines."""
        if self._unread <= self.counters.packets:
            return None
        return f"{self._unread} lines cannot be read, the first: {self._first_unread}"

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream, in order of arrival."""
        self.counters.bytes += len(data)
        *lines, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        samples = []
        for line in lines:
            too_long = self._too_long or len(line) > MAX_LINE
            self._too_long = False
            if not line and not too_long:
                continue
            sample = self._line("" if too_long else line.decode("latin-1"))
            if sample is not None:
                samples.append(sample)
        if len(rest) > MAX_LINE:
            self._too_long = True
        self._rest = rest[-MAX_LINE:]
        return samples

    def feed_datagram(self, data: bytes) -> list[Sample]:
        """Return the samples of a datagram, whose end is the end of a line."""
        return self.feed(data if data.endswith((b"\n", b"\r")) else data + b"\n")

    def _line(self, line: str) -> Sample | None:
        self._line_number += 1
        # `feed` passes a line that is too long as an empty one.
        if not line or not line.isascii():
            self._count_bad()
            return None
        values: Mapping[str, str | None]
        if self._regex is not None:
            match = self._regex.search(line)
            if match is None:
                self.counters.skipped += 1
                return None
            values = match.groupdict()
        else:
            columns = columns_of(line, self.pattern.separator)
            header = None if self._names.isdisjoint(columns) else find_columns(self.pattern, columns)
            if header is not None:
                # A second header: the device has restarted.
                self.counters.restarts += self._layout is not None and not self._skip_first
                self._layout, self._skip_first = header, False
                return None
            if self._skip_first or self._layout is None:
                self._skip_first = False
                self.counters.skipped += 1
                return None
            count, indices = self._layout
            if len(columns) != count:
                self._count_unread(f"it has {len(columns)} columns instead of {count}")
                return None
            values = {name: columns[index] for name, index in indices.items()}
        try:
            sample = self._sample(values)
        except (ValueError, OverflowError) as error:
            self._count_unread(str(error))
            return None
        self._count_good()
        self.counters.packets += 1
        return sample

    def _count_unread(self, why: str) -> None:
        self._count_bad()
        self._unread += 1
        self._first_unread = self._first_unread or f"line {self._line_number}: {why}"

    def _sample(self, values: Mapping[str, str | None]) -> Sample:
        """Return the sample of a line.

        Raises:
            ValueError: a value is not a number of its quantity; the message names it.
            OverflowError: a number is too large.
        """
        sensor, time_us, temperature = 0, None, None
        quat: Quaternion | None = None
        numbers = {}
        for name, text in values.items():
            if text is None:
                continue
            if name == "sensor":
                sensor = int(text)
                if not 0 <= sensor < 1 << 32:
                    raise ValueError(f"sensor is {text!r}, which is no id")
            elif name == "time":
                time_us = self._time(text)
            else:
                numbers[name] = self._number(name, text)
        if "x" in numbers:
            x, y, z = numbers["x"], numbers["y"], numbers["z"]
            w = numbers.get("w")
            if w is None:
                square = 1 - x * x - y * y - z * z
                w = sqrt(max(square, 0.0)) if square >= -0.02 else nan
            quat = unit_quaternion(w, x, y, z)
            if quat is None:
                raise ValueError("the quaternion is not of length 1")
        elif "yaw" in numbers:
            scale = self._scales["angle"]
            yaw, pitch, roll = (numbers[name] * scale for name in ANGLES)
            quat = rotation.from_angles(yaw, pitch, roll)
            if quat is None:
                raise ValueError("the angles are implausibly large")
        if quat is not None and self._ned:
            quat = z_up(quat)
        if "temperature" in numbers:
            temperature = number(numbers["temperature"] * self._scales["temperature"])
        acc, gyr, mag = (
            self._vector(numbers, names, quantity)
            for names, quantity in ((ACC, "acc"), (GYR, "gyr"), (MAG, "mag"))
        )
        if quat is None and acc is None and gyr is None:
            raise ValueError("it has neither orientation nor acceleration nor rate")
        return Sample(sensor, time_us, quat, acc, gyr, mag, temperature)

    def _vector(self, numbers: dict[str, float], names: tuple[str, ...], quantity: str) -> Vector3 | None:
        a, b, c = names
        if a not in numbers or b not in numbers or c not in numbers:
            return None
        result = vector((numbers[a], numbers[b], numbers[c]), self._scales[quantity])
        if result is None:
            raise ValueError("a value is implausibly large")
        return result

    def _number(self, name: str, text: str) -> float:
        point = text.replace(",", ".") if self._decimal_comma and "." not in text else text
        try:
            value = float(point)
        except ValueError:
            value = nan
        if not isfinite(value) or "_" in text:
            raise ValueError(f"{name} is {text[:20]!r}, which is no number")
        return value

    def _time(self, text: str) -> int:
        try:
            time_us = self._time_us(text)
        except ValueError:
            time_us = -1
        if time_us < 0 or "_" in text:
            unit = self.pattern.units.get("time", "us")
            raise ValueError(f"time is {text[:30]!r}, which is no time in the unit {unit}")
        return time_us % self.WRAP_US

    def _time_us(self, text: str) -> int:
        if self._clock:
            # A date may precede it: 2023-03-04 21:27:11.770, or with a T between the two.
            _, _, clock = text.strip().replace("T", " ").rpartition(" ")
            hours, minutes, seconds = clock.split(":")
            time_us = round(
                (int(hours) * 60 + int(minutes)) * 60_000_000 + float(seconds.replace(",", ".")) * 1e6
            )
        else:
            # Integer arithmetic is exact for any number of steps.
            scale = self._scales["time"]
            time_us = (
                int(text) * int(scale)
                if text.isdecimal() and scale.is_integer()
                else round(self._number("time", text) * scale)
            )
        return time_us


# --- for simulation -------------------------------------------------------------------------------

_HEADERS = {
    "artemis": "rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,",
    "artemis-dmp": "rtcDate,rtcTime,Q9_1,Q9_2,Q9_3,HeadAcc,"
    "RawAX,RawAY,RawAZ,RawGX,RawGY,RawGZ,RawMX,RawMY,RawMZ,",
}


def encode_header(name: str) -> bytes:
    """Return the header line that precedes the lines of `encode`; empty if the device sends none."""
    header = _HEADERS.get(name)
    return b"" if header is None else header.encode() + b"\r\n"


def encode(sample: Sample, name: str) -> bytes:
    """Return the line of a sample in a built-in pattern, with zeros for an absent `mag` or temperature.

    Raises:
        ValueError: no such pattern, or the sample lacks a quantity of its lines.
    """
    quat, acc, gyr = sample.quat, sample.acc, sample.gyr
    if name not in PATTERNS:
        raise ValueError(f"pattern must be one of {', '.join(PATTERNS)}, not {name!r}")
    if quat is None and name != "artemis":
        raise ValueError(f"lines of {name} need an orientation")
    if name == "adafruit":
        line = "Quaternion: " + ", ".join(f"{x:.4f}" for x in quat or ())
    elif name == "razor":
        # z_up is its own inverse, up to the sign of the quaternion.
        angles = rotation.to_yaw_pitch_roll(z_up(quat)) if quat is not None else ()
        line = "#YPR=" + ",".join(f"{degrees(x):.2f}" for x in angles)
    else:
        if acc is None or gyr is None or sample.time_us is None:
            raise ValueError(f"lines of {name} need time, acceleration and angular rate")
        pattern = PATTERNS[name]
        raw = name == "artemis-dmp"
        parts = ["01/01/2026", _clock(sample.time_us)]
        if raw and quat is not None:
            # Only x, y, z are sent: w has to be positive.
            sign = -1.0 if quat[0] < 0 else 1.0
            parts += [f"{x * sign:.5f}" for x in quat[1:]] + ["0"]
        for quantity, vector in (("acc", acc), ("gyr", gyr), ("mag", sample.mag or (0.0, 0.0, 0.0))):
            scale = pattern.scale(quantity)
            parts += [f"{x / scale:.{0 if raw else 2}f}" for x in vector]
        if not raw:
            parts.append(f"{sample.temperature or 0.0:.2f}")
        line = ",".join(parts) + ","
    return line.encode() + b"\r\n"


def _clock(time_us: int) -> str:
    seconds, hundredths = divmod(time_us % DAY_US // 10_000, 100)
    return f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{hundredths:02}"


def _encoder(pattern: str) -> Callable[[], Encode]:
    """Return the `Protocol.encoder` of a built-in pattern; it sends a header line before the first sample."""

    def encode_sample(sample: Sample, seq: int) -> bytes:
        header = b"" if seq else encode_header(pattern)
        return header + encode(sample, pattern)

    return lambda: encode_sample


PROTOCOL_ADAFRUIT = Protocol(
    name="adafruit",
    transport="bytes",
    default_bitrate=115200,
    description='sketches for Adafruit\'s libraries: text lines "Quaternion: w, x, y, z"',
    decoder=partial(TextDecoder, "adafruit"),
    encoder=_encoder("adafruit"),
    single_device=True,
    lacks=("time", "acc"),
    page="text",
)

PROTOCOL_RAZOR = Protocol(
    name="razor",
    transport="bytes",
    default_bitrate=57600,
    description='Razor AHRS firmware: text lines "#YPR="',
    decoder=partial(TextDecoder, "razor"),
    encoder=_encoder("razor"),
    single_device=True,
    lacks=("time", "acc"),
    page="text",
)

PROTOCOL_OPENLOG = Protocol(
    name="openlog",
    transport="bytes",
    default_bitrate=115200,
    description="OpenLog Artemis as delivered: text lines without orientation",
    decoder=partial(TextDecoder, "artemis"),
    encoder=_encoder("artemis"),
    single_device=True,
    lacks=("quat",),
    page="text",
)

PROTOCOL_OPENLOG_DMP = Protocol(
    name="openlog-dmp",
    transport="bytes",
    default_bitrate=115200,
    description="OpenLog Artemis: text lines with the sensor's own orientation",
    decoder=partial(TextDecoder, "artemis-dmp"),
    encoder=_encoder("artemis-dmp"),
    single_device=True,
    page="text",
)
