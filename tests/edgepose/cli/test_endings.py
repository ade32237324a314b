"""How commands end: whatever is read and whoever stops reading, in bounded time, with one line."""

from __future__ import annotations

import fcntl
import os
import pickle
import pty
import re
import resource
import signal
import sqlite3
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import can
import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.base import samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.utils.safe_pickle import read_pickle
from firmware_protocols import native_can
from firmware_protocols.native_packet import Packet
from tests.support.terminals import on_a_terminal

RUN = [sys.executable, "-m", "edgepose", "run", "--model", "rnn"]
LIMIT_S = 60.0
"""Nobody waits so long; a machine under load may."""


@pytest.fixture(autouse=True)
def hangup():
    """Tests that were started with nohup have SIGHUP ignored, and what they start would inherit that."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def started(wearer, *words: object, short: bool = False, **options) -> subprocess.Popen:
    """A run on 12 s, or 3 s, of a recording."""
    file = wearer.short if short else wearer.recording
    command = [*RUN, "--file", file, "--calibration", wearer.calibration, *words]
    return subprocess.Popen(list(map(str, command)), **options)


def ended(process: subprocess.Popen) -> tuple[int, str]:
    """Exit code and messages."""
    try:
        _, errors = process.communicate(timeout=LIMIT_S)
    finally:
        process.kill()
    return process.returncode, errors


def until(condition, what: str) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.02)


# --- files that keep a reader busy --------------------------------------------------------------------------


def nested(depth: int) -> bytes:
    """Pickle instructions for a tuple of a tuple twice, and so on: 2**depth parts in a few bytes."""
    return b"K\x01\x85" + b"2\x86" * depth


BOMBS = {
    "a set of bytes": b"cbuiltins\nset\ncbuiltins\nbytes\n\x8a\x05\x00\x00\x00\x00\x01\x85R\x85R.",
    "bytes by number": b"cbuiltins\nbytes\n\x8a\x05\x00\x00\x00\x00\x01\x85R.",
    "a key": b"}" + nested(40) + b"K\x00s.",
    "keys": b"}(" + nested(40) + b"K\x00u.",
    "a set": b"\x8f(" + nested(40) + b"\x90.",
    "a frozen set": b"(" + nested(40) + b"\x91.",
    "a byte array": b"\x80\x05\x96" + struct.pack("<Q", 1 << 45) + b"abc.",
    "bytes": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 45) + b"abc.",
    "text of a list": b"c_codecs\nencode\n\x8c\x01x"
    + b"]"
    + b"".join(b"q" + bytes([i]) + b"](h" + bytes([i]) + b"h" + bytes([i]) + b"e" for i in range(40))
    + b"\x86R.",
    "numbers that meet": b"}("
    + b"".join(
        b"\x8a\x0a" + ((2**61 - 1) * i).to_bytes(10, "little", signed=True) + b"K\x00" for i in range(150_000)
    )
    + b"u.",
    "one set again and again": b"]("
    + b"K\x01" * 300_000
    + b"e0"
    + b"cbuiltins\nset\nq\x01]("
    + b"K\x01" * 30_000
    + b"eq\x02"
    + b"h\x01h\x02\x85R0" * 30_000
    + b".",
    "memory": b"}r\xff\xff\xff\xff.",
}


@pytest.mark.parametrize("name", BOMBS)
def test_pickles_that_ask_for_everything(tmp_path, name):
    """In a process of its own with little memory: none takes time, none takes memory."""
    path = tmp_path / "a.pkl"
    path.write_bytes(BOMBS[name])
    code = (
        "import sys; from pathlib import Path; from edgepose.utils.safe_pickle import read_pickle\n"
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (20, 20))\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))\n"
        "try: read_pickle(Path(sys.argv[1]), 'pickle', 'no')\n"
        "except Exception as error: print(type(error).__name__, error)\n"
        "else: print('read')\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, text=True, capture_output=True, timeout=LIMIT_S, check=False, env=environment
    )
    expected = "read\n" if name == "memory" else "FileFormatError "
    assert done.stdout.startswith(expected), done.stdout + done.stderr


def test_a_list_in_a_pickle_that_holds_itself_many_times(tmp_path):
    value: list = [1.0]
    for _ in range(30):
        value = [value, value]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": value}))
    from edgepose.utils.safe_pickle import numbers

    content = read_pickle(tmp_path / "a.pkl", "pickle", "no")
    with pytest.raises(EdgeposeError, match="poses is not an array"):
        numbers(content["poses"], "poses", tmp_path / "a.pkl")


def test_a_broken_pickle_costs_only_itself(command, tmp_path):
    (tmp_path / "a.pkl").write_bytes(BOMBS["a set of bytes"])
    rng = np.random.default_rng(1)
    quats = rng.normal(size=(60, 17, 4))
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    matrices = np.tile(np.eye(3), (60, 17, 1, 1))
    good = {"imu_ori": matrices, "imu_acc": np.zeros((60, 17, 3)), "gt": np.zeros((60, 72))}
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(good))
    result = command(
        "convert", tmp_path / "a.pkl", tmp_path / "b.pkl", "--to", "npz", "--out", tmp_path / "o"
    )
    assert result.returncode == 1
    assert "a.pkl: failed: " in result.stderr
    assert "b.pkl: ok" in result.stderr


def can_log(path: Path, wearer, **options) -> int:
    """A log of the wearer's first half second; gives the number of its frames."""
    count = 0
    seq = dict.fromkeys(range(6), 0)
    with can.Logger(path, **options) as log:
        for sample in samples(read_recording(wearer.short)):
            if sample.time_s > 0.5 + next(iter(samples(read_recording(wearer.short)))).time_s:
                break
            packet = Packet(
                sample.sensor, seq[sample.sensor], int(sample.time_s * 1e6), sample.quat, sample.acc
            )
            seq[sample.sensor] += 1
            for identifier, data in native_can.encode(packet):
                log.on_message_received(
                    can.Message(
                        timestamp=sample.time_s, arbitration_id=identifier, data=data, is_extended_id=False
                    )
                )
                count += 1
    return count


