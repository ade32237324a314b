"""The DBC files say the same as the decoders."""

import random
import sys
from pathlib import Path

import cantools
import pytest

import firmware_protocols
from firmware_protocols.native_can import NativeCanDecoder, encode, encode_sync
from firmware_protocols.native_packet import Packet
from firmware_protocols.sample import unit_quaternion
from tests.support import processes

FOLDER = Path(firmware_protocols.__file__).parent / "dbc"
SCRIPT = Path(__file__).parents[2] / "tools" / "make_dbc.py"


@pytest.fixture(scope="module")
def native():
    return cantools.database.load_file(FOLDER / "native.dbc")


@pytest.fixture(scope="module")
def mti600():
    return cantools.database.load_file(FOLDER / "mti600.dbc")


def test_files_are_in_step_with_the_script(tmp_path):
    processes.run([sys.executable, str(SCRIPT), str(tmp_path)], check=True)
    assert sorted(p.name for p in FOLDER.iterdir()) == ["mti600.dbc", "native.dbc"]
    for path in FOLDER.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), f"run tools/make_dbc.py: {path.name}"


def values(message, name, axes="xyz"):
    return tuple(message[f"{name}_{axis}"] for axis in axes)


def test_native_frames(native):
    rng = random.Random(11)
    decoder = NativeCanDecoder()
    assert len(native.messages) == 129
    for sensor in range(32):
        quat = unit_quaternion(*(x / 2 for x in rng.choice([(1, -1, 1, 1), (2, 0, 0, 0), (0, 1.2, 1.6, 0)])))
        acc, gyr, mag = (tuple(rng.uniform(-30, 30) for _ in range(3)) for _ in range(3))
        frames = encode(Packet(sensor, 0, rng.randrange(2**32), quat, acc, gyr, mag))
        (sample,) = [s for frame in frames for s in decoder.feed(*frame)]
        seen = {}
        for can_id, data in frames:
            message = native.get_message_by_frame_id(can_id)
            name, number = message.name.split("_")
            assert int(number) == sensor
            seen[name] = message.decode(data)
        assert unit_quaternion(*values(seen["QUAT"], "quat", "wxyz")) == pytest.approx(sample.quat, abs=1e-12)
        for name in ("acc", "gyr", "mag"):
            assert values(seen[name.upper()], name) == pytest.approx(getattr(sample, name), abs=1e-12)
            assert seen[name.upper()]["time"] == sample.time_us


def test_native_sync(native):
    can_id, data = encode_sync(3_000_000_000)
    assert native.decode_message(can_id, data) == {"time": 3_000_000_000}


def test_mti600_scales(mti600):
    quat = mti600.decode_message(0x021, bytes.fromhex("7FFF000000000000"))
    assert values(quat, "quat", "wxyz") == (1.0, 0.0, 0.0, 0.0)
    assert values(mti600.decode_message(0x032, bytes.fromhex("020000000000")), "gyr") == (1.0, 0.0, 0.0)
    assert mti600.decode_message(0x034, bytes.fromhex("0000000009CF"))["acc_z"] == 9.80859375
    assert mti600.decode_message(0x052, bytes.fromhex("C5E68000")) == {"pressure": 101325.0}
    assert mti600.decode_message(0x031, bytes.fromhex("0001FFFF00020A"))["dv_exponent"] == 10
