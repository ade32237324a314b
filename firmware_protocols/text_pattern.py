"""Descriptions of text lines, for the decoder in `text`.

docs/text.md shows how to write one in a TOML file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import radians

from firmware_protocols._numbers import LARGEST
from firmware_protocols.sample import STANDARD_G

FIELDS = (
    "sensor", "time", "w", "x", "y", "z", "yaw", "pitch", "roll",
    "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature",
)  # fmt: skip
"""Names of the values in a line: groups of a regular expression, or keys of `columns`."""

FRAMES = ("Z-up", "NED")

UNITS: dict[str, dict[str, float]] = {
    "acc": {"m/s2": 1.0, "g": STANDARD_G, "mg": STANDARD_G / 1000},
    "gyr": {"rad/s": 1.0, "deg/s": radians(1.0), "mrad/s": 0.001},
    "mag": {"uT": 1.0, "nT": 0.001, "mG": 0.1, "G": 100.0},
    "angle": {"deg": radians(1.0), "rad": 1.0},
    "time": {"us": 1.0, "ms": 1e3, "s": 1e6, "clock": 1e6},
    "temperature": {"degC": 1.0},
}
DAY_US = 86_400_000_000
_WRAP_US = {"us": 1 << 32, "ms": 1000 << 32, "clock": DAY_US}

QUAT, ANGLES = ("w", "x", "y", "z"), ("yaw", "pitch", "roll")
ACC, GYR, MAG = ("ax", "ay", "az"), ("gx", "gy", "gz"), ("mx", "my", "mz")


@dataclass(frozen=True)
class Pattern:
    """Description of the lines of a device: either a regular expression or columns.

    Attributes:
        regex: searched for in every line; its named groups are FIELDS. It should begin with fixed text and
            end in `$`, so that neither a part of a line nor two joined parts can match. A group should not
            match the text that separates it from the next, or bad lines take long to be rejected.
        columns: for each of the FIELDS, the name of its column in the header line, or a list of names, the
            first of which in the header is used. Fields without a column in the header are absent.
        header: the header line, for devices that send none or sent it before the port was open.
        separator: text between columns.
        units: of acc (m/s2, g, mg), gyr (rad/s, deg/s, mrad/s), mag (uT, nT, mG, G), angle (deg, rad), time
            (us, ms, s, clock: hours:minutes:seconds), or the SI value (uT, us) of one step as a number; a
            leading minus inverts the sign. The defaults are SI units, degrees and us.
        frame: inertial frame of the orientation, "Z-up" or "NED".
        wrap_us: the time restarts at 0 after this many microseconds; by default after 2^32 us or ms, after a
            day for clock, never for s.

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
        """Check the pattern.

        Raises:
            ValueError: the pattern is invalid or ambiguous.
        """
        if (self.regex is None) == (not self.columns):
            raise ValueError("a pattern needs either a regex or columns")
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
        for group in (QUAT[1:], ANGLES, ACC, GYR, MAG):
            missing = [name for name in group if name not in names]
            if 0 < len(missing) < 3:
                raise ValueError(
                    f"{group[0]} without {missing[0]}" if missing[0] != group[0] else f"no {group[0]}"
                )
        if "w" in names and "x" not in names:
            raise ValueError("w without x")
        if not names & {"x", "yaw", "ax", "gx"}:
            raise ValueError("a pattern needs an orientation, an acceleration or an angular rate")
        if {"x", "yaw"} <= names:
            raise ValueError("a pattern can have either a quaternion or angles, not both")
        if not self.separator or not isinstance(self.separator, str):
            raise ValueError("separator must be a non-empty string")
        if self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(FRAMES)}, not {self.frame!r}")
        if self.wrap_us is not None and not (type(self.wrap_us) is int and 0 < self.wrap_us <= 1 << 64):
            raise ValueError("wrap_us must be an integer from 1 to 2^64")
        for quantity in self.units:
            self.scale(quantity)
        if self.header is not None and (
            not self.columns or find_columns(self, columns_of(self.header, self.separator)) is None
        ):
            raise ValueError("the header has none of the columns")

    def scale(self, quantity: str) -> float:
        """Return the SI value (uT, us) of one step.

        Raises:
            ValueError: no such quantity or unit.
        """
        known = UNITS.get(quantity)
        if known is None:
            raise ValueError(f"units: unknown quantity {quantity!r}; quantities are {', '.join(UNITS)}")
        unit = self.units.get(quantity, next(iter(known)))
        if isinstance(unit, str):
            name = unit.removeprefix("-")
            if name in known and (unit == name or quantity not in ("time", "temperature")):
                return known[name] if unit == name else -known[name]
        elif type(unit) in (int, float) and 0 < abs(unit) <= LARGEST:
            return float(unit)
        raise ValueError(f"units: {quantity} must be one of {', '.join(known)} or a number, not {unit!r}")

    @property
    def wraps_at_us(self) -> int:
        """The time restarts at 0 after this many microseconds."""
        if self.wrap_us is not None:
            return self.wrap_us
        unit = self.units.get("time", "us")
        return _WRAP_US.get(unit, 1 << 64) if isinstance(unit, str) else 1 << 64


