"""What commands that write do to what is there already: a table of commands against kinds of targets."""

from __future__ import annotations

import json
import os
import resource
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.poses.registry import is_poses, pose_suffixes, read_poses
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording, recording_suffixes
from edgepose.pose import PoseFrame
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.registry import SINKS
from tests.support import limits, processes
from tests.support.recordings import part

OLD = b"what was there before\n"


def make_pose(index: int) -> PoseFrame:
    return PoseFrame(index, index / 60, np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)), np.zeros(24))


@pytest.fixture(scope="module")
def files(wearer, tmp_path_factory):
    """Inputs of the commands: a short recording and a file of poses."""
    folder = tmp_path_factory.mktemp("inputs")
    write_npz(folder / "take.npz", part(read_recording(wearer.recording), 5.6, 6.4))
    with CsvSink(folder / "poses.csv") as sink:
        for i in range(60):
            sink.write(make_pose(i))
    return folder


Words = Callable[[object, Path, Path], list[object]]


def running(flag: str) -> Words:
    return lambda wearer, files, out: [
        *(
            "run",
            "--file",
            files / "take.npz",
            "--calibration",
            wearer.calibration,
            "--model",
            "rnn",
            flag,
            out,
        )
    ]


def solving(*flags: str) -> Words:
    return lambda wearer, files, out: [
        *("solve", files / "take.npz", "--calibration", wearer.calibration, "--method", "sop", *flags, out)
    ]


# One of each kind: a file that grows, one that is written at the end, one with a number at its start.
FILES = {f"--{name}": SINKS[name].suffix for name in ("csv", "npz", "bvh")}

COMMANDS: dict[str, tuple[str, Words]] = {
    **{f"run {flag}": (suffix, running(flag)) for flag, suffix in FILES.items()},
    **{f"solve {flag}": (suffix, solving(flag)) for flag, suffix in FILES.items()},
    "solve --plot": (".png", solving("--csv", "/dev/null", "--plot")),
    "calibrate": (
        ".json",
        lambda wearer, files, out: [
            *("calibrate", "--file", wearer.recording, "--body-frame", "heading:0", "--from", 1, "--out", out)
        ],
    ),
    "record .csv": (".csv", lambda wearer, files, out: ["record", out, "--file", files / "take.npz"]),
    "record .npz": (".npz", lambda wearer, files, out: ["record", out, "--file", files / "take.npz"]),
    "report": (".html", lambda wearer, files, out: ["report", files / "poses.csv", "--out", out]),
    "convert": (
        ".csv",
        lambda wearer, files, out: ["convert", files / "take.npz", "--to", "csv", "--out", out.parent],
    ),
}


@pytest.fixture(params=COMMANDS)
def case(request, wearer, files, tmp_path):
    """The name of an output, and the words of the command that writes it."""
    ending, words = COMMANDS[request.param]
    out = tmp_path / "out" / f"take{ending}"
    out.parent.mkdir()
    return out, [str(word) for word in words(wearer, files, out)]


def fails(words: list[str]) -> str:
    with pytest.raises(EdgeposeError) as caught:
        CliRunner().invoke(cli, words, catch_exceptions=False)
    return str(caught.value)


