"""The example firmware compiles, and what it sends is read by the decoders."""

import subprocess
from itertools import pairwise
from pathlib import Path

import pytest

import firmware_protocols
from firmware_protocols.native import NativeDecoder
from firmware_protocols.native_can import NativeCanDecoder
from firmware_protocols.native_packet import Info

EXAMPLES = Path(firmware_protocols.__file__).parent / "examples"
ARDUINO = Path(__file__).parent / "arduino"
BONES = (18, 19, 4, 5, 15, 0)


def up(quat, acc):
    """Specific force in the inertial frame."""
    w, x, y, z = quat
    ax, ay, az = acc
    return (
        (1 - 2 * (y * y + z * z)) * ax + 2 * (x * y - w * z) * ay + 2 * (x * z + w * y) * az,
        2 * (x * y + w * z) * ax + (1 - 2 * (x * x + z * z)) * ay + 2 * (y * z - w * x) * az,
        2 * (x * z - w * y) * ax + 2 * (y * z + w * x) * ay + (1 - 2 * (x * x + y * y)) * az,
    )


def good(samples, counters, sensors, count):
    assert {s.sensor for s in samples} == set(sensors)
    for sensor in sensors:
        times = [s.time_us for s in samples if s.sensor == sensor]
        assert len(times) == pytest.approx(count, abs=2)
    for s in samples:
        assert up(s.quat, s.acc) == pytest.approx((0.0, 0.0, 9.81), abs=0.01)
    assert (counters.bad, counters.lost, counters.late, counters.restarts) == (0, 0, 0, 0)


# --- C ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def send_packets(cc, tmp_path_factory):
    return cc(
        tmp_path_factory.mktemp("c") / "send_packets", "-std=c99", "-O2", EXAMPLES / "c" / "send_packets.c"
    )


def test_c_example(send_packets):
    done = subprocess.run([send_packets, "300"], capture_output=True, check=True)
    decoder = NativeDecoder()
    samples = decoder.feed(done.stdout)
    good(samples, decoder.counters, range(6), 300)
    assert all(b.time_us - a.time_us == 10_000 for a, b in pairwise(samples[::6]))
    assert len({s.quat for s in samples}) == 6
    assert decoder.infos == {
        i: Info(i, "send_packets 1", bone, "Z-up", 100.0) for i, bone in enumerate(BONES)
    }
    assert decoder.counters.skipped == 12


def test_c_example_on_a_device(send_packets, tmp_path):
    device = tmp_path / "device"
    subprocess.run([send_packets, "5", device], check=True)
    assert device.read_bytes() == subprocess.run([send_packets, "5"], capture_output=True).stdout
    for arguments in ([], ["0"], ["5", tmp_path / "none" / "device"]):
        done = subprocess.run([send_packets, *arguments], capture_output=True, text=True)
        assert done.returncode != 0
        assert done.stderr


# --- Arduino ----------------------------------------------------------------------------------------


@pytest.fixture
def run_sketch(cxx, tmp_path):
    def run(**defines):
        options = [f"-D{name}={value}" for name, value in defines.items()]
        sketch = EXAMPLES / "arduino" / "edgepose_sketch" / "edgepose_sketch.ino"
        program = cxx(
            tmp_path / "sketch",
            *("-std=c++11", "-I", ARDUINO, *options, "-x", "c++", sketch, ARDUINO / "run_sketch.cpp"),
        )
        return subprocess.run([program, "5"], capture_output=True, check=True).stdout

    return run


def test_sketch_with_made_up_data(run_sketch):
    decoder = NativeDecoder()
    samples = decoder.feed(run_sketch(SENSOR_COUNT=6))
    good(samples, decoder.counters, range(6), 500)
    firmware = "edgepose_sketch 1 made-up data"
    assert decoder.infos == {i: Info(i, firmware, bone, "unknown", 100.0) for i, bone in enumerate(BONES)}
    assert decoder.counters.skipped == 18


def test_sketch_with_bno085(run_sketch):
    decoder = NativeDecoder()
    samples = decoder.feed(run_sketch(SENSOR="SENSOR_BNO085", FIRST_ID=3))
    good(samples, decoder.counters, [3], 500)
    assert samples[-1].quat == (0.0, 1.0, 0.0, 0.0)
    assert samples[-1].gyr == (0.5, 0.0, -0.5)
    assert decoder.infos == {3: Info(3, "edgepose_sketch 1 BNO085", 5, "Z-up", 100.0)}


def test_sketch_on_a_can_bus(run_sketch):
    decoder = NativeCanDecoder()
    samples = []
    for line in run_sketch(LINK="LINK_ESP32_CAN", SENSOR_COUNT=2, FIRST_ID=4).decode().splitlines():
        can_id, data = line.split(":")
        samples += decoder.feed(int(can_id, 16), bytes.fromhex(data))
    good(samples, decoder.counters, [4, 5], 500)
    steps = [(b.time_us - a.time_us) % decoder.WRAP_US for a, b in pairwise(samples[::2])]
    assert set(steps) == {10_000}


def test_sketch_over_wifi(run_sketch):
    decoder = NativeDecoder()
    samples = []
    for line in run_sketch(LINK="LINK_ESP32_WIFI", FIRST_ID=2).decode().splitlines():
        address, data = line.split(" ")
        assert address == "192.168.1.10:9000"
        found = decoder.feed_datagram(bytes.fromhex(data))
        assert len(found) <= 1  # one packet a datagram
        samples += found
    good(samples, decoder.counters, [2], 500)
    assert decoder.infos[2].firmware == "edgepose_sketch 1 made-up data"
