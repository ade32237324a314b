"""Movella DOT sensors over Bluetooth: the real bleak, a simulated BlueZ on a D-Bus message bus of its own."""

import sys
import threading
from contextlib import contextmanager

import pytest
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.cli.conflicts import check_lines
from edgepose.config import WearerConfig
from edgepose.errors import DeviceError, EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sources import ble, line_checks, open_source
from firmware_protocols.dot import encode
from firmware_protocols.sample import Sample
from tools.simulated_bluez import SimulatedBluez, SimulatedDot

ADDRESSES = [f"D4:22:CD:00:00:0{i}" for i in range(6)]
SIX = ",".join(ADDRESSES)
START, STOP = bytes([1, 1, 26]), bytes([1, 0, 26])
QUAT = (0.6, 0.0, 0.8, 0.0)


@contextmanager
def rig(tmp_path, monkeypatch, dots, *, length=None, adapter=True):
    """A bus with these devices, which send notifications, of another length if one is given."""
    stop = threading.Event()

    def send():
        k = 0
        while not stop.wait(0.01):
            k += 1
            for i, dot in enumerate(dots):
                data = encode(Sample(0, 16_667 * k, QUAT, (0.1, 0.2, 9.0 + 0.1 * i), (0.1, 0.0, 0.0)))
                bluez.notify(dot, data[:length])

    with SimulatedBluez(tmp_path / "bus", dots, adapter=adapter) as bluez:
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", bluez.address)
        sender = threading.Thread(target=send)
        sender.start()
        try:
            yield bluez
        finally:
            stop.set()
            sender.join()


