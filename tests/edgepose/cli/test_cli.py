"""The command line itself: help, lean start, wrong input told in one line. Nothing here loads a network."""

import json
import os
import pty
import re
import shlex
import subprocess
import sys
import tty

import click
import pytest
import serial

from edgepose.cli import cli, own_commands
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.inference import archive
from edgepose.placements import PLACEMENTS

COMMANDS = cli.list_commands(click.Context(cli))


def problem(result, code=1):
    """The one or two lines on stderr of a run that failed."""
    assert result.returncode == code, result
    assert "Traceback" not in result.stderr
    lines = result.stderr.splitlines()
    if code == 1:
        assert 1 <= len(lines) <= 2, result.stderr
        assert lines[0].startswith("edgepose: ")
    assert result.stdout == ""
    return result.stderr


# --- help ---------------------------------------------------------------------------------------------------


def imported(*words):
    """Output and the names of all modules that a command imports."""
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "edgepose", *map(str, words)],
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout, set(re.findall(r"^import time:.*\| +([\w.]+)$", result.stderr, re.MULTILINE))


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["--version"], ["devices"]], ids=" ".join)
def test_it_answers_without_torch(words):
    output, modules = imported(*words)
    assert output.strip()
    assert "click" in modules
    assert "torch" not in modules


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_an_example_and_does_not_import_torch(name):
    output, modules = imported(name, "--help")
    usage, *rest = output.splitlines()
    assert re.match(rf"Usage: .*edgepose {name}\b", usage)
    assert any(line.strip().startswith(f"edgepose {name}") for line in rest)
    assert "torch" not in modules


@pytest.mark.parametrize("name", COMMANDS)
def test_every_flag_is_explained(name):
    command = cli.get_command(click.Context(cli), name)
    assert command.get_short_help_str()
    bare = [p.name for p in command.params if isinstance(p, click.Option) and not p.help]
    assert bare == []


@pytest.mark.parametrize("name", [*COMMANDS, "bench orientation"])
def test_help_fits_a_terminal_and_its_examples_can_be_parsed(name):
    command = cli
    for word in name.split():
        command = command.get_command(click.Context(command), word)
    text = command.get_help(click.Context(command, info_name=f"edgepose {name}", terminal_width=80))
    assert [line for line in text.splitlines() if len(line) > 80] == []
    examples = re.findall(rf"^ +edgepose {name}\b *(.*)$", text.replace("\\\n", ""), re.MULTILINE)
    assert examples
    for example in examples:
        words = shlex.split(re.sub(" [|>] .*", "", example))
        problem = ""
        try:
            command.make_context(name, words)
        except click.BadParameter as error:
            problem = error.message
        assert not problem or "does not exist" in problem, example  # the files of the examples


def test_all_commands_are_listed():
    output, modules = imported("--help")
    assert {"calibrate", "convert", "run", "train", "evaluate", "export"} <= set(COMMANDS)
    for name in COMMANDS:
        assert re.search(rf"^  {name} +[A-Z].*\.$", output, re.MULTILINE)
    assert not [name for name in own_commands() if f"edgepose.cli.commands.{name}" in modules]


def test_calibrate_does_not_import_torch(wearer, tmp_path):
    _, modules = imported(
        "calibrate", "--file", wearer.recording, "--hold", 2, "--out", tmp_path / "calibration.json"
    )
    assert "numpy" in modules
    assert "torch" not in modules


def test_models_lists_and_shows_archives_without_torch():
    output, modules = imported("models")
    for path in archive.bundled_archives():
        assert re.search(rf"^{path.stem} ", output, re.MULTILINE)
    assert "torch" not in modules
    output, modules = imported("models", "birnn")
    assert "trusted: yes" in output
    assert "torch" not in modules


# --- wrong use ----------------------------------------------------------------------------------------------


