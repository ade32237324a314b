import contextlib
import os
import re
import select
import time
from collections import Counter
from itertools import pairwise
from math import inf
from pathlib import Path

import numpy as np
import pytest
import serial

from edgepose.errors import DeviceError, EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.csv import csv_header, csv_row, write_csv
from edgepose.formats.recordings.raw_capture import times_header, times_path, times_row
from edgepose.formats.recordings.registry import read_recording
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.placements import PLACEMENTS
from edgepose.sources import POLL_S, open_source
from edgepose.sources.protocol_detection import protocol_named
from firmware_protocols import mip
from firmware_protocols.native import encode, encode_info
from firmware_protocols.native_packet import Info, Packet
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support.ports import Port, Sender

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"


@pytest.fixture
def port():
    with Port(blocking=True) as port:
        yield port


def packets(n, start_us=0, ids=range(6), period_us=10_000):
    return [
        Packet(
            s,
            i & 0xFFFF,
            (start_us + period_us * i) % (1 << 32),
            (0.6, 0.0, 0.8, 0.0),
            (0.0, 0.0, 9.81),
            (0.1, 0.0, 0.0),
        )
        for i in range(n)
        for s in ids
    ]


class Device(Sender):
    """Writes chunks at 100 Hz to the other end of a port, until told to stop."""

    def __init__(self, port, chunks):
        super().__init__()
        self.port, self.chunks = port, iter(chunks)

    def send(self, k):
        if (chunk := next(self.chunks, None)) is None:
            self.left.set()
        else:
            os.write(self.port.master, chunk)


def chunks(n, **kwargs):
    rows = packets(n, **kwargs)
    width = len(rows) // n
    return [b"".join(map(encode, rows[i : i + width])) for i in range(0, len(rows), width)]


# --- serial -------------------------------------------------------------------------------------------------


def test_live_packets_become_samples_and_frames(port):
    name = port.name
    got, frames = [], []
    with open_source(port=name) as source, Device(port, chunks(200, start_us=(1 << 32) - 500_000)):
        clock = FrameSynchronizer()
        for now_s, batch, *_ in source:
            assert abs(now_s - time.time()) < 1.0
            got += batch
            clock.push(batch, now_s)
            frames += clock.frames(now_s)
            if len(got) > 600:
                break
    assert {s.sensor for s in got} == set(range(6))
    assert got[0].quat == pytest.approx((0.6, 0.0, 0.8, 0.0), abs=1e-4)
    assert got[0].acc == (0.0, 0.0, 9.81)
    assert got[0].gyr == pytest.approx((0.1, 0.0, 0.0))
    times = [s.time_s for s in got if s.sensor == 2]
    assert all(b > a for a, b in pairwise(times))
    assert [f.index for f in frames] == list(range(len(frames)))
    assert len(frames) > 20
    # Bytes that came before the first look may be gone, in the middle of a packet.
    assert source.counters.packets == len(got)
    assert source.counters.bad <= 1
    assert source.counters.lost == 0


def test_silent_port_still_gives_batches(port):
    with open_source(port=port.name) as source:
        batches = iter(source)
        times = [next(batches) for _ in range(5)]
    assert all(batch.samples == [] for batch in times)
    assert all(b[0] > a[0] for a, b in pairwise(times))


def test_packets_gather_until_they_are_wanted_and_are_kept_for_a_busy_caller(port):
    """Whoever wants nothing for long gets few batches; what comes while they are busy is not lost."""
    times = []
    with open_source(port=port.name, wanted=lambda: inf) as source:
        batches = iter(source)
        start_s = next(batches).now_s
        with Device(port, chunks(1000)):
            while len(times) < 5:
                if (now_s := next(batches).now_s) > start_s + 1.2:  # the devices are known to send times
                    times.append(now_s)
        assert all(b - a > 0.9 * POLL_S for a, b in pairwise(times))
        while next(batches).samples:
            pass
        # More than the system's buffers hold; nobody iterates meanwhile.
        before, data = source.counters.packets, b"".join(chunks(200, start_us=5_000_000))
        os.set_blocking(port.master, False)
        end_s = time.monotonic() + 20.0
        while data and time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(port.master, data) :]
        while next(batches).samples:
            pass
    assert not data
    assert source.counters.packets == before + 1200
    assert source.counters.bad <= 1