def test_one_of_six_is_lost_and_comes_back(tmp_path, monkeypatch, caplog):
    dots = [SimulatedDot(address) for address in ADDRESSES]
    dots[4].aborts = 1  # bleak connects again by itself, which is no loss
    stranger = SimulatedDot("D4:22:CD:00:00:0F")
    with rig(tmp_path, monkeypatch, [*dots, stranger]) as bluez:
        with open_source(ble=SIX.lower()) as source:
            after = [0] * 6  # samples since the connection was lost
            lost = False
            for batch in source:
                for each in batch.samples:
                    assert each.quat == pytest.approx(QUAT)
                    assert each.acc == pytest.approx((0.1, 0.2, 9.0 + 0.1 * each.sensor), abs=1e-5)
                    after[each.sensor] += lost
                if not lost and len(source.devices) == 6:
                    bluez.disconnect(dots[2], in_range=False)
                    lost = True
                if lost and after[3] >= 10 and "disconnected" in caplog.text:
                    dots[2].in_range = True
                if "back after" in caplog.text and after[2] >= 10:
                    break
        assert min(after) >= 10
        assert source.counters.bad == source.counters.unknown == 0
        assert str(source.devices[5]) == f"dot id 0 on {ADDRESSES[5]}"
        assert [dot.messages for dot in dots] == [
            [START, *([START] if i == 2 else []), STOP] for i in range(6)
        ]
        assert not any(dot.connected for dot in dots)
        assert stranger.messages == []
    warnings = [each for each in caplog.messages if "D4:22" in each]
    assert warnings[0] == f"{ADDRESSES[2]}: disconnected; the run continues and waits for it"
    assert len(warnings) == 2


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("adapter", "Bluetooth is not available: No Bluetooth adapters found; plug in an adapter"),
        ("bus", "Bluetooth is not available: no D-Bus (No such file or directory); check that BlueZ"),
        ("range", "not found over Bluetooth in 0.3 s; check that the sensor is on, in range"),
        ("service", "not a Movella DOT, because it has no measurement service"),
        ("length", "no valid dot packet; check with Movella's app that its firmware is up to date"),
    ],
)
def test_faults_at_the_start_name_the_sensor(fault, message, tmp_path, monkeypatch):
    monkeypatch.setattr(ble, "FIND_S", 0.3 if fault == "range" else 5.0)
    monkeypatch.setattr(line_checks, "NOISE_S", 0.2)
    dot = SimulatedDot(ADDRESSES[0], measures=fault != "service")
    dot.in_range = fault != "range"
    sensors = tmp_path / "map.toml"
    sensors.write_text(f'pelvis = {{ ble = "{dot.address.lower()}" }}\n')
    length = 30 if fault == "length" else None
    with rig(tmp_path, monkeypatch, [dot], length=length, adapter=fault != "adapter"):
        if fault == "bus":
            monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={tmp_path / 'none'}")
            monkeypatch.setattr(ble, "_radio", ble._Radio())  # bleak keeps its connection to the bus
        with pytest.raises(DeviceError) as error, open_source(sensors=sensors) as source:
            for _ in source:
                pass
        assert not dot.connected
    assert str(error.value).startswith(f"{dot.address}: ")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_sensor_map_names_them(tmp_path, monkeypatch):
    dots = [SimulatedDot(address) for address in ADDRESSES[:2]]
    sensors = tmp_path / "map.toml"
    sensors.write_text(
        f'head = {{ ble = "{ADDRESSES[1]}" }}\npelvis = {{ ble = "{ADDRESSES[0].lower()}" }}\n'
    )
    with rig(tmp_path, monkeypatch, dots), open_source(sensors=sensors) as source:
        for _ in source:
            if len(source.devices) == 2:
                break
    names = {PLACEMENTS[placement]: device.line for placement, device in source.devices.items()}
    assert names == {"head": ADDRESSES[1], "pelvis": ADDRESSES[0]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ble": "D4:22:CD:00:12"}, "not a Bluetooth address such as D4:22:CD:00:12:34"),
        ({"ble": f"{SIX},{ADDRESSES[0].lower()}"}, f"{ADDRESSES[0]} is given twice"),
        ({"ble": SIX, "protocol": "xsens"}, "--ble is for Movella DOT sensors"),
        ({"ble": ADDRESSES[0]}, f'left_forearm = {{ ble = "{ADDRESSES[0]}" }}'),
        ({"ble": SIX, "file": "walk.npz"}, "give one input"),
    ],
)
def test_settings_that_cannot_be(arguments, message):
    with pytest.raises(EdgeposeError) as error:
        open_source(**arguments)
    assert message in str(error.value)


def test_without_bleak_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "bleak", None)
    monkeypatch.delitem(sys.modules, "edgepose.sources.ble")
    with pytest.raises(EdgeposeError, match=r"pip install 'edgepose\[ble\]'"), open_source(ble=SIX):
        pass


def test_devices_lists_those_in_range(tmp_path, monkeypatch):
    monkeypatch.setattr(ble, "SCAN_S", 0.3)
    dots = [SimulatedDot(ADDRESSES[1]), SimulatedDot(ADDRESSES[0]), SimulatedDot("00:11:22:33:44:55", "Lamp")]
    with rig(tmp_path, monkeypatch, dots):
        result = CliRunner().invoke(cli, ["devices", "--ble"])
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "Movella DOT sensors (edgepose run --ble ADDRESS):",
        f"  {ADDRESSES[0]}  Movella DOT  -60 dBm",
        f"  {ADDRESSES[1]}  Movella DOT  -60 dBm",
    ]
    assert not any(dot.messages or dot.connected for dot in dots)


def test_two_wearers_cannot_have_one_sensor(tmp_path):
    wearers = []
    for name, addresses in (("anna", SIX), ("ben", SIX.lower())):
        path = tmp_path / f"{name}.toml"
        path.write_text(f'ble = "{addresses}"\ncalibration = "c.json"\ncsv = "{name}.csv"\n')
        wearers.append(WearerConfig.from_toml(path))
    with pytest.raises(EdgeposeError, match="both use the address D4:22:CD:00:00:0"):
        check_lines(wearers)
