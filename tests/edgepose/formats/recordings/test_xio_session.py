"""Sessions that x-io's own library has logged, of what a simulated device sends."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import salvage_recording
from edgepose.formats.recordings.xio_session import read_session

COUNT = 50
TURNS = Rotation.from_rotvec(np.cumsum(np.full((COUNT, 3), [0.01, -0.02, 0.03]), axis=0))
NAME = "left forearm"
FILES = {"Q": "Quaternion.csv", "R": "RotationMatrix.csv", "A": "EulerAngles.csv"}

MESSAGES: dict[str, Callable[[Rotation], np.ndarray]] = {
    "Q": lambda r: r.as_quat()[[3, 0, 1, 2]],
    "R": lambda r: r.as_matrix().ravel(),
    "A": lambda r: r.as_euler("ZYX", degrees=True)[::-1],
}


def logged(folder: Path, letters: str) -> Path:
    """The folder that the library makes of messages with these letters, and inertial ones."""
    library = pytest.importorskip("ximu3")
    stream = b'{"ping":{"interface":"USB","deviceName":"left forearm","serialNumber":"64F61CB3"}}\r\n'
    for i, turn in enumerate(TURNS):
        messages = {"I": np.array([1.0, 2.0, 3.0, 0.0, 0.0, 1.0])} | {
            letter: MESSAGES[letter](turn) for letter in letters
        }
        for letter, values in messages.items():
            cells = ",".join(f"{value:.6f}" for value in values)
            stream += f"{letter},{1_000_000 + 10_000 * i},{cells}\r\n".encode()
    (folder / "a.ximu3").write_bytes(stream)
    connection = library.Connection(library.FileConnectionConfig(str(folder / "a.ximu3")))
    logger = library.DataLogger(str(folder), "log", [connection])
    connection.open()
    until = time.monotonic() + 20.0
    while connection.get_statistics().message_total < (1 + len(letters)) * COUNT:
        assert time.monotonic() < until
        time.sleep(0.05)
    connection.close()
    del logger
    (sensor,) = (folder / "log").iterdir()
    files = [sensor / name for name in ("Inertial.csv", *(FILES[letter] for letter in letters))]
    while not all(path.exists() and path.read_text().count("\n") == COUNT + 1 for path in files):
        assert time.monotonic() < until
        time.sleep(0.05)
    sensor.rename(folder / "log" / NAME)
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
