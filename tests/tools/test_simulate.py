"""The device simulator as its users run it: a process, its lines, and the bytes on its port."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
import tty
from binascii import crc_hqx
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.recording import from_samples, read_recording, write_csv, write_npz
from firmware_protocols.native import cobs_decode, decode_body

SIMULATOR = Path(__file__).parents[2] / "tools" / "simulate.py"
ROWS = 150
STEP = 0.05  # m/s^2 between two rows


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """1.5 s at 100 Hz in which every row can be told from its acceleration along X."""
    rng = np.random.default_rng(4)
    quats = rng.normal(size=(ROWS, 6, 4))
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    acc, gyr = rng.uniform(-5.0, 5.0, size=(2, ROWS, 6, 3))
    acc[:, :, 0] = STEP * np.arange(ROWS)[:, None]
    samples = [
        ImuSample(i, 7.0 + row / 100, tuple(quats[row, i]), tuple(acc[row, i]), tuple(gyr[row, i]))
        for row in range(ROWS)
        for i in range(6)
    ]
    path = tmp_path_factory.mktemp("simulate") / "recording.npz"
    write_npz(path, from_samples(samples))
    return path


def start(*words, stdin=subprocess.PIPE):
    return subprocess.Popen(
        [sys.executable, str(SIMULATOR), *map(str, words)],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


class Line:
    """Reads a port and decodes what comes; `until` reads on until something holds."""

    def __init__(self, port):
        self.file = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.file)
        self.rest = b""
        self.packets = []

    def until(self, enough):
        while not enough():
            if select.select([self.file], [], [], 0.2)[0]:
                *frames, self.rest = (self.rest + os.read(self.file, 65536)).split(b"\0")
                for frame in frames:
                    with contextlib.suppress(ValueError):  # cut where a buffer was full
                        body = cobs_decode(frame)
                        if crc_hqx(body[:-2], 0xFFFF) == int.from_bytes(body[-2:], "little"):
                            self.packets.append(decode_body(body[:-2]))

    def of(self, sensor):
        return [packet for packet in self.packets if packet.sensor_id == sensor]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self.file)


def row_of(packet):
    return round(packet.acc[0] / STEP)


def check_values(packets, data):
    """Packets carry the values of their rows, as well as the wire can."""
    rows = [row_of(packet) for packet in packets]
    # 16 bits: 1 / 32767 of a quaternion's number, 0.01 m/s^2, 1 / 900 rad/s.
    np.testing.assert_allclose([p.quat for p in packets], data.quat[rows], atol=4e-5)
    np.testing.assert_allclose([p.acc for p in packets], data.acc[rows], atol=0.0051)
    np.testing.assert_allclose([p.gyr for p in packets], data.gyr[rows], atol=0.0006)
    return rows


def test_standing_then_playing_then_standing(recording):
    with start(recording, "--stand") as process:
        word, port = process.stdout.readline().split()
        assert word == "port"
        with Line(port) as line:
            line.until(lambda: len(line.packets) > 100)
            assert {row_of(packet) for packet in line.packets} == {0}
            begun = time.time()
            process.stdin.write("go\n")
            process.stdin.flush()
            line.until(lambda: len(line.of(5)) > 20 and all(row_of(p) == ROWS - 1 for p in line.of(5)[-20:]))
            said = [process.stdout.readline().split() for _ in range(2)]
            process.stdin.close()
            assert process.wait(20) == 0
        assert process.stderr.read() == ""
    assert [words[0] for words in said] == ["started", "ended"]
    started, ended = (float(words[1]) for words in said)
    assert ended - started == pytest.approx((ROWS - 1) / 100, abs=1e-3)
    assert abs(started - begun) < 30.0  # Unix time, on a machine that may be busy
    for i, data in enumerate(read_recording(recording).sensors.values()):
        packets = line.of(i)
        rows = check_values(packets, data)
        assert rows == sorted(rows)
        assert rows[0] == 0
        # A busy machine may lose packets, as a line does; what comes has the times of its row.
        assert len(set(rows)) > ROWS // 2
        playing = [(p, row) for p, row in zip(packets, rows, strict=True) if 0 < row < ROWS - 1]
        for (a, row_a), (b, row_b) in pairwise(playing):
            assert b.seq - a.seq == row_b - row_a
            assert abs(b.t_us - a.t_us - 10_000 * (row_b - row_a)) <= 1


def test_playing_at_once_takes_its_time_and_ends_with_its_input(recording):
    with start(recording, stdin=subprocess.DEVNULL) as process:
        begun = time.monotonic()
        lines = process.stdout.read().splitlines()
        assert process.wait(20) == 0
        assert time.monotonic() - begun > 1.0  # of 1.5 s: nobody waits for a slow machine here
    assert [line.split()[0] for line in lines] == ["port", "started", "ended"]


def test_ctrl_c_ends_it(recording):
    with start(recording, "--stand") as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        assert process.stderr.read() == ""


def test_a_recording_without_angular_rate(recording, tmp_path):
    source = read_recording(recording)
    bare = {name: data._replace(gyr=None) for name, data in source.sensors.items()}
    file = tmp_path / "bare.csv"
    write_csv(file, source._replace(sensors=bare))
    with start(file, "--stand") as process, Line(process.stdout.readline().split()[1]) as line:
        line.until(lambda: len(line.packets) > 12)
        process.stdin.close()
        assert process.wait(20) == 0
    assert {packet.gyr for packet in line.packets} == {None}


def drop_orientation(sensors):
    sensors["head"] = sensors["head"]._replace(quat=None)


def shorten(sensors):
    sensors["head"] = type(sensors["head"])(*(c if c is None else c[:-1] for c in sensors["head"]))


def one_instant(sensors):
    for name in PLACEMENTS:
        sensors[name] = type(sensors[name])(*(c if c is None else c[:1] for c in sensors[name]))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (drop_orientation, "head: the recording lacks orientation"),
        (shorten, "head: its times differ from those of left_forearm"),
        (one_instant, "the recording needs two instants or more"),
    ],
)
def test_a_recording_that_cannot_be_played(recording, tmp_path, change, says):
    source = read_recording(recording)
    change(source.sensors)
    file = tmp_path / "recording.npz"
    write_npz(file, source)
    with start(file) as process:
        output, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert output == ""
    assert errors.startswith(f"Error: {says}")
    assert len(errors.splitlines()) == 1


def test_a_file_that_is_not_there(tmp_path):
    with start(tmp_path / "nowhere.npz") as process:
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert errors.startswith(f"Error: {tmp_path / 'nowhere.npz'}: cannot read it")
