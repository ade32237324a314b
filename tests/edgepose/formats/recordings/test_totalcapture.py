"""TotalCapture's sensors as recordings, on a small file of its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording as read_npz
from edgepose.formats.recordings.totalcapture import NAMES, read_recording
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"
SENSORS = ("Head", "Sternum", "Pelvis", "L_UpArm", "R_UpArm", "L_LowArm", "R_LowArm", "L_LowLeg", "R_LowLeg")
FRAMES = 30


@pytest.fixture
def file(tmp_path) -> Path:
    """Half a second of a real recording, in a folder of a subject."""
    sensors = read_npz(REAL).sensors
    rows = [f"{len(SENSORS)}\t{FRAMES}"]
    for frame in range(FRAMES):
        rows.append(str(frame + 1))
        for name in SENSORS:
            data = sensors[PLACEMENTS[NAMES.index(name)] if name in NAMES else "pelvis"]
            numbers = [*data.quat[frame], *data.acc[frame], *data.gyr[frame], 0.5, 0.0, -1.0]
            rows.append("\t".join([name, *(f"{number:.9f}" for number in numbers)]))
    path = tmp_path / "tc" / "s1" / "acting1_Xsens_AuxFields.sensors"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(rows) + "\n")
    return path


def test_by_the_command(file, command, tmp_path):
    result = command("convert", tmp_path / "tc", "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stdout
    recording = read_npz(tmp_path / "out" / "s1" / "acting1_Xsens_AuxFields.npz")
    assert recording.metadata["rate"] == "60"
    for name, wanted in read_npz(REAL).sensors.items():
        data = recording.sensors[name]
        np.testing.assert_allclose(data.time_s, np.arange(FRAMES) / 60)
        np.testing.assert_allclose(data.acc, wanted.acc[:FRAMES], atol=1e-5)
        apart = np.abs((data.quat * wanted.quat[:FRAMES]).sum(axis=1))
        np.testing.assert_allclose(apart, 1.0, atol=1e-6)


def test_other_files(file):
    for changed, message in (
        ("", "line 1: expected the numbers of sensors and frames"),
        ("9\t30\n1\n", "frame 1 has no L_LowArm, R_LowArm, L_LowLeg, R_LowLeg, Head, Pelvis"),
        ("9\t30\n7\n", "line 2: expected frame 1 of 30, found '7'"),
    ):
        file.write_text(changed)
        with pytest.raises(EdgeposeError, match=message) as info:
            read_recording(file)
        assert "\n" not in str(info.value)


LINE = len(SENSORS) + 1
NAN = "\tnan\t0\t0\t0\t0\t0\t9.8\t0\t0\t0\t0\t0\t0"


@pytest.mark.parametrize(
    ("change", "counts", "message"),
    [
        (lambda rows: rows[:-3], {1: 29, 2: 29, 3: 29}, "frame 30 has no R_LowArm, L_LowLeg, R_LowLeg"),
        (lambda rows: rows[: 20 * LINE + 1], {i: 20 for i in range(6)}, "line at the end: expected frame 21"),
        (lambda rows: [*rows[:5], rows[5].split("\t")[0] + NAN, *rows[6:]], {}, None),
        (lambda rows: [*rows[:2], "Head" + NAN, *rows[3:]], {4: 29}, "line 3: expected a unit quaternion"),
        (lambda rows: [row.replace("Head\t", "Tail\t") for row in rows], {4: 0}, "frame 1 has no Head"),
    ],
)
def test_good_rows_of_damaged_files(file, change, counts, message):
    rows = change(file.read_text().splitlines())
    file.write_text("\n".join(rows) + "\n")
    recording = read_recording(file)
    found = [len(recording.sensors[name].time_s) if name in recording.sensors else 0 for name in PLACEMENTS]
    assert found == [counts.get(i, FRAMES) for i in range(6)]
    assert (recording.damage is None) if message is None else (message in recording.damage)


def test_a_number_that_is_cut_is_none(file):
    rows = file.read_text().splitlines()
    head = 1 + 11 * LINE + 1
    assert rows[head - 1] == "12"
    cut = "\t".join(rows[head].split("\t")[:8])[:-3]
    file.write_text("\n".join([*rows[:head], cut]))
    recording = read_recording(file)
    assert "frame 12 has no L_LowArm, R_LowArm, L_LowLeg, R_LowLeg, Head, Pelvis" in recording.damage
    assert [len(data.time_s) for data in recording.sensors.values()] == [11] * 6


def test_another_inertial_frame(file):
    rows = [row.split("\t") for row in file.read_text().splitlines()]
    for row in rows:
        if row[0] in NAMES:
            row[1:5] = ["1", "0", "0", "0"]
            row[5:8] = ["0", "9.8", "0"]
    file.write_text("\n".join("\t".join(row) for row in rows) + "\n")
    with pytest.raises(
        EdgeposeError, match=r"L_LowArm measures gravity along \[0\.0, 9\.8, 0\.0\] instead of Z"
    ):
        read_recording(file)


def write_recording(path: Path, recording: Recording) -> Path:
    frames = len(recording.sensors["head"].time_s)
    lines = [f"{len(NAMES)}\t{frames}"]
    for i in range(frames):
        lines.append(str(i + 1))
        for name, data in zip(NAMES, recording.sensors.values(), strict=True):
            lines.append("\t".join([name, *(f"{x:.7f}" for x in (*data.quat[i], *data.acc[i]))]))
    path = path.with_suffix(".sensors")
    path.write_text("\n".join(lines) + "\n")
    return path
