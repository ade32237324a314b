"""Sessions of MT Manager, written here in its layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.mt_manager import is_session, read_session
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
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
    assert "no placement in the names of its files" in result.stdout


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
    assert recording.damage == f"{head}: 5 bad rows left out"
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
