"""Every format of recordings through every command that takes a recording."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from edgepose.calibration import load_calibration
from edgepose.cli import cli
from edgepose.convert import plan
from edgepose.errors import EdgeposeError
from edgepose.formats.poses import registry as pose_registry
from edgepose.formats.poses.registry import is_poses, read_poses
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import (
    READERS,
    find_format,
    read_recording,
    salvage_recording,
)
from edgepose.formats.registered import plugin_formats
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS
from edgepose.rotations import geodesic_angle, quat_to_matrix
from tests.edgepose.formats.recordings.test_xsens_session import write_recording as write_mt_manager

FRAMES, RATE = 90, 60
"""1.5 s at the only rate that all formats can have; the wearer stands for the first 50 frames."""


def csv(path: Path, recording: Recording) -> Path:
    write_csv(path.with_suffix(".csv"), recording)
    return path.with_suffix(".csv")


def npz(path: Path, recording: Recording) -> Path:
    write_npz(path.with_suffix(".npz"), recording)
    return path.with_suffix(".npz")


Writer = Callable[[Path, Recording], Path]

WRITERS: dict[str, Writer] = {"csv": csv, "npz": npz}
"""Writers of edgepose's own formats; the test of any other format has a function `write_recording`."""


def writer(name: str) -> Writer:
    """Return the function that writes a recording in a format, and returns the path with its suffix."""
    if name in WRITERS:
        return WRITERS[name]
    test: Any = import_module(f"tests.edgepose.formats.recordings.test_{name.replace('-', '_')}")
    return test.write_recording


@pytest.fixture(scope="module")
def original(wearer) -> Recording:
    """A part of the wearer's recording, as slow as 60 Hz make it."""
    sensors = {}
    for name, data in read_recording(wearer.short).sensors.items():
        assert data.gyr is not None
        columns = [None if column is None else column[:FRAMES] for column in data[1:4]]
        sensors[name] = SensorData(np.arange(FRAMES) / RATE, *columns)
    return Recording(sensors, {})


@pytest.fixture(scope="module")
def files(original, tmp_path_factory) -> dict[str, Path]:
    """The recording in each format."""
    folder = tmp_path_factory.mktemp("formats")
    return {name: writer(name)(folder / name, original) for name in READERS}


def edgepose(*words: object) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


def done(result: Result) -> Result:
    assert result.exit_code == 0, (result.output, result.exception)
    return result


every_format = pytest.mark.parametrize("name", READERS)


@every_format
def test_what_is_read(name, files, original):
    recording = read_recording(files[name])
    assert recording.damage is None
    assert list(recording.sensors) == list(PLACEMENTS)
    for found, wanted in zip(recording.sensors.values(), original.sensors.values(), strict=True):
        np.testing.assert_allclose(found.time_s, wanted.time_s, atol=1e-6)
        np.testing.assert_allclose(found.acc, wanted.acc, atol=1e-4)
        turns = geodesic_angle(quat_to_matrix(found.quat), quat_to_matrix(wanted.quat))
        assert turns.max() < 1e-5


@every_format
def test_calibrate(name, files, tmp_path):
    found = []
    for file in (files[name], files["npz"]):
        out = tmp_path / f"{len(found)}.json"
        done(
            edgepose(
                *("calibrate", "--file", file, "--from", 0, "--hold", 0.6, "--body-frame", "heading:0"),
                *("--out", out),
            )
        )
        found.append(load_calibration(out))
    assert found[0].metadata["source"] == str(files[name])
    turns = geodesic_angle(*(quat_to_matrix(calibration.bone_from_sensor) for calibration in found))
    assert turns.max() < 1e-4


@pytest.fixture(scope="module")
def wanted(files, wearer, tmp_path_factory) -> dict[str, np.ndarray]:
    """Rotations that `run` and `solve` make of the recording as NPZ."""
    folder = tmp_path_factory.mktemp("wanted")
    return {command: poses(command, files["npz"], wearer, folder) for command in ("run", "solve")}


