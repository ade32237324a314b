"""Slope Sensor Information 2: a captured message, numbers that are none, and the way back."""

from math import radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocols.j1939 import Tilt, encode, tilt

CAPTURE = bytes.fromhex("3be87df5bf7c0006")
CAN_ID = 0x0CF02990  # of another message in the same log


def test_capture():
    got = tilt(CAN_ID, CAPTURE)
    assert got.source == 0x90
    assert got.pitch == pytest.approx(radians(1.8143), abs=1e-6)
    assert got.roll == pytest.approx(radians(-0.50034), abs=1e-6)
    assert got.latency_s == pytest.approx(0.003)


def test_numbers_that_mean_something_else():
    assert tilt(CAN_ID, bytes.fromhex("fffffffffafe00ff")) == Tilt(0x90, None, None, None)
    assert tilt(CAN_ID, bytes.fromhex("0000fb0000fa00fb")) == Tilt(
        0x90, None, pytest.approx(radians(0xFA0000 / 32768 - 250)), None
    )


@pytest.mark.parametrize(
    ("can_id", "data", "extended"),
    [
        (0x0CF02D90, CAPTURE, True),
        (CAN_ID, CAPTURE, False),
        (CAN_ID, CAPTURE[:7], True),
        (CAN_ID | 0xFF, CAPTURE, True),
    ],
)
def test_other_frames(can_id, data, extended):
    assert tilt(can_id, data, extended) is None


@given(st.integers(0, (1 << 29) - 1) | st.just(CAN_ID), st.binary(max_size=64), st.booleans())
def test_nothing_raises(can_id, data, extended):
    tilt(can_id, data, extended)


@given(st.floats(-4.3, 4.3) | st.none(), st.floats(-4.3, 4.3) | st.none(), st.integers(0, 253))
def test_round_trip(pitch, roll, source):
    can_id, data = encode(Tilt(source, pitch, roll, 0.004))
    got = tilt(can_id, data)
    assert (got.source, got.latency_s) == (source, pytest.approx(0.004))
    for a, b in ((got.pitch, pitch), (got.roll, roll)):
        assert a is b is None or a == pytest.approx(b, abs=radians(1 / 32768))


def test_what_cannot_be_sent():
    with pytest.raises(ValueError, match="angle must be"):
        encode(Tilt(1, 5.0, 0.0, None))
    with pytest.raises(ValueError, match="cannot send"):
        encode(Tilt(254, 0.0, 0.0, None))
    assert encode(Tilt(1, None, None, None))[1] == b"\xff" * 8
