"""Specifications of the lines named by the flags and the sensor map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from edgepose.errors import ConfigError
from edgepose.sources.line_decoder import PlacementById
from edgepose.sources.line_reader import LineSpec, Transport
from edgepose.sources.protocol_detection import candidate_protocols
from edgepose.sources.sensor_map import PortSettings, SensorMap, channel, default_places
from firmware_protocols.registry import Protocol

BAUD = 115200
"""Default speed of a serial port, bit/s."""

BITRATE = 500_000
"""Default speed of a CAN bus, bit/s."""


def line_specs(
    port: str | None,
    baud: int | None,
    can: str | None,
    bitrate: int | None,
    fd: bool,
    protocol: str,
    sensor_map: SensorMap | None,
) -> list[LineSpec]:
    """Return the ports and buses to read from; the arguments are those of `open_source`.

    Raises:
        ConfigError: there are none, a name is invalid, or the map names a line that the flags do not.
    """
    ports = _split_names("--port", port)
    buses = _split_names("--can", can)
    if sensor_map is not None:
        if not ports and not buses:
            ports, buses = sensor_map.lines("port"), sensor_map.lines("can")
        known = {*ports, *map(channel, buses)}
        for name, device in sensor_map.devices.items():
            if device.line is not None and device.line not in known:
                raise ConfigError(
                    f"{sensor_map.path}: {name}: {device.port or device.can} is not one of the lines given "
                    f"with --port and --can: {', '.join([*ports, *buses])}"
                )
        for name in sensor_map.ports:
            if name not in ports and name not in buses:
                raise ConfigError(
                    f"{sensor_map.path}: ports.{name}: no such line, only {', '.join([*ports, *buses])}"
                )
    count = len(ports) + len(buses)
    if not count:
        raise ConfigError("give one input: --port, --can or --file")
    for bus in buses:
        if ":" not in bus:
            raise ConfigError(f"{bus}: give --can as INTERFACE:CHANNEL, such as socketcan:can0")

    def placements(line: str, index: int) -> Callable[[Protocol], PlacementById]:
        if sensor_map is not None:
            return lambda found: sensor_map.places(line)
        return lambda found: default_places(line, found, index, count)

    result = []
    for index, name in enumerate([*ports, *buses]):
        settings = PortSettings() if sensor_map is None else sensor_map.settings(name)
        line_protocol = settings.protocol or protocol
        if index < len(ports):
            spec = serial_line(name, line_protocol, settings.baud or baud, placements(name, index))
        else:
            spec = can_line(name, line_protocol, settings.baud or bitrate, fd, placements(name, index))
        result.append(spec)
    return result


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


def _split_names(flag: str, text: str | None) -> Sequence[str]:
    names = [] if text is None else [name.strip() for name in text.split(",")]
    for i, name in enumerate(names):
        if not name:
            raise ConfigError(f"{flag} {text}: an empty name between commas")
        if name in names[:i]:
            raise ConfigError(f"{flag} {text}: {name} is given twice")
    return names
