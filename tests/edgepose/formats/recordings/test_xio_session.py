"""Sessions of x-io sensors, written here in the layout of x-io's own logger."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import salvage_recording
from edgepose.formats.recordings.xio_session import read_session
from edgepose.imu import Recording
from firmware_protocols.sample import STANDARD_G

COUNT = 50
TURNS = Rotation.from_rotvec(np.cumsum(np.full((COUNT, 3), [0.01, -0.02, 0.03]), axis=0))
NAME = "left forearm"
INERTIAL = (1.0, 2.0, 3.0, 0.0, 0.0, 1.0)
FILES = {"I": "Inertial.csv", "Q": "Quaternion.csv", "R": "RotationMatrix.csv", "A": "EulerAngles.csv"}

MESSAGES: dict[str, Callable[[Rotation], np.ndarray]] = {
    "Q": lambda r: r.as_quat()[[3, 0, 1, 2]],
    "R": lambda r: r.as_matrix().ravel(),
    "A": lambda r: r.as_euler("ZYX", degrees=True)[::-1],
}


HEADS = {
    "I": "Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
    "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)",
    "Q": "W,X,Y,Z",
    "R": "XX,XY,XZ,YX,YY,YZ,ZX,ZY,ZZ",
    "A": "Roll (deg),Pitch (deg),Yaw (deg)",
}
"""Columns as ximu3.DataLogger writes them, after the time."""


def logged(folder: Path, letters: str) -> Path:
    """A session with the files of messages with these letters, and of inertial ones."""
    sensor = folder / "log" / NAME
    sensor.mkdir(parents=True)
    for letter in f"I{letters}":
        lines = [f"Timestamp (us),{HEADS[letter]}"]
        for i, turn in enumerate(TURNS):
            values = INERTIAL if letter == "I" else MESSAGES[letter](turn)
            lines.append(",".join([str(1_000_000 + 10_000 * i), *(f"{value:.6f}" for value in values)]))
        (sensor / FILES[letter]).write_text("\n".join(lines) + "\n")
    return folder / "log"


@pytest.mark.parametrize("letters", ["Q", "R", "A", "RQ", "AR"])
def test_an_orientation_in_any_form(tmp_path, letters):
    recording = read_session(logged(tmp_path, letters))
    assert recording.damage is None
    data = recording.sensors["left_forearm"]
    np.testing.assert_allclose(data.time_s, 1.0 + 0.01 * np.arange(COUNT), atol=1e-9)
    quat = TURNS.as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(data.quat * quat, axis=1)), 1.0, atol=1e-7)
    np.testing.assert_allclose(data.acc, np.full((COUNT, 3), [0.0, 0.0, 9.80665]), atol=1e-6)


def test_decimal_commas(tmp_path):
    folder = logged(tmp_path, "Q")
    whole = salvage_recording(folder)
    for path in (folder / NAME).glob("*.csv"):
        text = path.read_text().replace(",", ";").replace(".", ",")
        path.write_text(text, encoding="utf-16")
    spelled = salvage_recording(folder)
    assert spelled.damage is None
    for a, b in zip(whole.sensors["left_forearm"][:4], spelled.sensors["left_forearm"][:4], strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_file(tmp_path):
    folder = logged(tmp_path, "Q")
    (folder / NAME / "Quaternion.csv").write_text("t,W,X,Y,Z\n")
    with pytest.raises(EdgeposeError, match=r"Quaternion.csv: starts with 't,W,X,Y,Z', not with"):
        read_session(folder)


def write_recording(path: Path, recording: Recording) -> Path:
    for name, data in recording.sensors.items():
        inertial = [
            "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
            "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)"
        ]
        quaternion = ["Timestamp (us),W,X,Y,Z"]
        for time_s, quat, acc, gyr in zip(data.time_s, data.quat, data.acc, data.gyr, strict=True):
            numbers = [*map(np.degrees, gyr), *(acc / STANDARD_G)]
            inertial.append(",".join([str(round(1e6 * time_s)), *(f"{x:.7f}" for x in numbers)]))
            quaternion.append(",".join([str(round(1e6 * time_s)), *(f"{x:.7f}" for x in quat)]))
        folder = path / name
        folder.mkdir(parents=True)
        (folder / "Inertial.csv").write_text("\n".join(inertial) + "\n")
        (folder / "Quaternion.csv").write_text("\n".join(quaternion) + "\n")
    return path
