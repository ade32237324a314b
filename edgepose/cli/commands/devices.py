"""`edgepose devices`: list serial ports and CAN interfaces."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.terminal.messages import say, show
from edgepose.errors import EdgeposeError

if TYPE_CHECKING:
    from edgepose.sources.probe import ProbeResult


@click.command()
@click.argument("names", nargs=-1, metavar="[PORT|INTERFACE:CHANNEL]...")
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
def devices(names: tuple[str, ...], probe: bool, listen: str | None, connect: str | None) -> None:
    """List the serial ports and CAN interfaces of this machine, or only the named ones.

    \b
    Examples:
      edgepose devices
      edgepose devices --probe
      edgepose devices --probe /dev/ttyUSB0 slcan:/dev/ttyACM0
      edgepose devices --listen 0.0.0.0:9000
    """
    failed: list[str] = []
    if listen is not None or connect is not None:
        _show_network(listen, connect, failed)
        if not names and not probe:
            _check_failed(failed)
            return
    names = tuple(name for text in names for name in text.split(",") if name)  # as --port names several
    ports = dict.fromkeys((name for name in names if not _is_bus(name)), "") if names else _ports()
    buses = [name for name in names if _is_bus(name)] if names else None
    if ports or not names:
        show("Serial ports (edgepose run --port NAME):")
        width = max(map(len, ports), default=0)
        for name, description in ports.items():
            absent = bool(names) and not probe and not Path(name).exists() and name not in _ports()
            failed += [name] * absent
            show(f"  {name.ljust(width)}  {'no such port' if absent else description}".rstrip())
            if probe:
                show(f"    {_probe(name, _probe_port, failed)}")
        if not ports:
            show(
                "  none found; connect the sensors, and check that the driver is loaded and that you may "
                "read the port (group dialout)"
            )
    if buses is None:
        buses = _buses()
    if buses or not names:
        show("CAN interfaces (edgepose run --can NAME):")
        for name in buses:
            show(f"  {name}")
            if probe:
                show(f"    {_probe(name, _probe_bus, failed)}")
        if not buses:
            show("  none found; adapters on a serial port are named slcan:PORT")
    if names or listen or connect:
        _check_failed(failed)


def _show_network(listen: str | None, connect: str | None, failed: list[str]) -> None:
    """Show what is sent to addresses of this machine, and by devices over TCP."""
    for flag, text, probe in (("listen", listen, _probe_socket), ("connect", connect, _probe_connection)):
        if text is None:
            continue
        show(f"Network (edgepose run --{flag} ADDRESS):")
        for name in text.split(","):
            show(f"  {name}")
            for line in _probe(name, probe, failed).splitlines():
                show(f"    {line}")


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


def _probe(name: str, probe: Callable[[str], str], failed: list[str]) -> str:
    """Return what was found on a line, or why it cannot be probed; then the line is added to `failed`."""
    if sys.stderr.isatty():
        say(f"listening to {name} ...")
    try:
        return probe(name)
    except EdgeposeError as error:
        failed.append(name)
        return str(error)


def _probe_port(name: str) -> str:
    from edgepose.sources.probe import probe_port

    finding, baud = probe_port(name)
    return _describe(finding, "bytes", f" at --baud {baud}")


def _probe_bus(name: str) -> str:
    from edgepose.sources.probe import probe_bus

    return _describe(probe_bus(name), "frames", "")


def _probe_socket(name: str) -> str:
    from edgepose.sources.probe import probe_socket

    senders = probe_socket(name)
    lines = [f"{sender}: {_describe(finding, 'datagrams', '')}" for sender, finding in senders.items()]
    return "\n".join(lines) or "nothing arrives"


def _probe_connection(name: str) -> str:
    from edgepose.sources.probe import probe_connection

    return _describe(probe_connection(name), "bytes", "")


def _describe(finding: ProbeResult, unit: str, speed: str) -> str:
    if finding.protocol is None:
        if not finding.amount:
            return "nothing arrives"
        if finding.refused is not None:
            return f"{finding.refused}{speed and ' (' + speed.strip() + ')'}"
        return (
            f"{finding.amount} {unit} arrived, in no known protocol"
            f"{'' if unit == 'datagrams' else '; the device may be set to another speed'}"
        )
    ids = ", ".join(f"id {sensor} at {rate:.0f} Hz" for sensor, rate in finding.rates_hz.items())
    return f"--protocol {finding.protocol}{speed}: {ids}"