def test_a_blf_object_without_a_length(command, wearer, tmp_path):
    log = tmp_path / "a.blf"
    can_log(log, wearer, compression_level=0)
    content = bytearray(log.read_bytes())
    objects = [match.start() for match in re.finditer(b"LOBJ", content)]
    middle = objects[len(objects) // 2]
    content[middle + 8 : middle + 12] = bytes(4)
    log.write_bytes(content)
    result = command("convert", log, "--protocol", "native-can", "--to", "npz", "--out", tmp_path)
    assert result.returncode == 1
    assert "damaged: an object in it has no length" in result.stderr
    kept = read_recording(tmp_path / "a.npz")
    assert 10 < len(kept.sensors["head"].time_s) < 50


@pytest.mark.parametrize("what", ["NULL id", "text id", "infinite time", "NaN time", "huge time"])
def test_frames_of_a_log_that_cannot_be(command, wearer, tmp_path, what):
    """They cost themselves: the others are converted, and their number is told."""
    if "id" in what:
        log = tmp_path / "a.db"
        count = can_log(log, wearer)
        with sqlite3.connect(log) as database:
            value = None if what == "NULL id" else "abc"
            database.execute("UPDATE messages SET arbitration_id = ? WHERE rowid = 20", (value,))
        database.close()
    else:
        log = tmp_path / "a.log"
        count = can_log(log, wearer)
        lines = log.read_text().splitlines()
        stamp = {"infinite time": "1e400", "NaN time": "nan", "huge time": "1e300"}[what]
        lines[20] = re.sub(r"^\(.*?\)", f"({stamp})", lines[20])
        log.write_text("\n".join(lines) + "\n")
    result = command("convert", log, "--protocol", "native-can", "--to", "csv", "--out", tmp_path / "o")
    assert result.returncode == 1
    assert "1 of its frames have no possible time or id" in result.stderr, result.stderr
    assert "Traceback" not in result.stderr
    kept = sum(len(data.time_s) for data in read_recording(tmp_path / "o" / "a.csv").sensors.values())
    assert count / 2 - 4 <= kept < count


@pytest.mark.parametrize("what", ["a view", "a view that counts", "nothing"])
def test_a_database_that_is_no_log(command, tmp_path, what):
    """SQLite would compute for ever, and look at no signal."""
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT"
    log = tmp_path / "a.db"
    with sqlite3.connect(log) as database:
        if what != "nothing":
            database.execute(
                f"CREATE VIEW messages AS {endless} {'x' if what == 'a view' else 'count(*)'} FROM c"
            )
    database.close()
    result = command("convert", log, "--protocol", "native-can", "--to", "npz", "--out", tmp_path / "o")
    assert result.returncode == 1
    assert "it has no table of messages" in result.stderr


@pytest.mark.parametrize(
    "text",
    ["\n" * 260_000 + "!", ".".join(['"="'] * 60_000) + " = 1", "a" + ".a" * 100_000 + " = 1"],
    ids=["empty lines", "quoted parts", "parts"],
)
def test_toml_of_other_kinds_that_keeps_the_parser_busy(command, tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    result = command("run", "--rig", tmp_path / "a.toml")
    assert result.returncode == 1
    assert "a.toml: " in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_calibration_of_many_keys(command, wearer, tmp_path):
    (tmp_path / "c.json").write_text("{" + ",".join(f'"{i}":0' for i in range(95_000)) + ',"a":0,"a":0}')
    result = command("run", "--file", wearer.short, "--calibration", tmp_path / "c.json", "--csv", "-")
    assert result.returncode == 1
    assert "'a' appears twice" in result.stderr


@pytest.mark.parametrize("name", ["--prior", "report", "run"])
def test_a_device_in_the_place_of_an_npz_file(command, wearer, tmp_path, name):
    (tmp_path / "z.npz").symlink_to("/dev/zero")
    words = {
        "--prior": (
            "solve",
            wearer.short,
            "--calibration",
            wearer.calibration,
            "--prior",
            "/dev/zero",
            "--csv",
            "-",
        ),
        "report": ("report", tmp_path / "z.npz", "--out", tmp_path / "r.html"),
        "run": ("run", "--file", tmp_path / "z.npz", "--calibration", wearer.calibration, "--csv", "-"),
    }
    result = command(*words[name])
    assert result.returncode == 1
    assert "no file on a disk" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("flag", ["--rig", "--sensors", "--protocol"])
def test_toml_that_keeps_the_parser_busy(command, wearer, tmp_path, flag):
    deep = tmp_path / "deep.toml"
    deep.write_text("a." * 100_000 + "b = 1\n")
    words = ["--rig", deep] if flag == "--rig" else ["--port", "/dev/ttyNONE", flag, deep]
    more = () if flag == "--rig" else ("--calibration", wearer.calibration, "--csv", "-")
    result = command("run", *words, *more)
    assert result.returncode == 1
    assert result.stderr == f"edgepose: {deep}: not valid TOML: a key has more than 100 parts\n"


@pytest.mark.parametrize("flag", ["--calibration", "--rig", "--sensors"])
def test_a_device_without_an_end_as_a_text_file(wearer, flag):
    given = {"--calibration": wearer.calibration, "--port": "/dev/ttyNONE", flag: "/dev/zero", "--csv": "-"}
    if flag == "--rig":
        given = {"--rig": "/dev/zero"}
    words = [str(word) for pair in given.items() for word in pair]
    done = subprocess.run(
        [*RUN, *words],
        text=True,
        capture_output=True,
        timeout=LIMIT_S,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (20, 20)),
    )
    assert done.returncode == 1
    assert re.fullmatch(r"edgepose: /dev/zero: larger than \d+ kB, as no such file is; .*\n", done.stderr)


# --- readers and terminals that go --------------------------------------------------------------------------


def full(pipe) -> bool:
    """Whether there is something in a pipe, and no more of it after a while."""
    before, after = 0, -1
    while before != after:
        before = after
        time.sleep(0.5)
        after = struct.unpack("i", fcntl.ioctl(pipe.fileno(), termios.FIONREAD, bytes(4)))[0]
    return after > 10_000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_signal_ends_a_run_whose_output_nobody_reads(wearer, tmp_path, number):
    process = started(
        *(wearer, "--csv", "-", "--npz", tmp_path / "p.npz"),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    until(lambda: full(process.stdout), "a full pipe")
    process.send_signal(number)
    try:
        assert process.wait(LIMIT_S) == 1
        errors = process.stderr.read()
    finally:
        process.kill()
        process.stdout.close()
        process.stderr.close()
        process.wait()
    assert "poses    " in errors
    assert re.search(
        r"edgepose: the program that reads the poses from standard output takes nothing: \d+ bytes", errors
    )
    count = int(re.search(r"poses    (\d+) in", errors)[1])
    assert len(read_poses(tmp_path / "p.npz").frames) == count > 20
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


@pytest.mark.parametrize("how", ["goes away", "closed at the start"])
def test_standard_error_that_nobody_reads(wearer, tmp_path, how):
    """Messages are not what a run is for."""
    options = {"stderr": subprocess.PIPE} if how == "goes away" else {"preexec_fn": lambda: os.close(2)}
    process = started(wearer, "--realtime", "--csv", tmp_path / "p.csv", short=True, **options)
    if how == "goes away":
        process.stderr.readline()
        process.stderr.close()
    assert process.wait(LIMIT_S) == 0
    assert len(read_poses(tmp_path / "p.csv").frames) == 180


def test_every_command_works_without_standard_error():
    done = subprocess.run(
        [sys.executable, "-m", "edgepose", "models"], stdout=subprocess.PIPE, preexec_fn=lambda: os.close(2)
    )
    assert done.returncode == 0
    assert b"birnn" in done.stdout


def test_standard_output_that_is_closed(wearer):
    process = started(wearer, "--csv", "-", text=True, stderr=subprocess.PIPE, preexec_fn=lambda: os.close(1))
    code, errors = ended(process)
    assert code == 1
    assert errors.endswith("edgepose: cannot write poses: standard output is closed\n")


def test_a_terminal_that_is_closed_ends_a_run_with_whole_files(wearer, tmp_path):
    """The window is closed, or the line of ssh breaks: SIGHUP, and a standard error that is an error."""
    master, slave = pty.openpty()
    process = started(
        *(wearer, "--realtime", "--npz", tmp_path / "p.npz"),
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=take_terminal,
    )
    os.close(slave)
    seen = b""
    while b" poses, " not in seen:
        seen += os.read(master, 4096)
    os.close(master)
    assert process.wait(LIMIT_S) == 0
    assert 30 < len(read_poses(tmp_path / "p.npz").frames) < 720
    assert [path.name for path in tmp_path.iterdir()] == ["p.npz"]


def take_terminal() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def test_nohup_goes_on(wearer, tmp_path):
    process = started(
        *(wearer, "--realtime", "--csv", tmp_path / "p.csv"),
        short=True,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    process.stderr.readline()
    until(lambda: (tmp_path / "p.csv").stat().st_size > 20_000, "poses")
    process.send_signal(signal.SIGHUP)
    code, _ = ended(process)
    assert code == 0
    assert len(read_poses(tmp_path / "p.csv").frames) == 180


def test_a_recording_to_a_pipe_that_nobody_reads(wearer):
    process = subprocess.Popen(
        [sys.executable, "-m", "edgepose", "record", "-", "--file", str(wearer.recording)],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    until(lambda: full(process.stdout), "a full pipe")
    process.send_signal(signal.SIGTERM)
    try:
        assert process.wait(LIMIT_S) == 1
    finally:
        process.kill()
        errors = process.stderr.read()
        process.stdout.close()
        process.stderr.close()
    assert "the program that reads the samples from standard output takes nothing" in errors


def test_a_pipe_is_waited_for_until_the_run_is_to_end(wearer, tmp_path):
    os.mkfifo(tmp_path / "p.csv")
    process = started(wearer, "--csv", tmp_path / "p.csv", text=True, stderr=subprocess.PIPE)
    assert process.stderr.readline() == f"{tmp_path / 'p.csv'}: waiting for a program that reads it\n"
    process.send_signal(signal.SIGTERM)
    code, errors = ended(process)
    assert code == 1
    assert errors == f"edgepose: nobody reads the poses from {tmp_path / 'p.csv'}\n"


def test_a_user_without_a_home(tmp_path):
    """As in a container that runs under any number."""
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CONFIG_HOME")}
    done = subprocess.run(
        [sys.executable, "-m", "edgepose", "models"],
        text=True,
        capture_output=True,
        check=False,
        env=environment | {"XDG_CONFIG_HOME": "~nobody-of-that-name/x"},
    )
    assert done.returncode == 0, done.stderr
    assert "birnn" in done.stdout


# --- escape sequences ---------------------------------------------------------------------------------------

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e"


OWN = re.compile(rb"\x1b\[(K|\?25[hl]|\?1049[hl]|[HJ]|\d*m)")
"""What the program itself draws with: the rest of a line, the cursor, colours."""


@pytest.mark.parametrize(
    "words",
    [
        ("report", ESCAPES + ".csv"),
        ("run", "--file", ESCAPES + ".npz", "--calibration", "c.json", "--csv", "-"),
        ("run", "--file", "REC", "--calibration", ESCAPES + ".json", "--csv", "-"),
        ("run", "--file", "REC", "--calibration", "CAL", "--csv", ESCAPES + "/a.csv"),
        ("run", "--file", "REC", "--calibration", "CAL", "--model", ESCAPES, "--csv", "-"),
        ("run", "--rig", "rig.toml"),
        ("run", "--rig", "name.toml"),
        ("check", "--port", ESCAPES),
        ("check", "--file", ESCAPES + ".csv"),
        ("calibrate", "--file", ESCAPES + ".csv", "--out", "o.json"),
        ("record", ESCAPES + ".csv", "--port", ESCAPES),
        ("convert", ESCAPES + ".csv", "--to", "npz", "--out", "o"),
        ("convert", "folder", "--to", "npz", "--out", "o"),
        ("record", "-", "--file", ESCAPES.replace("/", "") + ".npz"),
        ("calibrate", "--file", ESCAPES + ".npz", "--body-frame", "heading:0", "--from", 1, "--out", "-"),
        ("--debug", "run", "--file", ESCAPES + ".csv", "--calibration", "CAL", "--csv", "-"),
        ("solve", ESCAPES + ".npz", "--calibration", "CAL", "--csv", "-"),
        ("models", ESCAPES),
        ("view", ESCAPES + ".csv"),
        ("synthesize", "CLIP", "--out", "o", "--body", "body.pkl"),
        (ESCAPES,),
    ],
    ids=lambda words: " ".join(str(word) for word in words if ESCAPES not in str(word)),
)
def test_escape_sequences_of_others_do_not_reach_a_terminal(wearer, tmp_path, words):
    (tmp_path / "rig.toml").write_text(
        'file = "\\u001b]0;owned\\u0007.npz"\ncalibration = "c"\ncsv = "\\u001b[2J"'
    )
    (tmp_path / "name.toml").write_text('"\\u001b[2J" = 1\n')
    (tmp_path / "body.pkl").write_bytes(b"c\x1b]0;owned\x07\n\x1b[2J\n.")
    (tmp_path / "folder").mkdir()
    (tmp_path / f"{ESCAPES}.npz").write_bytes(wearer.recording.read_bytes())
    (tmp_path / "folder" / f"{ESCAPES}.csv").write_text("nothing\n")
    clip = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
    stands_for = {"REC": wearer.short, "CAL": wearer.calibration, "CLIP": clip}
    words = [stands_for.get(word, word) for word in words]
    _, text = on_a_terminal([sys.executable, "-m", "edgepose", *words], cwd=tmp_path)
    assert text
    assert (b"Traceback" in text) == ("--debug" in words)
    rest = OWN.sub(b"", text)
    assert b"\x1b" not in rest
    assert b"\x07" not in rest
    assert "\x9b" not in rest.decode(errors="replace")
    if words[0] != "record":  # whose output is data
        assert "\u202e" not in rest.decode(errors="replace")


def test_names_that_are_no_text(command, wearer, tmp_path):
    """A file of another system: its name is shown as far as it goes, in pages and files, too."""
    odd = os.fsdecode(b"na\xefme")
    shortened = tmp_path / f"{odd}.npz"
    shortened.write_bytes(wearer.recording.read_bytes())
    calibration = tmp_path / "c.json"
    flags = ("--body-frame", "heading:0", "--from", 1)
    result = command("calibrate", "--file", shortened, *flags, "--out", calibration)
    assert result.returncode == 0, result.stderr
    poses = tmp_path / f"{odd}.csv"
    result = command(
        "run", "--file", shortened, "--calibration", calibration, "--model", "rnn", "--csv", poses
    )
    assert result.returncode == 0, result.stderr
    result = command("report", poses)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / f"{odd}.html").read_bytes().endswith(b"</html>\n")
