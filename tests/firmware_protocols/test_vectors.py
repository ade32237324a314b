"""Every packet of the collected list through our decoders: captured, printed in a manual, or made elsewhere.

The list (`tests/data/protocols/vectors.json`) says what each packet holds, in the units of the wire. A packet
that nobody here reads fails, and so does a number in it.
"""

import json
import math
import struct
from math import degrees
from pathlib import Path

import pytest

from firmware_protocols import (
    bno08x,
    haritorax,
    hipnuc,
    hipnuc_can,
    j1939,
    lpms,
    mip,
    native,
    native_packet,
    rotation,
    vectornav,
    witmotion,
    ximu3,
    xsens,
    xsens_can,
)
from firmware_protocols.sample import STANDARD_G, Sample, z_up

VECTORS = json.loads((Path(__file__).parents[1] / "data/protocols/vectors.json").read_text(encoding="utf-8"))

NOT_READ = {
    ("hipnuc", "pressure"),
    ("hipnuc", "rpy_deg"),  # the quaternion says the same without an order of axes
}
"""What devices send and no decoder takes, by protocol."""


def scaled(vector, unit):
    return [0.0, 0.0, 0.0] if vector is None else [value / unit for value in vector]


def read_xsens_xbus(wire, vector):
    decoder = xsens.XbusDecoder()
    (sample,) = [*decoder.feed(wire), *decoder.flush()]
    got = {f"{item:04X}": list(values) for item, values in xsens.mtdata2_items(wire[4:-1])}
    if "1010" in got:
        got["1010"] = struct.pack(">IH6B", *got["1010"]).hex()
    # The sample has what the items have.
    for item, values in (("2010", sample.quat), ("4020", sample.acc), ("8020", sample.gyr)):
        if item in got:
            assert values == pytest.approx(got[item], rel=1e-6)
    if "1060" in got:
        assert sample.time_us == got["1060"][0] * 100
    return {
        item: values[0] if len(values) == 1 and item[0] in "13E" else values for item, values in got.items()
    }


def read_hipnuc(wire, vector):
    (sample,) = hipnuc.HipnucDecoder().feed(wire)
    got = {
        "temp": sample.temperature,
        "t_ms": sample.time_us and sample.time_us / 1000,
        "acc_g": scaled(sample.acc, STANDARD_G),
        "acc_mg": scaled(sample.acc, STANDARD_G / 1000),
        "gyr_dps": scaled(sample.gyr, math.radians(1)),
        "gyr_01dps": scaled(sample.gyr, math.radians(0.1)),
        "mag_uT": scaled(sample.mag, 1.0),
        "quat_wxyz": sample.quat,
    }
    yaw, pitch, roll = map(degrees, rotation.to_yaw_pitch_roll(sample.quat))
    got["eul_raw"] = [pitch * 100, roll * 100, yaw * 10]
    (numbered,) = hipnuc.HipnucDecoder(node_ids=True).feed(wire)
    wanted = vector["expect"].get("id_or_status", 0)
    got["id_or_status"] = wanted & 0xFF00 | numbered.sensor
    return got


def read_hipnuc_canopen(wire, vector):
    decoder, can_id = hipnuc_can.HipnucCanopenDecoder(), int(vector["expect"]["can_id"], 16)
    node = can_id & 0x7F
    frames = dict.fromkeys((0x180 + node, 0x280 + node), bytes(6)) | {can_id: wire}
    for other, data in frames.items():
        assert decoder.feed(other, data) == []
    (sample,) = decoder.feed(0x480 + node, struct.pack("<4h", 10000, 0, 0, 0))
    assert sample.sensor == node
    return {
        "can_id": vector["expect"]["can_id"],
        "acc_g": scaled(sample.acc, STANDARD_G),
        "gyr_dps": scaled(sample.gyr, math.radians(1)),
    }


def read_witmotion(wire, vector):
    # A sample needs an orientation, and goes out when the next one begins.
    kinds = [wire[at + 1] for at in range(0, len(wire), 11)]
    level = b"" if 0x53 in kinds else witmotion.encode(Sample(0, quat=(1.0, 0.0, 0.0, 0.0)), angles=True)
    sample, *_ = witmotion.WitDecoder().feed((wire + level) * 2)
    yaw, pitch, roll = rotation.to_yaw_pitch_roll(sample.quat)
    steps = {
        0x51: [value * 2048 / STANDARD_G for value in sample.acc] + [sample.temperature * 100],
        0x52: scaled(sample.gyr, math.radians(2000) / 32768),
        0x53: scaled((roll, pitch, yaw), math.pi / 32768),
        0x54: scaled(sample.mag, 1.0),
    }
    # The fourth number of a packet is read where it is the temperature of the acceleration.
    wanted = vector["expect"]["packets"]
    return {
        "packets": [
            [hex(kind), [*steps[kind], *numbers[len(steps[kind]) :]]]
            for kind, (_, numbers) in zip(kinds, wanted, strict=True)
        ]
    }


