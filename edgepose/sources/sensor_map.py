"""Sensor maps: the file that assigns devices to placements (`--sensors`), and the default assignment."""

from __future__ import annotations

import re
from collections.abc import Mapping
from ipaddress import ip_address
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from edgepose.errors import ConfigError
from edgepose.placements import PLACEMENTS, ROOT, SENSORS
from edgepose.sources import LINES
from edgepose.sources.line_decoder import PlacementById
from edgepose.utils.similar_names import choices
from edgepose.utils.text_files import read_toml
from edgepose.utils.toml_values import TEXT, WHOLE, checked_value
from firmware_protocols.registry import Protocol

_DIRECTION = "(left|right|up|down|forward|back)"
_MOUNTING = re.compile(f"x {_DIRECTION}, z {_DIRECTION}")
_MAC = re.compile("[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}")
_AXIS = {"left": 0, "right": 0, "up": 1, "down": 1, "forward": 2, "back": 2}


class Device(NamedTuple):
    """The device of a placement.

    Attributes:
        port: its serial port; None for any line.
        can: its bus, INTERFACE:CHANNEL or the channel alone; None for any line.
        listen: the address at which its datagrams arrive, HOST:PORT; None for any line.
        connect: its address for TCP, HOST:PORT; None for any line.
        ble: its Bluetooth address; None for any line.
        hid: its USB receiver, by serial number or path, or "slimevr"; None for any line.
        sender: IP address from which its datagrams come, or the MAC address that they state; None for any.
        id: its id on the line; None if it is the only device there.
        mounting: orientation in which it is worn, in the format of `edgepose calibrate`.
    """

    port: str | None = None
    can: str | None = None
    listen: str | None = None
    connect: str | None = None
    ble: str | None = None
    hid: str | None = None
    sender: str | None = None
    id: int | None = None
    mounting: str | None = None

    @property
    def name(self) -> str | None:
        """The line as the file names it; None for any."""
        return self.port or self.can or self.listen or self.connect or self.ble or self.hid

    @property
    def line(self) -> str | None:
        """Port, channel or address; None for any."""
        return self.name if self.can is None else channel(self.can)


class PortSettings(NamedTuple):
    """Settings of one line that override the flags.

    Attributes:
        protocol: name of its protocol.
        baud: speed of the port or bus, bit/s.
    """

    protocol: str | None = None
    baud: int | None = None


class SensorMap(NamedTuple):
    """The content of a map file.

    Attributes:
        path: the file, for messages.
        devices: devices by sensor, in the order of SENSORS.
        ports: settings by port or bus.
    """

    path: str
    devices: Mapping[str, Device]
    ports: Mapping[str, PortSettings]

    @property
    def without(self) -> list[str]:
        """Those of the six sensors that the rig lacks."""
        return [name for name in PLACEMENTS if name not in self.devices]

    def lines(self, key: str) -> list[str]:
        """Return the lines of a kind that the devices name, each once: a key of `LINES`."""
        named = [getattr(device, key) for device in self.devices.values()]
        return [name for name in dict.fromkeys(named) if name is not None]

    def settings(self, line: str) -> PortSettings:
        """Return the settings of a line."""
        return self.ports.get(line, PortSettings())

    def places(self, line: str, sender: str | None = None) -> PlacementById:
        """Return the placements by id on one line, for the datagrams of one sender if it is a socket."""
        return {
            device.id: SENSORS.index(name)
            for name, device in self.devices.items()
            if device.line in (None, line, channel(line)) and device.sender in (None, sender)
        }

    def senders(self, line: str) -> frozenset[str] | None:
        """Return the IP and MAC addresses that may send to a socket; None for any."""
        senders = [device.sender for device in self.devices.values() if device.line in (None, line)]
        return None if None in senders else frozenset(map(str, senders))

    def serial_numbers(self) -> dict[int, str]:
        """Return the placements by id, for sessions whose files are named after serial numbers."""
        return {device.id: name for name, device in self.devices.items() if device.id is not None}

    def all_places(self) -> PlacementById:
        """Return the placements by id on a line whose name is unknown.

        Raises:
            ConfigError: two devices differ only in their lines.
        """
        result = {device.id: SENSORS.index(name) for name, device in self.devices.items()}
        if len(result) < len(self.devices):
            raise ConfigError(
                f"{self.path}: it distinguishes sensors by port or address, but a capture holds only one "
                "line; record samples instead (edgepose record walk.csv)"
            )
        return result


def channel(bus: str) -> str:
    """Return the channel of a bus named INTERFACE:CHANNEL, or by its channel alone."""
    return bus.split(":", 1)[-1]