def test_a_source_that_does_not_wait(port, caplog):
    """Looked at whenever one likes; also while its port is gone and after it is back."""
    name = port.name
    got = []

    def look_until(wanted):
        while not wanted():
            now_s, batch, *_ = next(batches)
            assert abs(now_s - time.time()) < 1.0
            got.extend(batch)
            time.sleep(0.004)

    with open_source(port=name, blocking=False) as source:
        batches = iter(source)
        assert [next(batches)[1] for _ in range(100)] == [[]] * 100
        with Device(port, chunks(300)):
            look_until(lambda: len(got) > 300)
        port.unplug()
        look_until(lambda: "disconnected; the run continues" in caplog.text)
    assert {s.sensor for s in got} == set(range(6))
    for sensor in range(6):
        assert all(b > a for a, b in pairwise(s.time_s for s in got if s.sensor == sensor))
    assert source.counters.packets == len(got)
    assert source.counters.lost == 0


def test_what_waits_behind_a_full_buffer_is_not_said_to_be_delivered(port):
    """The system shows 4 kB at a time."""
    name = port.name
    data = b"".join(map(encode, packets(51)[6:]))
    assert 8192 < len(data) < 12_000
    got = []
    with open_source(port=name, protocol="native", blocking=False) as source:
        batches = iter(source)
        while not got:
            time.sleep(0.02)
            os.write(port.master, encode(packets(1)[0]))
            got += next(batches)[1]
        time.sleep(0.1)
        got += next(batches)[1]
        before = len(got)
        written = 0
        while written < len(data):
            written += os.write(port.master, data[written:])
        written_s = time.time()
        time.sleep(0.1)
        while len(got) < before + 300:
            now_s, batch, *_ = next(batches)
            got += batch
            assert now_s < written_s or len(got) == before + 300
            time.sleep(0.01)
        assert next(batches)[0] > written_s


def test_a_line_that_is_never_empty_does_not_stop_the_time(port, monkeypatch):
    monkeypatch.setattr("edgepose.sources.line_reader.FULL_READS", 3)
    name = port.name
    os.set_blocking(port.master, False)

    def fill():
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(port.master, bytes(4096))

    with open_source(port=name, protocol="native", blocking=False) as source:
        start_s = now_s = next(iter(batches := iter(source)))[0]
        for _ in range(200):
            if now_s > start_s + 1.0:
                break
            fill()
            time.sleep(0.02)
            now_s, *_ = next(batches)
        else:
            pytest.fail("the time stands still")


def test_the_time_until_a_look_counts_as_waiting(port):
    name = port.name
    with open_source(port=name, protocol="native", blocking=False) as source:
        batches, got = iter(source), []
        while not got:
            time.sleep(0.02)
            os.write(port.master, encode(packets(1)[0]))
            got += next(batches)[1]
        os.write(port.master, encode(packets(2)[6]))
        time.sleep(0.3)
        late = next(batches)
        assert len(late.samples) == 1
        assert late.backlog_s >= 0.3
        assert next(batches).backlog_s < 0.3


def test_sources_share_a_clock_that_nobody_sets(port, monkeypatch):
    with open_source(port=port.name, blocking=False) as source:
        first_s, *_ = next(iter(source))
    monkeypatch.setattr(time, "time", lambda: 0.0)
    with open_source(port=port.name, blocking=False) as source:
        second_s, *_ = next(iter(source))
    assert first_s < second_s < first_s + 60.0


def test_unknown_ids_are_counted_and_told_once(port, caplog):
    name = port.name
    with open_source(port=name) as source, Device(port, chunks(200, ids=(0, 9))):
        for _ in source:
            if source.counters.unknown > 20:
                break
    assert source.counters.packets > 10
    assert [r.getMessage() for r in caplog.records] == [
        f"{name}: ignoring packets of sensor id 9; expected ids are 0 to 5"
    ]


def drain(name, monkeypatch, seconds=0.3, **options):
    """The error in which a port ends, with the time-outs made short."""
    monkeypatch.setattr("edgepose.sources.line_checks.SILENCE_S", seconds)
    monkeypatch.setattr("edgepose.sources.line_checks.NOISE_S", seconds)
    got = []
    with open_source(port=name, baud=9600, **options) as source, pytest.raises(EdgeposeError) as info:
        got.extend(sample for _, batch, *_ in source for sample in batch)
    assert str(info.value).startswith(f"{name}: ")
    assert "\n" not in str(info.value)
    return str(info.value), got


