import subprocess
import sys

import pytest

from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample

NO_TIME = {
    *("hipnuc-canopen", "hipnuc-j1939", "witmotion-modbus", "witmotion-can", "bno08x-rvc"),
    *("vectornav-ascii", "haritorax", "adafruit", "razor"),
}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_is_encoded_is_decoded(name):
    protocol = PROTOCOLS[name]
    decoder, encode = protocol.decoder(), protocol.encoder()
    sensors = [0] if protocol.alone and name != "mavlink" else list(protocol.ids)
    got = []
    for seq in range(20):
        for sensor in sensors:
            wire = encode(
                Sample(
                    sensor,
                    1_000_000 + 10_000 * seq,
                    (0.6, 0.0, 0.8, 0.0),
                    (0.1, 0.2, 9.81),
                    (0.1, 0.2, 0.3),
                    (10.0, 20.0, 30.0),
                    25.0,
                ),
                seq,
            )
            if protocol.transport == "bytes":
                got += decoder.feed(wire)
            else:
                for can_id, data, extended, fd in wire:
                    assert not fd
                    got += decoder.feed(can_id, data, extended)
    assert len(got) >= 20 * len(sensors) - len(sensors)
    assert {sample.sensor for sample in got} == set(sensors)
    assert {sample.time_us is None for sample in got} == {name in NO_TIME}
    assert decoder.counters.bad == decoder.counters.lost == 0
    assert decoder.counters.packets == len(got)
    assert protocol.wrap_us > 1_000_000


def test_names_ids_and_words():
    for name, protocol in PROTOCOLS.items():
        assert name == protocol.name
        assert name == name.lower()
        assert "\n" not in protocol.text
        assert len(set(protocol.ids)) == len(protocol.ids) in (0, 6)
        assert protocol.ids or protocol.alone


def test_families_are_imported_only_when_used():
    script = "import sys, firmware_protocols.registry; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert {m for m in result.stdout.split() if m.startswith("firmware_protocols.")} == {
        "firmware_protocols.registry",
        "firmware_protocols.sample",
    }