def default_places(
    line: str, protocol: Protocol, index: int, count: int, kind: str = "port"
) -> PlacementById:
    """Return the placements by id on one line, without a map.

    Args:
        line: name of the line, for the message.
        protocol: protocol of the line.
        index: number of the line, from 0.
        count: total number of lines.
        kind: kind of the line, for the message, one of LINES.

    Raises:
        ConfigError: there is no default for such a line.
    """
    if protocol.single_device and count == len(PLACEMENTS):
        return {None: index}
    if protocol.ids:
        return {sensor: i for i, sensor in enumerate(protocol.ids)}
    row = '{ sender = "192.168.1.21" }' if kind == "listen" else f'{{ {kind} = "{line}" }}'
    lines = {"port": "ports", "can": "buses"}.get(kind, "addresses")
    raise ConfigError(
        f"{line}: which sensor is where? {protocol.name} has one sensor per "
        f"{'sender' if kind == 'listen' else 'line'}: give six {lines} in the "
        f"order {', '.join(PLACEMENTS)},\nor --sensors MAP.toml with a row for each, such as  "
        f"{PLACEMENTS[0]} = {row}"
    )


def read_map(path: Path) -> SensorMap:
    """Read a map file.

    Raises:
        ConfigError: the file cannot be read, or an entry is not valid.
    """
    content = read_toml(path)
    tables = content.pop("ports", {})
    if not isinstance(tables, dict):
        raise ConfigError(f'{path}: ports must be tables, such as  [ports."/dev/ttyUSB0"]')
    unknown = [name for name in content if name not in SENSORS]
    if unknown:
        hint = choices(unknown[0], [*SENSORS, "ports"], "placements are")
        raise ConfigError(f"{path}: unknown placement {unknown[0]!r}; {hint}")
    if PLACEMENTS[ROOT] not in content:
        raise ConfigError(f"{path}: no entry for {PLACEMENTS[ROOT]}, without which no rig works")
    devices = {name: _device(f"{path}: {name}", content[name]) for name in SENSORS if name in content}
    for (other, before), (name, device) in combinations(devices.items(), 2):
        if _same(device, before):
            raise ConfigError(
                f"{path}: {name} and {other} are the same device; give each its own port, sender or id"
            )
    return SensorMap(str(path), devices, {n: _port(f"{path}: ports.{n}", t) for n, t in tables.items()})


def _same(device: Device, other: Device) -> bool:
    """Return whether two rows may stand for one device."""
    if {device.sender, other.sender} == {None}:
        same_line = device.line == other.line or None in (device.line, other.line)
    elif None not in (device.sender, other.sender) and device.sender != other.sender:
        return False
    else:  # only sockets have senders
        lines = [each.listen for each in (device, other) if each.line is not None]
        same_line = None not in lines and len(set(lines)) < 2
    if not same_line:
        return False
    sure = device.line == other.line and device.sender == other.sender
    return device.id == other.id or (sure and None in (device.id, other.id))


def _device(where: str, entry: object) -> Device:
    table = _table(where, entry, dict.fromkeys(Device._fields, TEXT) | {"id": WHOLE})
    device = Device(**table)
    if device.id is not None and device.id < 0:
        raise ConfigError(f"{where}: id must be 0 or more, not {device.id}")
    given = [key for key in LINES if getattr(device, key) is not None]
    if given[1:]:
        raise ConfigError(f"{where}: give {' or '.join(given)}, not both")
    if not given and device.id is None and device.sender is None:
        raise ConfigError(f"{where}: no device named; give its {', '.join(LINES)}, sender or id")
    if device.sender is not None:
        if given not in ([], ["listen"]):
            raise ConfigError(f"{where}: sender is for datagrams; it does not go with {given[0]}")
        device = device._replace(sender=_sender(where, device.sender))
    if device.ble is not None:
        device = device._replace(ble=device.ble.upper())
    if device.mounting is not None:
        words = _MOUNTING.fullmatch(device.mounting)
        if words is None or _AXIS[words[1]] == _AXIS[words[2]]:
            raise ConfigError(
                f'{where}: mounting must be as calibrate prints it, such as "x up, z back", '
                f"not {device.mounting!r}"
            )
    return device


def _sender(where: str, text: str) -> str:
    """Return an IP address as the system writes it, or a MAC address in lower case."""
    if _MAC.fullmatch(text):
        return text.lower()
    try:
        return str(ip_address(text))
    except ValueError:
        raise ConfigError(f"{where}: sender must be an IP address or a MAC address, not {text!r}") from None


def _port(where: str, entry: object) -> PortSettings:
    table = _table(where, entry, {"protocol": TEXT, "baud": WHOLE})
    if table.get("baud", 1) < 1:
        raise ConfigError(f"{where}: baud must be 1 or more, not {table['baud']}")
    return PortSettings(**table)


def _table(where: str, entry: object, keys: Mapping[str, str]) -> dict[str, Any]:
    """Return a table whose values have the types of their keys, see `checked_value`."""
    if not isinstance(entry, dict):
        raise ConfigError(f'{where}: must be a table, such as  {{ port = "/dev/ttyUSB0" }}')
    for key in entry:
        if key not in keys:
            raise ConfigError(f"{where}: unknown key {key!r}; {choices(key, keys, 'keys are')}")
    return {key: checked_value(f"{where}: {key}", value, keys[key]) for key, value in entry.items()}