def succeeds(words: list[str]) -> None:
    result = CliRunner().invoke(cli, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output


def check_whole(path: Path, data: bytes | None = None) -> None:
    """Raises unless a file, or what came out of a pipe, is what its name says."""
    if data is not None:
        path = path.with_name(f"copy{path.suffix}")
        path.write_bytes(data)
    content = path.read_bytes()
    if path.suffix == ".json":
        assert json.loads(content)["format"] == "edgepose-calibration"
    elif path.suffix == ".html":
        assert content.startswith(b"<!doctype html>")
        assert content.endswith(b"</html>\n")
    elif path.suffix == ".png":
        assert content.startswith(b"\x89PNG")
        assert content.endswith(b"IEND\xaeB`\x82")
    elif path.suffix == ".bvh":
        assert len(read_bvh(path).rotations) > 40
    elif path.suffix in pose_suffixes() and is_poses(path):
        assert len(read_poses(path).frames) > 40
    elif path.suffix in recording_suffixes():
        assert len(read_recording(path).sensors["head"].time_s) > 70
    else:
        raise AssertionError(f"no check of {path.suffix}")


def test_new(case):
    out, words = case
    succeeds(words)
    check_whole(out)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert stat.S_IMODE(out.stat().st_mode) == 0o666 & ~umask()


def umask() -> int:
    own = os.umask(0)
    os.umask(own)
    return own


def test_existing(case):
    out, words = case
    out.write_bytes(OLD)
    assert "already exists" in fails(words)
    assert out.read_bytes() == OLD
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_overwrite(case):
    out, words = case
    out.write_bytes(OLD)
    out.chmod(0o640)
    succeeds([*words, "--overwrite"])
    check_whole(out)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert stat.S_IMODE(out.stat().st_mode) == 0o640


def test_device(case):
    out, words = case
    out.symlink_to("/dev/null")
    succeeds(words)
    assert out.readlink() == Path("/dev/null")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    assert not Path("/dev/null.part.csv").exists()


def test_full_device(case):
    out, words = case
    out.symlink_to("/dev/full")
    if words[0] == "convert":
        result = CliRunner().invoke(cli, words)
        assert "the disk is full" in result.stderr
    else:
        assert "the disk is full" in fails(words)
    assert stat.S_ISCHR(Path("/dev/full").stat().st_mode)


def test_pipe(case):
    out, words = case
    os.mkfifo(out)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(out.read_bytes()))
    reader.start()
    succeeds(words)
    reader.join(30)
    assert out.is_fifo()
    out.unlink()
    check_whole(out, read[0])


def test_link(case):
    out, words = case
    end = out.parent / f"end{out.suffix}"
    end.write_bytes(OLD)
    out.symlink_to(end.name)
    assert "already exists" in fails(words)
    assert end.read_bytes() == OLD
    succeeds([*words, "--overwrite"])
    assert out.is_symlink()
    check_whole(end)


def test_dangling_link(case):
    out, words = case
    end = out.parent / f"end{out.suffix}"
    out.symlink_to(end.name)
    succeeds(words)
    assert out.is_symlink()
    check_whole(end)


def test_folder(case):
    out, words = case
    out.mkdir()
    for flags in ([], ["--overwrite"]):
        if words[0] == "convert":
            assert CliRunner().invoke(cli, [*words, *flags]).exit_code == 1
        else:
            result = CliRunner().invoke(cli, [*words, *flags])
            assert result.exit_code in (1, 2)
        assert list(out.iterdir()) == []


OTHER_KIND = [
    name for name in COMMANDS if name not in ("convert", "record .csv", "record .npz", "solve --plot")
]


@pytest.mark.parametrize("name", OTHER_KIND)
def test_a_name_of_another_kind(name, wearer, files, tmp_path):
    ending, words = COMMANDS[name]
    out = tmp_path / ("walk.toml" if ending == ".json" else "walk.json")
    out.write_bytes(OLD)
    for flags in ([], ["--overwrite"]):
        message = fails([str(word) for word in [*words(wearer, files, out), *flags]])
        assert "is the ending of another kind of file" in message
        assert out.read_bytes() == OLD


def edgepose(words: list[str], **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "edgepose", *words]
    return processes.run(command, text=True, capture_output=True, timeout=120, check=False, **options)


def test_a_folder_that_cannot_be_listed_costs_only_itself(wearer, tmp_path):
    (tmp_path / "in" / "closed").mkdir(parents=True)
    for folder in ("in", "in/closed"):
        (tmp_path / folder / "a.npz").write_bytes(wearer.short.read_bytes())
    (tmp_path / "in" / "closed").chmod(0)
    try:
        words = ["convert", "in", "--to", "csv", "--out", "out"]
        result = edgepose(words, cwd=tmp_path, preexec_fn=limits.mind_permissions)
    finally:
        (tmp_path / "in" / "closed").chmod(0o755)
    assert result.returncode == 1
    assert "in/closed: failed: cannot read it: Permission denied\n" in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.csv"]