def test_silence(port, monkeypatch):
    message, _ = drain(port.name, monkeypatch)
    assert "no data for" in message


def test_noise(port, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 256, 40_000, dtype=np.uint8).tobytes()
    with Device(port, [noise[i : i + 200] for i in range(0, len(noise), 200)]):
        message, got = drain(port.name, monkeypatch)
    assert got == []
    assert "bytes" in message
    assert "--baud (now 9600)" in message
    assert "--protocol" in message


def test_only_unknown_ids(port, monkeypatch):
    with Device(port, chunks(200, ids=(7, 9))):
        message, _ = drain(port.name, monkeypatch)
    assert "only from sensor ids 7, 9" in message


def test_frame_with_z_down_is_refused(port, monkeypatch):
    with Device(port, [encode_info(Info(3, "x", frame="NED"))] * 100):
        message, _ = drain(port.name, monkeypatch, protocol="native")
    assert "NED" in message


@pytest.fixture
def link(tmp_path):
    """A name for a port that can be plugged in and out: a symbolic link to a pty."""
    with contextlib.ExitStack() as ports:

        class Link:
            path = tmp_path / "port"

            def plug(self):
                self.port = ports.enter_context(Port(blocking=True))
                self.path.symlink_to(self.port.name)
                return self.port

            def unplug(self):
                self.path.unlink()
                self.port.close()

        yield Link()


def test_a_port_that_goes_and_comes_back(link, caplog):
    """Batches never stop; samples go on, later than all before, when the port is back."""
    before, gap, after = [], [], []
    link.plug()
    with open_source(port=str(link.path)) as source:
        batches = iter(source)
        with Device(link.port, chunks(300)):
            while len(before) < 200:
                before += next(batches)[1]
        link.unplug()
        while "disconnected" not in caplog.text or len(gap) < 10:
            now_s, batch, *_ = next(batches)
            before += batch
            gap.append(now_s)
        assert all(b > a for a, b in pairwise(gap))
        with Device(link.plug(), chunks(1000, start_us=5_000_000)):
            while len(after) < 200:
                after += next(batches)[1]
    assert max(s.time_s for s in before) < min(s.time_s for s in after)
    assert {s.sensor for s in after} == set(range(6))
    told = [r.getMessage() for r in caplog.records]
    assert len(told) == 2
    assert told[0] == f"{link.path}: disconnected; the run continues and waits for it"
    assert re.fullmatch(rf"{link.path}: back after \d+\.\d s", told[1])


def test_unknown_port():
    with pytest.raises(EdgeposeError, match=r"/dev/nowhere: no such port; ports here: "):
        open_source(port="/dev/nowhere").__enter__()


def test_busy_port(port):
    with open_source(port=port.name), pytest.raises(EdgeposeError, match="in use"):
        open_source(port=port.name).__enter__()
    # Closing gives it free.
    with open_source(port=port.name):
        pass


def test_port_without_permission(monkeypatch):
    def refuse(*_, **__):
        raise serial.SerialException(13, "could not open port")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(EdgeposeError, match="dialout"):
        open_source(port="/dev/ttyX").__enter__()


def test_not_a_port(tmp_path):
    (tmp_path / "file").write_text("x")
    for path, baud in ((tmp_path / "file", 115200), ("/dev/null", 115200)):
        with pytest.raises(EdgeposeError, match="cannot open it as a serial port"):
            open_source(port=str(path), baud=baud).__enter__()


def test_a_speed_beyond_what_systems_count(port):
    with pytest.raises(EdgeposeError, match="no port has a speed of 3000000000 bit/s; check --baud"):
        open_source(port=port.name, baud=3_000_000_000).__enter__()


def test_impossible_speed(port):
    with pytest.raises(EdgeposeError, match="cannot open"):
        open_source(port=port.name, baud=-1).__enter__()


# --- every wire format --------------------------------------------------------------------------------------

BYTES = [name for name, protocol in PROTOCOLS.items() if protocol.transport == "bytes"]
QUAT = (0.6, 0.0, 0.8, 0.0)


