"""`edgepose devices --probe`: what is on a port or bus that nobody has described."""

import re
import time

import pytest

from edgepose.errors import EdgeposeError
from edgepose.sources.probe import BAUDS, probe_bus, probe_port
from firmware_protocols import lpms
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support.ports import Port, Sender


class Devices(Sender):
    """Devices of one wire format on a line, as bytes or as a slcan adapter's lines."""

    def __init__(self, name, ids=(0,), rate=100, noise=False):
        (self.line,) = ports = (Port(),)
        super().__init__(*ports, rate=rate)
        self.protocol, self.ids, self.noise = PROTOCOLS.get(name), ids, noise
        self.port = self.line.name
        self.sent = 0
        self.encode = self.protocol and self.protocol.encoder()

    def send(self, k):
        for sensor in self.ids:
            if self.noise:
                self.line.write(bytes([1 + (37 * k + i * k * k) % 255 for i in range(30)]))
                continue
            sample = Sample(sensor, 10_000 * k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            wire = self.encode(sample, k)
            if self.protocol.transport == "can":
                wire = b"".join(b"t%03X%d%s\r" % (i, len(d), d.hex().encode()) for i, d, *_ in wire)
            self.line.write(wire)
        self.sent = k + 1


def test_what_is_on_ports_and_buses(command, monkeypatch):
    """As users see it: a hub, a slow device of its own, an adapter of a CAN bus, and silence."""
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')
    with (
        Devices("native", ids=(0, 2, 5)) as hub,
        Devices("witmotion", rate=20) as alone,
        Devices("hipnuc-canopen", ids=(8, 9)) as adapter,
        Devices(None, ids=()) as silent,
    ):
        names = [hub.port, alone.port, silent.port, f"slcan:{adapter.port}"]
        result = command("devices", "--probe", *names)
    assert result.returncode == 0, result.stderr
    lines = [line.strip() for line in result.stdout.splitlines()]
    assert [line for line in lines if line in names] == names
    says = [lines[lines.index(name) + 1] for name in names]
    assert says[0].startswith("--protocol native at --baud 115200: id 0 at ")
    assert re.findall(r"id (\d)", says[0]) == ["0", "2", "5"]
    assert says[1].startswith("--protocol witmotion at --baud 115200: id 0 at ")
    assert says[2] == "nothing arrives"
    assert says[3].startswith("--protocol hipnuc-canopen: id 8 at ")
    assert ", id 9 at " in says[3]


@pytest.mark.parametrize("bus", [False, True])
def test_rates_do_not_count_what_had_waited(bus, monkeypatch):
    monkeypatch.setenv("CAN_CONFIG", '{"sleep_after_open": 0.01}')
    with Devices("hipnuc-canopen" if bus else "xsens", ids=(8,) if bus else (0,), rate=50) as device:
        while device.sent < 60:  # a second of data that nobody has read
            time.sleep(0.01)
        before = device.sent
        start_s = time.monotonic()
        finding, baud = (probe_bus(f"slcan:{device.port}"), BAUDS[0]) if bus else probe_port(device.port)
        true_hz = (device.sent - before) / (time.monotonic() - start_s)
    assert baud == BAUDS[0]
    assert finding.protocol == ("hipnuc-canopen" if bus else "xsens")
    ((sensor, rate_hz),) = finding.rates_hz.items()
    assert sensor == (8 if bus else 0)
    # A busy machine slows the sender down.
    assert rate_hz == pytest.approx(true_hz, rel=0.15)


def test_sensors_with_other_settings_are_named(command):
    """A protocol at the right speed whose content is not what poses need."""
    more = [*lpms.USUAL_FIELDS, "euler"]
    with Devices("lpms", ids=(1,)) as device:
        device.encode = lambda sample, seq: lpms.encode(sample, more)
        result = command("devices", "--probe", device.port)
    assert result.returncode == 0
    assert " measurements came whole, but with 68 bytes instead of 56 (floats) or 30" in result.stdout
    assert "another speed" not in result.stdout


def test_noise_is_listened_to_at_all_speeds(monkeypatch):
    monkeypatch.setattr("edgepose.sources.probe.LISTEN_S", 0.1)
    with Devices(None, noise=True) as device:
        finding, _ = probe_port(device.port)
    assert finding.protocol is None
    assert finding.amount > 0


def test_what_cannot_be_opened(command):
    with pytest.raises(EdgeposeError, match="no such port"):
        probe_port("/dev/nowhere")
    with pytest.raises(EdgeposeError, match="no CAN interface"):
        probe_bus("nonsense:0")
    result = command("devices", "--probe", "/dev/nowhere7", "socketcan:nowhere7")
    assert result.returncode == 1
    assert result.stderr == "edgepose: cannot listen to /dev/nowhere7, socketcan:nowhere7\n"
    assert "/dev/nowhere7: no such port" in result.stdout
    assert re.search("socketcan:nowhere7: (cannot open it|this system has no CAN sockets)", result.stdout)


def test_devices_without_names(command):
    result = command("devices")
    assert result.returncode == 0
    assert "Serial ports (edgepose run --port NAME):" in result.stdout
    assert "CAN interfaces (edgepose run --can NAME):" in result.stdout


@pytest.mark.parametrize("probe", [(), ("--probe",)])
def test_ports_that_are_not_there(command, probe):
    result = command("devices", *probe, "/dev/ttyNONE,/dev/ttyNEVER", "/dev/null")
    assert result.returncode == 1
    assert result.stdout.count("no such port") == 2
    assert "/dev/ttyNONE,/dev/ttyNEVER" not in result.stdout
    assert "edgepose: cannot listen to /dev/ttyNONE, /dev/ttyNEVER" in result.stderr
