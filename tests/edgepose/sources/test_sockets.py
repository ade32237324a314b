"""Sensors in the network: datagrams of several senders, trackers that want an answer, TCP connections."""

import logging
import socket
import struct
import threading

import pytest

from edgepose.cli.conflicts import check_lines
from edgepose.config import WearerConfig
from edgepose.errors import ConfigError, DeviceError, EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from edgepose.sources.clock_sync import HostClocks
from edgepose.sources.line_config import QUEUE, line_specs
from edgepose.sources.probe import probe_socket
from edgepose.sources.protocol_detection import Datagram, candidate_protocols
from edgepose.sources.sender_decoders import MOST_NAMED, MOST_SENDERS, SenderDecoders
from edgepose.sources.sensor_map import read_map
from edgepose.sources.udp_socket import LONGEST
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support.datagrams import free_address
from tests.support.ports import Sender
from tools.simulate_network import DatagramLine, SlimevrTracker, TcpServer, network_line

QUAT = (0.6, 0.0, 0.8, 0.0)
SENDERS = [f"127.0.0.{11 + i}" for i in range(6)]
BY_SENDER = "".join(
    f'{name} = {{ sender = "{sender}" }}\n' for name, sender in zip(PLACEMENTS, SENDERS, strict=True)
)
AUTO = candidate_protocols("auto", "udp", live=True)


@pytest.fixture
def by_sender(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(BY_SENDER)
    return path


@pytest.fixture
def address():
    return free_address(socket.SOCK_DGRAM)


def sample(protocol, i, k):
    ids = protocol.ids or [0] * 6
    return Sample(
        *(ids[i], 7_000_000 + 10_000 * k, QUAT, (0.1, 0.2, 9.81), (0.1, 0.0, 0.0)),
        *((10.0, 20.0, 30.0), 25.0),
    )


class Sensors(Sender):
    """Six devices that send on lines of the simulator, in turn if there are fewer lines."""

    def __init__(self, name, lines):
        super().__init__()
        self.protocol, self.lines = PROTOCOLS[name], lines
        self.encoders = [self.protocol.encoder() for _ in lines]

    def send(self, k):
        for line in self.lines:
            if isinstance(line, SlimevrTracker | TcpServer):
                line.receive()
        for i in range(6):
            line = i % len(self.lines)
            self.lines[line].send(self.encoders[line](sample(self.protocol, i, k), k))

    def __exit__(self, *_):
        super().__exit__()
        for line in self.lines:
            line.close()


def sensors(name, address):
    host, _, port = address.rpartition(":")
    make = network_line(host, int(port), name)
    return Sensors(name, [make(i) for i in range(6)])


def samples_of(batches, enough):
    """Samples until each of six placements has enough."""
    counts = [0] * 6
    for batch in batches:
        for each in batch.samples:
            counts[each.sensor] += 1
            yield each
        if min(counts) >= enough:
            return


# --- datagrams ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "protocol", "blocking"),
    [
        ("native", "auto", True),
        ("native", "native", False),
        ("ximu3", "auto", False),
        ("slimevr", "slimevr", True),
    ],
)
def test_six_senders_to_one_address(name, protocol, blocking, address, by_sender):
    rig = None if name == "native" else by_sender
    with (
        open_source(listen=address, protocol=protocol, sensors=rig, blocking=blocking) as source,
        sensors(name, address),
    ):
        got = list(samples_of(source, 20))
    assert source.counters.bad == source.counters.unknown == 0
    assert set(source.devices) == set(range(6))
    assert str(source.devices[5]) == (
        f"{name} id {5 if name == 'native' else 0} on {address} from {SENDERS[5]}"
    )
    for each in got:
        assert each.quat == pytest.approx(QUAT, abs=1e-4)
        assert each.acc == pytest.approx((0.1, 0.2, 9.81), abs=0.01)