class Rig(Sender):
    """Six devices of one wire format, on six ports or one, 100 samples a second each until it is left."""

    def __init__(self, name, lines=None, ids=None):
        self.protocol = PROTOCOLS[name]
        self.alone = self.protocol.single_device and lines != 1
        super().__init__(*(Port() for _ in range(6 if self.alone else 1)))
        self.ids = [0] * 6 if self.alone else list(ids or self.protocol.ids)
        self.names = ",".join(port.name for port in self.ports)
        self.encoders = [self.protocol.encoder() for _ in self.ports]

    def wire(self, i, k, start_us=7_000_000):
        sample = Sample(
            *(self.ids[i], start_us + 10_000 * k, QUAT, (0.1, 0.2, 9.81), (0.1, 0.0, 0.0)),
            *((10.0, 20.0, 30.0), 25.0),
        )
        # Text lines have their header again from time to time.
        return self.encoders[i % len(self.encoders)](sample, k % 20 if "openlog" in self.protocol.name else k)

    def send(self, k):
        if self.protocol.request:
            self.answer(k)
        else:
            for i in range(6):
                self.ports[i % len(self.ports)].write(self.wire(i, k))

    def answer(self, k):
        master = self.ports[0].master
        while select.select([master], [], [], 0.002)[0]:
            asked = os.read(master, 1000)
            for i, sensor in enumerate(self.ids):
                if self.protocol.request(sensor)[0] in asked:
                    os.write(master, self.wire(i, k))


def listen(n, least_frames=0, **options):
    """Source, samples, so many of each sensor, and frames.

    A busy machine gets many samples at once, of which frames come later: it may take more samples for them.
    """
    got, frames, clock = [], [], FrameSynchronizer()
    missing = Counter(dict.fromkeys(range(6), n))
    with open_source(**options) as source:
        for now_s, batch, *_ in source:
            got += batch
            if batch and all(sample.acc and sample.quat for sample in batch):
                clock.push(batch, now_s)
                frames += clock.frames(now_s)
            missing -= Counter(sample.sensor for sample in batch)
            enough = len(frames) >= least_frames or len(got) > 60 * n
            if not missing and (enough or not (got[-1].acc and got[-1].quat)):
                return source, got, frames
    raise AssertionError("a live source does not end")


@pytest.mark.parametrize("name", BYTES)
def test_any_protocol_is_found_and_read(name):
    """In the order of PLACEMENTS, whether sensors share a line or not; those that must be asked are named."""
    with Rig(name) as rig:
        protocol = name if rig.protocol.request else "auto"
        least = 0 if rig.protocol.request else 6
        source, got, frames = listen(30, least, port=rig.names, protocol=protocol, baud=115200)
    assert {sample.sensor for sample in got} == set(range(6))
    for sensor in range(6):
        times = [sample.time_s for sample in got if sample.sensor == sensor]
        assert all(b > a for a, b in pairwise(times))
        assert abs(times[-1] - time.time()) < 5.0
    assert source.counters.packets == len(got)
    assert source.counters.bad <= 6  # the first one of a line may have lost its beginning
    if got[-1].quat is not None:
        assert abs(np.dot(got[-1].quat, QUAT)) == pytest.approx(1.0, abs=1e-3)
    if got[-1].acc is not None and name != "openlog":
        assert got[-1].acc == pytest.approx((0.1, 0.2, 9.81), abs=0.02)
        assert len(frames) >= 6 or rig.protocol.request  # they are asked as fast as the line is


def test_a_map_names_ports_and_protocols(tmp_path):
    """Two wire formats, a hub and two devices of their own, and nothing but the map says so."""
    rig_file = tmp_path / "rig.toml"
    with Rig("native", ids=[40, 41, 42, 43, 44, 45]) as hub, Rig("xsens") as alone:
        first, second, *_ = alone.names.split(",")
        rows = [f'{PLACEMENTS[i]} = {{ port = "{hub.names}", id = {45 - i} }}' for i in range(4)]
        rows += [f'head = {{ port = "{first}" }}', f'pelvis = {{ port = "{second}" }}']
        rows += [f'[ports."{first}"]', 'protocol = "xsens"', "baud = 460800"]
        rig_file.write_text("\n".join(rows))
        source, got, _ = listen(50, sensors=rig_file)
    assert {sample.sensor for sample in got} == set(range(6))
    assert source.counters.unknown > 50  # ids 40 and 41


def test_two_hubs_with_the_same_ids():
    with Rig("native") as a, Rig("native") as b, pytest.raises(EdgeposeError) as info:
        listen(10_000, port=f"{a.names},{b.names}")
    assert re.search(r"both have a sensor for \w+, id \d; ", str(info.value))
    assert "--sensors" in str(info.value)


