"""The device simulator as its users run it: a process, its lines, and the bytes on its port."""

from __future__ import annotations

import contextlib
import math
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import time
import tty
from binascii import crc_hqx
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest

from edgepose.formats.recordings.base import recording_from_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from firmware_protocols.native import cobs_decode
from firmware_protocols.native_packet import decode_body
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.rotation import rotate
from tests.support import processes
from tests.support.datagrams import free_address

SIMULATOR = Path(__file__).parents[2] / "tools" / "simulate.py"
CLIP = SIMULATOR.parent / "data" / "09_12.bvh"
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
    # The last sample is one of a sensor at rest, as those that follow are.
    tilt = math.asin(acc[-1, 0, 0] / 9.81)
    quats[-1], gyr[-1] = (math.cos(tilt / 2), 0.0, -math.sin(tilt / 2), 0.0), 0.0
    acc[-1] = 9.81 * math.sin(tilt), 0.0, 9.81 * math.cos(tilt)
    samples = [
        ImuSample(i, 7.0 + row / 100, tuple(quats[row, i]), tuple(acc[row, i]), tuple(gyr[row, i]))
        for row in range(ROWS)
        for i in range(6)
    ]
    path = tmp_path_factory.mktemp("simulate") / "recording.npz"
    write_npz(path, recording_from_samples(samples))
    return path


def start(*words, stdin=subprocess.PIPE):
    return processes.Popen(
        [sys.executable, str(SIMULATOR), "--ideal", *map(str, words)],
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
        self.broken = 0

    def until(self, enough):
        while not enough():
            if select.select([self.file], [], [], 0.2)[0]:
                *frames, self.rest = (self.rest + os.read(self.file, 65536)).split(b"\0")
                self.broken += len(frames)
                for frame in frames:
                    with contextlib.suppress(ValueError):  # cut where a buffer was full
                        body = cobs_decode(frame)
                        if crc_hqx(body[:-2], 0xFFFF) == int.from_bytes(body[-2:], "little"):
                            self.packets.append(decode_body(body[:-2]))
                            self.broken -= 1

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
    rows = np.array([row_of(packet) for packet in packets])
    rests = (rows == 0) | (rows == ROWS - 1)
    # 16 bits: 1 / 32767 of a quaternion's number, 0.01 m/s^2, 1 / 900 rad/s; at rest there is noise as well.
    for name, resolution, noise in (("quat", 4e-5, 5e-4), ("acc", 0.0051, 0.05), ("gyr", 0.0006, 0.005)):
        sent, source = np.array([getattr(p, name) for p in packets]), getattr(data, name)[rows]
        np.testing.assert_allclose(sent[~rests], source[~rests], atol=resolution)
        np.testing.assert_allclose(sent[rests], source[rests], atol=noise)
        assert np.ptp(sent[rests & (rows == rows[0])], axis=0).max() > 0.0
    return rows.tolist()


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


def one_instant(sensors):
    for name in PLACEMENTS:
        sensors[name] = type(sensors[name])(*(c if c is None else c[:1] for c in sensors[name]))


@pytest.mark.parametrize(
    ("change", "words", "says"),
    [
        (
            drop_orientation,
            ["--protocol", "hipnuc"],
            "head: hipnuc cannot represent its samples: "
            "quaternion, acceleration and angular rate are required",
        ),
        (one_instant, [], "left_forearm: needs at least two samples"),
    ],
)
def test_a_recording_that_cannot_be_played(recording, tmp_path, change, words, says):
    source = read_recording(recording)
    change(source.sensors)
    file = tmp_path / "recording.npz"
    write_npz(file, source)
    with start(file, *words) as process:
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


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--udp", "[::1]:9000", "--protocol", "ximu3"], "--udp [::1]:9000: cannot send from 127.0.0.11: "),
        (["--tcp", "192.0.2.5"], "--tcp 192.0.2.5: cannot listen there: "),
        (["--tcp", "127.0.0.1", "--udp", "127.0.0.1:9000"], "give --udp or --tcp, not both"),
    ],
)
def test_addresses_that_do_not_work(recording, flags, says):
    with start(recording, *flags) as process:
        _, errors = process.communicate(timeout=30)
    assert process.returncode in (1, 2)
    assert errors.splitlines()[-1].startswith(f"Error: {says}")