def test_trackers_are_known_by_their_mac_addresses(address, tmp_path, caplog):
    """Whatever address the router gives them; another tracker gets no answer."""
    rig = tmp_path / "rig.toml"
    macs = [f"02:00:00:00:00:{5 - i:02X}" for i in range(5)] + ["02:00:00:00:00:77"]
    rig.write_text(
        "".join(f'{n} = {{ sender = "{mac}" }}\n' for n, mac in zip(PLACEMENTS, macs, strict=True))
    )
    with (
        open_source(listen=address, protocol="slimevr", sensors=rig) as source,
        sensors("slimevr", address) as trackers,
    ):
        seen = 0
        for batch in source:
            seen += len(batch.samples)
            if len(source.devices) == 5 and caplog.records:
                break
        connected = [line._heard_s > 0.0 for line in trackers.lines]
    assert str(source.devices[0]) == f"slimevr id 0 on {address} from 02:00:00:00:00:05"
    assert set(source.devices) == set(range(5))
    assert seen >= 5
    assert connected == [False, *[True] * 5]
    assert "ignoring datagrams from 127.0.0.11: it is not in the sensor map" in caplog.text


def decoders(protocols, placements, owner=None):
    clocks = []

    def clock(wrap_us):
        clocks.append(HostClocks(wrap_us))
        return clocks[-1].time

    return SenderDecoders("here", protocols, placements, clock, {} if owner is None else owner)


@pytest.mark.parametrize("name", [protocol.name for protocol in AUTO])
def test_every_format_in_datagrams(name):
    """One packet in each, from senders that are told apart by their addresses alone; nothing else fits."""
    protocol = PROTOCOLS[name]
    got = decoders(AUTO, lambda sender: lambda found: {None: int(sender)})
    encoders = [protocol.encoder() for _ in range(2)]
    samples = []
    for k in range(150):
        for i, encode in enumerate(encoders):
            # Text lines have their header again from time to time.
            wire = encode(sample(protocol, i, k), k % 20 if "openlog" in name else k)
            if name in ("adafruit", "razor"):
                wire = wire.rstrip()  # the end of a datagram ends a line
            assert 0 < len(wire) <= LONGEST
            samples += got.feed([Datagram(str(i), wire)], k / 100)
    assert {device.protocol for device in got.devices.values()} == {name}
    assert {each.sensor for each in samples} == {0, 1}
    assert len(samples) > 200
    assert got.counters.bad == 0


def native(i, k=0):
    protocol = PROTOCOLS["native"]
    return protocol.encode(sample(protocol, i, k), k)


def test_a_sender_that_is_not_in_the_map_is_named_once(by_sender, caplog):
    (spec,) = line_specs(listen="127.0.0.1:9000", protocol="native", sensor_map=read_map(by_sender))
    got = decoders(spec.protocols, spec.senders)
    for k in range(5):
        assert got.feed([Datagram("10.0.0.7", native(0, k))], k / 100) == []
    assert [record.getMessage() for record in caplog.records] == [
        "here: ignoring datagrams from 10.0.0.7: it is not in the sensor map"
    ]
    assert got.counters.unknown == 5
    assert got.unknown == "datagrams come only from 10.0.0.7: it is not in the sensor map"
    assert [s.sensor for s in got.feed([Datagram(SENDERS[3], native(0, 9))], 1.0)] == [3]


class StrangerFirst(Sensors):
    """A stranger that sends for a while before six sensors do."""

    def send(self, k):
        if k < 40:
            self.stranger.send(native(0, k))
        else:
            super().send(k)


def test_a_stranger_does_not_end_the_wait_for_the_sensors(address, by_sender, monkeypatch):
    monkeypatch.setattr("edgepose.sources.line_checks.NOISE_S", 0.1)
    monkeypatch.setattr("edgepose.sources.line_checks.REFUSED_S", 0.1)
    host, _, port = address.rpartition(":")
    lines = [DatagramLine(host, int(port), i) for i in range(7)]
    with open_source(listen=address, protocol="native", sensors=by_sender) as source:
        rig = StrangerFirst("native", lines[:6])
        rig.stranger = lines[6]
        with rig:
            assert {each.sensor for each in samples_of(source, 3)} == set(range(6))
    lines[6].close()


def test_two_senders_with_one_id_cost_only_the_second(caplog):
    got = decoders([PROTOCOLS["native"]], lambda sender: lambda found: {0: 0, 1: 1})
    pieces = [Datagram(sender, native(0, k)) for k in range(3) for sender in ("a", "b")]
    assert len(got.feed(pieces, 0.0)) == 3
    assert len(caplog.records) == 1
    assert (
        "here: ignoring datagrams from b: here from a and here from b both have a sensor for left_f"
        in caplog.text
    )


