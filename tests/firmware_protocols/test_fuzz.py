"""Every decoder of the registry on noise and on damaged packets: `tools/fuzz_decoders.py`, a short run."""

import random
import runpy
import sys
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import pytest

from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample

TOOLS = Path(__file__).parents[2] / "tools"
with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(TOOLS)
    TOOL = runpy.run_path(str(TOOLS / "fuzz_decoders.py"))
PACKETS = sys.modules["fuzz_packets"]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_noise_and_damage_cost_only_what_they_touch(name):
    result = TOOL["fuzz"](PROTOCOLS[name], 20_000, seed=3)
    assert result.fed >= 20_000
    assert result.good > 300
    assert result.missed == 0
    # All that a decoder may keep is a state for each id there can be.
    assert result.grown < 50_000


@pytest.mark.parametrize("name", PROTOCOLS)
def test_samples_can_be_told_apart(name):
    protocol = PROTOCOLS[name]
    sender = TOOL["Sender"](protocol)
    pieces = [piece for sample in sender.round() for piece in sample]
    numbers = [TOOL["number_of"](s) for s in TOOL["Feeder"](protocol, random.Random(1)).feed(pieces)]
    assert len(set(numbers)) == len(numbers) > TOOL["ROUND"] - TOOL["REST"]
    assert set(numbers) <= set(range(TOOL["ROUND"]))


def pieces(name):
    return TOOL["Sender"](PROTOCOLS[name]).round()


@pytest.mark.parametrize("name", PROTOCOLS)
def test_packets_with_right_checksums_give_plausible_numbers(name):
    result = PACKETS.fuzz_packets(PROTOCOLS[name], pieces(name), 2000, seed=1)
    assert result.packets >= 2000
    assert result.samples > 200
    assert result.problems == []


@pytest.mark.parametrize("name", PACKETS.FRAMINGS)
def test_packets_are_taken_apart_and_put_together(name):
    """Their contents make the same stream again, and the decoder reads it."""
    framing = PACKETS.FRAMINGS[name]
    contents = PACKETS.sources(PROTOCOLS[name], pieces(name))
    stream = b"".join(piece for sample in pieces(name) for piece in sample)
    again = b"".join(map(framing.packet, contents))
    assert again.startswith(stream)
    decoder = PROTOCOLS[name].decoder()
    assert len(decoder.feed(again)) > 200


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({}, None),
        ({"sensor": -1}, "sensor"),
        ({"time_us": -1}, "time_us"),
        ({"time_us": 1001}, "time_us"),
        ({"quat": (1.0, 0.1, 0.0, 0.0)}, "quat"),
        ({"acc": (nan, 0.0, 0.0)}, "acc"),
        ({"gyr": (2e7, 0.0, 0.0)}, "gyr"),
        ({"mag": (0.0, inf, 0.0)}, "mag"),
        ({"temperature": -inf}, "temperature"),
    ],
)
def test_samples_that_are_not_plausible(change, wrong):
    sample = Sample(1, 10, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    assert PACKETS.implausible(sample._replace(**change), 1000) == wrong


def test_what_decoders_do_wrong_is_found():
    class Raises(type(PROTOCOLS["native"].decoder())):
        def feed(self, data):
            raise KeyError("x")

    protocol = replace(PROTOCOLS["native"], decoder=Raises)
    assert "KeyError" in PACKETS.fuzz_packets(protocol, pieces("native"), 100, seed=1).problems[0]