def test_one_port_of_a_device_that_is_alone():
    with Rig("witmotion") as rig, pytest.raises(EdgeposeError, match="which sensor is where"):
        listen(10_000, port=rig.names.split(",")[0])


def test_two_devices_with_one_id_are_told_once(port, caplog):
    name = port.name
    both = zip(chunks(250), chunks(250, start_us=900_000_000, ids=[2]), strict=True)
    with open_source(port=name, protocol="native") as source, Device(port, [a + b for a, b in both]):
        for _ in source:
            if "two devices" in caplog.text:
                break
    assert [r.getMessage() for r in caplog.records] == [
        f"{name}: left_lower_leg: two devices, whose clocks differ, send under its id: "
        "give each an id of its own"
    ]


def test_what_two_formats_understand(port):
    """A line on which two formats are spoken equally often belongs to none of them."""
    name = port.name
    hipnuc, xsens = Rig("hipnuc"), Rig("xsens")
    mixed = [hipnuc.wire(0, k) + xsens.wire(0, k) for k in range(300)]
    with Device(port, mixed), pytest.raises(EdgeposeError, match=r"it could be .* or .*--protocol"):
        listen(10_000, port=name)


@pytest.mark.parametrize("name", ["native", "xsens", "hipnuc", "ximu3", "mavlink", "openlog"])
def test_captures_of_other_protocols(tmp_path, name):
    """Without arrival times; of a device that is alone, the file of --sensors gives its id on the line."""
    rig = Rig(name, lines=1, ids=range(40, 46) if name != "xsens" else range(11, 17))
    if name in ("hipnuc", "openlog"):
        rig.ids = [0] * 6
    n = 6 if rig.ids[1] else 1
    data = b"".join(rig.wire(i, k) for k in range(150) for i in range(n))
    file, sensors = tmp_path / "walk.bin", tmp_path / "rig.toml"
    file.write_bytes(data)
    sensors.write_text("\n".join(f"{p} = {{ id = {rig.ids[0] + i} }}" for i, p in enumerate(PLACEMENTS)))
    source, _, got = everything(file=file, sensors=sensors)
    assert len(got) >= 148 * n
    assert {sample.sensor for sample in got} == set(range(n))
    times = [sample.time_s for sample in got if sample.sensor == 0]
    assert times[-1] - times[0] == pytest.approx(0.01 * (len(times) - 1), abs=1e-3)
    assert source.counters.bad == source.counters.lost == 0
    # With the name of the protocol, the file may have any name.
    other = file.rename(tmp_path / "walk.dat")
    assert len(everything(file=other, sensors=sensors, protocol=name)[2]) == len(got)


def test_a_capture_without_times(tmp_path):
    """Of packets without a clock: arrival times, if they were noted, make up for it."""
    rig = Rig("haritorax")
    file, end = tmp_path / "walk.bin", 0
    with file.open("wb") as out, times_path(file).open("w") as noted:
        noted.write(times_header({}))
        for k in range(100):
            wire = b"".join(rig.wire(i, k) for i in range(6))
            end += out.write(wire)
            noted.write(times_row(1_700_000_000.0 + 0.01 * k, end))
    _, _, got = everything(file=file)
    times = [sample.time_s for sample in got if sample.sensor == 4]
    assert len(times) >= 98
    assert np.diff(times) == pytest.approx(0.01, abs=1e-3)
    times_path(file).unlink()
    with pytest.raises(EdgeposeError, match=r"walk\.bin: neither its packets nor the capture hold times"):
        everything(file=file)


def test_lines_of_text_as_a_file_describes_them(tmp_path):
    pattern = tmp_path / "mine.toml"
    pattern.write_text(
        "regex = '^P(?P<sensor>\\d) (?P<time>\\d+) (?P<w>\\S+) (?P<x>\\S+) (?P<y>\\S+) (?P<z>\\S+)$'\n"
        "units = { time = 'ms' }\n"
    )
    (tmp_path / "log.txt").write_text(
        "".join(f"P{s} {10 * k} 1 0 0 0\n" for k in range(50) for s in range(6))
    )
    _, _, got = everything(file=tmp_path / "log.txt", protocol=str(pattern))
    assert len(got) == 300
    assert got[-1].sensor == 5
    assert got[-1].time_s - got[0].time_s == pytest.approx(0.49)
    with pytest.raises(ValueError, match=r"mine\.toml can only be decoded"):
        protocol_named(str(pattern)).encode(Sample(0), 0)
    pattern.write_text("regexp = 'x'\n")
    with pytest.raises(EdgeposeError, match=r"mine\.toml: unknown key 'regexp'"):
        open_source(port="a", protocol=str(pattern))