def test_a_sender_that_is_turned_away_frees_its_placements():
    got = decoders([PROTOCOLS["native"]], lambda sender: lambda found: {0: 0, 1: 1})
    for sender, i, k in (("a", 0, 0), ("b", 1, 0), ("b", 0, 1)):
        got.feed([Datagram(sender, native(i, k))], 0.1 * k)
    assert set(got.devices) == {0}  # b is gone, for it claimed what is a's
    assert len(got.feed([Datagram("c", native(1, 0))], 0.3)) == 1


def test_a_flood_of_senders_stays_bounded(caplog):
    caplog.set_level(logging.WARNING)
    got = decoders(AUTO, lambda sender: lambda found: {0: 0, 1: 1})
    for k in range(12):
        assert got.feed([Datagram("real", native(0, k))], k / 100) is not None
    for number in range(100):
        got.feed([Datagram(f"s{number}", b"\xff" * 30)], 0.2 + number / 1000)
    assert len(got._decoders) == MOST_SENDERS
    # The one that is known stays, and a new one gets the place of one that has been useless for long.
    assert len(got.feed([Datagram("real", native(0, 13))], 4.0)) == 1
    assert (
        len([s for k in range(12) for s in got.feed([Datagram("late", native(1, k))], 4.0 + k / 100)]) == 12
    )
    assert len(got._decoders) == MOST_SENDERS
    strangers = decoders([PROTOCOLS["native"]], lambda sender: None)
    for number in range(300):
        strangers.feed([Datagram(f"s{number}", b"x")], 0.0)
    assert len(caplog.records) == MOST_NAMED + 1
    assert strangers.counters.unknown == strangers.amount == 300
    assert strangers.unknown.endswith(", s15 and others: it is not in the sensor map")


def test_a_flood_of_senders_with_unknown_ids_warns_a_bounded_number_of_times(caplog):
    got = decoders([PROTOCOLS["native"]], lambda sender: lambda found: {0: 0})
    for k in range(12 * MOST_SENDERS):
        got.feed([Datagram(f"s{k}", native(1, k))], k / 10)
    assert got.counters.unknown + got.counters.bad == 12 * MOST_SENDERS
    assert len(caplog.records) <= MOST_SENDERS + MOST_NAMED + 1
    assert caplog.records[-1].getMessage().endswith("from more senders, without naming them")


def test_a_sender_of_noise_is_listened_to_afresh():
    got = decoders(AUTO, lambda sender: lambda found: {0: 0})
    for k in range(80):
        got.feed([Datagram("a", bytes([1 + k] * 40))], k / 10)
    samples = []
    for k in range(60):
        samples += got.feed([Datagram("a", native(0, k))], 8.0 + k / 10)
    assert samples
    assert got.counters.bad >= 60


def test_ids_without_a_placement_are_named_up_to_a_number(caplog):
    got = decoders([PROTOCOLS["native"]], lambda sender: lambda found: {0: 0})
    for i in range(200):
        packet = PROTOCOLS["native"].encode(sample(PROTOCOLS["native"], 0, i)._replace(sensor=1 + i), i)
        got.feed([Datagram("a", packet)], i / 100)
    assert len(caplog.records) == 16
    assert got.counters.unknown == 200


def test_what_no_datagram_of_a_sensor_is(address):
    with open_source(listen=address, protocol="native") as source, sensors("native", address) as devices:
        batches = samples_of(source, 20)
        next(batches)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            host, _, port = address.rpartition(":")
            for data in (
                b"",
                b"\xff" * (LONGEST + 1),
                b"\0\xff\xff\0",
                struct.pack("<4f", *[float("nan")] * 4),
            ):
                other.sendto(data, (host, int(port)))
        assert len(list(batches)) > 100
        assert devices.is_alive()
    assert source.counters.bad >= 3


def test_more_than_can_be_read_stays_with_the_system(address):
    """The queue to a reader that is busy is bounded, however much comes."""
    host, _, port = address.rpartition(":")
    with open_source(listen=address, protocol="native") as source, sensors("native", address):
        batches = iter(source)
        while not next(batches).samples:
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flood:
            data = native(0)
            while True:
                for _ in range(200):
                    flood.sendto(data, (host, int(port)))
                if source._queue.qsize() > QUEUE:
                    break
            for _ in range(5000):
                flood.sendto(data, (host, int(port)))
        assert source._queue.qsize() <= QUEUE + 2
        batches.close()


