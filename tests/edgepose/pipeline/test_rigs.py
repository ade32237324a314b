"""Several wearers in one run: rig files, the same poses as alone, lines that go and come back."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest

from edgepose.calibration import load_calibration
from edgepose.cli.conflicts import check_all_files
from edgepose.cli.options.wearer import read_rigs
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.registry import read_recording
from edgepose.inference.engine import StreamEngine
from edgepose.pipeline.run import run
from edgepose.pipeline.wearer_pipeline import WearerPipeline
from edgepose.placements import PLACEMENTS
from edgepose.sinks.csv import CsvSink
from edgepose.sources import open_source
from edgepose.utils.output_targets import FileTarget
from edgepose_export.networks.shape import NetworkShape
from tests.support import processes
from tests.support.datagrams import Listener
from tests.support.processes import simulated
from tests.support.recordings import write_part
from tests.support.terminals import own_terminal

PAGE = (Path(__file__).parents[3] / "docs" / "guide" / "sensors.md").read_text(encoding="utf-8")
ALL_HELD = f"held {' '.join(PLACEMENTS)}"


@pytest.fixture
def rig(wearer, tmp_path):
    """Writes a rig file, gives its path; keywords replace or add keys, None leaves one out."""

    def write(stem: str = "anna", /, **changes: object) -> Path:
        keys = {"file": str(wearer.short), "calibration": str(wearer.calibration), "csv": f"{stem}.csv"}
        keys |= {key.replace("_", "-"): value for key, value in changes.items()}
        path = tmp_path / f"{stem}.toml"
        lines = [f"{key} = {json.dumps(value)}\n" for key, value in keys.items() if value is not None]
        path.write_text("".join(lines))
        return path

    return write


def words(*files: Path) -> list[object]:
    return [word for file in files for word in ("--rig", file)]


# --- rig files ----------------------------------------------------------------------------------------------


def test_files_are_named_against_the_folder_of_the_rig_file(rig, tmp_path):
    own = {"file": "walk.csv", "calibration": "../calib.json", "sensors": "/map.toml", "csv": "-"}
    more = {"height": 2, "std": True, "no_mag": True, "leg_length": 1, "no_place": True}
    (flags,) = read_rigs([rig(**own, protocol="mine.toml", npz="out/a.npz", **more)])
    assert flags.name == "anna"
    assert flags.source.file == tmp_path / "walk.csv"
    assert flags.source.sensors == Path("/map.toml")
    assert flags.source.protocol == str(tmp_path / "mine.toml")
    assert flags.calibration == tmp_path / "../calib.json"
    assert flags.outputs.targets == (
        ("csv", FileTarget("-", (("rotations", ""),))),
        ("npz", FileTarget(str(tmp_path / "out/a.npz"), (("joints", "24"),))),
    )
    assert (flags.outputs.height, flags.outputs.std, flags.no_mag) == (2.0, True, True)
    assert (flags.outputs.leg_length, flags.outputs.body.leg_length_m, flags.no_place) == (1.0, 1.0, True)
    # What is not there is as on the command line.
    assert (flags.filter, flags.outputs.rotations, flags.source.realtime) == (None, "axis-angle", False)
    (flags,) = read_rigs([rig("ben")])
    assert (flags.outputs.leg_length, flags.no_place) == (None, False)


def test_addresses_and_lines_are_read_as_flags(rig):
    (flags,) = read_rigs(
        [
            rig(
                file=None, port="/dev/ttyUSB0", baud=921600, protocol="native", name="Anna B.", csv=None,
                udp=["10.0.0.5:9000,format=binary", "10.0.0.6:9000"], osc="127.0.0.1:39539",
                control="127.0.0.1:9100",
            )
        ]
    )  # fmt: skip
    assert flags.name == "Anna B."
    assert (flags.source.port, flags.source.baud, flags.source.protocol) == ("/dev/ttyUSB0", 921600, "native")
    assert flags.outputs.targets == (
        ("udp", ("10.0.0.5", 9000, "binary", "")),
        ("udp", ("10.0.0.6", 9000, "json", "")),
        ("osc", ("127.0.0.1", 39539, "")),
    )
    assert flags.control == ("127.0.0.1", 9100)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"speed": 3}, "unknown key 'speed'; keys are name, port, baud, can"),
        ({"model": "rnn"}, "unknown key 'model'"),
        ({"rig": "other.toml"}, "unknown key 'rig'"),
        ({"file": 3}, "file must be text in quotes, not 3"),
        ({"realtime": "yes"}, "realtime must be true or false, not 'yes'"),
        ({"std": 1}, "std must be true or false, not 1"),
        ({"baud": 9600.0}, "baud must be a whole number, not 9600.0"),
        ({"baud": True}, "baud must be a whole number, not True"),
        ({"baud": 0}, "baud: 0 is not in the range x>=1"),
        ({"height": "tall"}, "height must be a number, not 'tall'"),
        ({"height": 10**400}, "height is too large for a number"),
        ({"height": 175}, "height 175 m is not between 0.8 and 2.5 m"),
        ({"leg-length": 85}, "leg length 85 m is not between 0.3 and 1.5 m"),
        ({"csv": ""}, "csv is empty: give a value, or leave it out"),
        ({"sinks": 3}, "sinks must be a table of names and texts, not 3"),
        ({"mocopi": "localhost:9", "udp": "127.0.0.1:9"}, "udp and mocopi send to localhost:9 in two"),
        ({"leg-length": "long"}, "leg-length must be a number, not 'long'"),
        ({"no-place": 1}, "no-place must be true or false, not 1"),
        ({"csv": ["a.csv", 3]}, "csv must be text in quotes or a list of such texts, not ['a.csv', 3]"),
        ({"csv": ["a.csv", "b\0.csv"]}, "csv must be text without NUL characters"),
        ({"port": ["a", "b"]}, "port must be text in quotes, not ['a', 'b']"),
        ({"protocol": "nonsense"}, "protocol: unknown protocol 'nonsense'"),
        ({"filter": "best"}, "filter: 'best' is not one of"),
        ({"udp": "127.0.0.1"}, "udp: no port in '127.0.0.1'"),
        ({"calibration": None}, "calibration is missing"),
        ({"file": None}, "give one source: port PORT"),
        ({"file": None, "port": "a", "realtime": True}, "realtime is for a file: live sensors have"),
        ({"port": "/dev/ttyUSB0"}, "give one source: port PORT"),
        ({"csv": None}, "give at least one output, such as csv FILE"),
        ({"control": "127.0.0.1:9"}, "control needs live sensors, or realtime"),
        ({"name": 3}, "name must be text in quotes on one line, not 3"),
        ({"name": " "}, "name must be text"),
        ({"name": "a\nb"}, "name must be text"),
        *(({key: "a\0.toml"}, f"{key} must be text without NUL characters") for key in ("csv", "file")),
        *(
            ({key: "a\0.toml"}, f"{key} must be text without NUL")
            for key in ("sensors", "calibration", "udp")
        ),
    ],
    ids=str,
)
def test_what_is_wrong_in_a_rig_file_is_told_with_file_and_key(rig, changes, says):
    file = rig(**changes)
    with pytest.raises(EdgeposeError) as error:
        read_rigs([file])
    assert str(error.value).startswith(f"{file}: ")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_rig_file_that_is_not_there_or_not_toml(rig, tmp_path):
    with pytest.raises(EdgeposeError, match=r"nobody\.toml: cannot read it: No such file"):
        read_rigs([tmp_path / "nobody.toml"])
    file = rig()
    file.write_text("file = ")
    with pytest.raises(EdgeposeError, match=r"anna\.toml: not valid TOML"):
        read_rigs([file])
    file.write_text("file = " + "[" * 100_000)
    with pytest.raises(EdgeposeError, match=r"anna\.toml: not valid TOML: brackets are nested too deeply"):
        read_rigs([file])


def test_wearers_have_names_and_ports_of_their_own(rig):
    with pytest.raises(EdgeposeError, match=r"anna\.toml, .*ben\.toml: two wearers have the name anna;"):
        read_rigs([rig(), rig("ben", name="anna")])
    first, second = rig(file=None, port="A,B"), rig("ben", file=None, port="B")
    with pytest.raises(EdgeposeError, match="both use the port B; give each its own"):
        read_rigs([first, second])


def sensor_map(path: Path, line: str, first: int) -> str:
    path.write_text(
        "".join(f"{name} = {{ {line}, id = {first + i} }}\n" for i, name in enumerate(PLACEMENTS))
    )
    return path.name


def test_wearers_have_lines_of_their_own(rig, tmp_path):
    """Whatever names them; only a bus has room for two, if each says which ids are his."""
    hub = sensor_map(tmp_path / "hub.toml", 'port = "B"', 0)
    low, high, high_again = (
        sensor_map(tmp_path / f"{i}.toml", 'can = "socketcan:can0"', first)
        for i, first in enumerate((0, 6, 11))
    )
    bus, nobody = "both use the bus socketcan:can0; give each its own, or ids", None
    for anna, ben, says in (
        ({"port": "A, B"}, {"port": "B"}, "both use the port B"),
        ({"port": "A,B,C"}, {"sensors": hub}, "both use the port B"),
        ({"sensors": hub}, {"sensors": hub}, "both use the port B"),
        ({"port": "A"}, {"sensors": hub}, nobody),
        ({"can": "socketcan:can0"}, {"can": "socketcan:can0"}, bus),
        ({"can": "socketcan:can0"}, {"can": "socketcan:can0", "sensors": low}, bus),
        ({"sensors": high}, {"sensors": high_again}, bus),
        ({"sensors": low}, {"can": "socketcan:can0", "sensors": high}, nobody),
        ({"can": "socketcan:can0"}, {"can": "socketcan:can1"}, nobody),
        ({"file": "-"}, {"file": "-"}, "both use the standard input"),
    ):
        files = [rig("anna", **{"file": None} | anna), rig("ben", **{"file": None} | ben)]
        if says is nobody:
            assert len(read_rigs(files)) == 2
        else:
            with pytest.raises(EdgeposeError, match=says):
                read_rigs(files)


def test_no_output_takes_the_place_of_what_is_read(command, rig, tmp_path, write_archive):
    hub = sensor_map(tmp_path / "hub.toml", 'port = "B"', 0)
    (tmp_path / "mine.toml").write_text("[columns]\n")
    (tmp_path / "hub.toml").write_text((tmp_path / hub).read_text() + "[ports.B]\nprotocol = 'mine.toml'\n")
    model = write_archive(tmp_path / "model.pt", NetworkShape("rnn", 8, "global-6d", "passed"))
    inputs = {name: (tmp_path / name).read_bytes() for name in ("hub.toml", "mine.toml", "model.pt")}
    outputs = {"anna.toml": "--rig", "hub.toml": "--sensors", "mine.toml": "--protocol mine.toml"}
    outputs["model.pt"] = "--model"
    for output, flag in outputs.items():
        file = rig(file=None, sensors="hub.toml", csv=output)
        text = file.read_bytes()
        result = command("run", "--rig", file, "--model", model, cwd=tmp_path)
        assert result.returncode == 2, result.stderr
        assert f"--csv would overwrite {output}" in result.stderr.replace(f"{tmp_path}/", "")
        assert f", which is {'' if flag == '--model' else 'anna: '}{flag};" in result.stderr
        assert file.read_bytes() == text
    assert inputs == {name: (tmp_path / name).read_bytes() for name in inputs}


def test_several_wearers_write_to_nothing_that_can_stop_them(command, rig, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for flag, output in {"csv": "-", "bvh": "pipe"}.items():
        result = command("run", *words(rig(), rig("ben", **{"csv": None, flag: output})))
        assert result.returncode == 2, result.stderr
        assert f"ben: --{flag} " in result.stderr
        assert f"{output} is not a file on a disk: a slow reader of it would delay" in result.stderr
    # Where standard output is a file, there is no reader.
    rigs = map(str, words(rig(), rig("ben", csv="-")))
    with (tmp_path / "out.csv").open("w") as out:
        done = processes.run([sys.executable, "-m", "edgepose", "run", *rigs, "--model", "rnn"], stdout=out)
    assert done.returncode == 0
    assert len(read_poses(tmp_path / "out.csv").frames) == 180


@pytest.mark.parametrize(
    ("ben", "flags", "says"),
    [
        ({}, ["--csv", "x.csv"], "--csv belongs to a wearer: with --rig, put csv into the file"),
        ({}, ["--calibration", "c.json"], "--calibration belongs to a wearer"),
        ({}, ["--online", "window"], "--online window runs one wearer; use --online stream for several"),
        ({"realtime": True}, [], "anna and ben: a recording beside live sensors needs"),
        ({"csv": "anna.csv"}, [], "anna: --csv and ben: --csv name the same file"),
        ({"csv": "short.npz"}, [], "ben: --csv would overwrite"),
    ],
    ids=str,
)
def test_what_does_not_go_together(command, wearer, rig, tmp_path, ben, flags, says):
    (tmp_path / "short.npz").write_bytes(wearer.short.read_bytes())
    rigs = [rig(file="short.npz"), rig("ben", **ben)]
    result = command("run", *words(*rigs), *flags)
    assert result.returncode == 2, result.stderr
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert (tmp_path / "short.npz").read_bytes() == wearer.short.read_bytes()


@pytest.mark.parametrize("name", ["osc", "vrchat", "mocopi", "lsl", "udp"])
def test_a_receiver_that_cannot_tell_wearers_apart_gets_one(rig, name):
    wearers = read_rigs(
        [rig("anna", **{name: "127.0.0.1:9"}), rig("ben", **{name: ["[::1]:8", "127.0.0.1:9"]})]
    )
    if name == "udp":
        check_all_files(wearers, Path("model.pt"))
        return
    with pytest.raises(click.UsageError, match=f"anna and ben have the same {name}, whose receiver cannot"):
        check_all_files(wearers, Path("model.pt"))


def test_outputs_of_all_wearers_are_opened_or_none(command, rig, tmp_path):
    (tmp_path / "old.csv").write_text("a take")
    anna = rig(csv=["anna.csv", "old.csv"], overwrite=True)
    for target in ({"osc": "nosuch.invalid:39539"}, {"csv": ["ben.csv", "nowhere/ben.csv"]}):
        result = command("run", *words(anna, rig("ben", **target)), "--model", "rnn")
        assert result.returncode == 1
        assert re.search(r"ben: cannot (find host 'nosuch|write poses to .*nowhere/ben.csv)", result.stderr)
        assert {path.name for path in tmp_path.glob("*.csv")} == {"old.csv"}
    assert (tmp_path / "old.csv").read_text() == "a take"


def test_only_one_wearer_has_standard_output(command, rig):
    result = command("run", *words(rig(csv="-"), rig("ben", csv="-")))
    assert result.returncode == 2
    assert "several wearers write to standard output; give all but one a file" in result.stderr


def test_the_example_of_a_rig_file_is_one(tmp_path):
    (example,) = (text for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "calibration" in text)
    (tmp_path / "example.toml").write_text(example)
    (flags,) = read_rigs([tmp_path / "example.toml"])
    assert (flags.name, flags.source.port, flags.control) == ("anna", "/dev/ttyUSB0", ("127.0.0.1", 9101))
    assert ("csv", FileTarget(str(tmp_path / "anna.csv"), (("rotations", ""),))) in flags.outputs.targets


# --- recordings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["birnn", "rnn"])
def test_wearers_get_the_poses_that_each_gets_alone(
    command, wearer, rig, write_archive, tiny, tmp_path, kind
):
    shape = NetworkShape(kind, 8, "global-6d", "passed")
    model = write_archive(tmp_path / f"{kind}.pt", shape)
    window = (0, 0) if kind == "rnn" else (4, 2)
    files = {
        "anna": wearer.short,
        "ben": write_part(wearer.recording, 4.003, 5.501, tmp_path / "ben.npz"),
        "cleo": write_part(wearer.recording, 6.2, 6.21, tmp_path / "cleo.npz"),
    }
    rigs = [rig(name, file=str(file), rotations="matrix") for name, file in files.items()]
    result = command("run", *words(*rigs), "--model", model, "--trust", "--precision", "f32", "--json")
    assert result.returncode == 0, result.stderr
    assert f"running 3 wearers with {model} ({kind}, stream) in f32" in result.stderr
    no_contacts = f"{model} does not estimate contacts: the lowest foot counts as standing"
    assert result.stderr.count(no_contacts) == 1
    assert sum(no_contacts in line for line in json.loads(result.stdout)["messages"]) == 1
    lengths = []
    for name, file in files.items():
        with open_source(file=file) as source, CsvSink(tmp_path / "alone.csv", "matrix") as sink:
            run(
                WearerPipeline(load_calibration(wearer.calibration), 60.0, [sink]),
                source,
                StreamEngine(tiny(shape), *window),
            )
        ours, theirs = (read_poses(tmp_path / f"{each}.csv") for each in (name, "alone"))
        np.testing.assert_array_equal(ours.frames, theirs.frames)
        np.testing.assert_array_equal(ours.time_s, theirs.time_s)
        assert ours.status == theirs.status
        assert ours.translation is not None
        np.testing.assert_allclose(ours.rotations, theirs.rotations, atol=1e-5)
        lengths.append(len(ours.frames))
        assert f"{name}: poses    {len(ours.frames)} in " in result.stderr
        assert re.search(rf"^{name}: distance \d+\.\d m walked$", result.stderr, re.MULTILINE)
    assert lengths == [180, 90, 1]


def test_one_rig_file_is_a_run_of_one_wearer(command, rig, tmp_path):
    result = command("run", "--rig", rig(), "--model", "rnn")
    assert result.returncode == 0, result.stderr
    assert "running rnn (rnn, stream) in" in result.stderr
    assert "anna: poses    180 in " in result.stderr
    assert len(read_poses(tmp_path / "anna.csv").frames) == 180


def test_a_wearer_whose_input_is_broken_costs_only_his_own(command, wearer, rig, tmp_path):
    (tmp_path / "empty.bin").touch()
    damaged = tmp_path / "damaged.csv"
    write_csv(damaged, read_recording(wearer.short))
    lines = damaged.read_text().splitlines(keepends=True)
    damaged.write_text("".join(lines[:901]) + lines[901][:-20])
    rigs = [rig("ben", file="empty.bin"), rig(), rig("cleo", file="damaged.csv")]
    result = command("run", *words(*rigs), "--model", "rnn")
    assert result.returncode == 1
    assert f"ben: ended: {tmp_path}/empty.bin: no known packet in 0 bytes" in result.stderr
    told = result.stderr.splitlines()[-1]
    assert told.startswith("edgepose: 2 of 3 wearers failed: ben: ")
    assert f"; cleo: {damaged}: row 902 is cut off" in told
    counts = {name: len(read_poses(tmp_path / f"{name}.csv").frames) for name in ("anna", "cleo")}
    assert counts == {"anna": 180, "cleo": 90}


# --- live ---------------------------------------------------------------------------------------------------


def test_a_port_that_is_unplugged_and_comes_back_costs_only_its_wearer(wearer, rig, tmp_path, monkeypatch):
    """The other has a CAN bus, which is read in another way."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')  # python-can's own way to set this
    link, log = tmp_path / "hub", tmp_path / "told.txt"
    with contextlib.ExitStack() as stack:
        receivers = [stack.enter_context(Listener()) for _ in range(2)]
        _, bus = stack.enter_context(simulated(wearer.short, "--stand", "--protocol", "native-can"))
        unplugged, first = stack.enter_context(simulated(wearer.short, "--stand"))
        link.symlink_to(first)
        anna, ben = receivers
        rigs = [
            rig("anna", file=None, can=bus, protocol="native-can", udp=anna.address),
            rig("ben", file=None, port=str(link), protocol="native", udp=ben.address),
        ]
        command = [sys.executable, "-m", "edgepose", "run", "--model", "rnn", *map(str, words(*rigs))]
        process = processes.Popen(command, stderr=stack.enter_context(log.open("w")))
        stack.callback(process.wait)
        stack.callback(process.kill)
        anna.wait_for("ok", 20)
        ben.wait_for("ok", 20)
        link.unlink()
        unplugged.kill()
        ben.wait_for(ALL_HELD, 20)
        anna.wait_for("ok", 20)
        _, second = stack.enter_context(simulated(wearer.short, "--stand"))
        link.symlink_to(second)
        ben.wait_for("ok", 20)
        anna.wait_for("ok", 20)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    told = log.read_text()
    assert f"{link}: disconnected; the run continues and waits for it" in told
    assert f"{link}: back after " in told
    poses = {name: read_poses(tmp_path / f"{name}.csv") for name in ("anna", "ben")}
    for name, own in poses.items():
        assert own.frames.tolist() == list(range(len(own.frames)))
        assert f"{name}: poses    {len(own.frames)} in " in told
        # Wearers share their ticks.
        np.testing.assert_allclose(own.time_s * 60.0, np.round(own.time_s * 60.0), atol=1e-3)
    assert ALL_HELD in poses["ben"].status


