"""Text lines with numbers: one reader for the many sketches and loggers that print their readings.

A `Pattern` says what a line looks like and what its numbers mean; docs/text.md shows how one is written in a
TOML file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import degrees, isfinite, radians, sqrt

from firmware_protocols import rotation
from firmware_protocols._numbers import number, vector
from firmware_protocols._stream import Receiver
from firmware_protocols.sample import GRAVITY, Quaternion, Sample, Vector3, unit_quaternion, z_up

MAX_LINE = 512
"""Longest line that is read, bytes."""

FIELDS = (
    "sensor", "time", "w", "x", "y", "z", "yaw", "pitch", "roll",
    "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature",
)  # fmt: skip
"""Names of what a line can hold: groups of a regular expression, or keys of `columns`."""

FRAMES = ("Z-up", "NED")

_UNITS: dict[str, dict[str, float]] = {
    "acc": {"m/s2": 1.0, "g": GRAVITY, "mg": GRAVITY / 1000},
    "gyr": {"rad/s": 1.0, "deg/s": radians(1.0), "mrad/s": 0.001},
    "mag": {"uT": 1.0, "nT": 0.001, "mG": 0.1, "G": 100.0},
    "angle": {"deg": radians(1.0), "rad": 1.0},
    "time": {"us": 1.0, "ms": 1e3, "s": 1e6, "clock": 1e6},
    "temperature": {"degC": 1.0},
}
_DAY_US = 86_400_000_000
_WRAP_US = {"us": 1 << 32, "ms": 1000 << 32, "clock": _DAY_US}

_QUAT, _ANGLES = ("w", "x", "y", "z"), ("yaw", "pitch", "roll")
_ACC, _GYR, _MAG = ("ax", "ay", "az"), ("gx", "gy", "gz"), ("mx", "my", "mz")


@dataclass(frozen=True)
class Pattern:
    """What the lines of a device look like: either a regular expression or columns.

    Attributes:
        regex: searched in every line; its named groups are FIELDS. It should begin with fixed text and end in
            `$`, so that no piece of a line, and no two pieces run together, can match. A group should not be
            able to hold what separates it from the next, or bad lines take long to be refused.
        columns: name of the column for each of the FIELDS, or a list of names of which the first that is
            there counts; names are in a header line. Those that the header does not have are absent.
        header: the header line, for devices that send none or sent it before the port was open.
        separator: between columns.
        units: of acc (m/s2, g, mg), gyr (rad/s, deg/s, mrad/s), mag (uT, nT, mG, G), angle (deg, rad), time
            (us, ms, s, clock: hours:minutes:seconds), or the SI value (uT, us) of one step as a number; a
            leading minus turns the sign around. What is not named is SI, degrees or us.
        frame: inertial frame of the orientation, "Z-up" or "NED".
        wrap_us: where the time starts again at 0; by default 2^32 us or ms, a day for clock, never for s.

    Without w, w = sqrt(1 - x^2 - y^2 - z^2). Angles are Rz(yaw) Ry(pitch) Rx(roll).
    """

    regex: str | None = None
    columns: Mapping[str, str | list[str]] = field(default_factory=dict)
    header: str | None = None
    separator: str = ","
    units: Mapping[str, str | float] = field(default_factory=dict)
    frame: str = "Z-up"
    wrap_us: int | None = None

    def __post_init__(self) -> None:
        """Check.

        Raises:
            ValueError: the pattern means nothing, or not one thing.
        """
        if (self.regex is None) == (not self.columns):
            raise ValueError("a pattern has either a regex or columns")
        if self.regex is not None:
            try:
                names = set(re.compile(self.regex).groupindex)
            except (re.error, TypeError, OverflowError) as error:
                raise ValueError(f"regex: {error}") from None
        else:
            if not isinstance(self.columns, Mapping):
                raise ValueError("columns must be a table: field = name of the column")
            names = set(self.columns)
            for name, wanted in self.columns.items():
                listed = [wanted] if isinstance(wanted, str) else wanted
                if not isinstance(listed, list) or not listed or not all(isinstance(w, str) for w in listed):
                    raise ValueError(f"columns: {name} must be a name or a list of names, not {wanted!r}")
        unknown = sorted(names - set(FIELDS))
        if unknown:
            raise ValueError(f"unknown field {unknown[0]!r}; fields are {', '.join(FIELDS)}")
        for group in (_QUAT[1:], _ANGLES, _ACC, _GYR, _MAG):
            missing = [name for name in group if name not in names]
            if 0 < len(missing) < 3:
                raise ValueError(
                    f"{group[0]} without {missing[0]}" if missing[0] != group[0] else f"no {group[0]}"
                )
        if "w" in names and "x" not in names:
            raise ValueError("w without x")
        if not names & {"x", "yaw", "ax", "gx"}:
            raise ValueError("a pattern needs an orientation, a force or a rate")
        if {"x", "yaw"} <= names:
            raise ValueError("a pattern has either a quaternion or angles")
        if not self.separator or not isinstance(self.separator, str):
            raise ValueError("separator must be a character")
        if self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(FRAMES)}, not {self.frame!r}")
        if self.wrap_us is not None and not (type(self.wrap_us) is int and self.wrap_us > 0):
            raise ValueError(f"wrap_us must be a whole number above 0, not {self.wrap_us!r}")
        for quantity in self.units:
            self.scale(quantity)
        if self.header is not None and (
            not self.columns or _indices(self, _columns(self.header, self.separator)) is None
        ):
            raise ValueError("the header has none of the columns")

    def scale(self, quantity: str) -> float:
        """SI value (uT, us) of one step.

        Raises:
            ValueError: there is no such quantity or unit.
        """
        known = _UNITS.get(quantity)
        if known is None:
            raise ValueError(f"units: unknown quantity {quantity!r}; quantities are {', '.join(_UNITS)}")
        unit = self.units.get(quantity, next(iter(known)))
        if isinstance(unit, str):
            name = unit.removeprefix("-")
            if name in known and (unit == name or quantity not in ("time", "temperature")):
                return known[name] if unit == name else -known[name]
        elif type(unit) in (int, float) and isfinite(unit) and unit:
            return float(unit)
        raise ValueError(f"units: {quantity} must be one of {', '.join(known)} or a number, not {unit!r}")

    @property
    def wraps_at_us(self) -> int:
        """Where the time starts again at 0."""
        if self.wrap_us is not None:
            return self.wrap_us
        unit = self.units.get("time", "us")
        return _WRAP_US.get(unit, 1 << 64) if isinstance(unit, str) else 1 << 64


def pattern_from_table(table: Mapping[str, object]) -> Pattern:
    """Pattern of a table of a TOML file; its keys are the attributes.

    Raises:
        ValueError: an unknown key, or values that mean nothing.
    """
    known = {f.name for f in fields(Pattern)}
    unknown = sorted(set(table) - known)
    if unknown:
        raise ValueError(f"unknown key {unknown[0]!r}; keys are {', '.join(sorted(known))}")
    for key in ("columns", "units"):
        if not isinstance(table.get(key, {}), Mapping):
            raise ValueError(f"{key} must be a table")
    for key in ("regex", "header", "separator", "frame"):
        if not isinstance(table.get(key, ""), str):
            raise ValueError(f"{key} must be text")
    return Pattern(**table)  # type: ignore[arg-type]


_NUMBER = r"[-+]?\d+(?:\.\d*)?"


def _list(names: tuple[str, ...]) -> str:
    return r"\s*,\s*".join(f"(?P<{name}>{_NUMBER})" for name in names)


_ARTEMIS: dict[str, str | list[str]] = {
    "time": "rtcTime",
    "x": ["Q9_1", "Q6_1"],
    "y": ["Q9_2", "Q6_2"],
    "z": ["Q9_3", "Q6_3"],
}

PATTERNS = {
    # Sketches for Adafruit's AHRS and BNO055 libraries.
    "adafruit": Pattern(regex=rf"Quaternion:\s*{_list(_QUAT)}\s*$"),
    # Razor AHRS firmware: x forward, y right, z down.
    "razor": Pattern(regex=rf"#YPR={_list(_ANGLES)}\s*$", frame="NED"),
    # OpenLog Artemis as delivered: no orientation.
    "artemis": Pattern(
        columns={
            **_ARTEMIS,
            **dict(zip(_ACC, ("aX", "aY", "aZ"), strict=True)),
            **dict(zip(_GYR, ("gX", "gY", "gZ"), strict=True)),
            **dict(zip(_MAG, ("mX", "mY", "mZ"), strict=True)),
            "temperature": "imu_degC",
        },
        units={"acc": "mg", "gyr": "deg/s", "mag": "uT", "time": "clock"},
    ),
    # OpenLog Artemis with the sensor's own motion processor: orientation, and readings as raw steps.
    "artemis-dmp": Pattern(
        columns={
            **_ARTEMIS,
            **dict(zip(_ACC, ("RawAX", "RawAY", "RawAZ"), strict=True)),
            **dict(zip(_GYR, ("RawGX", "RawGY", "RawGZ"), strict=True)),
            **dict(zip(_MAG, ("RawMX", "RawMY", "RawMZ"), strict=True)),
        },
        units={"acc": GRAVITY / 8192, "gyr": radians(1 / 16.4), "mag": 0.15, "time": "clock"},
    ),
}
"""Ready patterns by name."""


def _columns(line: str, separator: str) -> list[str]:
    columns = [column.strip() for column in line.split(separator)]
    # Loggers end lines with a separator.
    while columns and not columns[-1]:
        columns.pop()
    return columns


def _indices(pattern: Pattern, columns: list[str]) -> tuple[int, dict[str, int]] | None:
    """Number of columns and place of each field; None if these are not the columns of a header."""
    places = {}
    for name, wanted in pattern.columns.items():
        for column in [wanted] if isinstance(wanted, str) else wanted:
            if column in columns:
                places[name] = columns.index(column)
                break
    for group in (_QUAT[1:], _ANGLES, _ACC, _GYR, _MAG):
        if not all(name in places for name in group):
            for name in group:
                places.pop(name, None)
    if not places.keys() & {"x", "yaw", "ax", "gx"}:
        return None
    return len(columns), places


class Decoder(Receiver):
    """Samples out of a byte stream of lines that may be cut anywhere, start anywhere and contain noise.

    Lines that the pattern says nothing about are skipped. Text has no checksum: a wrong digit stays unseen.
    """

    WRAP_US: int = 1 << 64

    def __init__(self, pattern: Pattern | str) -> None:
        """Start with nothing seen.

        Args:
            pattern: a pattern, or the name of one of PATTERNS.

        Raises:
            ValueError: there is no pattern of that name.
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
            self._layout = _indices(pattern, _columns(pattern.header, pattern.separator))
        self._names = {
            name
            for wanted in pattern.columns.values()
            for name in ([wanted] if isinstance(wanted, str) else wanted)
        }
        # Of columns, the first line may lack its beginning and still have enough of them.
        self._whole = self._layout is None
        self._scales = {quantity: pattern.scale(quantity) for quantity in _UNITS}
        self._clock = pattern.units.get("time") == "clock"
        self._ned = pattern.frame == "NED"
        self._rest = b""
        self._too_long = False

    def feed(self, data: bytes) -> list[Sample]:
        """Samples completed by the next bytes of the stream, in the order they came."""
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

    def _line(self, line: str) -> Sample | None:
        # A line that is too long comes as an empty one.
        if not line or not line.isascii():
            self._bad()
            return None
        values: Mapping[str, str | None]
        if self._regex is not None:
            match = self._regex.search(line)
            if match is None:
                self.counters.skipped += 1
                return None
            values = match.groupdict()
        else:
            columns = _columns(line, self.pattern.separator)
            header = None if self._names.isdisjoint(columns) else _indices(self.pattern, columns)
            if header is not None:
                # A second one: the device has started again.
                self.counters.restarts += self._layout is not None and self._whole
                self._layout, self._whole = header, True
                return None
            if not self._whole or self._layout is None:
                self._whole = True
                self.counters.skipped += 1
                return None
            count, places = self._layout
            if len(columns) != count:
                self._bad()
                return None
            values = {name: columns[place] for name, place in places.items()}
        try:
            sample = self._sample(values)
        except (ValueError, OverflowError):
            sample = None
        if sample is None:
            self._bad()
            return None
        self._good()
        self.counters.packets += 1
        return sample

    def _sample(self, values: Mapping[str, str | None]) -> Sample | None:
        sensor, time_us, temperature = 0, None, None
        quat: Quaternion | None = None
        numbers = {}
        for name, text in values.items():
            if text is None:
                continue
            if name == "sensor":
                sensor = int(text)
                if not 0 <= sensor < 1 << 32:
                    return None
            elif name == "time":
                time_us = self._time(text)
            else:
                value = float(text)
                if not isfinite(value) or "_" in text:
                    return None
                numbers[name] = value
        if "x" in numbers:
            x, y, z = numbers["x"], numbers["y"], numbers["z"]
            w = numbers.get("w")
            if w is None:
                square = 1 - x * x - y * y - z * z
                if square < -0.02:
                    return None
                w = sqrt(max(square, 0.0))
            quat = unit_quaternion(w, x, y, z)
            if quat is None:
                return None
        elif "yaw" in numbers:
            scale = self._scales["angle"]
            yaw, pitch, roll = (numbers[name] * scale for name in _ANGLES)
            quat = rotation.from_angles(yaw, pitch, roll)
            if quat is None:
                return None
        if quat is not None and self._ned:
            quat = z_up(quat)
        if "temperature" in numbers:
            temperature = number(numbers["temperature"] * self._scales["temperature"])
        acc, gyr, mag = (
            self._vector(numbers, names, quantity)
            for names, quantity in ((_ACC, "acc"), (_GYR, "gyr"), (_MAG, "mag"))
        )
        if quat is None and acc is None and gyr is None:
            return None
        return Sample(sensor, time_us, quat, acc, gyr, mag, temperature)

    def _vector(self, numbers: dict[str, float], names: tuple[str, ...], quantity: str) -> Vector3 | None:
        a, b, c = names
        if a not in numbers or b not in numbers or c not in numbers:
            return None
        result = vector((numbers[a], numbers[b], numbers[c]), self._scales[quantity])
        if result is None:
            raise ValueError("no quantity is this large")
        return result

    def _time(self, text: str) -> int:
        if "_" in text:
            raise ValueError
        if self._clock:
            hours, minutes, seconds = text.split(":")
            time_us = round((int(hours) * 60 + int(minutes)) * 60_000_000 + float(seconds) * 1e6)
        else:
            # Whole steps stay whole, however many there are.
            scale = self._scales["time"]
            time_us = (
                int(text) * int(scale)
                if text.isdecimal() and scale.is_integer()
                else round(float(text) * scale)
            )
        if time_us < 0:
            raise ValueError
        return time_us % self.WRAP_US