def read_bno08x_rvc(wire, vector):
    (sample,) = bno08x.Bno08xDecoder().feed(wire)
    (index,) = [i for i in range(256) if bno08x.encode(sample, i) == wire]
    angles = struct.unpack_from("<3h", bno08x.encode(sample, index), 3)
    return {"index": index, "raw": [*angles, *scaled(sample.acc, STANDARD_G / 1000)]}


def read_vectornav(wire, vector):
    (sample,) = vectornav.VectorNavDecoder().feed(wire)
    # To z-up and back is the same half turn.
    return {"ypr": [degrees(angle) for angle in rotation.to_yaw_pitch_roll(z_up(sample.quat))]}


def read_mip(wire, vector):
    (sample,) = mip.MipDecoder().feed(wire)
    got = {
        hex(kind): struct.unpack(">Q", data)[0] if kind >= 0xD0 else list(struct.unpack(">3f", data))
        for kind, data in mip.fields(wire)
    }
    assert sample.time_us == got["0xd5"] // 1000
    assert scaled(sample.acc, STANDARD_G) == pytest.approx(got["0x4"])
    assert sample.gyr == pytest.approx(got["0x5"])
    return got


def read_lpbus(wire, vector):
    decoder = lpms.LpmsDecoder()
    assert decoder.feed(wire) == []
    assert (decoder.counters.skipped, decoder.counters.bad) == (1, 0)  # good, and no measurement
    return dict(zip(("id", "cmd", "len"), struct.unpack_from("<3H", wire, 1), strict=True))


def read_ximu3(wire, vector):
    decoder = ximu3.Ximu3Decoder()
    assert decoder.feed(wire) == []
    (sample,) = decoder.flush()
    return {"id": chr(wire[0] & 0x7F), "t_us": sample.time_us, "quat_wxyz": sample.quat}


def read_haritorax(wire, vector):
    (sample,) = haritorax.HaritoraxDecoder().feed(wire + b"\n")
    w, x, y, z = (value * vector["expect"]["norm"] for value in sample.quat)
    return {
        "qxyzw_raw": [round(value) for value in (x, y, z, w)],
        "acc_raw": scaled(sample.acc, STANDARD_G / 2048),
        "norm": vector["expect"]["norm"],
    }


def read_native(wire, vector):
    (sample,) = native.NativeDecoder().feed(wire)
    body = native.cobs_decode(wire[:-1])[:-2]
    return {
        "header": list(struct.unpack_from("<BBHHI", body)),
        "quat": scaled(sample.quat, 1 / native_packet.QUAT_SCALE),
        "acc": scaled(sample.acc, 1 / native_packet.ACC_SCALE),
        "gyr": scaled(sample.gyr, 1 / native_packet.GYR_SCALE),
    }


def read_xsens_can(wire, vector):
    can_id = int(vector["expect"]["can_id"], 16)
    decoder = xsens_can.Mti600CanDecoder()
    # The first messages only show which there are.
    samples = [sample for _ in range(4) for sample in decoder.feed(can_id, wire)]
    (value,) = [v for v in (samples[0].quat, samples[0].acc, samples[0].gyr) if v is not None]
    return {"can_id": vector["expect"]["can_id"], "value": list(value)}


def read_j1939(wire, vector):
    got = j1939.tilt(vector["expect"]["pgn"] << 8 | 0x90, wire)
    return {
        "pgn": j1939.SSI2,
        "pitch": degrees(got.pitch),
        "roll": degrees(got.roll),
        "latency_ms": got.latency_s * 1000,
    }


READERS = {
    name.removeprefix("read_"): reader for name, reader in globals().items() if name.startswith("read_")
}


def assert_close(got, wanted):
    if isinstance(wanted, list):
        assert len(got) == len(wanted)
        for a, b in zip(got, wanted, strict=True):
            assert_close(a, b)
    elif isinstance(wanted, str):
        assert got == wanted
    else:
        # The list has six to ten digits.
        assert got == pytest.approx(wanted, rel=2e-5, abs=2e-6)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_vector(vector):
    protocol = vector["protocol"]
    wire = bytes.fromhex(vector["hex"]) if "hex" in vector else vector["text"].encode()
    got = READERS[protocol](wire, vector)
    for key, wanted in vector["expect"].items():
        if (protocol, key) not in NOT_READ:
            if key == "quat_wxyz":
                norm = math.hypot(*wanted)
                wanted = [value / norm for value in wanted]
            assert_close(got[key], wanted)


def test_the_list_is_whole():
    assert len(VECTORS) == 28
    assert {vector["protocol"] for vector in VECTORS} == set(READERS)
    assert all(vector["source"] for vector in VECTORS)
