"""Sessions of Xsens sensors: a folder with one table for each sensor, of MT Manager or of Movella DOT.

Columns have names. Sensors of one session count packets together, in 16 bits, and share the time in
SampleTimeFine, which has 32 bits: units of 100 us in files of MT Manager, of 1 us in files of Movella DOT.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import nan
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.ledger import Ledger
from edgepose.formats.recordings.base import RecordingFormat, SampleTable
from edgepose.formats.recordings.xio_session import by_placement, placement_of
from edgepose.formats.tables import open_table, read_numbers
from edgepose.imu import Recording
from edgepose.rotations import euler_to_matrix, matrix_to_quat, quat_conjugate, quat_rotate
from firmware_protocols.sample import STANDARD_G

Array = NDArray[np.float64]

_ENDINGS = (".txt", ".csv")
_COUNTER, _TICKS = "PacketCounter", "SampleTimeFine"
_RATE = re.compile(r"(?:Update Rate|OutputRate)\W*([0-9]+(?:\.[0-9]+)?)\s*Hz", re.IGNORECASE)
_DOT = ("DeviceTag", "Quat_W", "Euler_X")
_UP = (0.0, 0.0, STANDARD_G)
_LONGEST_GAP = 1 / 32  # of the counts from wrap to wrap, in which a counter may wrap unseen: 20 s at 100 Hz

_METADATA = {"frame": "Z up", "units": "s, m/s^2, rad/s; mag in the device's own units"}


def _from_matrix(values: Array) -> Array:
    # The file has the columns of the matrix one after the other.
    return matrix_to_quat(values.reshape(-1, 3, 3).transpose(0, 2, 1))


def _from_euler(values: Array) -> Array:
    return matrix_to_quat(euler_to_matrix(np.radians(values[:, ::-1]), "zyx"))


_Orientation = tuple[Sequence[str], Callable[[Array], Array]]

_ORIENTATIONS: tuple[_Orientation, ...] = (
    (("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"), lambda values: values),
    (("Quat_W", "Quat_X", "Quat_Y", "Quat_Z"), lambda values: values),
    ([f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)], _from_matrix),
    (("Roll", "Pitch", "Yaw"), _from_euler),
    (("Euler_X", "Euler_Y", "Euler_Z"), _from_euler),
)
"""Columns of an orientation, and what makes quaternions (n, 4) of them; the first that a file has is read."""

_VECTORS = {name: [f"{name}_{axis}" for axis in "XYZ"] for name in ("Acc", "FreeAcc", "Gyr", "Mag")}


class _Sensor(NamedTuple):
    """One sensor's file.

    Attributes:
        time: (n,) numbers of packets, or ticks, counted on over the wraps.
        scale_s: seconds in one of them.
        wrap: after how many they start again at 0.
        quantities: (n, 13) quaternion, specific force, rate and field; NaN where not measured.
        numbers: (n,) lines of the file.
    """

    time: Array
    scale_s: float
    wrap: int
    quantities: Array
    numbers: NDArray[np.int_]


def is_sensor(path: Path) -> bool:
    """Whether a file is the table of one sensor."""
    if path.suffix.lower() not in _ENDINGS or not path.is_file():  # a pipe could be waited for in vain
        return False
    with suppress(OSError, FileFormatError), open_table(path, _fits, _COUNTER):
        return True
    return False


def is_session(folder: Path) -> bool:
    """Whether a folder holds tables of Xsens sensors."""
    return bool(_sensors(folder))


def _sensors(folder: Path) -> list[Path]:
    with suppress(OSError):
        return sorted(filter(is_sensor, folder.iterdir()))
    return []


def _empty_files(folder: Path) -> list[Path]:
    files = (path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS and path.is_file())
    return sorted(path for path in files if not path.stat().st_size)


def _fits(names: Sequence[str]) -> bool:
    return _COUNTER in names and len(names) > 1


def read_session(folder: Path, ids: Mapping[int, str] | None = None) -> Recording:
    """Read a session; its time starts with the first packet.

    Args:
        folder: of the session.
        ids: placements by device id, which is in the names of the files. Without them a file has the
            placement in its name, such as "left_lower_leg_00B4D7D3.txt".

    Raises:
        FileFormatError: no file is of a placement, two are of one, or a file lacks columns.
    """
    places = by_placement(folder, _sensors(folder), ids)
    damage = [f"{path}: is empty" for path in _empty_files(folder) if placement_of(path.name, ids)]
    sensors = {name: _read(path, damage) for name, path in places.items()}
    sensors = {name: sensor for name, sensor in sensors.items() if len(sensor.time)}
    table = SampleTable(str(folder), salvage=True)
    times = _common_times(list(sensors.values()))
    for (name, sensor), time_s in zip(sensors.items(), times, strict=True):
        empty = np.isnan(sensor.quantities).sum(axis=1)
        table.add_block(name, sensor.numbers, np.hstack([time_s[:, None], sensor.quantities]), empty)
    data = table.sensors()
    damage += [table.damage() or ""]
    return Recording(data, _METADATA | {"source": "Xsens tables"}, "; ".join(filter(None, damage)) or None)


def _common_times(sensors: Sequence[_Sensor]) -> list[Array]:
    """Times (n,) of each sensor, seconds, from the first packet of all."""
    if not sensors:
        return []
    first = sensors[0]
    times = []
    for sensor in sensors:
        # Starts that are near each other may be on either side of a wrap.
        apart = sensor.time[0] - first.time[0]
        shift = (apart + sensor.wrap / 2) % sensor.wrap - sensor.wrap / 2 - apart
        times.append((sensor.time + shift) * sensor.scale_s)
    start = min(time[0] for time in times)
    return [time - start for time in times]


def _read(path: Path, damage: list[str]) -> _Sensor:
    """Read the table of one sensor; what is left out of it is added to `damage`."""
    ledger = Ledger(str(path))
    try:
        with open_table(path, _fits, _COUNTER) as table:
            head, names = table.head, table.names
            orientation = next((each for each in _ORIENTATIONS if set(each[0]) <= set(names)), None)
            force = "FreeAcc" if orientation and "Acc_X" not in names and "FreeAcc_X" in names else "Acc"
            missing = [name for name in _VECTORS[force] if name not in names]
            if missing:
                raise FileFormatError(f"{path}: has no columns {', '.join(missing)}; export them too")
            rows, columns = read_numbers(table, ledger)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror}") from None
    is_dot = any(mark in text for text in (*head, *names) for mark in _DOT)
    count, scale_s, wrap = _clock(path, head, columns, is_dot)

    def keep(good: NDArray[np.bool_], problem: str) -> None:
        nonlocal rows, columns, count
        ledger.leave_out_unless(good, rows, problem)
        rows, columns, count = rows[good], {name: v[good] for name, v in columns.items()}, count[good]

    keep(np.isfinite(count), "has no number of its packet")
    keep(
        _steps_on(count, wrap),
        "is not after the row before it; if the sensor was restarted there, split the file",
    )
    quantities = _quantities(columns, orientation, force, is_dot)
    measured = np.asarray(~np.isnan(quantities).all(axis=1))
    ledger.leave_out_unless(measured, rows, "has no measurement")
    empty = None if measured.any() or ledger.count else f"{path}: has no rows below its columns"
    damage += filter(None, [ledger.damage(), empty])
    return _Sensor(_unwrapped(count, wrap)[measured], scale_s, wrap, quantities[measured], rows[measured])


def _clock(
    path: Path, head: Sequence[str], columns: Mapping[str, Array], is_dot: bool
) -> tuple[Array, float, int]:
    """What counts the rows (n,), seconds in one count, and after how many it starts again at 0."""
    found = next((float(match[1]) for line in head if (match := _RATE.search(line))), None)
    ticks = columns.get(_TICKS)
    has_ticks = ticks is not None and len(ticks) > 0 and bool(np.isfinite(ticks).all())
    if ticks is not None and has_ticks and (is_dot or found is None):
        return ticks, 1e-6 if is_dot else 1e-4, 1 << 32
    if found is None or not 0.1 < found < 10_000.0:
        raise FileFormatError(
            f"{path}: no valid 'Update Rate: ... Hz' in its first lines, and no {_TICKS}; export one of them"
        )
    return columns[_COUNTER], 1.0 / found, 1 << 16


def _steps_on(count: Array, wrap: int) -> NDArray[np.bool_]:
    """Which counts (n,) come after the last good one, over wraps.

    A count that starts again long before it would wrap is that of a sensor that was restarted.
    """
    good = np.ones(len(count), dtype=bool)
    last = None
    for i, value in enumerate(count.tolist()):
        longest = wrap / 2 if last is None or value > last else wrap * _LONGEST_GAP
        good[i] = last is None or 0 < (value - last) % wrap < longest
        last = value if good[i] else last
    return good


def _unwrapped(count: Array, wrap: int) -> Array:
    """Counts (n,) that go on over the wraps."""
    return count[:1].sum() + np.concatenate([[0.0], np.cumsum(np.diff(count) % wrap)])[: len(count)]


def _quantities(
    columns: Mapping[str, Array], orientation: _Orientation | None, force: str, is_dot: bool
) -> Array:
    """Quaternion, specific force, rate and field (n, 13) in the units of a sample."""

    def of(names: Sequence[str]) -> Array:
        values = np.stack([columns.get(name, np.full(len(columns[_COUNTER]), nan)) for name in names], axis=1)
        values[np.isnan(values).any(axis=1)] = nan
        return values

    quat = np.full((len(columns[_COUNTER]), 4), nan)
    if orientation is not None:
        values = of(orientation[0])
        whole = ~np.isnan(values[:, 0])
        quat[whole] = orientation[1](values[whole])
    acc, gyr, mag = (of(_VECTORS[name]) for name in (force, "Gyr", "Mag"))
    if force == "FreeAcc":
        acc = quat_rotate(quat_conjugate(quat), acc + _UP)
    return np.hstack([quat, acc, np.radians(gyr) if is_dot else gyr, mag])


FORMAT = RecordingFormat(
    (),
    lambda folder, options: read_session(folder, options.ids),
    is_folder=is_session,
    is_part=is_sensor,
    description="a session of Xsens sensors",
)