def test_batches_carry_what_came_over_the_line(port):
    name = port.name
    raw = []
    with open_source(port=name) as source, Device(port, chunks(100)):
        for batch in source:
            raw += batch.raw
            if source.counters.packets > 100:
                break
    decoder = PROTOCOLS["native"].decoder()
    assert len([s for _, data in raw for s in decoder.feed(data)]) == source.counters.packets
    assert all(b[0] >= a[0] for a, b in pairwise(raw))


def test_what_came_before_an_error_is_in_a_batch(port, monkeypatch):
    def refuse(*_):
        raise DeviceError("nobody can tell")

    monkeypatch.setattr("edgepose.sources.line_decoder.LineDecoder.feed", refuse)
    raw = []
    with (
        open_source(port=port.name) as source,
        Device(port, chunks(100)),
        pytest.raises(DeviceError, match="nobody"),
    ):
        raw.extend(piece for batch in source for piece in batch.raw)
    assert len(raw) == 1


# --- files --------------------------------------------------------------------------------------------------


def everything(**options):
    with open_source(**options) as source:
        batches = list(source)
    return source, batches, [s for _, batch, *_ in batches for s in batch]


@pytest.mark.parametrize("kind", ["npz", "csv"])
def test_recording(tmp_path, kind):
    path = REAL
    if kind == "csv":
        path = tmp_path / "a.csv"
        write_csv(path, read_recording(REAL))
    source, batches, got = everything(file=path)
    assert len(got) == source.counters.packets == 1800
    assert source.damage is None
    for now_s, batch, *_ in batches:
        assert now_s == max(s.time_s for s in batch)
    assert all(a[0] < b[0] for a, b in pairwise(batches))


def test_cut_recording_gives_what_is_good(tmp_path):
    rows = list(iter_samples(read_recording(REAL)))[:60]
    (tmp_path / "a.csv").write_text((csv_header({}) + "".join(map(csv_row, rows)))[:-20])
    source, _, got = everything(file=tmp_path / "a.csv")
    assert len(got) == 59
    assert "cut off" in source.damage


def test_capture_with_wrap_noise_and_loss(tmp_path):
    rows = packets(100, start_us=(1 << 32) - 300_000)
    del rows[60]
    data = b"\x01\x02\x03" + b"".join(map(encode, rows[:300])) + os.urandom(50).replace(b"\0", b"\1") + b"\0"
    (tmp_path / "a.bin").write_bytes(data + b"".join(map(encode, rows[300:]))[:-5])
    source, _, got = everything(file=tmp_path / "a.bin")
    assert len(got) == source.counters.packets >= 597
    assert source.counters.lost >= 1
    assert source.counters.bad >= 1
    first = [s.time_s for s in got if s.sensor == 1]
    assert first[-1] - first[0] == pytest.approx(0.99, abs=1e-3)
    clock = FrameSynchronizer()
    clock.push(got, 0.0)
    assert 58 <= len(clock.flush()) <= 60


@pytest.mark.parametrize("protocol", ["native", "auto"])
@pytest.mark.parametrize(
    ("change", "damage"),
    [
        (lambda data: data, None),
        # A capture may start and end anywhere.
        (lambda data: data[10:-10], None),
        (lambda data: data[:2010] + b"\7" + data[2011:], "1 corrupted packets left out"),
        (lambda data: data[5:-1000] + b"\1" + data[-1000:], "1 corrupted packets left out"),
    ],
)
def test_corrupted_packets_of_a_capture(tmp_path, protocol, change, damage):
    (tmp_path / "a.bin").write_bytes(change(b"".join(map(encode, packets(100)))))
    source, _, got = everything(file=tmp_path / "a.bin", protocol=protocol)
    assert len(got) >= 597
    assert source.damage == (damage and f"{tmp_path / 'a.bin'}: {damage}")


def test_capture_without_packets(tmp_path):
    (tmp_path / "a.raw").write_bytes(os.urandom(5000))
    with pytest.raises(EdgeposeError, match="5000 bytes"):
        everything(file=tmp_path / "a.raw")
    (tmp_path / "b.raw").write_bytes(b"")
    with pytest.raises(EdgeposeError, match="0 bytes"):
        everything(file=tmp_path / "b.raw")


