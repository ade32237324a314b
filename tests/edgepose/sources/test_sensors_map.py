"""The file of --sensors: what it may say, what it means, and what is told when it means nothing."""

import re
import shlex
from pathlib import Path

import click
import pytest

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sources import open_source
from edgepose.sources.line_config import line_specs
from edgepose.sources.sensor_map import default_places, read_map
from firmware_protocols.native import encode
from firmware_protocols.native_packet import Packet
from firmware_protocols.registry import PROTOCOLS

PORTS = "\n".join(f'{name} = {{ port = "/dev/ttyUSB{i}" }}' for i, name in enumerate(PLACEMENTS))
IDS = "\n".join(f"{name} = {{ id = {20 + i} }}" for i, name in enumerate(PLACEMENTS))


@pytest.fixture
def read(tmp_path):
    def read(text):
        file = tmp_path / "rig.toml"
        file.write_text(text)
        return read_map(file)

    return read


def test_a_sensor_a_port(read):
    rig = read(PORTS + '\n[ports."/dev/ttyUSB2"]\nprotocol = "witmotion"\nbaud = 115200\n')
    assert rig.lines("port") == [f"/dev/ttyUSB{i}" for i in range(6)]
    assert rig.places("/dev/ttyUSB4") == {None: 4}
    found = line_specs(None, 921600, None, None, False, "xsens", rig)
    assert [link.name for link in found] == rig.lines("port")
    assert [link.protocols[0].name for link in found] == ["xsens"] * 2 + ["witmotion"] + ["xsens"] * 3
    assert ["now 115200" in link.check[1] for link in found] == [i == 2 for i in range(6)]


def test_ids_on_any_line(read):
    rig = read(IDS)
    assert rig.lines("port") == []
    assert rig.places("COM3") == rig.places("virtual:x") == {20 + i: i for i in range(6)}


def test_two_hubs_and_a_bus(read):
    rows = [
        'left_forearm = { port = "a", id = 0 }',
        'right_forearm = { port = "a", id = 1 }',
        'left_lower_leg = { port = "b", id = 0 }',
        'right_lower_leg = { port = "b", id = 1 }',
        'head = { can = "virtual:x", id = 0, mounting = "x left, z up" }',
        'pelvis = { can = "x", id = 1, mounting = "x up, z back" }',
        '[ports."virtual:x"]',
        'protocol = "native-can"',
        "baud = 1000000",
    ]
    rig = read("\n".join(rows))
    assert rig.places("a") == {0: 0, 1: 1}
    assert rig.places("b") == {0: 2, 1: 3}
    assert rig.places("virtual:x") == rig.places("x") == {0: 4, 1: 5}
    found = line_specs("a,b", None, "virtual:x", None, False, "auto", rig)
    assert [(link.name, link.unit) for link in found] == [
        ("a", "bytes"),
        ("b", "bytes"),
        ("virtual:x", "frames"),
    ]
    assert "--bitrate (now 1000000)" in found[2].check[0]
    assert [protocol.name for protocol in found[2].protocols] == ["native-can"]
    given = "--port, --can, --listen, --connect, --ble or --hid: a, virtual:x"
    with pytest.raises(EdgeposeError, match=f"left_lower_leg: b is not one of the lines given with {given}"):
        line_specs("a", None, "virtual:x", None, False, "auto", rig)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("head = ", r"rig\.toml: not valid TOML: Invalid value"),
        (PORTS + '\nhead = { port = "x" }', r"rig\.toml: head is defined twice"),
        ("[head]\nid = 1\n[pelvis]\nid = 2\n[head]\nid = 3", r"rig\.toml: head is defined twice"),
        (PORTS.replace("head", "hat"), r"rig\.toml: unknown placement 'hat'; placements are left_forearm, "),
        (PORTS.replace("pelvis", "#"), r"rig\.toml: no entry for pelvis, without which"),
        (PORTS.replace("USB3", "USB2"), "right_lower_leg and left_lower_leg are the same device"),
        (IDS.replace("23", "20"), "right_lower_leg and left_forearm are the same device"),
        (PORTS.replace('port = "/dev/ttyUSB1"', 'port = "/dev/ttyUSB0", id = 3'), "are the same device"),
        (PORTS.replace('port = "/dev/ttyUSB1"', 'prot = "x"'), "unknown key 'prot'; did you mean 'port'"),
        (PORTS.replace('{ port = "/dev/ttyUSB1" }', "1"), "right_forearm: must be a table"),
        (PORTS.replace('port = "/dev/ttyUSB1"', ""), "right_forearm: no device named; give its port"),
        (PORTS.replace('"/dev/ttyUSB1"', "1"), "right_forearm: port must be text in quotes, not 1"),
        (IDS.replace("21", '"21"'), "right_forearm: id must be a whole number, not '21'"),
        (IDS.replace("21", "true"), "right_forearm: id must be a whole number, not True"),
        (IDS.replace("21", "-1"), "right_forearm: id must be 0 or more"),
        (IDS.replace("21", '21, port = "a", can = "b"'), "right_forearm: give port or can, not both"),
        (IDS.replace("21", '21, mounting = "upside down"'), 'mounting must be .*"x up, z back"'),
        (IDS.replace("21", '21, mounting = "x up, z down"'), "right_forearm: mounting must be"),
        ("ports = 1\n" + IDS, "ports must be tables"),
        (IDS + "\n[ports.a]\nspeed = 1", r"ports\.a: unknown key 'speed'; keys are protocol, baud"),
        (IDS + "\n[ports.a]\nbaud = 0", r"ports\.a: baud must be 1 or more"),
        (PORTS.replace("/dev/ttyUSB1", ""), "right_forearm: port is empty: give a value, or leave it out"),
        (PORTS.replace("USB1", "\\u0000"), "right_forearm: port must be text without NUL characters"),
        (IDS + "\n[ports.a]\nprotocol = 7", r"ports\.a: protocol must be text"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_one_line(read, text, says):
    with pytest.raises(EdgeposeError) as info:
        read(text)
    assert re.search(says, str(info.value))
    assert "rig.toml" in str(info.value)
    assert "\n" not in str(info.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(EdgeposeError, match=r"none\.toml: cannot read it: No such file"):
        open_source(sensors=tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b'head = "\xe4"')
    with pytest.raises(EdgeposeError, match="not valid TOML"):
        open_source(sensors=tmp_path / "latin.toml")


def test_settings_of_a_line_that_is_not_there(read):
    rig = read(PORTS + "\n[ports.COM9]\nbaud = 9600\n")
    with pytest.raises(EdgeposeError, match=r"rig\.toml: ports\.COM9: no such line, only /dev/ttyUSB0"):
        line_specs(None, None, None, None, False, "auto", rig)


def test_an_unknown_protocol_of_a_port(read):
    rig = read(PORTS + '\n[ports."/dev/ttyUSB2"]\nprotocol = "nonsense"\n')
    with pytest.raises(EdgeposeError, match="unknown protocol 'nonsense'"):
        line_specs(None, None, None, None, False, "auto", rig)


# --- the page about it --------------------------------------------------------------------------------------

PAGE = (Path(__file__).parents[3] / "docs" / "guide" / "sensors.md").read_text()


MAPS = [text for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) if "calibration" not in text]


@pytest.mark.parametrize("text", MAPS)
def test_examples_of_maps_are_maps(read, text):
    rig = read(text)
    assert set(rig.devices) >= set(PLACEMENTS)
    for settings in rig.ports.values():
        assert settings.protocol in PROTOCOLS


@pytest.mark.parametrize("line", re.findall(r"^edgepose .*$", PAGE, re.MULTILINE))
def test_examples_of_commands_are_commands(line):
    _, name, *words = shlex.split(line)
    command = cli.get_command(click.Context(cli), name)
    assert command.make_context(name, words).params


# --- without a map ------------------------------------------------------------------------------------------


def test_what_is_assumed_without_a_map():
    native, canopen, wit, xsens = (PROTOCOLS[n] for n in ("native", "hipnuc-canopen", "witmotion", "xsens"))
    for count in (1, 2, 6):
        assert default_places("a", native, 0, count) == {i: i for i in range(6)}
    assert default_places("can", canopen, 0, 1) == {i + 1: i for i in range(6)}
    assert default_places("f", wit, 5, 6) == {None: 5}
    assert default_places("f", xsens, 2, 6) == {None: 2}
    assert default_places("f", xsens, 0, 1) == {i + 1: i for i in range(6)}  # behind a master
    with pytest.raises(EdgeposeError) as info:
        default_places("/dev/ttyUSB3", wit, 3, 5)
    first, second = str(info.value).splitlines()
    assert "give six ports in the order left_forearm, " in first
    assert second.endswith('left_forearm = { port = "/dev/ttyUSB3" }')


# --- with samples -------------------------------------------------------------------------------------------


def capture(path, ids):
    packets = [
        Packet(s, i, 10_000 * i, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81)) for i in range(30) for s in ids
    ]
    path.write_bytes(b"".join(map(encode, packets)))
    return path