def test_sensors_that_sample_at_other_times(recording, tmp_path):
    source = read_recording(recording)
    head = source.sensors["head"]
    # Every other row of the head, from the third on.
    source.sensors["head"] = type(head)(*(c if c is None else c[2::2] for c in head))
    file = tmp_path / "recording.npz"
    write_npz(file, source)
    with start(file, "--stand") as process, Line(process.stdout.readline().split()[1]) as line:
        line.until(lambda: len(line.packets) > 12)
        process.stdin.write("go\n")
        process.stdin.flush()
        line.until(lambda: len(line.of(4)) > 12 and row_of(line.of(4)[-1]) == ROWS - 2)
        process.stdin.close()
        assert process.wait(20) == 0
    pelvis = {row_of(packet): packet.t_us for packet in line.of(5)}
    playing = [packet for packet in line.of(4) if 2 < row_of(packet) < ROWS - 2]
    assert {row_of(packet) % 2 for packet in playing} == {0}
    common = [packet for packet in playing if row_of(packet) in pelvis]
    assert len(common) > ROWS // 8
    assert all(abs(packet.t_us - pelvis[row_of(packet)]) <= 1 for packet in common)


# --- other wire formats -------------------------------------------------------------------------------------


def read_ports(spoken, ports, enough, ask=()):
    """Samples of each port until there are enough on all of them."""
    files = [os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK) for port in ports]
    samples, decoders = {file: [] for file in files}, {}
    for file in files:
        tty.setraw(file)
        decoders[file] = spoken.decoder()
    try:
        while min(map(len, samples.values())) < enough:
            for request in ask:
                os.write(files[0], request)
            for file in select.select(files, [], [], 0.02)[0]:
                samples[file] += decoders[file].feed(os.read(file, 65536))
    finally:
        for file in files:
            os.close(file)
    return list(samples.values())


@pytest.mark.parametrize(("name", "lines"), [("xsens", 6), ("haritorax", 1), ("witmotion-modbus", 1)])
def test_other_wire_formats(recording, name, lines):
    spoken = PROTOCOLS[name]
    ask = [spoken.request(sensor)[0] for sensor in spoken.ids] if spoken.request else ()
    with start(recording, "--stand", "--protocol", name) as process:
        word, ports = process.stdout.readline().split()
        assert (word, ports.count(",")) == ("port", lines - 1)
        got = read_ports(spoken, ports.split(","), 60 // lines, ask)
        process.stdin.close()
        assert process.wait(20) == 0
        assert process.stderr.read() == ""
    first = [data.quat[0] for data in read_recording(recording).sensors.values()]
    for line, samples in enumerate(got):
        for sample in samples:
            index = line if spoken.single_device else list(spoken.ids).index(sample.sensor)
            assert abs(np.dot(sample.quat, first[index])) == pytest.approx(1.0, abs=1e-6)
    if not spoken.single_device:
        assert {sample.sensor for sample in got[0]} == set(spoken.ids)


def frames_until(bus, spoken, enough):
    decoder, samples = spoken.decoder(), []
    while len(samples) < enough:
        message = bus.recv(0.5)
        if message is not None:
            samples += decoder.feed(message.arbitration_id, bytes(message.data), message.is_extended_id)
    return samples


def test_can_frames_of_an_adapter(recording):
    with start(recording, "--stand", "--protocol", "native-can") as process:
        word, name = process.stdout.readline().split()
        interface, channel = name.split(":")
        assert (word, interface) == ("can", "slcan")
        bus = can.Bus(interface=interface, channel=channel, bitrate=500_000, sleep_after_open=0)
        samples = frames_until(bus, PROTOCOLS["native-can"], 60)
        bus.shutdown()
        process.stdin.close()
        assert process.wait(20) == 0
    assert {sample.sensor for sample in samples} == set(range(6))
    assert {row_of(sample) for sample in samples} == {0}


def test_can_frames_on_a_bus_of_python_can(recording):
    master, slave = os.openpty()
    tty.setraw(slave)
    words = ["--stand", "--protocol", "hipnuc-j1939", "--can", f"slcan:{os.ttyname(slave)}"]
    with start(recording, *words) as process:
        assert process.stdout.readline().split() == ["can", words[-1]]
        text = b""
        while text.count(b"\r") < 100:
            text += os.read(master, 4096)
        process.stdin.close()
        assert process.wait(20) == 0
    os.close(master)
    os.close(slave)
    commands, *lines = text.split(b"\rT", 1)
    assert commands.split(b"\r")[-1] == b"O"  # the bus was opened before anything was sent
    assert lines[0].startswith(b"0CFF34018")


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("slimevr", ("--udp",)),
        ("ximu3", ("--tcp", "127.0.0.1")),
        ("native", ("--udp",)),
        ("dot", ("--ble",)),
    ],
)
def test_devices_without_a_cable(recording, tmp_path, monkeypatch, name, flags):
    if flags == ("--udp",):
        flags = ("--udp", free_address(socket.SOCK_DGRAM))
    rig = None
    with start(recording, "--stand", "--protocol", name, *flags) as process:
        flag, address = process.stdout.readline().split()
        if name == "slimevr":
            _, senders = process.stdout.readline().split()
            pairs = zip(PLACEMENTS, senders.split(","), strict=True)
            rig = tmp_path / "rig.toml"
            rig.write_text("".join(f'{place} = {{ sender = "{sender}" }}\n' for place, sender in pairs))
        if name == "dot":
            monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", process.stdout.readline().split()[1])
        quats = {}
        with open_source(**{flag: address}, protocol=name, sensors=rig) as source:
            for batch in source:
                quats |= {sample.sensor: sample.quat for sample in batch.samples}
                if len(quats) == 6:
                    break
        process.stdin.close()
        assert process.wait(20) == 0
    for sensor, data in enumerate(read_recording(recording).sensors.values()):
        assert abs(data.quat[0] @ quats[sensor]) == pytest.approx(1.0, abs=1e-5)