WEARER = "--calibration CALIBRATION "
BASICS = WEARER + "--file SHORT --csv OUT "


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("", "--calibration"),
        (WEARER + "--csv OUT", "give one source"),
        (WEARER + "--file SHORT", "give at least one output"),
        (BASICS + "--port x", "give one source"),
        (BASICS + "--future -1", "--future"),
        (BASICS + "--rotations x", "--rotations"),
        (BASICS + "--height 175", "'--height': 175.0 is not in the range 0.8<=x<=2.5 metres"),
        (BASICS + "--leg-length 85", "'--leg-length': 85.0 is not in the range 0.3<=x<=1.5 metres"),
        (BASICS + "--jobs 2", "--jobs is for recordings named as IN"),
        (
            BASICS + "--udp 127.0.0.1:9 --mocopi localhost:9",
            "udp and mocopi send to localhost:9 in two",
        ),
        (BASICS + "--model rnn --future 3", "unidirectional"),
        (BASICS + "--debug", "--debug"),  # it belongs in front of the command
        (WEARER + "--file SHORT --csv SHORT", "overwrite"),
        (WEARER + "--file SHORT --csv CALIBRATION", "overwrite"),
    ],
)
def test_wrong_use(command, wearer, tmp_path, words, says):
    names = {"CALIBRATION": wearer.calibration, "SHORT": wearer.short, "OUT": tmp_path / "poses.csv"}
    before = wearer.short.read_bytes(), wearer.calibration.read_bytes()
    text = problem(command("run", *(names.get(word, word) for word in words.split())), code=2)
    assert says in text
    assert re.match(r"Usage: .*edgepose run", text)
    assert list(tmp_path.iterdir()) == []
    assert before == (wearer.short.read_bytes(), wearer.calibration.read_bytes())


def test_unknown_commands_are_wrong_use(command):
    assert "No such command 'nonsense'" in problem(command("nonsense"), code=2)


# --- sources ------------------------------------------------------------------------------------------------


@pytest.fixture
def fail(command, wearer, tmp_path):
    """The problem of a run with these flags instead of the good ones."""

    def run(code=1, **changes):
        flags = {"file": wearer.short, "calibration": wearer.calibration, "csv": tmp_path / "poses.csv"}
        flags |= changes
        words = [
            word for key, value in flags.items() if value is not None for word in (f"--{key}", str(value))
        ]
        text = problem(command("run", *words), code)
        assert not (tmp_path / "poses.csv").exists()
        return text

    return run


def test_an_unknown_port(fail):
    text = fail(file=None, port="/dev/ttyNOWHERE7")
    assert "/dev/ttyNOWHERE7: no such port; ports here: " in text


def test_a_file_as_a_port(fail, wearer):
    assert f"{wearer.short}: cannot open it as a serial port" in fail(file=None, port=wearer.short)


def test_a_port_in_use(fail):
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        name = os.ttyname(slave)
        with serial.Serial(name, exclusive=True):
            text = fail(file=None, port=name)
        assert f"{name}: the port is in use by another program; close that first" in text
    finally:
        os.close(master)
        os.close(slave)


def test_a_missing_recording(fail, tmp_path):
    assert f"{tmp_path / 'nowhere.npz'}: cannot read it: No such file" in fail(file=tmp_path / "nowhere.npz")


def test_a_missing_session(fail, tmp_path):
    assert f"{tmp_path / 'session'}: no such file or folder" in fail(file=tmp_path / "session")


def test_a_folder_as_a_recording(fail, tmp_path):
    assert "unknown kind of file" in fail(file=tmp_path)
    (tmp_path / "folder.csv").mkdir()
    assert "Is a directory" in fail(file=tmp_path / "folder.csv")


@pytest.mark.parametrize("name", ["walk.npz", "walk.csv"])
def test_an_empty_recording(fail, tmp_path, name):
    (tmp_path / name).touch()
    assert f"{tmp_path / name}: " in fail(file=tmp_path / name)