def pattern_from_table(table: Mapping[str, object]) -> Pattern:
    """Return the pattern of a TOML table, whose keys are the attributes of `Pattern`.

    Raises:
        ValueError: an unknown key or an invalid value.
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
    "adafruit": Pattern(regex=rf"Quaternion:\s*{_list(QUAT)}\s*$"),
    # Razor AHRS firmware: x forward, y right, z down.
    "razor": Pattern(regex=rf"#YPR={_list(ANGLES)}\s*$", frame="NED"),
    # OpenLog Artemis as delivered: no orientation.
    "artemis": Pattern(
        columns={
            **_ARTEMIS,
            **dict(zip(ACC, ("aX", "aY", "aZ"), strict=True)),
            **dict(zip(GYR, ("gX", "gY", "gZ"), strict=True)),
            **dict(zip(MAG, ("mX", "mY", "mZ"), strict=True)),
            "temperature": "imu_degC",
        },
        units={"acc": "mg", "gyr": "deg/s", "mag": "uT", "time": "clock"},
    ),
    # OpenLog Artemis with the sensor's own motion processor: orientation, and readings as raw steps.
    "artemis-dmp": Pattern(
        columns={
            **_ARTEMIS,
            **dict(zip(ACC, ("RawAX", "RawAY", "RawAZ"), strict=True)),
            **dict(zip(GYR, ("RawGX", "RawGY", "RawGZ"), strict=True)),
            **dict(zip(MAG, ("RawMX", "RawMY", "RawMZ"), strict=True)),
        },
        units={"acc": STANDARD_G / 8192, "gyr": radians(1 / 16.4), "mag": 0.15, "time": "clock"},
    ),
}
"""Built-in patterns by name."""


def columns_of(line: str, separator: str) -> list[str]:
    """Return the columns of a line, without empty ones at its end."""
    columns = [column.strip() for column in line.split(separator)]
    # Loggers end lines with a separator.
    while columns and not columns[-1]:
        columns.pop()
    return columns


def find_columns(pattern: Pattern, columns: list[str]) -> tuple[int, dict[str, int]] | None:
    """Return the number of columns and the index of each field; None if the columns are not a header."""
    indices = {}
    for name, wanted in pattern.columns.items():
        for column in [wanted] if isinstance(wanted, str) else wanted:
            if column in columns:
                indices[name] = columns.index(column)
                break
    for group in (QUAT[1:], ANGLES, ACC, GYR, MAG):
        if not all(name in indices for name in group):
            for name in group:
                indices.pop(name, None)
    if not indices.keys() & {"x", "yaw", "ax", "gx"}:
        return None
    return len(columns), indices