@pytest.mark.parametrize("name", ["none.bin", "none.csv"])
def test_missing_file(tmp_path, name):
    with pytest.raises(EdgeposeError, match="No such file"):
        everything(file=tmp_path / name)


def test_realtime_without_waiting_gives_the_same_and_empty_batches_between(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"".join(chunks(20)))
    with open_source(file=tmp_path / "a.bin", realtime=True, blocking=False) as source:
        batches = list(source)
    _, _, alone = everything(file=tmp_path / "a.bin")
    assert [sample for _, batch, *_ in batches for sample in batch] == alone
    assert [] in [batch for _, batch, *_ in batches]
    assert all(b[0] >= a[0] for a, b in pairwise(batches))


def test_realtime_takes_its_time(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"".join(map(encode, packets(30))))
    start = time.monotonic()
    _, batches, got = everything(file=tmp_path / "a.bin", realtime=True)
    assert time.monotonic() - start >= 0.27
    assert len(got) == 180
    assert all(s.time_s <= now_s for now_s, batch, *_ in batches for s in batch)
    assert len(batches) >= 28


@pytest.mark.parametrize("kind", ["bin", "npz"])
def test_a_recording_at_its_own_pace_says_how_late_it_is_taken(tmp_path, kind):
    (tmp_path / "a.bin").write_bytes(b"".join(chunks(20)))
    with open_source(file={"bin": tmp_path / "a.bin", "npz": REAL}[kind], realtime=True) as source:
        batches = iter(source)
        next(batches)
        time.sleep(0.15)
        assert 0.13 < next(batches).backlog_s < 10.0


def test_options():
    for options in ({"port": "a", "file": "b.csv"}, {"can": "a:b", "file": "b.csv"}):
        with pytest.raises(EdgeposeError, match="--connect, --ble or --hid, or --file"):
            open_source(**options)
    with pytest.raises(EdgeposeError, match="--ble or --hid, or --file"):
        open_source()
    for options in ({"port": "a"}, {"can": "virtual:a"}, {"file": "a.csv"}):
        with pytest.raises(EdgeposeError, match="unknown protocol 'x'; known are auto, native, "):
            open_source(**options, protocol="x")
    with pytest.raises(EdgeposeError, match="unknown kind"):
        open_source(file="a.txt")
    with pytest.raises(EdgeposeError, match="a is given twice"):
        open_source(port="a,b,a")
    with pytest.raises(EdgeposeError, match="empty name"):
        open_source(port="a,,b")
    with pytest.raises(EdgeposeError, match="INTERFACE:CHANNEL"):
        open_source(can="can0")
    with pytest.raises(EdgeposeError, match="protocol native is for serial lines; use it with --port"):
        open_source(can="virtual:a", protocol="native")
    with pytest.raises(EdgeposeError, match="protocol native-can is for CAN buses; use it with --can"):
        open_source(port="a", protocol="native-can")
    assert len(PLACEMENTS) == 6


@pytest.mark.parametrize("untimed_first", [0, 3])
def test_packets_without_a_time_between_those_with_one(tmp_path, untimed_first):
    """A device that sends its magnetometer in packets of their own, in a capture of another program."""
    quat, vector = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81)
    wire = mip.encode(Sample(0, None, None, None, None, (0.2, 0.0, 0.4))) * untimed_first
    for k in range(100):
        wire += mip.encode(Sample(0, 1_000_000 + 10_000 * k, quat, vector, (0.0, 0.0, 0.1)))
        wire += mip.encode(Sample(0, None, None, None, None, (0.2, 0.0, 0.4)))
    (tmp_path / "a.bin").write_bytes(wire)
    others = "".join(f"{name} = {{ id = {i + 1} }}\n" for i, name in enumerate(PLACEMENTS[:-1]))
    (tmp_path / "map.toml").write_text(f"{others}pelvis = {{ id = 0 }}\n")
    with open_source(file=tmp_path / "a.bin", protocol="mip", sensors=tmp_path / "map.toml") as source:
        got = [sample for batch in source for sample in batch.samples]
        damage = source.damage
    assert [sample.time_s - got[0].time_s for sample in got] == pytest.approx(
        np.repeat(0.01 * np.arange(100), 2), abs=1e-6
    )
    assert [sample.mag is None for sample in got] == [True, False] * 100
    expected = f"{tmp_path / 'a.bin'}: left out {untimed_first} samples before the first time"
    assert damage == (expected if untimed_first else None)
