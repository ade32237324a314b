"""A sensor at rest, in any orientation and any wire format, reads 9.81 m/s^2 straight up."""

from itertools import product
from math import hypot

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.rotation import rotate, rotate_back
from firmware_protocols.sample import Sample

UP = (0.0, 0.0, 9.81)
ONLY_PART = [name for name, protocol in PROTOCOLS.items() if {"quat", "acc"} & set(protocol.lacks)]
"""Formats with either orientation or force."""

quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: hypot(*q) > 0.1)
    .map(lambda q: tuple(x / hypot(*q) for x in q))
    # Upright in every way: where angles have no heading.
    | st.sampled_from(list(product((0.5, -0.5), repeat=4)))
)


def sent_and_read(name, quat):
    """What comes out of a few samples of a sensor at rest."""
    protocol = PROTOCOLS[name]
    decoder, encode = protocol.decoder(), protocol.encoder()
    sensor = 0 if protocol.single_device else protocol.ids[0]
    still = Sample(sensor, None, quat, rotate_back(quat, UP), (0.0, 0.0, 0.0), (20.0, 0.0, -40.0), 25.0)
    samples = []
    # Some decoders have to see first what a sensor sends.
    for seq in range(5):
        wire = encode(still._replace(time_us=1_000_000 + 10_000 * seq), seq)
        if protocol.transport != "can":
            samples += decoder.feed(wire)
        else:
            for can_id, data, extended, _ in wire:
                samples += decoder.feed(can_id, data, extended)
    assert len(samples) >= 3
    return samples


@pytest.mark.parametrize("name", [name for name in PROTOCOLS if name not in ONLY_PART])
def test_still(name):
    # 16 bit steps of 1 mg and of 1e-4 of a quaternion. Without its w, five digits of the rest say little of a
    # small w.
    tolerance = 0.1 if name == "openlog-dmp" else 0.02

    @given(quaternions)
    @settings(max_examples=60, deadline=None)
    def check(quat):
        for sample in sent_and_read(name, quat):
            assert rotate(sample.quat, sample.acc) == pytest.approx(UP, abs=tolerance)
            assert abs(sum(a * b for a, b in zip(quat, sample.quat, strict=True))) > 1 - 1e-5

    check()


@pytest.mark.parametrize("name", ONLY_PART)
def test_formats_with_a_part_only(name):
    for sample in sent_and_read(name, (0.5, 0.5, -0.5, 0.5)):
        lacks = PROTOCOLS[name].lacks
        assert (sample.quat is None, sample.acc is None) == ("quat" in lacks, "acc" in lacks)
