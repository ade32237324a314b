"""Specifications of the lines named by the flags and the sensor map."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from edgepose.errors import ConfigError
from edgepose.sources import LINE_FLAGS
from edgepose.sources.line_decoder import PlacementById
from edgepose.sources.line_reader import LineSpec, Transport
from edgepose.sources.protocol_detection import candidate_protocols
from edgepose.sources.sensor_map import PortSettings, SensorMap, channel, default_places
from edgepose.utils.sockets import parse_host_and_port
from firmware_protocols.registry import Protocol

BAUD = 115200
"""Default speed of a serial port, bit/s."""

BITRATE = 500_000
"""Default speed of a CAN bus, bit/s."""

QUEUE = 512
"""Number of arrivals from a socket that may wait: most of a second of the packets of six sensors."""

DOT = "dot"
"""Name of the protocol of Movella DOT sensors."""

_BLUETOOTH_ADDRESS = re.compile("[0-9A-F]{2}(:[0-9A-F]{2}){5}|[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}")
"""A MAC address, or the name that macOS gives a device in its place."""


class Lines(NamedTuple):
    """Names of the lines to read from, by kind.

    Attributes:
        port: serial ports.
        can: CAN buses, INTERFACE:CHANNEL.
        listen: addresses to listen on for datagrams, HOST:PORT.
        connect: devices to connect to over TCP, HOST:PORT.
        ble: Bluetooth addresses of Movella DOT sensors.
        hid: USB receivers, by serial number or path, or "slimevr".
    """

    port: Sequence[str] = ()
    can: Sequence[str] = ()
    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    ble: Sequence[str] = ()
    hid: Sequence[str] = ()

    @property
    def all(self) -> list[str]:
        """All names, in the order of the placements."""
        return [name for names in self for name in names]


def line_specs(
    port: str | None = None,
    baud: int | None = None,
    can: str | None = None,
    bitrate: int | None = None,
    fd: bool = False,
    protocol: str = "auto",
    sensor_map: SensorMap | None = None,
    listen: str | None = None,
    connect: str | None = None,
    ble: str | None = None,
    hid: str | None = None,
) -> list[LineSpec]:
    """Return the lines to read from; the arguments are those of `open_source`.

    Raises:
        ConfigError: there are none, a name is invalid, or the map names a line that the flags do not.
    """
    lines = Lines(
        *(
            _split_names(f"--{kind}", text)
            for kind, text in zip(Lines._fields, (port, can, listen, connect, _upper(ble), hid), strict=True)
        )
    )
    if sensor_map is not None:
        if not lines.all:
            lines = Lines(*map(sensor_map.lines, Lines._fields))
        _check_map(sensor_map, lines)
    count = len(lines.all)
    if not count:
        raise ConfigError(f"give one input: {LINE_FLAGS}, or --file")
    for bus in lines.can:
        if ":" not in bus:
            raise ConfigError(f"{bus}: give --can as INTERFACE:CHANNEL, such as socketcan:can0")

    def spec(kind: str, name: str, index: int) -> LineSpec:
        settings = PortSettings() if sensor_map is None else sensor_map.settings(name)
        found = settings.protocol or protocol

        def placements(protocol: Protocol, sender: str | None = None) -> PlacementById:
            if sensor_map is not None:
                return sensor_map.places(name, sender)
            return default_places(name, protocol, index, count, kind)

        if kind == "port":
            return serial_line(name, found, settings.baud or baud, placements)
        if kind == "can":
            return can_line(name, found, settings.baud or bitrate, fd, placements)
        if kind == "connect":
            return tcp_line(name, found, placements)
        if kind == "ble":
            return ble_line(name, found, placements)
        if kind == "hid":
            return hid_line(name, found, placements)
        return udp_line(name, found, placements, None if sensor_map is None else sensor_map.senders(name))

    named = [(kind, name) for kind in Lines._fields for name in getattr(lines, kind)]
    return [spec(kind, name, index) for index, (kind, name) in enumerate(named)]


def _check_map(sensor_map: SensorMap, lines: Lines) -> None:
    """Check that all lines that a map names are read.

    Raises:
        ConfigError: one is not.
    """
    known = {*lines.all, *map(channel, lines.can)}
    for name, device in sensor_map.devices.items():
        if device.line is not None and device.line not in known:
            raise ConfigError(
                f"{sensor_map.path}: {name}: {device.name} is not one of the lines given "
                f"with {LINE_FLAGS}: {', '.join(lines.all)}"
            )
        if device.sender is not None and not lines.listen:
            raise ConfigError(
                f"{sensor_map.path}: {name}: nothing listens for the datagrams of {device.sender}; "
                "give --listen HOST:PORT"
            )
    for name in sensor_map.ports:
        if name not in lines.all:
            raise ConfigError(f"{sensor_map.path}: ports.{name}: no such line, only {', '.join(lines.all)}")


def serial_line(
    name: str, protocol: str, baud: int | None, placements: Callable[[Protocol], PlacementById]
) -> LineSpec:
    """Return the specification of a serial port.

    Raises:
        ConfigError: no such protocol.
    """
    protocols = candidate_protocols(protocol, "bytes", live=True)
    named = protocols[0] if len(protocols) == 1 else None
    speed = baud or (named.default_bitrate if named else BAUD)
    requests: list[tuple[bytes, int]] = []
    if named is not None and named.request is not None:
        requests = [named.request(sensor) for sensor in placements(named) if sensor is not None]
        if not requests:
            raise ConfigError(f"{name}: {named.name} devices are polled by id; give their ids with --sensors")

    def open_port() -> Transport:
        # Imported only here: pyserial is not needed to read files.
        from edgepose.sources.serial_port import SerialPort

        return SerialPort(name, speed, requests)

    check = ("--port and that the device is on and sending", f"--baud (now {speed}) and --protocol")
    return LineSpec(name, open_port, protocols, placements, "bytes", check)


def can_line(
    name: str, protocol: str, bitrate: int | None, fd: bool, placements: Callable[[Protocol], PlacementById]
) -> LineSpec:
    """Return the specification of a CAN bus.

    Raises:
        ConfigError: no such protocol.
    """
    protocols = candidate_protocols(protocol, "can", live=True)
    speed = bitrate or (protocols[0].default_bitrate if len(protocols) == 1 else BITRATE)

    def open_bus() -> Transport:
        # Imported only here: python-can takes a while to import.
        from edgepose.sources.can_bus import CanBus

        return CanBus(name, speed, fd)

    check = (
        f"that the devices are on and that --bitrate (now {speed}) is theirs",
        "--protocol, --fd and the ids that the devices are set to",
    )
    return LineSpec(name, open_bus, protocols, placements, "frames", check)


def udp_line(
    name: str,
    protocol: str,
    placements: Callable[[Protocol, str | None], PlacementById],
    senders: Collection[str] | None,
) -> LineSpec:
    """Return the specification of a UDP socket.

    Args:
        name: address to listen on, HOST:PORT.
        protocol: name of a protocol, or "auto".
        placements: map of ids to placements, given the protocol and a sender.
        senders: IP and MAC addresses of the sensors; None if any may be one.

    Raises:
        ConfigError: no such protocol, an invalid address, or sensors without a placement.
    """
    host, port = parse_host_and_port(name)
    protocols = candidate_protocols(protocol, "udp", live=True)
    named = protocols[0] if len(protocols) == 1 else None
    if named is not None and senders is None:
        placements(named, None)  # raises if it cannot be known which sensor is where

    def open_socket() -> Transport:
        from edgepose.sources.udp_socket import UdpSocket

        trackers = None if named is None or named.host is None else named.host()
        return UdpSocket(host, port, trackers, senders)

    def by_sender(sender: str) -> Callable[[Protocol], PlacementById] | None:
        if senders is not None and sender not in senders:
            return None
        return lambda found: placements(found, sender)

    check = (
        f"that the sensors send to this machine's port {port}, that no firewall stops them"
        + ("" if host in ("0.0.0.0", "::") else ", and listen on 0.0.0.0 for broadcasts"),
        "--protocol",
    )
    return LineSpec(
        name,
        open_socket,
        protocols,
        lambda found: placements(found, None),
        "datagrams",
        check,
        by_sender,
        QUEUE,
    )


def tcp_line(name: str, protocol: str, placements: Callable[[Protocol], PlacementById]) -> LineSpec:
    """Return the specification of a TCP connection to a device, HOST:PORT.

    Raises:
        ConfigError: no such protocol, or an invalid address.
    """
    host, port = parse_host_and_port(name)
    protocols = candidate_protocols(protocol, "bytes", live=True)
    if len(protocols) == 1 and protocols[0].request is not None:
        raise ConfigError(f"{name}: {protocols[0].name} devices are polled; connect them to a serial port")

    def open_connection() -> Transport:
        from edgepose.sources.tcp_connection import TcpConnection

        return TcpConnection(host, port)

    check = ("that the device is set to send over this connection", "--protocol")
    return LineSpec(name, open_connection, protocols, placements, "bytes", check, None, QUEUE)


def ble_line(name: str, protocol: str, placements: Callable[[Protocol], PlacementById]) -> LineSpec:
    """Return the specification of a Movella DOT, by its Bluetooth address.

    Raises:
        ConfigError: the protocol is another one, the address is invalid, or the sensor has no placement.
    """
    if protocol not in ("auto", DOT):
        raise ConfigError(f"--ble is for Movella DOT sensors: leave out --protocol {protocol}, or give {DOT}")
    if not _BLUETOOTH_ADDRESS.fullmatch(name):
        raise ConfigError(
            f"--ble {name}: not a Bluetooth address such as D4:22:CD:00:12:34; "
            "edgepose devices --ble lists those in range"
        )
    protocols = candidate_protocols(DOT, "udp", live=True)
    placements(protocols[0])  # raises if it cannot be known where the sensor is

    def open_sensor() -> Transport:
        # Imported only here: bleak is optional, and brings an event loop along.
        from edgepose.sources.ble import DotSensor

        return DotSensor(name)

    check = ("that the sensor is not charging", "with Movella's app that its firmware is up to date")
    return LineSpec(name, open_sensor, protocols, placements, "notifications", check, None, QUEUE)


def _upper(addresses: str | None) -> str | None:
    return None if addresses is None else addresses.upper()


def hid_line(name: str, protocol: str, placements: Callable[[Protocol], PlacementById]) -> LineSpec:
    """Return the specification of a USB receiver.

    Raises:
        ConfigError: no such protocol.
    """
    protocols = candidate_protocols(protocol, "hid", live=True)

    def open_receiver() -> Transport:
        from edgepose.sources.hid_receiver import HidReceiver

        return HidReceiver(name)

    check = ("that it is the receiver", "that the trackers are on and paired with this receiver")
    return LineSpec(name, open_receiver, protocols, placements, "reports", check)


def _split_names(flag: str, text: str | None) -> Sequence[str]:
    names = [] if text is None else [name.strip() for name in text.split(",")]
    for i, name in enumerate(names):
        if not name:
            raise ConfigError(f"{flag} {text}: an empty name between commas")
        if name in names[:i]:
            raise ConfigError(f"{flag} {text}: {name} is given twice")
    return names