def test_every_format_takes_the_samples_of_a_clip(monkeypatch):
    monkeypatch.syspath_prepend(SIMULATOR.parent)
    tool = runpy.run_path(str(SIMULATOR))
    recording = tool["read_input"](CLIP)
    for name, spoken in PROTOCOLS.items():
        data = recording.sensors["pelvis"]
        sensor = tool["Sensor"](5, data, data.time_s[0], False, spoken.encoder())
        sensor.prepare(spoken, 0 if spoken.single_device else spoken.ids[5])
        sensor.measure(0)
        assert sensor.wire, name
    # The clip stands straight first: gravity is all there is.
    rows = sensor.rows[:500]
    for row in rows[::100]:
        assert rotate(row.quat, row.acc) == pytest.approx((0.0, 0.0, 9.81), abs=0.01)


# --- what goes wrong on demand ------------------------------------------------------------------------------


def play(words, recording):
    """What comes while a recording plays, from its first row to its last."""
    with start(recording, "--stand", *words) as process, Line(process.stdout.readline().split()[1]) as line:
        line.until(lambda: len(line.packets) > 12)
        process.stdin.write("go\n")
        process.stdin.flush()
        line.until(lambda: any(row_of(packet) == ROWS - 1 for packet in line.of(0)[-5:]))
        process.stdin.close()
        assert process.wait(20) == 0
        assert process.stderr.read() == ""
    return line


def test_lost_packets_a_dead_sensor_and_clocks_that_run_apart(recording):
    line = play(["--loss", "0.3", "--kill", "head@0.4..0.9", "--drift", "50000"], recording)
    rows = [[row_of(packet) for packet in line.of(sensor)] for sensor in range(6)]
    for playing in rows:
        # A busy machine may lose more, but not fewer.
        assert 10 < len({row for row in playing if 0 < row < ROWS - 1}) < 0.85 * ROWS
    assert not {row for row in rows[4] if 41 <= row < 89}
    assert {row for row in rows[3] if 41 <= row < 89}
    for sensor, step in ((0, 9_500), (5, 10_500)):
        playing = [packet for packet in line.of(sensor) if 0 < row_of(packet) < ROWS - 1]
        for a, b in pairwise(playing):
            assert abs(b.t_us - a.t_us - step * (row_of(b) - row_of(a))) <= 2


def test_broken_and_late_packets_and_two_sensors_with_one_id(recording):
    line = play(["--corrupt", "0.5", "--jitter", "30", "--duplicate-id"], recording)
    assert line.broken > 0.2 * len(line.packets)
    assert line.of(1) == []
    assert len(line.of(0)) > 1.2 * len(line.of(2))
    # Late, but in their order.
    times = [packet.t_us for packet in line.of(2)]
    assert times == sorted(times)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--can", "slcan:x"], "native is not a CAN protocol"),
        (["--protocol", "native-can", "--corrupt", "0.1"], "use --loss"),
        (["--protocol", "xsens", "--duplicate-id"], "one sensor per line"),
        (["--protocol", "native-can", "--udp", "127.0.0.1:9000"], "native-can is a CAN protocol"),
        (["--protocol", "slimevr"], "slimevr needs --udp HOST:PORT"),
        (["--udp", "9000"], "no port in '9000'"),
        (["--kill", "nose@1..2"], "'nose@1..2' is not SENSOR@T..T"),
        (["--kill", "head"], "'head' is not SENSOR@T..T"),
        (["--protocol", "native-can", "--can", "slcan:/nowhere"], "slcan:/nowhere: cannot be opened"),
        (["--protocol", "native-can", "--can", "nonsense:x"], "nonsense:x: cannot be opened"),
    ],
)
def test_flags_that_mean_nothing(recording, words, says):
    with start(recording, *words) as process:
        output, errors = process.communicate(timeout=30)
    assert process.returncode in (1, 2)
    assert output == ""
    assert says in errors
    assert "Traceback" not in errors
