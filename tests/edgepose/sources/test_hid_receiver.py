"""SlimeVR's USB receivers: hidapi reads ptys that it takes for them, see `tests.support.hid_devices`."""

import os
import re
import sys
from pathlib import Path

import hidraw
import pytest

from edgepose.cli.conflicts import check_lines
from edgepose.config import WearerConfig
from edgepose.errors import ConfigError, DeviceError, EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from edgepose.sources.hid_receiver import RULE, hidapi, path_of, receivers_among
from edgepose.sources.line_config import line_specs
from edgepose.sources.probe import probe_receiver
from firmware_protocols.sample import Sample
from firmware_protocols.slimevr_hid import encode
from tests.support import limits
from tests.support.hid_devices import take_files_for_hid_devices, with_hid_devices
from tests.support.ports import Port, Sender
from tests.support.processes import run

LISTED = {
    "path": b"/dev/hidraw0",
    "vendor_id": 4617,
    "product_id": 30352,
    "serial_number": "A1B2C3D4E5F60718",
    "release_number": 256,
    "manufacturer_string": "SlimeVR",
    "product_string": "SlimeNRF Receiver",
    "usage_page": 0,
    "usage": 0,
    "interface_number": 2,
    "bus_type": 1,
}
"""What hidapi 0.15.0 lists of a receiver that umockdev made of its descriptors."""


class Receiver(Sender):
    """A receiver with three trackers: each transfer has their reports, and the address of one of them.

    It can be plugged in and out; its path stays the same.
    """

    def __init__(self, path, ids=range(3)):
        self.port = Port()
        super().__init__(self.port)
        self.path, self.ids = path, ids
        path.symlink_to(self.port.name)

    def send(self, k):
        reports = [encode(Sample(i, None, (0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 9.81))) for i in self.ids]
        address = bytes([255, k % 3, 1, 2, 3, 4, 5, 6]) + bytes(8)
        self.port.write(b"".join(reports) + address)

    def unplug(self):
        self.path.unlink()
        super().unplug()


def map_of(folder, *lines):
    """A map of three trackers on each of two receivers."""
    path = folder / "rig.toml"
    rows = [f'{name} = {{ hid = "{lines[i // 3]}", id = {i % 3} }}\n' for i, name in enumerate(PLACEMENTS)]
    path.write_text("".join(rows))
    return path


def test_two_receivers_of_which_one_is_unplugged_and_comes_back(tmp_path, caplog):
    a, b = tmp_path / "a", tmp_path / "b"

    def follow():
        """Samples by sensor with both, without the second, and with both again."""
        counts = [[0] * 6 for _ in range(3)]
        with Receiver(a), Receiver(b) as second, open_source(sensors=map_of(tmp_path, a, b)) as source:
            batches = iter(source)

            def count_until(found, enough):
                while not enough():
                    for each in next(batches).samples:
                        assert each.acc == pytest.approx((0.1, 0.2, 9.81), abs=0.01)
                        found[each.sensor] += 1

            count_until(counts[0], lambda: min(counts[0]) > 3)
            second.unplug()
            count_until([0] * 6, lambda: "disconnected" in caplog.text)
            count_until(counts[1], lambda: counts[1][0] > 3)
            with Receiver(b):
                count_until(counts[2], lambda: min(counts[2]) > 3)
            return counts, {device.line for device in source.devices.values()}, source.counters

    counts, lines, counters = with_hid_devices(follow)
    assert counts[1][3:] == [0, 0, 0]
    assert lines == {str(a), str(b)}
    assert (counters.bad, counters.unknown) == (0, 0)
    first, last = (record.getMessage() for record in caplog.records[:2])  # it goes again at the end
    assert first == f"{b}: disconnected; the run continues and waits for it"
    assert re.fullmatch(rf"{b}: back after \d+\.\d s", last)


def test_a_command_reads_it(tmp_path):
    out, path = tmp_path / "walk.csv", tmp_path / "receiver"
    command = [sys.executable, "-m", "edgepose", "record", out, "--hid", path, "--seconds", "0.2"]
    with Receiver(path, range(6)):
        done = run(command, capture_output=True, text=True, preexec_fn=take_files_for_hid_devices)
    assert done.returncode == 0, done.stderr
    assert "0 lost, 0 bad, 0 unknown" in done.stderr
    assert "nothing arrived" not in done.stderr
    head = out.read_text().splitlines()[:12]
    assert any("slimevr-hid" in line or str(path) in line for line in head)


def test_what_a_probe_finds(tmp_path):
    with Receiver(tmp_path / "receiver"):
        found = with_hid_devices(lambda: probe_receiver(str(tmp_path / "receiver")))
    assert (found.protocol, list(found.rates_hz)) == ("slimevr-hid", [0, 1, 2])


