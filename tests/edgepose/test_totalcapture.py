"""TotalCapture's sensors as recordings, on a small file of its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.recording import read_recording as read_npz
from edgepose.totalcapture import NAMES, read_recording

REAL = Path(__file__).parents[1] / "data" / "imu" / "six-sites-3s.npz"
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
    text = file.read_text()
    for changed, message in (
        (text[: len(text) // 2], r"line \d+: expected|line at the end: expected|has no"),
        (text.replace("Head\t", "Tail\t"), "frame 1 has no Head"),
        ("", "line 1: expected the numbers of sensors and frames"),
    ):
        file.write_text(changed)
        with pytest.raises(EdgeposeError, match=message) as info:
            read_recording(file)
        assert "\n" not in str(info.value)


def test_another_inertial_frame(file):
    rows = [row.split("\t") for row in file.read_text().splitlines()]
    for row in rows:
        if row[0] in NAMES:
            row[1:5] = ["1", "0", "0", "0"]
            row[5:8] = ["0", "9.8", "0"]
    file.write_text("\n".join("\t".join(row) for row in rows) + "\n")
    with pytest.raises(EdgeposeError, match=r"L_LowArm measures gravity along \[0\.0, 9\.8, 0\.0\] and not"):
        read_recording(file)
