"""CAN buses and logs of them: `virtual` ones, a slcan adapter on a pty, files; SocketCAN is not needed."""

import os
import re
import time
from itertools import pairwise

import can
import pytest

from edgepose.errors import EdgeposeError
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from edgepose.sources.can_bus import is_down
from firmware_protocols import native_can
from firmware_protocols.native_packet import Info, Packet
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support.ports import Port, Sender

QUAT = (0.6, 0.0, 0.8, 0.0)
CAN = [name for name, protocol in PROTOCOLS.items() if protocol.transport == "can"]


def messages(name, first, n, start_s=0.0, **options):
    """Messages of six devices, 100 samples a second each, with times from start_s on."""
    protocol = PROTOCOLS[name]
    encode = protocol.encoder()
    result = []
    for k in range(first, first + n):
        for i, sensor in enumerate(protocol.ids):
            sample = Sample(sensor, 1_000_000 + 10_000 * k, QUAT, (0.1, 0.2, 9.81), (0.1, 0.0, 0.0))
            for j, (can_id, data, extended, fd) in enumerate(encode(sample, k)):
                result.append(
                    can.Message(
                        timestamp=start_s + 0.01 * k + 0.001 * i + 0.0001 * j,
                        arbitration_id=can_id,
                        data=data,
                        is_extended_id=extended,
                        is_fd=fd,
                        **options,
                    )
                )
    return result


class Devices(Sender):
    """Sends six devices' messages 100 times a second until it is left."""

    def __init__(self, send, what):
        super().__init__()
        self.give = send
        self.messages = what if callable(what) else lambda k: messages(what, k, 1)

    def send(self, k):
        for message in self.messages(k):
            self.give(message)


def collect(source, n):
    got = []
    for now_s, samples, *_ in source:
        got += samples
        assert abs(now_s - time.time()) < 5.0
        if len(got) >= n:
            return got
    return got


@pytest.fixture
def bus(request):
    """The devices' side of a virtual bus, and its name for --can."""
    channel = request.node.name
    with can.Bus(channel, "virtual") as bus:
        yield bus, f"virtual:{channel}"


@pytest.mark.parametrize("protocol", CAN)
def test_a_live_bus_of_any_protocol(bus, protocol):
    sender, name = bus
    frames = []
    with open_source(can=name) as source, Devices(sender.send, protocol):
        got = []
        clock = FrameSynchronizer()
        for now_s, samples, *_ in source:
            got += samples
            clock.push(samples, now_s)
            frames += clock.frames(now_s)
            if len(got) > 300:
                break
    assert {sample.sensor for sample in got} == set(range(6))
    assert got[-1].quat == pytest.approx(QUAT, abs=1e-3)
    assert got[-1].acc == pytest.approx((0.1, 0.2, 9.81), abs=0.01)
    for sensor in range(6):
        times = [sample.time_s for sample in got if sample.sensor == sensor]
        assert all(b > a for a, b in pairwise(times))
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert len(frames) > 10
    assert source.counters.bad == source.counters.lost == 0


def fd_messages(k):
    for sensor in range(6):
        packet = Packet(sensor, k, 10_000 * k, QUAT, (0.0, 0.0, 9.81), (0.1, 0.0, 0.0))
        for body in (packet, Info(sensor, "x", frame="ENU")):
            can_id, data = native_can.encode_fd(body)
            yield can.Message(arbitration_id=can_id, data=data, is_fd=True, is_extended_id=False)


def test_can_fd(bus):
    sender, name = bus
    with open_source(can=name, fd=True) as source, Devices(sender.send, fd_messages):
        got = collect(source, 200)
    assert {sample.sensor for sample in got} == set(range(6))
    assert source.counters.packets == len(got)
    assert source.counters.bad == source.counters.lost == 0


def test_frames_of_others_and_errors_are_passed_over(bus):
    sender, name = bus
    with open_source(can=name) as source, Devices(sender.send, "native-can"):
        for other in (
            can.Message(arbitration_id=0x123, data=b"12345678", is_extended_id=False),
            can.Message(arbitration_id=0x400, is_remote_frame=True, is_extended_id=False),
            can.Message(arbitration_id=0x400, is_error_frame=True),
        ):
            for _ in range(20):
                sender.send(other)
        got = collect(source, 200)
    assert {sample.sensor for sample in got} == set(range(6))
    assert source.counters.bad == 0


