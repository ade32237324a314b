"""Every decoder of the registry on noise and on damaged packets: `tools/fuzz_decoders.py`, a short run."""

import random
import runpy
from pathlib import Path

import pytest

from firmware_protocols.registry import PROTOCOLS

TOOL = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "fuzz_decoders.py"))


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
    numbers = [
        TOOL["number_of"](s) for s in TOOL["Feeder"](protocol.decoder(), random.Random(1)).feed(pieces)
    ]
    assert len(set(numbers)) == len(numbers) > TOOL["ROUND"] - TOOL["REST"]
    assert set(numbers) <= set(range(TOOL["ROUND"]))