def test_a_recording_cut_in_two(fail, wearer, tmp_path):
    content = wearer.short.read_bytes()
    file = tmp_path / "cut.npz"
    file.write_bytes(content[: len(content) // 2])
    text = fail(file=file)
    assert f"{file}: not a complete NPZ file" in text
    assert "copy it again" in text


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_recording_without_a_sensor(fail, wearer, tmp_path, suffix):
    recording = read_recording(wearer.short)
    del recording.sensors["head"]
    file = tmp_path / f"five{suffix}"
    (write_csv if suffix == ".csv" else write_npz)(file, recording)
    assert f"{file}: no samples of head; a recording needs all six sensors" in fail(file=file)


def test_poses_are_no_recording(fail, tmp_path):
    file = tmp_path / "something.csv"
    file.write_text("frame,time_s,status\n0,0.0,ok\n")
    assert "a recording has time_s,sensor,qw" in fail(file=file)


# --- calibrations -------------------------------------------------------------------------------------------


def test_a_missing_calibration(fail, tmp_path):
    assert f"{tmp_path / 'c.json'}: cannot read the calibration" in fail(calibration=tmp_path / "c.json")


@pytest.mark.parametrize("content", [b"", b"not JSON", b"\xff\xfe", b'{"format": "edge'])
def test_a_calibration_that_is_not_json(fail, tmp_path, content):
    file = tmp_path / "c.json"
    file.write_bytes(content)
    text = fail(calibration=file)
    assert f"{file}: not valid JSON" in text
    assert "edgepose calibrate" in text


def test_a_calibration_without_a_sensor(fail, wearer, tmp_path):
    document = json.loads(wearer.calibration.read_text())
    del document["sensors"][PLACEMENTS[2]]
    file = tmp_path / "c.json"
    file.write_text(json.dumps(document))
    assert f"{file}: no sensor {PLACEMENTS[2]}; calibrate again with all six" in fail(calibration=file)


# --- archives -----------------------------------------------------------------------------------------------


def test_an_unknown_model(fail):
    text = fail(model="nonsense")
    assert "nonsense: no such model; give the path of an archive, or one of birnn, rnn" in text


def test_an_archive_that_is_none(fail, wearer, tmp_path):
    file = tmp_path / "model.pt"
    file.write_bytes(b"not a zip file")
    assert f"{file}: not a model archive" in fail(model=file)
    assert f"{wearer.short}: not a model archive of edgepose" in fail(model=wearer.short)


def test_a_truncated_archive(fail, tmp_path):
    content = archive.find_archive("rnn").read_bytes()
    file = tmp_path / "model.pt"
    file.write_bytes(content[:-1000])
    assert f"{file}: not a model archive (no complete zip file)" in fail(model=file)


def test_an_archive_of_unknown_sum(fail, tmp_path):
    content = bytearray(archive.find_archive("rnn").read_bytes())
    end = content.rindex(b"PK\x05\x06")
    content[end + 20 : end + 22] = (4).to_bytes(2, "little")  # a comment changes only the sum
    file = tmp_path / "model.pt"
    file.write_bytes(content + b"note")
    text = fail(model=file)
    assert "SHA-256" in text
    assert "--trust" in text


# --- outputs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("udp", "says"),
    [
        ("", "--udp is empty"),
        ("localhost", "no port"),
        ("127.0.0.1:9,broadcast,multicast", "'broadcast' and 'multicast' in '127.0.0.1:9,"),
        ("127.0.0.1:9,format=json,format=json", "'format=json' and 'format=json' in "),
        ("127.0.0.1:0", "from 1 to 65535"),
        ("127.0.0.1:ninety", "from 1 to 65535"),
        (":9000", "no host"),
        ("127.0.0.1:9000,format=xml", "possible are format=json, format=binary"),
        ("127.0.0.1:9000,rate=3", "unknown option"),
    ],
)
def test_a_bad_udp_destination(fail, udp, says):
    assert says in fail(code=2, udp=udp)


# --- the whole traceback ------------------------------------------------------------------------------------


def test_debug_shows_the_traceback(command, wearer, tmp_path):
    flags = ("--file", tmp_path / "x.npz", "--calibration", wearer.calibration, "--csv", "-")
    result = command("--debug", "run", *flags)
    assert result.returncode == 1
    assert "Traceback (most recent call last)" in result.stderr
    assert "FileFormatError: " in result.stderr.splitlines()[-1]