def test_silence_and_strangers(bus, monkeypatch):
    sender, name = bus
    monkeypatch.setattr("edgepose.sources.line_checks.SILENCE_S", 0.2)
    monkeypatch.setattr("edgepose.sources.line_checks.NOISE_S", 0.2)
    with open_source(can=name) as source, pytest.raises(EdgeposeError) as info:
        list(source)
    assert str(info.value).startswith(f"{name}: no data for 0.2 s; check that the devices are on")
    assert "--bitrate (now 500000)" in str(info.value)

    def send(message):
        sender.send(can.Message(arbitration_id=0x111, data=b"1234", is_extended_id=False))

    with (
        open_source(can=name) as source,
        Devices(send, "native-can"),
        pytest.raises(EdgeposeError, match=r"\d+ frames in 0.2 s but no valid packet; check --protocol"),
    ):
        list(source)


def test_buses_that_cannot_be_opened():
    for name, says in (
        ("nonsense:0", "no CAN interface 'nonsense'; python-can has .*socketcan"),
        ("slcan:/dev/nowhere", "cannot open it: .*No such file"),
        # Systems without CAN, such as containers, know no interface at all.
        (
            "socketcan:nowhere7",
            "(cannot open it: .*sudo ip link set nowhere7 up|.* has no CAN sockets; load)",
        ),
    ):
        with pytest.raises(EdgeposeError, match=f"^{name}: {says}") as info:
            open_source(can=name).__enter__()
        assert "\n" not in str(info.value)


# --- an adapter that comes and goes -------------------------------------------------------------------------


def slcan_line(message):
    head = f"T{message.arbitration_id:08X}" if message.is_extended_id else f"t{message.arbitration_id:03X}"
    return f"{head}{message.dlc}{message.data.hex()}\r".encode()


class Adapter(Port):
    """A slcan adapter behind a symbolic link."""

    def __init__(self, path):
        super().__init__()
        path.unlink(missing_ok=True)
        path.symlink_to(self.name)

    def send(self, message):
        self.write(slcan_line(message))


def test_a_bus_that_goes_and_comes_back(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')  # python-can's own way to set this
    path = tmp_path / "adapter"
    adapter = Adapter(path)
    gap = []
    with open_source(can=f"slcan:{path}") as source:
        batches = iter(source)
        with Devices(adapter.send, "hipnuc-canopen"):
            before = collect(batches, 100)
        adapter.close()
        while "disconnected" not in caplog.text or len(gap) < 5:
            now_s, samples, *_ = next(batches)
            before += samples
            gap.append(now_s)
        assert all(b > a for a, b in pairwise(gap))
        adapter = Adapter(path)
        with Devices(adapter.send, "hipnuc-canopen"):
            after = collect(batches, 100)
    adapter.close()
    assert {sample.sensor for sample in after} == set(range(6))
    assert max(s.time_s for s in before) < min(s.time_s for s in after)
    told = [record.getMessage() for record in caplog.records if record.name.startswith("edgepose")]
    assert told[0] == f"slcan:{path}: disconnected; the run continues and waits for it"
    assert re.fullmatch(rf"slcan:{path}: back after \d+\.\d s", told[1])


def test_damaged_lines_of_an_adapter_cost_only_themselves(tmp_path, monkeypatch):
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')
    adapter = Adapter(tmp_path / "adapter")

    def send(message):
        os.write(adapter.master, b"t123\rt12\rtxyz\r")  # without a length, an id, a number
        adapter.send(message)

    with open_source(can=f"slcan:{tmp_path / 'adapter'}") as source, Devices(send, "hipnuc-canopen"):
        assert {sample.sensor for sample in collect(source, 100)} == set(range(6))
    adapter.close()


# --- logs ---------------------------------------------------------------------------------------------------


def write_log(path, name="native-can", n=100, **options):
    with can.Logger(path) as log:
        for message in messages(name, 0, n, start_s=1_700_000_000.0, **options):
            log.on_message_received(message)
    return path


def everything(**options):
    with open_source(**options) as source:
        return source, [sample for _, samples, *_ in source for sample in samples]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".csv", ".trc", ".log.gz"])