def poses(command: str, file: Path, wearer, folder: Path) -> np.ndarray:
    words = {"run": ("run", "--file", file, "--model", "rnn"), "solve": ("solve", file, "--method", "sop")}
    out = folder / f"{command}.csv"
    done(edgepose(*words[command], "--calibration", wearer.calibration, "--csv", out))
    return read_poses(out).rotations


def same_poses(found: np.ndarray, wanted: np.ndarray) -> None:
    # Times are rounded to a microsecond, which costs the last frame where it is that of the last sample.
    assert {len(found), len(wanted)} <= {FRAMES, FRAMES - 1}
    count = min(len(found), len(wanted))
    assert geodesic_angle(found[:count], wanted[:count]).max() < 2e-3


@every_format
@pytest.mark.parametrize("command", ["run", "solve"])
def test_poses(command, name, files, wearer, wanted, tmp_path):
    same_poses(poses(command, files[name], wearer, tmp_path), wanted[command])


@every_format
def test_check(name, files):
    result = edgepose("check", "--file", files[name], "--json")
    assert result.exit_code in (0, 3)
    shown = json.loads(result.stdout)
    assert [sensor["placement"] for sensor in shown["sensors"]] == list(PLACEMENTS)
    for sensor in shown["sensors"]:
        assert sensor["rate_hz"] == pytest.approx(RATE, rel=0.05)


def test_convert_finds_them_all(files, tmp_path):
    folder = next(iter(files.values())).parent
    planned = plan([folder], "npz", tmp_path)
    assert {job.source for job in planned} == set(files.values())
    result = done(edgepose("convert", folder, "--to", "npz", "--out", tmp_path))
    assert result.stdout.count(f" {6 * FRAMES} ") == len(files)


@pytest.mark.parametrize("command", ["calibrate", "check", "run"])
def test_serial_numbers_of_a_map(command, original, wearer, tmp_path):
    names = tuple(f"walk_00B4D7D{i}" for i in range(6))
    session = write_mt_manager(tmp_path / "walk", original, names)
    sensors = tmp_path / "map.toml"
    sensors.write_text("".join(f"{name} = {{ id = 0x00B4D7D{i} }}\n" for i, name in enumerate(PLACEMENTS)))
    more = {
        "calibrate": ("--hold", 0.6, "--body-frame", "heading:0", "--out", tmp_path / "new.json"),
        "check": ("--json",),
        "run": ("--model", "rnn", "--calibration", wearer.calibration, "--csv", tmp_path / "poses.csv"),
    }[command]
    result = edgepose(command, "--file", session, *more)
    assert "no placement in the names of its files" in str(result.exception)
    result = edgepose(command, "--file", session, "--sensors", sensors, *more)
    assert result.exit_code in ((0, 3) if command == "check" else (0,)), (result.output, result.exception)


def test_a_folder_that_is_no_session(files, wearer, tmp_path):
    sensor = files["xio-session"] / "head"
    for file in (tmp_path, sensor):
        for words in (
            ("check", "--file", file),
            ("calibrate", "--file", file, "--out", tmp_path / "calibration.json"),
            ("solve", file, "--calibration", wearer.calibration, "--csv", tmp_path / "poses.csv"),
        ):
            result = edgepose(*words)
            assert isinstance(result.exception, EdgeposeError), result
            assert str(result.exception).startswith(
                f"{file}: unknown kind of file (Is a directory with no rec"
            )
        assert find_format(file) is None


