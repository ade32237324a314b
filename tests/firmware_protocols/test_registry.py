import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_protocols import registry
from firmware_protocols.base import Decoder, Protocol
from firmware_protocols.registry import PROTOCOLS, protocol_names
from firmware_protocols.sample import Sample


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_is_encoded_is_decoded(name):
    protocol = PROTOCOLS[name]
    decoder, encode = protocol.decoder(), protocol.encoder()
    sensors = [0] if protocol.single_device and name != "mavlink" else list(protocol.ids)
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
            if protocol.transport != "can":
                got += decoder.feed(wire)
            else:
                for can_id, data, extended, fd in wire:
                    assert not fd
                    got += decoder.feed(can_id, data, extended)
    assert len(got) >= 20 * len(sensors) - len(sensors)
    assert {sample.sensor for sample in got} == set(sensors)
    assert {sample.time_us is None for sample in got} == {"time" in protocol.lacks}
    assert decoder.counters.bad == decoder.counters.lost == 0
    assert decoder.counters.packets == len(got)
    assert protocol.wrap_us > 1_000_000


def test_names_ids_and_words():
    for name, protocol in PROTOCOLS.items():
        assert name == protocol.name
        assert name == name.lower()
        assert "\n" not in protocol.description
        assert len(set(protocol.ids)) == len(protocol.ids) in (0, 6)
        assert protocol.ids or protocol.single_device


def test_families_are_imported_only_when_used():
    script = "import sys, firmware_protocols.registry; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert {m for m in result.stdout.split() if m.startswith("firmware_protocols.")} == {
        "firmware_protocols.base",
        "firmware_protocols.registry",
        "firmware_protocols.sample",
    }


def test_each_line_of_the_table_names_a_protocol_of_that_name():
    names = list(PROTOCOLS)
    assert len(names) == len(PROTOCOLS) == len(set(names))
    assert [PROTOCOLS[name].name for name in names] == names
    assert "native" in PROTOCOLS
    assert "unheard-of" not in PROTOCOLS
    with pytest.raises(KeyError):
        PROTOCOLS["unheard-of"]


def test_decoders_hold_nothing_back_and_know_no_devices_at_first():
    for name, protocol in PROTOCOLS.items():
        if name != "mavlink":  # needs a package of its own
            decoder = protocol.decoder()
            assert isinstance(decoder, Decoder)
            assert decoder.flush() == []
            assert decoder.infos == {}


BOOTS = """
import struct

from firmware_protocols.base import Decoder, Protocol, uncounted
from firmware_protocols.sample import Counters, Sample


class BootsDecoder(Decoder):
    WRAP_US = 1 << 16

    def __init__(self):
        self.counters = Counters()

    def feed(self, data):
        self.counters.packets += 1
        time_us, *acc = struct.unpack("<H3f", data)
        return [Sample(0, time_us, acc=tuple(acc))]


def encode(sample):
    return struct.pack("<H3f", sample.time_us, *sample.acc)


PROTOCOL = Protocol(
    name="boots",
    transport="bytes",
    default_bitrate=9600,
    description="sensors in boots",
    decoder=BootsDecoder,
    encoder=uncounted(encode),
    single_device=True,
)
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a distribution with these entry points, as pip would, and one module, `boots_protocol`."""

    def install(entry_points):
        (tmp_path / "boots_protocol.py").write_text(BOOTS)
        info = tmp_path / "boots-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: boots\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[edgepose.protocols]\n" + "\n".join(entry_points) + "\n")
        monkeypatch.syspath_prepend(tmp_path)
        registry._installed.cache_clear()

    yield install
    sys.modules.pop("boots_protocol", None)
    registry._installed.cache_clear()


def test_other_packages_add_protocols(install, caplog):
    built_in = list(PROTOCOLS)
    install(["boots = boots_protocol:PROTOCOL"])
    assert list(PROTOCOLS) == [*built_in, "boots"]
    assert len(PROTOCOLS) == len(built_in) + 1
    assert "boots" in PROTOCOLS
    protocol = PROTOCOLS["boots"]
    assert isinstance(protocol, Protocol)
    sample = Sample(0, 1000, acc=(0.0, 0.0, 9.5))
    assert protocol.decoder().feed(protocol.encode(sample, 0)) == [sample]
    assert not caplog.records


def test_a_protocol_of_another_package_that_cannot_be_used_costs_only_itself(install, caplog):
    built_in = dict(PROTOCOLS)
    install(
        [
            "boots = boots_protocol:PROTOCOL",
            "native = boots_protocol:PROTOCOL",
            "hats = no_such_module:PROTOCOL",
            "gloves = boots_protocol:GLOVES",
            "socks = boots_protocol:encode",
            "shoes = boots_protocol:PROTOCOL",
        ]
    )
    with caplog.at_level(logging.WARNING):
        assert list(PROTOCOLS) == [*built_in, "boots"]
    assert PROTOCOLS["native"] is built_in["native"]
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 5
    for name, why in {
        "native": "the name is taken",
        "hats": "No module named 'no_such_module'",
        "gloves": "GLOVES",
        "socks": "is not a Protocol of that name",
        "shoes": "is not a Protocol of that name",
    }.items():
        (line,) = [line for line in caplog.messages if line.startswith(f"protocol {name!r} of boots ")]
        assert why in line


def printed_by(script: str) -> str:
    """Output of a new Python that sees the packages of this one."""
    return subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    ).stdout


def test_protocols_of_other_packages_are_loaded_only_when_asked_for(install):
    install(["boots = boots_protocol:PROTOCOL"])
    script = (
        "import sys; from firmware_protocols.registry import PROTOCOLS; PROTOCOLS['native']\n"
        "print('boots_protocol' in sys.modules, PROTOCOLS['boots'].description)"
    )
    assert printed_by(script) == "False sensors in boots\n"


def test_the_help_names_formats_of_other_packages_without_importing_them(install):
    install(["boots = boots_protocol:PROTOCOL"])
    script = (
        "import sys; from click.testing import CliRunner; from edgepose.cli import cli\n"
        "text = CliRunner().invoke(cli, ['check', '--help']).output\n"
        "print('boots' in text, 'boots_protocol' in sys.modules)"
    )
    assert printed_by(script) == "True False\n"


def test_protocols_that_the_documentation_names():
    """A name behind --protocol, or in the column of that name, is one that the command line knows."""
    root = Path(__file__).parents[2]
    pages = [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "firmware_protocols").rglob("*.md")]
    named = set()
    for page in pages:
        text = page.read_text(encoding="utf-8")
        found = re.findall(r"--protocol[ =]([a-z][\w./-]*)|^protocol = \"(.*?)\"", text, re.MULTILINE)
        named |= {one or other for one, other in found}
        for head, *rows in _tables(text):
            if "`--protocol`" in head:
                cells = [row[head.index("`--protocol`")] for row in rows[1:]]
                named |= {name for cell in cells for name in re.findall("`([^`]+)`", cell)}
    named = {name for name in named if not name.endswith(".toml")}
    assert {"xsens", "openlog-dmp", "auto"} <= named
    assert named <= {*protocol_names(), "auto"}


def _tables(text):
    """The tables of a page, as rows of cells."""
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        yield [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