class OneAndAmbiguous(Sender):
    """A sender of one format, and one of two formats that fit equally well."""

    def __init__(self, address):
        super().__init__()
        host, _, port = address.rpartition(":")
        self.one, self.ambiguous = (DatagramLine(host, int(port), number) for number in range(2))

    def send(self, k):
        self.one.send(native(0, k))
        for name in ("native", "vectornav-ascii"):
            reading = sample(PROTOCOLS[name], 0, k)._replace(temperature=None)
            self.ambiguous.send(PROTOCOLS[name].encode(reading, k))

    def __exit__(self, *_):
        super().__exit__()
        self.one.close()
        self.ambiguous.close()


def test_an_ambiguous_sender_costs_only_its_own_finding(address):
    with OneAndAmbiguous(address) as sensors:
        found = probe_socket(address)
    assert found[sensors.one.sender].protocol == "native"
    ambiguous = found[sensors.ambiguous.sender]
    assert ambiguous.protocol is None
    assert ambiguous.refused.startswith("it could be ")
    assert ambiguous.refused.endswith("; choose one with --protocol")


# --- TCP ----------------------------------------------------------------------------------------------------


def test_six_connections_one_of_which_breaks(caplog):
    servers = [TcpServer("127.0.0.1") for _ in range(6)]
    names = ",".join(server.name for server in servers)
    with open_source(connect=names, protocol="ximu3") as source, Sensors("ximu3", servers):
        batches = iter(source)
        assert {each.sensor for each in samples_of(batches, 10)} == set(range(6))
        servers[2]._client.shutdown(socket.SHUT_RDWR)
        after = [each.sensor for each in samples_of(batches, 10)]
    assert set(after) == set(range(6))
    assert f"{servers[2].name}: disconnected" in caplog.text
    assert f"{servers[2].name}: back after" in caplog.text
    assert str(source.devices[2]) == f"ximu3 id 0 on {servers[2].name}"


def test_a_device_that_is_not_there():
    nowhere = free_address()
    with pytest.raises(DeviceError, match=f"{nowhere}: cannot connect: Connection refused; check"):
        open_source(connect=nowhere, protocol="native").__enter__()


# --- the vendor's reader ------------------------------------------------------------------------------------


@pytest.mark.parametrize("tcp", [False, True])
def test_the_vendors_library_reads_the_simulated_devices(tcp):
    """What is tried here without devices is what x-io's own library takes for an x-IMU3."""
    ximu3 = pytest.importorskip("ximu3")
    if tcp:
        line = TcpServer("127.0.0.1")
        config = ximu3.TcpConnectionConfig("127.0.0.1", int(line.name.rpartition(":")[2]))
    else:
        port = int(free_address(socket.SOCK_DGRAM).rpartition(":")[2])
        line = DatagramLine("127.0.0.1", port, 0)
        config = ximu3.UdpConnectionConfig("127.0.0.11", 9000, port)
    connection = ximu3.Connection(config)
    messages, errors, ready = [], [], threading.Event()

    def take(message):
        messages.append(message)
        if len(messages) >= 20:
            ready.set()

    connection.add_quaternion_callback(take)
    connection.add_receive_error_callback(errors.append)
    with Sensors("ximu3", [line]):
        connection.open()
        assert ready.wait(60)
        connection.close()
    assert not errors
    assert (messages[-1].w, messages[-1].y) == pytest.approx((0.6, 0.8))


# --- names and maps -----------------------------------------------------------------------------------------


