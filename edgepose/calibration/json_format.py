"""Calibration files: human-readable JSON, every value checked on reading."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from edgepose.calibration.added import AddedSensors
from edgepose.calibration.body_frame import check_body_frame
from edgepose.calibration.mounting import mounting
from edgepose.calibration.sensor_to_segment import POSES, Calibration
from edgepose.errors import CalibrationError, EdgeposeError
from edgepose.imu import FILTERS
from edgepose.placements import ADDED, LACKING, PLACEMENTS, SENSORS
from edgepose.rotations import Array
from edgepose.skeleton import MAX_HEIGHT, MIN_HEIGHT
from edgepose.utils.durable_files import write_whole
from edgepose.utils.text_files import read_text

_FORMAT, _VERSION = "edgepose-calibration", 1

_UNKNOWN = (0.0, np.array([1.0, 0.0, 0.0, 0.0]), 0.0)  # numbers of a sensor that the rig lacks

_Fail = Callable[[str], EdgeposeError]


def to_json(calibration: Calibration) -> str:
    """Format a calibration as JSON for `from_json` and for people: sensors by name, degrees, w, x, y, z."""
    mounted = mounting(calibration)
    sensors = {
        name: {
            "heading_offset_deg": math.degrees(sensor.heading_offset),
            "bone_from_sensor": sensor.bone_from_sensor.tolist(),
            "residual_deg": sensor.residual_deg,
            "mounting": mounted[name],
        }
        for name, sensor in calibration.sensors.items()
    }
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "created": calibration.created,
        "pose": calibration.pose,
        "body_frame": calibration.body_frame,
        "body_from_inertial": calibration.body_from_inertial.tolist(),
        "orientation": {"filter": calibration.filter, "north": calibration.north},
        "wearer": {} if calibration.height_m is None else {"height_m": calibration.height_m},
        "sensors": sensors,
        **({"without": list(calibration.without)} if calibration.without else {}),
        "metadata": dict(calibration.metadata),
    }
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # Quaternions on one line each; a line break inside a string is escaped and so never matches.
    text = re.sub(r"\[\n[-+.\de,\s]+\]", lambda numbers: " ".join(numbers[0].split()), text)
    # File names may contain control sequences of a terminal.
    return "".join(c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)


def from_json(text: str, where: str = "calibration") -> Calibration:
    """Read a calibration from JSON text and check every value; `where` names the text in messages.

    Raises:
        CalibrationError: not a calibration of this version, or a sensor or value is missing or impossible.
    """

    def fail(problem: str) -> EdgeposeError:
        return CalibrationError(f"{where}: {problem}")

    try:
        document = json.loads(text, object_pairs_hook=_no_duplicates, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise fail(
            f"not valid JSON ({str(error).splitlines()[0]}); make a new one with `edgepose calibrate`"
        ) from None
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise fail("not an edgepose calibration; make one with `edgepose calibrate`")
    if document.get("version") != _VERSION or isinstance(document.get("version"), bool):
        raise fail(
            f"format version {document.get('version')!r}; this program reads {_VERSION}, calibrate again"
        )
    numbers, without = _sensors(document, fail)
    pose = _member(document, "pose", str, fail)
    if pose not in POSES:
        raise fail(f"pose {pose!r} is none of: {', '.join(POSES)}")
    try:
        body_frame = check_body_frame(_member(document, "body_frame", str, fail))
    except EdgeposeError as error:
        raise fail(str(error).removeprefix(f"{where}: ")) from None
    # Files of versions without filters lack this entry.
    source = _member({"orientation": {"filter": "none", "north": True}} | document, "orientation", dict, fail)
    if source.get("filter") not in FILTERS or not isinstance(source.get("north"), bool):
        raise fail(f"'orientation' must have filter ({', '.join(FILTERS)}) and north (true or false)")
    wearer = _member({"wearer": {}} | document, "wearer", dict, fail)
    height_m = _number(wearer.get("height_m", 1.0))
    if height_m is None or not MIN_HEIGHT <= height_m <= MAX_HEIGHT:
        raise fail(f"'wearer': height_m is not a number between {MIN_HEIGHT} and {MAX_HEIGHT}")
    offsets, mounts, residuals = zip(*(numbers[name] for name in PLACEMENTS), strict=True)
    added = [name for name in ADDED if name in numbers]
    return Calibration(
        body_from_inertial=_unit_quaternion(document, "body_from_inertial", "", fail),
        heading_offset=np.radians(offsets),
        bone_from_sensor=np.stack(mounts),
        residual_deg=np.array(residuals),
        added=AddedSensors(
            added,
            np.radians([numbers[name][0] for name in added]),
            np.array([numbers[name][1] for name in added]).reshape(-1, 4),
            np.array([numbers[name][2] for name in added]),
        ),
        without=without,
        pose=pose,
        body_frame=body_frame,
        created=_member(document, "created", str, fail),
        metadata=_member(document, "metadata", dict, fail),
        filter=source["filter"],
        north=source["north"],
        height_m=height_m if "height_m" in wearer else None,
    )


def _sensors(
    document: dict[str, Any], fail: _Fail
) -> tuple[dict[str, tuple[float, Array, float]], list[str]]:
    """Return the numbers of each sensor, see `_numbers_of`, and those of the six that the rig lacks."""
    sensors = _member(document, "sensors", dict, fail)
    without = _without(document, fail)
    if missing := [name for name in PLACEMENTS if name not in sensors and name not in without]:
        raise fail(f"no sensor {', '.join(missing)}; calibrate again with all six")
    if unknown := [name for name in sensors if name not in SENSORS]:
        raise fail(f"unknown sensor {', '.join(map(repr, unknown))}; the sensors are {', '.join(SENSORS)}")
    if both := [name for name in without if name in sensors]:
        raise fail(f"sensor {', '.join(both)} is in 'without', too; calibrate again")
    if bare := [name for name in sensors if not isinstance(sensors[name], dict)]:
        raise fail(f"sensor {', '.join(bare)} is not an object")
    numbers = {name: _numbers_of(name, sensors[name], fail) for name in SENSORS if name in sensors}
    return dict.fromkeys(without, _UNKNOWN) | numbers, without


def _without(document: dict[str, Any], fail: _Fail) -> list[str]:
    """Return the sensors of the six that the rig lacks."""
    without = document.get("without", [])
    if not isinstance(without, list) or not set(map(str, without)) <= LACKING:
        raise fail(f"'without' may only list {', '.join(sorted(LACKING))}; calibrate again")
    return [name for name in PLACEMENTS if name in without]


def save(calibration: Calibration, path: str | Path, overwrite: bool = True) -> None:
    """Write a calibration as JSON; on failure the file stays as it was.

    Raises:
        CalibrationError: the file cannot be written, or exists and must not be overwritten.
    """
    write_whole(path, to_json(calibration), "the calibration", overwrite=overwrite)


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration from a JSON file; see `from_json` for errors, which name the file."""
    try:
        text = read_text(Path(path))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read the calibration ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(
            f"{path}: not valid JSON (not UTF-8 text); make a new one with `edgepose calibrate`"
        ) from error
    return from_json(text, str(path))


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        (name, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"{name!r} appears twice")
    return result


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _member(owner: dict[str, Any], key: str, kind: type, fail: _Fail) -> Any:
    if not isinstance(owner.get(key), kind):
        raise fail(f"{key!r} is missing or not {'text' if kind is str else 'an object'}")
    return owner[key]


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # An integer with hundreds of digits and 1e999 are valid JSON.
    return float(value) if abs(value) < 1e9 else None


def _unit_quaternion(owner: dict[str, Any], key: str, of: str, fail: _Fail) -> Array:
    values = owner.get(key)
    numbers = [_number(v) for v in values] if isinstance(values, list) else []
    quat = np.array([math.nan if n is None else n for n in numbers])
    if len(quat) != 4 or not abs(np.linalg.norm(quat) - 1.0) < 1e-3:
        raise fail(f"{of}{key!r} is not a unit quaternion w, x, y, z")
    return quat / np.linalg.norm(quat)


def _numbers_of(name: str, sensor: dict[str, Any], fail: _Fail) -> tuple[float, Array, float]:
    """Return heading offset (deg), R_BS (4,) and residual (deg) of one sensor's entry."""
    offset, residual = _number(sensor.get("heading_offset_deg")), _number(sensor.get("residual_deg"))
    if offset is None:
        raise fail(f"sensor {name}: 'heading_offset_deg' is not a number")
    if residual is None or residual < 0:
        raise fail(f"sensor {name}: 'residual_deg' is not a number of at least 0")
    return offset, _unit_quaternion(sensor, "bone_from_sensor", f"sensor {name}: ", fail), residual
