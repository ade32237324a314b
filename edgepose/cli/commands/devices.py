"""`edgepose devices`: list serial ports, CAN interfaces and USB receivers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.terminal.messages import say, show
from edgepose.errors import ConfigError, EdgeposeError

if TYPE_CHECKING:
    from edgepose.sources.hid_receiver import Receiver
    from edgepose.sources.probe import ProbeResult


@click.command()
@click.argument("names", nargs=-1, metavar="[PORT|INTERFACE:CHANNEL|RECEIVER]...")
@click.option(
    "--probe",
    is_flag=True,
    help="Listen to each for some seconds, to ports at the usual speeds, and report protocol, sensor ids and "
    "rates. Nothing is sent to the sensors.",
)
@click.option(
    "--listen",
    metavar="HOST:PORT[,...]",
    help="Listen for UDP datagrams at this address of this machine, and report the senders.",
)
@click.option(
    "--connect",
    metavar="HOST:PORT[,...]",
    help="Connect to sensors over TCP, and report what they send.",
)
@click.option(
    "--ble",
    is_flag=True,
    help="Look for Movella DOT sensors in range over Bluetooth, for some seconds. Needs edgepose[ble].",
)
@json_option
def devices(
    names: tuple[str, ...], probe: bool, listen: str | None, connect: str | None, ble: bool, as_json: bool
) -> None:
    """List the serial ports, CAN interfaces and USB receivers of this machine, or only the named ones.

    \b
    Examples:
      edgepose devices
      edgepose devices --probe
      edgepose devices --probe /dev/ttyUSB0 slcan:/dev/ttyACM0
      edgepose devices --listen 0.0.0.0:9000
    """
    lines = _Lines(as_json)
    for flag, text, find in (("listen", listen, _probe_socket), ("connect", connect, _probe_connection)):
        if text is not None:
            lines.begin(flag, f"Network (edgepose run --{flag} ADDRESS):")
            for name in text.split(","):
                lines.add(name, "", find)
    if ble:
        _show_bluetooth(lines)
    if names or probe or not (listen or connect or ble):
        _show_local(lines, tuple(name for text in names for name in text.split(",") if name), probe)
    if as_json:
        show_json("devices", lines.found)
    if names or listen or connect:
        _check_failed(lines.failed)


def _show_bluetooth(lines: _Lines) -> None:
    """Show the Movella DOT sensors in range."""
    from edgepose.sources.ble import sensors_in_range

    lines.begin("ble", "Movella DOT sensors (edgepose run --ble ADDRESS):")
    for address, description in sensors_in_range().items():
        lines.add(address, description, None)
    lines.end("none in range; switch them on, and disconnect them from phones and other programs")


def _show_local(lines: _Lines, names: tuple[str, ...], probe: bool) -> None:
    """Show the named ports, buses and receivers, or all."""
    from edgepose.sources.hid_receiver import ANY

    receivers = _receivers(ANY in names)
    of_receivers = {ANY, *(word for each in receivers or () for word in each.names)}
    others = [name for name in names if name not in of_receivers]
    ports = dict.fromkeys((name for name in others if not _is_bus(name)), "") if names else _ports()
    buses = [name for name in others if _is_bus(name)] if names else None
    if ports or not names:
        lines.begin("ports", "Serial ports (edgepose run --port NAME):", max(map(len, ports), default=0))
        for name, description in ports.items():
            absent = bool(names) and not probe and not Path(name).exists() and name not in _ports()
            if absent:
                lines.add_missing(name, "no such port")
            else:
                lines.add(name, description, _probe_port if probe else None)
        lines.end(
            "none found; connect the sensors, and check that the driver is loaded and that you may read the "
            "port (group dialout)"
        )
    if buses is None:
        buses = _buses()
    if buses or not names:
        lines.begin("buses", "CAN interfaces (edgepose run --can NAME):")
        for name in buses:
            lines.add(name, "", _probe_bus if probe else None)
        lines.end("none found; adapters on a serial port are named slcan:PORT")
    named = of_receivers.intersection(names)
    if receivers is not None and (named or not names):
        _show_receivers(lines, [each for each in receivers if not named or named & {ANY, *each.names}], probe)
        if named and not receivers:
            lines.add_missing(ANY, "no receiver is plugged in")
        lines.end("none found")


def _receivers(needed: bool) -> list[Receiver] | None:
    """Return the USB receivers; None if hidapi is missing, unless it is needed."""
    from edgepose.sources.hid_receiver import receivers

    try:
        return receivers()
    except ConfigError:
        if needed:
            raise
        return None


def _show_receivers(lines: _Lines, found: list[Receiver], probe: bool) -> None:
    """Show USB receivers."""
    width = max((len(receiver.name) for receiver in found), default=0)
    lines.begin("receivers", "USB receivers (edgepose run --hid NAME):", width)
    for receiver in found:
        description = "  ".join(dict.fromkeys((receiver.product, receiver.path)))
        lines.add(receiver.name, description, _probe_receiver if probe else None)


_KINDS = ("ports", "buses", "listen", "connect", "ble", "receivers")
"""Kinds of lines, as scripts get them."""


class _Lines:
    """The lines found, shown as they are found, or kept for JSON.

    Attributes:
        found: values of the lines for scripts by kind; docs/reference/scripts.md describes them.
        failed: names of the lines that cannot be listened to.
    """

    def __init__(self, as_json: bool) -> None:
        """Start without lines."""
        self.found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in _KINDS}
        self.failed: list[str] = []
        self._show: Callable[[str], None] = (lambda text: None) if as_json else show
        self._kind, self._width = "ports", 0

    def begin(self, kind: str, title: str, width: int = 0) -> None:
        """Begin with the lines of a kind, whose names are up to `width` characters long."""
        self._kind, self._width = kind, width
        self._show(title)

    def add(self, name: str, description: str, find: Callable[[str], list[Finding]] | None) -> None:
        """Show a line, and what a probe finds on it."""
        self._show(f"  {name.ljust(self._width)}  {description}".rstrip())
        values: dict[str, Any] = {"name": name, "description": description, "problem": None, "findings": []}
        self.found[self._kind].append(values)
        if find is None:
            return
        if sys.stderr.isatty():
            say(f"listening to {name} ...")
        try:
            findings = find(name)
        except EdgeposeError as error:
            values["problem"] = str(error)
            self.failed.append(name)
            self._show(f"    {error}")
            return
        values["findings"] = [finding.values() for finding in findings]
        for text in [finding.text() for finding in findings] or ["nothing arrives"]:
            self._show(f"    {text}")

    def add_missing(self, name: str, problem: str) -> None:
        """Show a line that does not exist."""
        self._show(f"  {name.ljust(self._width)}  {problem}")
        self.found[self._kind].append({"name": name, "description": "", "problem": problem, "findings": []})
        self.failed.append(name)

    def end(self, nothing: str) -> None:
        """Show a message if there is no line of this kind."""
        if not self.found[self._kind]:
            self._show(f"  {nothing}")


def _check_failed(failed: list[str]) -> None:
    if failed:
        raise EdgeposeError(f"cannot listen to {', '.join(failed)}")


def _is_bus(name: str) -> bool:
    # False for COM3 and for everything under /dev.
    return ":" in name and not name.startswith("/")


def _ports() -> dict[str, str]:
    """Return the serial ports of this machine with their descriptions."""
    from serial.tools import list_ports

    result = {}
    for port in sorted(list_ports.comports()):
        description = port.description if port.description != "n/a" else ""
        serial_number = f"serial number {port.serial_number}" if port.serial_number else ""
        result[port.device] = "  ".join(part for part in (description, serial_number) if part)
    return result


def _buses() -> list[str]:
    """Return the CAN interfaces of this machine."""
    # Imported late because python-can takes longer to import than all the rest of this command.
    from edgepose.sources.can_bus import can

    found = can.detect_available_configs(
        interfaces=["socketcan", "pcan", "vector", "kvaser", "ixxat", "usb2can"]
    )
    return [f"{config['interface']}:{config['channel']}" for config in found]


class Finding(NamedTuple):
    """A finding of a probe: of a line, or of one sender of datagrams.

    Attributes:
        result: the finding.
        unit: unit of the amount that has come, such as "bytes".
        baud: speed of a port, bit/s; None for others.
        sender: address of the sender; empty for a line.
    """

    result: ProbeResult
    unit: str
    baud: int | None = None
    sender: str = ""

    def values(self) -> dict[str, Any]:
        """Return the finding for scripts."""
        return {
            "sender": self.sender or None,
            "protocol": self.result.protocol,
            "baud": self.baud if self.result.protocol else None,
            "amount": self.result.amount,
            "unit": self.unit,
            "rates_hz": self.result.rates_hz,
            "refused": self.result.refused,
        }

    def text(self) -> str:
        """Return the finding for people."""
        speed = "" if self.baud is None else f" at --baud {self.baud}"
        text = _describe(self.result, self.unit, speed)
        return f"{self.sender}: {text}" if self.sender else text


def _probe_port(name: str) -> list[Finding]:
    from edgepose.sources.probe import probe_port

    result, baud = probe_port(name)
    return [Finding(result, "bytes", baud)]


def _probe_bus(name: str) -> list[Finding]:
    from edgepose.sources.probe import probe_bus

    return [Finding(probe_bus(name), "frames")]


def _probe_socket(name: str) -> list[Finding]:
    from edgepose.sources.probe import probe_socket

    return [Finding(result, "datagrams", None, sender) for sender, result in probe_socket(name).items()]


def _probe_connection(name: str) -> list[Finding]:
    from edgepose.sources.probe import probe_connection

    return [Finding(probe_connection(name), "bytes")]


def _probe_receiver(name: str) -> list[Finding]:
    from edgepose.sources.probe import probe_receiver

    return [Finding(probe_receiver(name), "reports")]


def _describe(finding: ProbeResult, unit: str, speed: str) -> str:
    if finding.protocol is None:
        if not finding.amount:
            return "nothing arrives"
        if finding.refused is not None:
            return f"{finding.refused}{speed and ' (' + speed.strip() + ')'}"
        return (
            f"{finding.amount} {unit} arrived, in no known protocol"
            f"{'; the device may be set to another speed' if unit in ('bytes', 'frames') else ''}"
        )
    ids = ", ".join(f"id {sensor} at {rate:.0f} Hz" for sensor, rate in finding.rates_hz.items())
    return f"--protocol {finding.protocol}{speed}: {ids}"