# --- for simulation -------------------------------------------------------------------------------

_HEADERS = {
    "artemis": "rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,mX,mY,mZ,imu_degC,",
    "artemis-dmp": "rtcDate,rtcTime,Q9_1,Q9_2,Q9_3,HeadAcc,"
    "RawAX,RawAY,RawAZ,RawGX,RawGY,RawGZ,RawMX,RawMY,RawMZ,",
}


def encode_header(name: str) -> bytes:
    """Line that comes before those of `encode`; empty where the device sends none."""
    header = _HEADERS.get(name)
    return b"" if header is None else header.encode() + b"\r\n"


def encode(sample: Sample, name: str) -> bytes:
    """The line of a sample in one of the ready patterns; an absent magnetometer or temperature is sent as 0.

    Raises:
        ValueError: there is no such pattern, or the sample lacks something that its lines have.
    """
    quat, acc, gyr = sample.quat, sample.acc, sample.gyr
    if name not in PATTERNS:
        raise ValueError(f"pattern must be one of {', '.join(PATTERNS)}, not {name!r}")
    if quat is None and name != "artemis":
        raise ValueError(f"lines of {name} have an orientation")
    if name == "adafruit":
        line = "Quaternion: " + ", ".join(f"{x:.4f}" for x in quat or ())
    elif name == "razor":
        # A half turn of the inertial frame is its own inverse.
        angles = rotation.to_yaw_pitch_roll(z_up(quat)) if quat is not None else ()
        line = "#YPR=" + ",".join(f"{degrees(x):.2f}" for x in angles)
    else:
        if acc is None or gyr is None or sample.time_us is None:
            raise ValueError(f"lines of {name} have time, force and rate")
        pattern = PATTERNS[name]
        raw = name == "artemis-dmp"
        parts = ["01/01/2026", _clock(sample.time_us)]
        if raw and quat is not None:
            # Only x, y, z are sent: w is above 0.
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
    seconds, hundredths = divmod(time_us % _DAY_US // 10_000, 100)
    return f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{hundredths:02}"