def test_logs(tmp_path, suffix):
    source, got = everything(file=write_log(tmp_path / f"walk{suffix}"))
    assert len(got) == source.counters.packets == 600
    times = [sample.time_s for sample in got if sample.sensor == 3]
    assert times[-1] - times[0] == pytest.approx(0.99, abs=0.01)
    clock = FrameSynchronizer()
    clock.push(got, 0.0)
    assert 58 <= len(clock.flush()) <= 60


@pytest.mark.parametrize("protocol", CAN)
def test_logs_of_any_protocol(tmp_path, protocol):
    """Those without a clock of their own have the log's."""
    source, got = everything(file=write_log(tmp_path / "a.log", protocol))
    # The first samples of some only show what there is of each.
    assert 590 <= len(got) == source.counters.packets
    times = [sample.time_s for sample in got if sample.sensor == 5][20:]
    assert times[-1] - times[0] == pytest.approx(0.01 * (len(times) - 1), abs=0.005)
    assert max(b - a for a, b in pairwise(times)) < 0.015


def test_a_log_of_two_buses_needs_a_map(tmp_path):
    file = tmp_path / "two.log"
    with can.Logger(file) as log:
        for k in range(100):
            for channel in ("can0", "can1"):
                for message in messages("native-can", k, 1, channel=channel)[:6]:
                    log.on_message_received(message)
    with pytest.raises(EdgeposeError, match=r"channel can0 and .*channel can1 both have a sensor for left_"):
        everything(file=file)
    rig = tmp_path / "rig.toml"
    rig.write_text(
        "\n".join(
            f'{name} = {{ can = "{bus}", id = {sensor} }}'
            for name, bus, sensor in (
                ("left_forearm", "can0", 0),
                ("right_forearm", "can0", 1),
                ("left_lower_leg", "socketcan:can1", 0),
                ("right_lower_leg", "socketcan:can1", 1),
                ("head", "can1", 2),
                ("pelvis", "can1", 3),
            )
        )
    )
    _, got = everything(file=file, sensors=rig)
    assert {sample.sensor for sample in got} == {0, 1, 2, 3}


def test_damaged_logs(tmp_path):
    whole = write_log(tmp_path / "a.log").read_text().splitlines(keepends=True)
    (tmp_path / "cut.log").write_text("".join(whole[:600]) + whole[600][:-12].replace("#", "") + "\n")
    got = []
    with open_source(file=tmp_path / "cut.log") as source:
        got.extend(sample for _, samples, *_ in source for sample in samples)
        assert source.damage == (
            f"{tmp_path}/cut.log: 1 bad lines left out, the first: line 601 is not a frame"
        )
    assert len(got) > 100
    (tmp_path / "no.mf4").write_bytes(b"nothing of the kind")
    with pytest.raises(EdgeposeError, match=r"no\.mf4: cannot read it as a log of a CAN bus"):
        everything(file=tmp_path / "no.mf4")
    (tmp_path / "empty.log").touch()
    with pytest.raises(EdgeposeError, match=r"empty\.log: no known packet in 0 bytes or frames"):
        everything(file=tmp_path / "empty.log")
    with pytest.raises(EdgeposeError, match="No such file"):
        everything(file=tmp_path / "none.log")
    with pytest.raises(
        EdgeposeError, match="packets come only from sensor ids 1, 2, 3, 4, 5, 6, but the expected ids are"
    ):
        everything(file=write_log(tmp_path / "b.log", "hipnuc-canopen"), sensors=ids(tmp_path))


def ids(folder):
    path = folder / "ids.toml"
    path.write_text("\n".join(f"{name} = {{ id = {40 + i} }}" for i, name in enumerate(PLACEMENTS)))
    return path


def test_an_interface_that_is_down(tmp_path):
    """The numbers are those of Linux for a CAN interface before and after `ip link set can0 up`."""
    for name, flags in (("can0", "0x40080\n"), ("can1", "0x400c1\n"), ("odd", "what\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "flags").write_text(flags)
    assert is_down("can0", tmp_path)
    for name in ("can1", "odd", "none"):
        assert not is_down(name, tmp_path)