def test_read_only_folder(case):
    out, words = case
    out.write_bytes(OLD)
    out.parent.chmod(0o555)
    try:
        result = edgepose([*words, "--overwrite"], preexec_fn=limits.mind_permissions)
    finally:
        out.parent.chmod(0o755)
    assert result.returncode == 1
    assert "Permission denied" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    assert out.read_bytes() == OLD


def test_read_only_file(case):
    """Who has taken the right to write from a file does not want it replaced."""
    out, words = case
    out.write_bytes(OLD)
    out.chmod(0o444)
    result = edgepose([*words, "--overwrite"], preexec_fn=limits.mind_permissions)
    assert result.returncode == 1
    assert "Permission denied" in result.stdout + result.stderr
    assert out.read_bytes() == OLD


def test_full_disk(case):
    """A limit on the size of files stops a write as a full disk does."""
    out, words = case
    limit = 700 if words[0] == "record" else 200  # some rows of samples fit, no pose does
    out.write_bytes(OLD)
    result = edgepose(
        [*words, "--overwrite"],
        preexec_fn=limits.limit(resource.RLIMIT_FSIZE, limit),
    )
    assert result.returncode == 1
    assert "File too large" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    if words[0] == "record":  # whose rows go to the disk while it runs: those that fitted are there
        rows = out if out.suffix == ".csv" else out.with_name("take.part.csv")
        assert rows.read_bytes().endswith(b"\n")
        rows.unlink()
    else:
        assert out.read_bytes() == OLD
    assert [path.name for path in out.parent.iterdir()] == ([out.name] if out.exists() else [])


# --- nothing is touched before everything is ready ----------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--osc", "nosuch.invalid:39539"], "cannot find host"),
        (["--osc", "127.255.255.255:39539"], "127.255.255.255"),
        (["--tcp", "192.0.2.1:8888"], "cannot listen for viewers"),
        (["--bvh", "nowhere/a.bvh"], "its folder does not exist"),
        (["--leg-length", "1.4"], "leg length 1.4 m does not fit"),
        (["--model", "nosuch"], "no such model"),
    ],
)
@pytest.mark.parametrize("there", [True, False])
def test_a_run_that_does_not_begin_costs_no_take(wearer, files, tmp_path, monkeypatch, flags, says, there):
    monkeypatch.chdir(tmp_path)
    if there:
        for name in ("take.csv", "take.bvh", "take.npz"):
            (tmp_path / name).write_bytes(OLD)
    words = [str(word) for word in running("--csv")(wearer, files, Path("take.csv"))]
    if flags[0] in words:
        words[words.index(flags[0]) + 1], flags = flags[1], []
    given = [] if "--bvh" in flags else ["--bvh", "take.bvh"]
    assert says in fails([*words, "--npz", "take.npz", *given, "--overwrite", *flags])
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert left == (dict.fromkeys(("take.csv", "take.bvh", "take.npz"), OLD) if there else {})


def test_a_run_without_poses_leaves_the_take_before(wearer, tmp_path):
    """A live rig that says nothing: the take before is still there."""
    master, slave = os.openpty()
    (tmp_path / "take.csv").write_bytes(OLD)
    result = edgepose(
        [
            *("run", "--port", os.ttyname(slave), "--protocol", "native", "--model", "rnn"),
            *("--calibration", str(wearer.calibration), "--csv", "take.csv", "--overwrite"),
        ],
        cwd=tmp_path,
    )
    os.close(master)
    os.close(slave)
    assert result.returncode == 1
    assert "no data for 5 s" in result.stderr
    assert (tmp_path / "take.csv").read_bytes() == OLD
    assert [path.name for path in tmp_path.iterdir()] == ["take.csv"]


