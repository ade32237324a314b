"""What scripts rely on: exit codes, JSON with the documented keys, many recordings in one command."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edgepose.cli.exit_codes import MEANINGS
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.registry import read_recording
from tests.support import processes
from tests.support.documented_keys import SCRIPTS, documented

RNN = ("--model", "rnn", "--runtime", "numpy")
BASICS = ("--body-frame", "heading:0", "--hold", 0.3)


def document(result, command: str) -> dict:
    """The document on standard output, with exactly the documented keys."""
    found = json.loads(result.stdout)
    assert found.pop("command") == command
    assert set(found) == documented(command)
    return found


def test_exit_codes_are_documented():
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", SCRIPTS.read_text(), re.MULTILINE)
    assert {int(code): meaning for code, meaning in rows} == MEANINGS


def test_exit_codes_are_in_the_help(command):
    text = command("--help").stdout
    for code, meaning in MEANINGS.items():
        assert re.search(rf"^ +{code} +{re.escape(meaning)}$", text, re.MULTILINE)


# --- many recordings ----------------------------------------------------------------------------------------


@pytest.fixture
def takes(wearer, tmp_path):
    """A folder with two recordings and a broken one."""
    folder = tmp_path / "takes"
    (folder / "anna").mkdir(parents=True)
    (folder / "a.npz").write_bytes(wearer.short.read_bytes())
    write_csv(folder / "anna" / "b.csv", read_recording(wearer.short))
    (folder / "broken.npz").write_bytes(wearer.short.read_bytes()[:3000])
    return folder


def test_many_runs_are_like_single_ones(command, wearer, takes, tmp_path):
    words = (
        takes,
        "--calibration",
        wearer.calibration,
        "--csv",
        tmp_path / "p",
        "--npz",
        tmp_path / "p",
        *RNN,
    )
    result = command("run", *words, "--json")
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].startswith("edgepose: 1 of 3 recordings not run")
    found = document(result, "run")
    assert found["planned"] == 3
    runs = {Path(run["source"]).name: run for run in found["runs"]}
    assert {name: run["result"] for name, run in runs.items()} == {
        "a.npz": "ok", "b.csv": "ok", "broken.npz": "failed"
    }  # fmt: skip
    for run in runs.values():
        assert set(run) == documented("run", "runs")
    assert "not a complete NPZ file" in runs["broken.npz"]["problem"]
    written = {path.relative_to(tmp_path / "p").as_posix() for path in (tmp_path / "p").rglob("*.*")}
    assert written == {"a.csv", "a.npz", "anna/b.csv", "anna/b.npz"}
    single = tmp_path / "single.csv"
    flags = ("--calibration", wearer.calibration, "--csv", single, *RNN)
    assert command("run", "--file", takes / "a.npz", *flags).returncode == 0
    assert single.read_bytes() == (tmp_path / "p" / "a.csv").read_bytes()
    poses = read_poses(tmp_path / "p" / "anna" / "b.npz")
    assert len(poses.frames) == runs["b.csv"]["poses"] == runs["a.npz"]["poses"] > 150
    np.testing.assert_allclose(poses.rotations, read_poses(single).rotations, atol=1e-4)


def test_nothing_begins_where_a_file_would_be_lost(command, wearer, takes, tmp_path):
    (tmp_path / "p" / "anna").mkdir(parents=True)
    (tmp_path / "p" / "anna" / "b.csv").write_text("precious")
    result = command("run", takes, "--calibration", wearer.calibration, "--csv", tmp_path / "p", *RNN)
    assert result.returncode == 1
    assert "b.csv: already exists; add --overwrite, or name other folders" in result.stderr
    assert [path.name for path in (tmp_path / "p").rglob("*.csv")] == ["b.csv"]
    assert (tmp_path / "p" / "anna" / "b.csv").read_text() == "precious"


def test_calibrations_and_then_runs_with_them_in_two_processes(command, takes, tmp_path):
    """The second time over poses that lie beside the recordings."""
    calibrations = tmp_path / "calibrations"
    result = command("calibrate", takes, "--out", calibrations, *BASICS, "--jobs", 2, "--json")
    assert result.returncode == 1
    found = document(result, "calibrate")
    results = {Path(each["source"]).name: each for each in found["calibrations"]}
    assert {name: each["result"] for name, each in results.items()} == {
        "a.npz": "ok", "b.csv": "ok", "broken.npz": "failed"
    }  # fmt: skip
    for each in results.values():
        assert set(each) == documented("calibrate", "calibrations")
    assert json.loads((calibrations / "anna" / "b.json").read_text())["format"] == "edgepose-calibration"
    (takes / "broken.npz").unlink()
    (calibrations / "a.json").unlink()
    flags = ("--jobs", 2, *RNN)
    words = (takes / "anna", "--calibration", calibrations / "anna", "--csv", takes / "poses")
    assert command("run", *words, *flags).returncode == 0
    result = command("run", takes, "--calibration", calibrations, "--csv", takes, *flags)
    assert result.returncode == 1
    assert "b.csv would be written over an input" in result.stderr
    result = command("run", takes, "--calibration", calibrations, "--csv", tmp_path / "more", *flags)
    assert result.returncode == 1
    assert re.search(r"a\.npz +- +- +failed$", result.stdout, re.MULTILINE)
    assert "a.json" in result.stderr
    assert [path.name for path in (tmp_path / "more").rglob("*.csv")] == ["b.csv"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("run takes --file a.npz --csv p", "give either recordings as IN or a source with --file"),
        ("run takes --rig a.toml", "give either recordings as IN or a source with --rig"),
        ("run takes --csv p --udp 127.0.0.1:9", "--udp is for one source; recordings named as IN take --csv"),
        ("run takes --csv -", "recordings named as IN take a folder for each output"),
        ("run takes --csv p --realtime", "--realtime is for one --file"),
        ("calibrate takes --out c --realtime", "--realtime is for one --file"),
        ("calibrate - --out c", "- is standard input, which is one recording: use --file -"),
        ("run --file a.npz --csv - --json", "--csv and --json both write to standard output"),
        ("calibrate takes", "recordings named as IN take a folder, such as --out calibrations"),
        ("calibrate --file a.npz --out - --json", "--out - and --json both write to standard output"),
    ],
)
def test_wrong_use(command, wearer, takes, words, says):
    name, *rest = words.split()
    calibration = ("--calibration", wearer.calibration) if name == "run" and "--rig" not in rest else ()
    result = command(name, *rest, *calibration, cwd=takes.parent)
    assert result.returncode == 2
    assert says in " ".join(result.stderr.split())
    assert result.stdout == ""
    assert sorted(path.name for path in takes.parent.iterdir()) == ["takes"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_between_two_recordings(wearer, tmp_path, jobs):
    """What was begun is whole, and the table has what was done."""
    (tmp_path / "takes").mkdir()
    for i in range(20):
        (tmp_path / "takes" / f"{i:02}.npz").write_bytes(wearer.recording.read_bytes())
    words = (
        "run",
        "takes",
        "--calibration",
        wearer.calibration,
        "--csv",
        "p",
        *RNN,
        "--jobs",
        jobs,
        "--json",
    )
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", *map(str, words)],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    line = process.stderr.readline()
    assert line.startswith("1 of 20"), line
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    done = json.loads(output)["runs"]
    assert 1 <= len(done) < 20
    written = sorted((tmp_path / "p").iterdir())
    assert len(written) == len(done)
    assert {len(read_poses(path).frames) for path in written} == {done[0]["poses"]}


# --- documents ----------------------------------------------------------------------------------------------


def test_a_single_calibration(command, wearer, tmp_path):
    words = ("calibrate", "--file", wearer.recording, "--out", tmp_path / "c.json", *BASICS, "--json")
    result = command(*words)
    (found,) = document(result, "calibrate")["calibrations"]
    assert set(found) == documented("calibrate", "calibrations")
    assert found["verdict"] == "GOOD"
    assert "edgepose run" in result.stderr


def test_warnings_of_a_calibration_are_in_the_document_and_shown_once(command, wearer, tmp_path):
    """Those on a damaged recording and on a sensor that is silent in the hold, also if there is no result."""
    recording = read_recording(wearer.short)
    head = recording.sensors["head"]
    chest = head._replace(**{key: v[:5] for key, v in head._asdict().items() if isinstance(v, np.ndarray)})
    path = tmp_path / "takes" / "a.csv"
    path.parent.mkdir()
    write_csv(path, recording._replace(sensors={**recording.sensors, "chest": chest}))
    with path.open("a") as file:
        file.write("1.0,hea")
    start = float(head.time_s[20])
    for words, at, count in (
        (("--file", path, "--out", tmp_path / "c.json"), start, 2),
        ((path.parent, "--out", tmp_path / "c"), start, 2),
        ((path.parent, "--out", tmp_path / "d"), start + 999, 1),
    ):
        result = command("calibrate", *words, *BASICS, "--from", at, "--json")
        assert result.returncode == 1
        (found,) = document(result, "calibrate")["calibrations"]
        assert len(found["warnings"]) == count, result.stderr
        assert "a.csv" in found["warnings"][0]
        assert all(result.stderr.count(warning) == 1 for warning in found["warnings"])
        expected = ("damaged", "FAIR") if count == 2 else ("failed", None)
        assert (found["result"], found["verdict"]) == expected
    words = ("--file", path, "--out", tmp_path / "e.json", "--from", start + 999)
    result = command("calibrate", *words, *BASICS)
    assert result.returncode == 1
    assert result.stderr.count(found["warnings"][0]) == 1


def test_conversions(command, takes, tmp_path):
    result = command("convert", takes, "--to", "csv", "--out", tmp_path / "c", "--json")
    assert result.returncode == 1
    files = document(result, "convert")["files"]
    assert [each["result"] for each in files] == ["ok", "ok", "failed"]
    section = SCRIPTS.read_text().split("\n### convert\n")[1].split("\n### ")[0]
    assert all(f"`{key}`" in section for key in files[0])


def test_devices_and_models(command):
    found = document(command("devices", os.devnull, "--json"), "devices")
    assert [line["name"] for line in found["ports"]] == [os.devnull]
    result = command("devices", "/dev/ttyNOWHERE7", "--json")
    assert result.returncode == 1
    assert document(result, "devices")["ports"][0]["problem"] == "no such port"
    (model,) = document(command("models", "rnn", "--json"), "models")["models"]
    assert model["trusted"] is True
    assert model["metadata"]["kind"] == "rnn"


def test_a_solution(command, wearer, tmp_path):
    words = ("solve", wearer.short, "--calibration", wearer.calibration, "--method", "sop")
    result = command(*words, "--csv", tmp_path / "s.csv", "--rate", 10, "--json")
    assert result.returncode == 0, result.stderr
    found = document(result, "solve")
    assert found["outputs"] == [{"kind": "csv", "target": str(tmp_path / "s.csv")}]
    assert found["poses"] == found["frames"] == len(read_poses(tmp_path / "s.csv").frames)


def test_a_check(command, wearer):
    found = document(command("check", "--file", wearer.short, "--json"), "check")
    assert len(found["sensors"]) == 6