def test_an_address_in_use(address):
    with open_source(listen=address, protocol="native"):
        host, _, port = address.rpartition(":")
        with pytest.raises(DeviceError, match=f"cannot listen on {host} port {port}: Address already in use"):
            open_source(listen=address, protocol="native").__enter__()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"listen": "9000"}, "no port in '9000': write HOST:PORT"),
        ({"listen": "1.2.3.4:9000,1.2.3.4:9000"}, "1.2.3.4:9000 is given twice"),
        ({"connect": "sensor:0"}, "port '0' in 'sensor:0' is not a number"),
        (
            {"connect": "a:1", "protocol": "slimevr"},
            "slimevr is for datagrams; use it with --listen",
        ),
        ({"connect": "a:1", "protocol": "witmotion-modbus"}, "devices are polled"),
        ({"listen": "1.2.3.4:9000", "protocol": "native-can"}, "protocol native-can is for CAN buses"),
        (
            {"listen": "1.2.3.4:9000", "protocol": "slimevr"},
            r"(?s)slimevr has one sensor per sender: give six addresses .*left_forearm = { sender = ",
        ),
        ({"connect": "a:1", "protocol": "ximu3"}, None),
    ],
)
def test_names(flags, message):
    if message is None:  # which sensor is where is asked when the decoder is made
        assert [spec.name for spec in line_specs(**flags)] == ["a:1"]
        return
    with pytest.raises(ConfigError, match=message):
        line_specs(**flags)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ('{ sender = "sensor7" }', "pelvis: sender must be an IP address or a MAC address, not 'sensor7'"),
        ('{ port = "a", sender = "1.2.3.4" }', "pelvis: sender is for datagrams; it does not go with port"),
        ('{ port = "a", listen = "1.2.3.4:5" }', "pelvis: give port or listen, not both"),
        (f'{{ sender = "{SENDERS[0]}" }}', "pelvis and left_forearm are the same device"),
        ('{ connect = "1.2.3.4:5" }', "pelvis: 1.2.3.4:5 is not one of the lines given"),
    ],
)
def test_rows_of_the_map(row, message, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text("".join(BY_SENDER.splitlines(True)[:5]) + f"pelvis = {row}\n")
    with pytest.raises(ConfigError, match=message):
        line_specs(listen="127.0.0.1:9000", sensor_map=read_map(path))


def test_lines_that_only_the_map_names(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(
        """
        left_forearm = { listen = "0.0.0.0:6969", sender = "192.168.1.20" }
        right_forearm = { listen = "0.0.0.0:6969", sender = "192.168.1.21", id = 1 }
        left_lower_leg = { listen = "0.0.0.0:6969", sender = "fe80:0::1" }
        right_lower_leg = { listen = "0.0.0.0:6969", sender = "192.168.1.22" }
        head = { connect = "192.168.1.23:7000" }
        pelvis = { port = "/dev/ttyUSB0" }
        [ports."0.0.0.0:6969"]
        protocol = "slimevr"
        """
    )
    rig = read_map(path)
    specs = line_specs(sensor_map=rig)
    assert [(spec.name, spec.unit, len(spec.protocols) > 1) for spec in specs] == [
        ("/dev/ttyUSB0", "bytes", True),
        ("0.0.0.0:6969", "datagrams", False),
        ("192.168.1.23:7000", "bytes", True),
    ]
    assert rig.places("0.0.0.0:6969", "192.168.1.20") == {None: 0}
    assert rig.places("0.0.0.0:6969", "192.168.1.21") == {1: 1}
    assert rig.senders("0.0.0.0:6969") == {"192.168.1.20", "192.168.1.21", "192.168.1.22", "fe80::1"}
    assert rig.places("192.168.1.23:7000") == {None: 4}


def test_senders_without_a_socket(by_sender):
    with pytest.raises(ConfigError, match=r"nothing listens for the datagrams of 127.0.0.11; give --listen"):
        line_specs("/dev/ttyUSB0", sensor_map=read_map(by_sender))


def test_rig_files_name_addresses(tmp_path):
    for name, line in (("anna", "listen"), ("ben", "listen"), ("cleo", "connect")):
        (tmp_path / f"{name}.toml").write_text(
            f'{line} = "127.0.0.1:9000"\nprotocol = "native"\ncalibration = "c.json"\ncsv = "{name}.csv"\n'
        )
    anna, ben, cleo = (WearerConfig.from_toml(tmp_path / f"{name}.toml") for name in ("anna", "ben", "cleo"))
    assert anna.source.listen == cleo.source.connect == anna.source.name == "127.0.0.1:9000"
    assert anna.source.live
    with pytest.raises(EdgeposeError, match=r"both use the address 127.0.0.1:9000; give each its own"):
        check_lines([anna, ben])
    check_lines([anna, cleo])