@pytest.mark.parametrize(
    "name", ["run --csv", "run --npz", "run --bvh", "calibrate", "report", "record .csv"]
)
def test_kill_at_ten_instants(name, wearer, files, tmp_path):
    """What has the name afterwards is the old file or a new one, whole as far as it goes."""
    ending, words = COMMANDS[name]
    out = tmp_path / f"take{ending}"
    command = [sys.executable, "-m", "edgepose", *map(str, words(wearer, files, out)), "--overwrite"]
    took_s = 1e3
    for _ in range(3):  # the shortest: other programs may have delayed one
        start_s = time.monotonic()
        processes.run(command, check=True, capture_output=True)
        took_s = min(took_s, time.monotonic() - start_s)
    new = 0
    for instant in np.linspace(0.0, 1.1, 10):
        out.write_bytes(OLD)
        process = processes.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(instant * took_s)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if out.read_bytes() == OLD:
            continue
        new += 1
        if ending == ".csv":
            text = out.read_text()
            assert text.startswith(("frame,", "# ", "time_s"))
            assert text.endswith("\n")
        elif ending == ".bvh":
            head, _, _ = out.read_text().partition("Frame Time")
            assert "MOTION\nFrames: " in head
        else:
            check_whole(out)
        for rest in tmp_path.glob("*.part.csv"):
            rest.unlink()
    assert new < 10


# --- outputs that meet each other, or the input -------------------------------------------------------------


def test_standard_output_by_its_other_name(wearer, files, tmp_path):
    """A shell has opened the file: what is written goes on where it is, and the file stays the shell's."""
    words = [str(word) for word in running("--csv")(wearer, files, Path("/dev/stdout"))]
    with (tmp_path / "out.csv").open("w") as out:
        out.write("a line before\n")
        out.flush()
        processes.run([sys.executable, "-m", "edgepose", *words], stdout=out, check=True)
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0] == "a line before"
    assert lines[1].startswith("frame,")
    assert len(lines) > 40


def test_a_link_to_a_name_without_an_ending_gets_what_was_asked_for(command, files, tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "poses.npz").symlink_to("../blob")
    result = command("convert", files / "poses.csv", "--to", "npz", "--out", tmp_path / "o")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "blob").read_bytes().startswith(b"PK")


def test_convert_does_not_follow_a_link_to_another_kind_of_file(command, files, tmp_path):
    (tmp_path / "important.json").write_bytes(OLD)
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "poses.npz").symlink_to("../important.json")
    result = command("convert", files / "poses.csv", "--to", "npz", "--out", tmp_path / "o", "--overwrite")
    assert result.returncode == 1
    assert "another kind of file" in result.stderr
    assert (tmp_path / "important.json").read_bytes() == OLD


def test_a_target_that_appears_while_a_conversion_reads(files, tmp_path):
    out = tmp_path / "o" / "stdin.npz"
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", "convert", "-", "--to", "npz", "--out", str(tmp_path / "o")],
        text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    time.sleep(1.0)
    out.parent.mkdir()
    out.write_bytes(OLD)
    _, errors = process.communicate((files / "poses.csv").read_text(), timeout=60)
    assert process.returncode == 1
    assert "already" in errors
    assert out.read_bytes() == OLD


@pytest.mark.parametrize("flags", [(), ("--overwrite",)])
def test_the_file_that_grows_is_nobody_elses(command, wearer, files, tmp_path, flags):
    words = [str(word) for word in running("--csv")(wearer, files, tmp_path / "walk.part.csv")]
    result = edgepose([*words, "--npz", str(tmp_path / "walk.npz"), *flags])
    assert result.returncode == 2
    assert "--csv and --npz (while it grows) name the same file" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("out", "source"), [("w.csv", "w.csv"), ("w.npz", "w.part.csv")])
def test_record_does_not_take_its_own_input(command, files, tmp_path, out, source):
    write = {".csv": "csv"}[Path(source).suffix]
    result = command("convert", files / "take.npz", "--to", write, "--out", tmp_path)
    (tmp_path / "take.csv").rename(tmp_path / source)
    before = (tmp_path / source).read_bytes()
    result = command("record", out, "--file", source, "--overwrite", cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert "would overwrite" in result.stderr
    assert (tmp_path / source).read_bytes() == before


def test_one_standard_output_for_one_output(wearer, files, tmp_path):
    words = [str(word) for word in running("--csv")(wearer, files, Path("-"))]
    with (tmp_path / "out").open("w") as out:
        done = processes.run(
            [sys.executable, "-m", "edgepose", *words, "--bvh", "/dev/stdout"],
            stdout=out, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert done.returncode == 2
    assert "name the same file" in done.stderr