def test_a_capture_with_ids_of_its_own(read, tmp_path):
    rig = read(IDS)
    file = capture(tmp_path / "a.bin", [25, 24, 23, 22, 21, 20, 7])
    with open_source(file=file, sensors=rig.path) as source:
        got = [sample.sensor for _, samples, *_ in source for sample in samples]
    assert got == [5, 4, 3, 2, 1, 0] * 30
    assert source.counters.unknown == 30
    with open_source(file=file) as source, pytest.raises(EdgeposeError, match="from sensor ids 7, 20, 21"):
        list(source)


def test_a_capture_does_not_say_of_which_port_it_is(read, tmp_path):
    rig = read(PORTS)
    with (
        open_source(file=capture(tmp_path / "a.bin", [0]), sensors=rig.path) as source,
        pytest.raises(EdgeposeError, match="distinguishes sensors by port"),
    ):
        list(source)


def test_calibrate_compares_how_sensors_are_worn(command, wearer, tmp_path):
    """What it prints first is what the map says next, but for one sensor."""
    out = tmp_path / "calibration.json"
    flags = ("calibrate", "--file", wearer.recording, "--body-frame", "heading:0", "--from", 1, "--out", out)
    result = command(*flags)
    assert result.returncode == 0, result.stderr
    sits = dict(re.findall(r"^(\w+) .*(x \w+, z \w+)$", result.stdout, re.MULTILINE))
    assert set(sits) == set(PLACEMENTS)
    sits["head"] = "x up, z left" if sits["head"] != "x up, z left" else "x down, z left"
    rig = tmp_path / "rig.toml"
    rig.write_text("\n".join(f'{n} = {{ port = "{n}", mounting = "{text}" }}' for n, text in sits.items()))
    result = command(*flags, "--overwrite", "--sensors", rig)
    assert result.returncode == 0, result.stderr
    warnings = [line for line in result.stderr.splitlines() if "rig.toml" in line]
    assert len(warnings) == 1
    assert warnings[0].startswith("warning: head is mounted x ")
    assert f"{rig} says {sits['head']}" in warnings[0]