def test_what_hidapi_lists():
    fields = set(re.findall(r"- '(\w+)'", hidraw.enumerate.__doc__))
    assert fields <= LISTED.keys()
    other = {"path": b"/dev/hidraw1", "serial_number": "77", "product_string": None}
    found = receivers_among(
        [LISTED | other, LISTED, LISTED, LISTED | {"vendor_id": 1}, LISTED | {"product_id": 1}]
    )
    assert [each.name for each in found] == ["77", "A1B2C3D4E5F60718"]
    assert path_of("slimevr", found[1:]) == path_of("A1B2C3D4E5F60718", found) == "/dev/hidraw0"
    assert path_of("/dev/by-udev", found) == "/dev/by-udev"
    tracker = receivers_among([LISTED | other | {"product_id": 0x7692}])
    assert path_of("slimevr", found[1:] + tracker) == "/dev/hidraw0"
    assert path_of("77", tracker) == "/dev/hidraw1"
    twins = receivers_among([LISTED, LISTED | {"path": b"/dev/hidraw1"}])
    hostile = receivers_among([LISTED | {"serial_number": " 7\n8 ", "product_string": "A\r\n\nB"}])
    assert (hostile[0].name, hostile[0].product) == ("7 8", "A B")
    for name, among, message in (
        ("slimevr", [], "slimevr: no receiver is plugged in"),
        ("slimevr", tracker, "slimevr: no such receiver; plugged in: 77"),
        ("slimevr", found, "slimevr: 2 receivers: 77, A1B2C3D4E5F60718; name the one to read from"),
        ("/dev/\0", [], "no receiver is plugged in"),
        ("78", found, "78: no such receiver; plugged in: 77, A1B2C3D4E5F60718"),
        (
            LISTED["serial_number"],
            twins,
            "2 receivers: /dev/hidraw0, /dev/hidraw1; name the one to read from",
        ),
    ):
        with pytest.raises(DeviceError, match=message):
            path_of(name, among)


def test_receivers_that_cannot_be_opened(tmp_path):
    with pytest.raises(DeviceError, match=r"/dev/nowhere: no (such device|receiver is plugged in)"):
        open_source(hid="/dev/nowhere").__enter__()
    with pytest.raises(DeviceError, match=r"null: cannot open it as a HID device: .* no other program"):
        open_source(hid=os.devnull).__enter__()

    def open_without_permission():
        limits.mind_permissions()
        with open_source(hid=str(tmp_path / "receiver")):
            pass

    with Receiver(tmp_path / "receiver") as receiver:
        Path(receiver.port.name).chmod(0)
        with pytest.raises(DeviceError) as error:
            with_hid_devices(open_without_permission)
    assert "receiver: no permission to open it; join the group dialout" in str(error.value)
    assert str(error.value).endswith(RULE)
    assert "\n" not in str(error.value)


def test_devices_knows_the_names_of_receivers(command):
    result = command("devices", "slimevr", os.devnull)
    assert result.stdout.splitlines() == [
        "Serial ports (edgepose run --port NAME):",
        f"  {os.devnull}",
        "USB receivers (edgepose run --hid NAME):",
        "  slimevr  no receiver is plugged in",
    ]
    assert (result.returncode, result.stderr) == (1, "edgepose: cannot listen to slimevr\n")


def test_without_hidapi(monkeypatch):
    monkeypatch.setitem(sys.modules, hidapi().__name__, None)
    with pytest.raises(ConfigError, match=r"USB receivers need hidapi: .* pip install 'edgepose\[hid\]'"):
        open_source(hid="slimevr").__enter__()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"hid": "A,A"}, "--hid A,A: A is given twice"),
        ({"hid": "A", "protocol": "native"}, "protocol native is for serial lines"),
        ({"port": "a", "protocol": "slimevr-hid"}, "slimevr-hid is for USB receivers; use it with --hid"),
    ],
)
def test_names(flags, message):
    with pytest.raises(ConfigError, match=message):
        line_specs(**flags)


def test_two_wearers_share_a_receiver_by_ids(tmp_path):
    def wearer(name, first=None):
        text = f'hid = "slimevr"\ncalibration = "c.json"\ncsv = "{name}.csv"\n'
        if first is not None:
            rows = [f"{place} = {{ id = {first + i} }}\n" for i, place in enumerate(PLACEMENTS)]
            (tmp_path / f"{name}-map.toml").write_text("".join(rows))
            text += f'sensors = "{name}-map.toml"\n'
        (tmp_path / f"{name}.toml").write_text(text)
        return WearerConfig.from_toml(tmp_path / f"{name}.toml")

    check_lines([wearer("anna", 0), wearer("ben", 6)])
    for pair in ([wearer("cleo", 0), wearer("dan", 5)], [wearer("eve"), wearer("finn", 6)]):
        with pytest.raises(EdgeposeError, match="both use the receiver slimevr; give each its own, or ids"):
            check_lines(pair)
