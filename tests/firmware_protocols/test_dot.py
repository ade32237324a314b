"""Movella DOT: notifications by hand, after the layout, and one that a public program shows."""

import math
import struct

import pytest

from firmware_protocols.dot import DotDecoder, encode
from firmware_protocols.sample import STANDARD_G, Sample

HALF = math.sqrt(0.5)
TURNED = (HALF, 0.0, HALF, 0.0)
"""X of the sensor points down."""

FREE_ACCELERATION = bytes.fromhex("d8052244af964040 6b2aa740 5add14c0 00000000".replace(" ", ""))
"""Payload 6, padded to 20 bytes, as printed by protobioengineering/xsens-dot-python-examples."""


@pytest.mark.parametrize("padding", [0, 19])
def test_custom_mode_5(padding):
    data = struct.pack("<I4f3f3f", 123456, *TURNED, -9.8, 0.1, 0.2, 90.0, 0.0, -180.0) + bytes(padding)
    (sample,) = DotDecoder().feed(data)
    assert sample.time_us == 123456
    assert sample.quat == pytest.approx(TURNED)
    assert sample.acc == pytest.approx((-9.8, 0.1, 0.2), abs=1e-6)
    assert sample.gyr == pytest.approx((math.pi / 2, 0.0, -math.pi), abs=1e-6)


@pytest.mark.parametrize("rest", [b"", bytes(4), bytes(8)])
def test_free_acceleration_is_in_the_inertial_frame(rest):
    """At rest it is zero, and gravity is on the axis that points up."""
    data = struct.pack("<I4f3f", 5, *TURNED, 0.0, 2.0, 0.0) + rest
    (sample,) = DotDecoder().feed(data)
    assert sample.acc == pytest.approx((-STANDARD_G, 2.0, 0.0), abs=1e-5)
    assert sample.gyr is None


def test_a_quaternion_alone():
    (sample,) = DotDecoder().feed(struct.pack("<I4f", 7, *TURNED))
    assert sample == Sample(0, 7, sample.quat)


def test_a_payload_without_quaternion_is_named():
    decoder = DotDecoder()
    assert decoder.feed(FREE_ACCELERATION) == []
    assert decoder.counters.bad == 1
    assert "choose Custom Mode 5" in decoder.refused
    decoder.feed(encode(Sample(0, 0, TURNED)))
    assert decoder.refused is None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_numbers_that_cannot_be(value):
    decoder = DotDecoder()
    assert decoder.feed(struct.pack("<I4f6f", 0, *TURNED, value, 0, 0, 0, 0, 0)) == []
    assert decoder.feed(struct.pack("<I4f6f", 0, *TURNED, 0, 0, 0, 0, value, 0)) == []
    assert decoder.feed(struct.pack("<I4f", 0, value, 0, 0, 0)) == []
    assert decoder.counters.bad == 3
