"""Recordings in each format that edgepose reads, written as the programs that export them do."""

from __future__ import annotations

import math
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from edgepose.calibration import GRAVITY
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.mvnx import LABELS
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.totalcapture import NAMES
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Z_UP_TO_T, quat_rotate, quat_to_matrix
from firmware_protocols import sample

FRAMES, RATE = 90, 60
"""1.5 s at the only rate that all formats can have; the wearer stands for the first 50 frames."""


def cells(*values: float) -> list[str]:
    return [f"{value:.7f}" for value in values]


def mvnx(path: Path, recording: Recording) -> Path:
    data = recording.sensors.values()
    frames = []
    for i in range(FRAMES):
        quats = " ".join(cell for d in data for cell in cells(*d.quat[i]))
        free = " ".join(
            cell for d in data for cell in cells(*(quat_rotate(d.quat[i], d.acc[i]) - [0.0, 0.0, GRAVITY]))
        )
        frames.append(
            f'<frame time="{1000 * i // RATE}" type="normal"><sensorOrientation>{quats}</sensorOrientation>'
            f"<sensorFreeAcceleration>{free}</sensorFreeAcceleration></frame>\n"
        )
    sensors = "".join(f'<sensor label="{label}"/>' for label in LABELS)
    path = path.with_suffix(".mvnx")
    path.write_text(
        f'<mvnx version="4"><subject frameRate="{RATE}"><sensors>{sensors}</sensors>\n'
        f"<frames>{''.join(frames)}</frames></subject></mvnx>\n"
    )
    return path


def xio_session(path: Path, recording: Recording) -> Path:
    for name, data in recording.sensors.items():
        inertial = [
            "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
            "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)"
        ]
        quaternion = ["Timestamp (us),W,X,Y,Z"]
        for time_s, quat, acc, gyr in zip(data.time_s, data.quat, data.acc, data.gyr, strict=True):
            numbers = [*map(math.degrees, gyr), *(acc / sample.STANDARD_G)]
            inertial.append(",".join([str(round(1e6 * time_s)), *cells(*numbers)]))
            quaternion.append(",".join([str(round(1e6 * time_s)), *cells(*quat)]))
        folder = path / name
        folder.mkdir(parents=True)
        (folder / "Inertial.csv").write_text("\n".join(inertial) + "\n")
        (folder / "Quaternion.csv").write_text("\n".join(quaternion) + "\n")
    return path


def mt_manager(path: Path, recording: Recording, names: tuple[str, ...] = PLACEMENTS) -> Path:
    columns = ["PacketCounter", *(f"Acc_{x}" for x in "XYZ"), *(f"Gyr_{x}" for x in "XYZ")]
    columns += [f"Quat_q{i}" for i in range(4)]
    path.mkdir()
    for name, data in zip(names, recording.sensors.values(), strict=True):
        lines = [f"// Update Rate: {RATE:.1f}Hz", "\t".join(columns)]
        for i in range(FRAMES):
            lines.append("\t".join([str(i), *cells(*data.acc[i], *data.gyr[i], *data.quat[i])]))
        (path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return path


def packed_session(path: Path, recording: Recording) -> Path:
    xio_session(path / "walk", recording)
    packed = shutil.make_archive(str(path), "zip", path)
    shutil.rmtree(path)
    return Path(packed)


def totalcapture(path: Path, recording: Recording) -> Path:
    lines = [f"{len(NAMES)}\t{FRAMES}"]
    for i in range(FRAMES):
        lines.append(str(i + 1))
        for name, data in zip(NAMES, recording.sensors.values(), strict=True):
            lines.append("\t".join([name, *cells(*data.quat[i], *data.acc[i])]))
    path = path.with_suffix(".sensors")
    path.write_text("\n".join(lines) + "\n")
    return path


def dip_imu(path: Path, recording: Recording) -> Path:
    content = {"imu_ori": np.zeros((FRAMES, 17, 3, 3)), "imu_acc": np.zeros((FRAMES, 17, 3))}
    for place, data in zip((7, 8, 11, 12, 0, 2), recording.sensors.values(), strict=True):
        bones = Z_UP_TO_T @ quat_to_matrix(data.quat)
        content["imu_ori"][:, place] = bones
        content["imu_acc"][:, place] = (bones @ data.acc[..., None])[..., 0] - [0.0, GRAVITY, 0.0]
    path = path.with_suffix(".pkl")
    path.write_bytes(pickle.dumps(content, 2))
    return path


def csv(path: Path, recording: Recording) -> Path:
    write_csv(path.with_suffix(".csv"), recording)
    return path.with_suffix(".csv")


def npz(path: Path, recording: Recording) -> Path:
    write_npz(path.with_suffix(".npz"), recording)
    return path.with_suffix(".npz")


WRITERS: dict[str, Callable[[Path, Recording], Path]] = {
    "csv": csv,
    "npz": npz,
    "mvnx": mvnx,
    "dip-imu": dip_imu,
    "totalcapture": totalcapture,
    "xsens-session": mt_manager,
    "xio-session": xio_session,
    "packed-session": packed_session,
}
