"""Files that would keep a reader busy for ever, or ask it for everything: one line, in bounded time."""

from __future__ import annotations

import os
import pickle
import re
import resource
import sqlite3
import struct
import sys
from pathlib import Path

import can
import numpy as np
import pytest

from edgepose.errors import EdgeposeError, FileFormatError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.utils.safe_pickle import read_pickle
from firmware_protocols import native_can
from firmware_protocols.native_packet import Packet
from tests.support import limits, processes

RUN = [sys.executable, "-m", "edgepose", "run", "--model", "rnn"]
LIMIT_S = 60.0
"""Nobody waits so long; a machine under load may."""


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
    done = processes.run(
        command, text=True, capture_output=True, timeout=LIMIT_S, check=False, env=environment
    )
    expected = "read\n" if name == "memory" else "FileFormatError "
    assert done.stdout.startswith(expected), done.stdout + done.stderr


@pytest.mark.parametrize("content", [b"", b"\x80\x04\x95", b".", b"}K", b"no pickle"])
def test_a_broken_pickle_is_told_with_a_reason(tmp_path, content):
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"a\.pkl: not a readable pickle: \S"):
        read_pickle(tmp_path / "a.pkl", "pickle", "advice")


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
        for sample in iter_samples(read_recording(wearer.short)):
            if sample.time_s > 0.5 + next(iter(iter_samples(read_recording(wearer.short)))).time_s:
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
    assert "ignored 1 frames with an impossible time or id" in result.stderr, result.stderr
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
    assert "not a file on a disk" in result.stderr
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
    done = processes.run(
        [*RUN, *words],
        text=True,
        capture_output=True,
        timeout=LIMIT_S,
        check=False,
        preexec_fn=limits.limit(resource.RLIMIT_CPU, 20),
    )
    assert done.returncode == 1
    assert re.fullmatch(
        r"edgepose: /dev/zero: larger than \d+ kB, too large for such a file; .*\n", done.stderr
    )


@pytest.mark.parametrize("words", [["check"], ["record", "o.csv"]])
def test_a_name_that_is_too_long(command, words):
    result = command(*words, "--file", "a" * 5000 + ".csv")
    assert result.returncode in (1, 2)
    assert re.fullmatch(r"edgepose: a{200}\.\.\.: File name too long\n", result.stderr), result.stderr[-200:]


@pytest.mark.parametrize("words", [["report"], ["check", "--file"], ["convert", "--to", "npz", "--out", "o"]])
def test_a_loop_of_links(command, tmp_path, words):
    loop = tmp_path / "a.csv"
    loop.symlink_to("a.csv")
    result = command(*words, loop, cwd=tmp_path)
    assert result.returncode in (1, 2)
    assert "Traceback" not in result.stderr
    assert "unexpected" not in result.stderr
    assert "a.csv" in result.stderr


def test_a_simulation_that_would_not_fit_into_memory(command, tmp_path):
    clip = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
    result = command("synthesize", clip, "--out", tmp_path / "o", "--hold", 600, "--rate", 1000)
    assert result.returncode == 2
    assert "--hold" in result.stderr
    assert not (tmp_path / "o").exists()
