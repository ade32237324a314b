"""`edgepose devices`: what could be read from on this machine."""

from __future__ import annotations

import logging

import click


@click.command()
def devices() -> None:
    """List the serial ports and CAN interfaces of this machine.

    \b
    Example:
      edgepose devices
    """
    from serial.tools import list_ports

    ports = sorted(list_ports.comports())
    click.echo("Serial ports (edgepose run --port NAME):")
    width = max((len(port.device) for port in ports), default=0)
    for port in ports:
        what = port.description if port.description != "n/a" else ""
        serial_number = f"serial number {port.serial_number}" if port.serial_number else ""
        click.echo(
            "  "
            + "  ".join(part for part in (port.device.ljust(width), what, serial_number) if part).rstrip()
        )
    if not ports:
        click.echo(
            "  none found; plug the hub in, or check that its driver is loaded and you may read it "
            "(group dialout)"
        )

    # No CAN backend is configured here; importing python-can costs more than the rest of this command.
    import can

    # It tells of every vendor's library that is not installed.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    click.echo("CAN interfaces (python-can):")
    channels = can.detect_available_configs(
        interfaces=["socketcan", "pcan", "vector", "kvaser", "ixxat", "usb2can"]
    )
    for config in channels:
        click.echo(f"  {config['interface']}:{config['channel']}")
    if not channels:
        click.echo("  none found")