def test_recordings_at_their_own_pace(command, rig, tmp_path, wearer):
    files = [write_part(wearer.recording, 4.0, end_s, tmp_path / f"{end_s}.npz") for end_s in (5.0, 4.5)]
    rigs = [
        rig(name, file=str(file), realtime=True) for name, file in zip(("anna", "ben"), files, strict=True)
    ]
    result = command("run", *words(*rigs), "--model", "rnn")
    assert result.returncode == 0, result.stderr
    assert "anna: latency " in result.stderr
    assert len(read_poses(tmp_path / "anna.csv").frames) == 60
    assert len(read_poses(tmp_path / "ben.csv").frames) == 30


def test_a_key_is_for_all_wearers():
    """Both hear of it, each once, whoever asks first."""
    code = """
import time
from edgepose.cli.terminal.keys import Keys
from edgepose.pipeline.remote_control import key_requests
with Keys() as keys:
    print('ready', keys.listening, flush=True)
    anna, ben = key_requests(2, keys.pressed)
    while not (wishes := anna()):
        time.sleep(0.01)
    while len(wishes) < 2:
        wishes += anna()
    print('anna', *[tuple(w) for w in wishes], anna(), 'ben', *[tuple(w) for w in ben()], ben(), flush=True)
"""
    outside, inside = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=inside, stdout=inside, stderr=inside, preexec_fn=own_terminal,
    )  # fmt: skip
    os.close(inside)
    try:
        screen = b""
        while b"ready True" not in screen:
            screen += os.read(outside, 4096)
        os.write(outside, b"rxo")
        while b"ben" not in screen or not screen.endswith(b"\n"):  # a line may come in parts
            screen += os.read(outside, 4096)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        os.close(outside)
    wishes = b"('rezero', 3.0) ('origin', 0.0)"
    assert b"anna " + wishes + b" [] ben " + wishes + b" []" in screen
