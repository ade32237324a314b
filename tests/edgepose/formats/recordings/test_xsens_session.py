"""Sessions of Xsens sensors, written here in the layouts of MT Manager and Movella DOT."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.convert import plan
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.formats.recordings.xsens_session import is_session, read_session
from edgepose.imu import ImuSample, Recording
from edgepose.placements import PLACEMENTS

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"
HEAD = (
    "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n"
    "// Firmware Version: 4.6.0\n"
)
COLUMNS = [
    "PacketCounter",
    "SampleTimeFine",
    "Acc_X",
    "Acc_Y",
    "Acc_Z",
    "Gyr_X",
    "Gyr_Y",
    "Gyr_Z",
    "Mag_X",
    "Mag_Y",
    "Mag_Z",
    "Quat_q0",
    "Quat_q1",
    "Quat_q2",
    "Quat_q3",
]


def session(folder: Path, names: list[str], start: int = 23_593, separator: str = "\t") -> list[ImuSample]:
    """One second of a real recording as MT Manager exports it."""
    written = list(iter_samples(read_recording(REAL)))[:600]
    folder.mkdir(exist_ok=True)
    for sensor, name in enumerate(names):
        lines = [separator.join(COLUMNS)]
        for i, row in enumerate(row for row in written if row.sensor == sensor):
            numbers = [*row.acc, *row.gyr, 0.25, -0.5, 1.0, *row.quat]
            cells = [str((start + i) & 0xFFFF), "", *(f"{number:.6f}" for number in numbers)]
            lines.append(separator.join(cells))
        (folder / f"{name}.txt").write_text(HEAD + "\n".join(lines) + "\n")
    return written


def same(recording, written: list[ImuSample]) -> None:
    for a, b in zip(
        recording_from_samples(written).sensors.values(), recording.sensors.values(), strict=True
    ):
        np.testing.assert_allclose(b.time_s, a.time_s - a.time_s[0], atol=1e-6)
        np.testing.assert_allclose(b.acc, a.acc, atol=1e-6)
        np.testing.assert_allclose(b.gyr, a.gyr, atol=1e-6)
        np.testing.assert_allclose(b.quat, a.quat, atol=1e-6)
        assert (b.mag == [0.25, -0.5, 1.0]).all()


IDS = [f"walk_000-000_00B4D7D{i}" for i in range(6)]


@pytest.mark.parametrize("separator", ["\t", ",", ";"])
def test_placements_in_the_names_of_files(tmp_path, separator):
    names = [f"{name}_{number}" for name, number in zip(PLACEMENTS, IDS, strict=True)]
    written = session(tmp_path / "walk", names, separator=separator)
    (tmp_path / "walk" / "readme.txt").write_text("what it was\n")
    recording = read_session(tmp_path / "walk")
    assert recording.damage is None
    same(recording, written)


def test_device_ids_by_the_command(command, tmp_path):
    written = session(tmp_path / "walk", IDS)
    sensors = tmp_path / "map.toml"
    sensors.write_text("".join(f"{name} = {{ id = 0x00B4D7D{i} }}\n" for i, name in enumerate(PLACEMENTS)))
    result = command("convert", tmp_path, "--sensors", sensors, "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stdout + result.stderr
    same(read_recording(tmp_path / "out" / "walk.npz"), written)
    result = command("convert", tmp_path / "walk", "--to", "npz", "--out", tmp_path / "out2")
    assert result.returncode == 1
    assert "no placement in the names of its files" in result.stderr


def test_a_counter_that_begins_anew_and_lost_packets(tmp_path):
    written = session(tmp_path, list(PLACEMENTS), start=65_500)
    head = tmp_path / "head.txt"
    lines = head.read_text().splitlines(keepends=True)
    del lines[5:60]  # the head comes when the counter has begun anew
    del lines[20]
    head.write_text("".join(lines))
    recording = read_session(tmp_path)
    assert recording.damage is None
    heads = [row for row in written if row.sensor == PLACEMENTS.index("head")][55:]
    del heads[15]
    np.testing.assert_allclose(
        recording.sensors["head"].time_s, [row.time_s - written[0].time_s for row in heads], atol=1e-6
    )
    np.testing.assert_allclose(recording.sensors["head"].acc, [row.acc for row in heads], atol=1e-6)


def test_bad_rows_cost_only_themselves(tmp_path):
    session(tmp_path, list(PLACEMENTS))
    head = tmp_path / "head.txt"
    lines = head.read_text().splitlines(keepends=True)
    lines[10] = lines[10].replace(".", "x")
    lines[20] = "1\t2\n"
    lines[30] = lines[29]  # once more
    lines[40] = lines[40].replace(lines[40].split("\t")[3], "nan")
    lines[50] = "\t".join(["" if 2 <= i < 8 else cell for i, cell in enumerate(lines[50].split("\t"))])
    lines[-1] = lines[-1][:-3]
    head.write_text("".join(lines))
    recording = read_session(tmp_path)
    assert recording.damage == (
        f"{head}: 5 bad rows left out, the first: row 11 holds something that is no number ('8x656100')"
    )
    assert len(recording.sensors["head"].time_s) == 95
    assert np.isnan(recording.sensors["head"].acc).any(axis=1).sum() == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("// Update Rate: 100.0Hz\n", "", "no valid 'Update Rate: ... Hz'"),
        ("100.0Hz", "0.0Hz", "no valid 'Update Rate: ... Hz'"),
        ("Acc_Y", "FreeAcc_N", "has no columns Acc_Y"),
    ],
)
def test_other_files(tmp_path, old, new, message):
    session(tmp_path, list(PLACEMENTS))
    head = tmp_path / "head.txt"
    head.write_text(head.read_text().replace(old, new))
    with pytest.raises(EdgeposeError, match=message):
        read_session(tmp_path)
    assert not is_session(tmp_path / "nowhere")


# --- other columns, clocks and spellings --------------------------------------------------------------------

ROWS = [row for row in iter_samples(read_recording(REAL)) if row.sensor == 0][:100]
QUAT = ["Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"]
MATRIX = [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
ACC, FREE, GYR = ([f"{name}_{axis}" for axis in "XYZ"] for name in ("Acc", "FreeAcc", "Gyr"))
ORIENTATION = {
    "quaternion": (QUAT, lambda r: r.as_quat()[[3, 0, 1, 2]]),
    "of DOT": (["Quat_W", "Quat_X", "Quat_Y", "Quat_Z"], lambda r: r.as_quat()[[3, 0, 1, 2]]),
    "matrix": (MATRIX, lambda r: r.as_matrix().T.ravel()),
    "Euler": (["Roll", "Pitch", "Yaw"], lambda r: r.as_euler("ZYX", degrees=True)[::-1]),
    "Euler of DOT": (["Euler_X", "Euler_Y", "Euler_Z"], lambda r: r.as_euler("ZYX", degrees=True)[::-1]),
}


def write(
    folder: Path, head: str, names: list[str], cells: Callable[[int, ImuSample], list[float]], **spelling: str
) -> Path:
    """The same sensor as all six; `cells` gives the numbers of a row."""
    text = ",".join(names) + "\n"
    for i, row in enumerate(ROWS):
        text += ",".join(str(x) if isinstance(x, int) else f"{x:.9f}" for x in cells(i, row)) + "\n"
    text = head + text.replace(",", spelling.get("separator", "\t")).replace(".", spelling.get("point", "."))
    folder.mkdir()
    for name in PLACEMENTS:
        path = folder / f"{name}{spelling.get('ending', '.txt')}"
        path.write_text(text, encoding=spelling.get("encoding", "utf-8"))
    return folder


def turned(row: ImuSample) -> Rotation:
    return Rotation.from_quat(np.roll(row.quat, -1))


def check_rows(folder: Path, gyr: bool = True) -> None:
    recording = read_recording(folder)
    assert recording.damage is None
    for data in recording.sensors.values():
        np.testing.assert_allclose(data.time_s, [row.time_s - ROWS[0].time_s for row in ROWS], atol=2e-6)
        np.testing.assert_allclose(np.abs(np.sum(data.quat * [row.quat for row in ROWS], axis=1)), 1.0)
        np.testing.assert_allclose(data.acc, [row.acc for row in ROWS], atol=1e-6)
        if gyr:
            np.testing.assert_allclose(data.gyr, [row.gyr for row in ROWS], atol=1e-6)
        else:
            assert data.gyr is None


@pytest.mark.parametrize("name", ORIENTATION)
def test_an_orientation_in_any_form(tmp_path, name):
    columns, values = ORIENTATION[name]
    head = "DeviceTag: A\n" if "DOT" in name else HEAD
    check_rows(
        write(
            tmp_path / "walk",
            head,
            ["PacketCounter", "SampleTimeFine", *ACC, *columns],
            lambda i, row: [i, 10_000 * i if "DOT" in name else 100 * i, *row.acc, *values(turned(row))],
        ),
        gyr=False,
    )


@pytest.mark.parametrize(
    "spelling",
    [
        {"separator": ";", "point": ","},
        {"separator": "\t", "point": ",", "encoding": "utf-16"},
        {"separator": ";", "encoding": "utf-8-sig", "ending": ".csv"},
        {"separator": ", ", "ending": ".CSV"},
    ],
)
def test_a_table_of_any_spelling(tmp_path, spelling):
    """Without an update rate: the rate is that of SampleTimeFine, which starts again at 0 on the way."""
    check_rows(
        write(
            tmp_path / "walk",
            "// MT Manager version: 2020\n",
            ["PacketCounter", "SampleTimeFine", *ACC, *GYR, *QUAT],
            lambda i, row: [i, (2**32 - 300 + 100 * i) % 2**32, *row.acc, *row.gyr, *row.quat],
            **spelling,
        )
    )


def test_movella_dot(tmp_path):
    """Acceleration without gravity in the inertial frame, rates in degrees a second, microseconds."""

    def cells(i: int, row: ImuSample) -> list[float]:
        free = turned(row).apply(row.acc) - [0.0, 0.0, 9.80665]
        return [i, (2**32 - 30_000 + 10_000 * i) % 2**32, *row.quat, *free, *np.degrees(row.gyr), 0]

    names = ["PacketCounter", "SampleTimeFine", *ORIENTATION["of DOT"][0], *FREE, *GYR, "Status"]
    head = "sep=,\nDeviceTag:,A\nOutputRate:,100Hz\n\n"
    check_rows(write(tmp_path / "walk", head, names, cells, separator=",", ending=".csv"))


def test_decimal_commas_between_commas(tmp_path):
    names = ["PacketCounter", "SampleTimeFine", *ACC, *QUAT]
    folder = write(
        tmp_path / "walk", HEAD, names, lambda i, row: [i, i, *row.acc, *row.quat], separator=",", point=","
    )
    with pytest.raises(EdgeposeError, match="row 6 has 16 cells for 9 columns: its numbers have decimal"):
        read_recording(folder)


def test_a_folder_is_converted_as_one_recording(tmp_path):
    names = ["PacketCounter", "SampleTimeFine", *ACC, *QUAT]
    folder = write(
        tmp_path / "walk",
        HEAD,
        names,
        lambda i, row: [i, i, *row.acc, *row.quat],
        separator=",",
        ending=".csv",
    )
    assert [job.source for job in plan([tmp_path], "npz", tmp_path / "out")] == [folder]
    with pytest.raises(
        EdgeposeError, match="one sensor of a session of Xsens sensors; give the folder above"
    ):
        read_recording(folder / "head.csv")


def test_tables_that_were_joined(tmp_path):
    written = session(tmp_path, list(PLACEMENTS))
    for name in PLACEMENTS:
        file = tmp_path / f"{name}.txt"
        lines = file.read_text().splitlines(keepends=True)
        file.write_text("".join([*lines[:50], *lines[:5], *lines[50:]]))
    recording = read_session(tmp_path)
    assert recording.damage is None
    same(recording, written)


@pytest.mark.parametrize(
    ("content", "says"),
    [("", "is empty"), (HEAD + "\t".join(COLUMNS) + "\n", "has no rows below its columns")],
)
def test_a_file_without_rows_is_named(tmp_path, content, says):
    session(tmp_path, list(PLACEMENTS))
    (tmp_path / "head.txt").write_text(content)
    with pytest.raises(EdgeposeError, match=rf"no samples of head; .* \({tmp_path / 'head.txt'}: {says}\)"):
        read_recording(tmp_path)


def test_a_sensor_that_was_restarted_far_from_the_wrap(tmp_path):
    """Its counter is at 0 again: that is no gap of four minutes."""
    session(tmp_path, list(PLACEMENTS), start=40_000)
    head = tmp_path / "head.txt"
    lines = head.read_text().splitlines(keepends=True)
    lines[65:] = [re.sub(r"^\d+", str(i), line) for i, line in enumerate(lines[65:])]
    head.write_text("".join(lines))
    recording = read_session(tmp_path)
    assert recording.damage == (
        f"{head}: 40 bad rows left out, the first: row 66 is not after the row before it; if the sensor was "
        "restarted there, split the file"
    )
    assert recording.sensors["head"].time_s[-1] == pytest.approx(0.59)


def test_two_recordings_in_one_folder(tmp_path):
    session(tmp_path, [f"{name}_000-000" for name in PLACEMENTS])
    session(tmp_path, [f"{name}_001-000" for name in PLACEMENTS])
    with pytest.raises(EdgeposeError, match=r"are both \w+; rename one, or give each recording a folder of"):
        read_session(tmp_path)


def write_recording(path: Path, recording: Recording, names: tuple[str, ...] = PLACEMENTS) -> Path:
    frames = len(recording.sensors["head"].time_s)
    columns = ["PacketCounter", *(f"Acc_{x}" for x in "XYZ"), *(f"Gyr_{x}" for x in "XYZ")]
    columns += [f"Quat_q{i}" for i in range(4)]
    path.mkdir()
    for name, data in zip(names, recording.sensors.values(), strict=True):
        lines = ["// Update Rate: 60.0Hz", "\t".join(columns)]
        for i in range(frames):
            lines.append(
                "\t".join([str(i), *(f"{x:.7f}" for x in (*data.acc[i], *data.gyr[i], *data.quat[i]))])
            )
        (path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return path