def test_good_frames_of_a_damaged_file(files, wearer, tmp_path):
    text = files["mvnx"].read_text()
    cut = tmp_path / "cut.mvnx"
    cut.write_text(text[: 9 * len(text) // 10])
    assert salvage_recording(cut).damage.startswith(f"{cut}: breaks off (")
    out = tmp_path / "poses.csv"
    result = edgepose(
        *("run", "--file", cut, "--model", "rnn", "--calibration", wearer.calibration, "--csv", out)
    )
    assert f"{cut}: breaks off (" in result.output + str(result.exception)
    assert 0.8 * FRAMES < len(read_poses(out).frames) < 0.95 * FRAMES


def test_five_sensors_are_too_few(files, tmp_path):
    shutil.copytree(files["xio-session"], tmp_path / "walk")
    shutil.rmtree(tmp_path / "walk" / "head")
    with pytest.raises(
        EdgeposeError, match=r"no samples of head; a recording needs all six .*--without head$"
    ):
        read_recording(tmp_path / "walk")
    assert len(salvage_recording(tmp_path / "walk").sensors) == 5


# --- formats of other packages ------------------------------------------------------------------------------

PACKAGE = """
from edgepose.formats.poses.base import PoseFormat
from edgepose.formats.poses.csv import read_csv as read_poses
from edgepose.formats.recordings.base import RecordingFormat
from edgepose.formats.recordings.csv import read_csv

RECORDINGS = RecordingFormat((".acme",), read_csv)
POSES = PoseFormat((".acmepose",), read_poses)
"""
ENTRY_POINTS = """
[edgepose.formats]
broken = acme_formats:NOWHERE
gone = acme_not_installed:FORMAT
odd = acme_formats:PACKAGE
poses = acme_formats:POSES
recordings = acme_formats:RECORDINGS
"""


@pytest.fixture
def package(tmp_path, monkeypatch) -> None:
    """A package with formats, three of which are broken."""
    folder = tmp_path / "site"
    (folder / "acme_formats-1.0.dist-info").mkdir(parents=True)
    (folder / "acme_formats.py").write_text(PACKAGE + "PACKAGE = 1\n")
    (folder / "acme_formats-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: acme-formats\nVersion: 1.0\n"
    )
    (folder / "acme_formats-1.0.dist-info" / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(folder)
    plugin_formats.cache_clear()
    yield
    plugin_formats.cache_clear()


def test_formats_of_a_package(package, files, original, wearer, wanted, tmp_path, caplog):
    file = tmp_path / "walk.acme"
    shutil.copy(files["csv"], file)
    with caplog.at_level(logging.WARNING):
        assert len(read_recording(file).sensors) == 6
    warnings = [record.getMessage() for record in caplog.records]
    assert len(warnings) == 3
    assert "cannot load the file format broken (acme_formats:NOWHERE): AttributeError" in warnings[0]
    assert "cannot load the file format gone (acme_not_installed:FORMAT): ModuleNotFound" in warnings[1]
    assert warnings[2] == (
        "the file format odd (acme_formats:PACKAGE) is not a RecordingFormat or PoseFormat"
    )
    same_poses(poses("run", file, wearer, tmp_path), wanted["run"])
    written = tmp_path / "poses.acmepose"
    shutil.copy(tmp_path / "run.csv", written)
    assert is_poses(written)
    assert not is_poses(file)
    same_poses(read_poses(written).rotations, wanted["run"])
    sources = {job.source for job in plan([tmp_path], "npz", tmp_path / "out")}
    assert {file, written} <= sources


def test_modules_of_formats_are_imported_when_they_are_needed():

    code = (
        "import sys\nfrom pathlib import Path\n"
        "from edgepose.formats.recordings.registry import find_format\n"
        "find_format(Path('walk.csv'))\n"
        "print([name for name in sys.modules if name.startswith('edgepose.formats.recordings.')])"
    )
    result = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert "recordings.csv" in result.stdout
    assert "mvnx" not in result.stdout


def test_tables_name_what_is_there():
    for table in (READERS, pose_registry.READERS):
        for reader in table.values():
            module = reader.location.partition(":")[0]
            assert (Path(__file__).parents[3] / f"{module.replace('.', '/')}.py").is_file()
