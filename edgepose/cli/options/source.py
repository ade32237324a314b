"""Flags for the source of samples and for orientation filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from edgepose.cli.options.gathered import gathered
from edgepose.config import SourceConfig
from edgepose.errors import ConfigError
from edgepose.formats.recordings.registry import READERS
from edgepose.imu import FILTERS
from edgepose.placements import LACKING, PLACEMENTS
from edgepose.sources.protocol_detection import checked_protocol
from edgepose.utils.similar_names import choices
from firmware_protocols.registry import protocol_names

BITS_PER_SECOND = click.IntRange(1)


def _protocol(ctx: click.Context, param: click.Parameter, value: str) -> str:
    try:
        return checked_protocol(value)
    except ConfigError as error:
        raise click.BadParameter(str(error)) from None


protocol_option = click.option(
    "--protocol",
    metavar="NAME|auto",
    callback=_protocol,
    default="auto",
    show_default=True,
    help=f"Wire format: {', '.join(protocol_names())}, or a .toml file that describes text lines. auto "
    "detects it from what arrives.",
)
"""The flag --protocol."""

sensors_option = click.option(
    "--sensors",
    type=click.Path(path_type=Path, dir_okay=False),
    help="TOML file that says which port, bus, sender and id is worn where; see docs/guide/sensors.md in the "
    "repository. Lines named in it need no flag of their own.  [default: ids in the usual order]",
)
"""The flag --sensors."""


def _without(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    names = () if value is None else tuple(name.strip() for name in value.split(","))
    for name in names:
        if name not in LACKING:
            allowed = [each for each in PLACEMENTS if each in LACKING]
            raise click.BadParameter(choices(name, allowed, f"{name!r}: a rig can do without"))
    return names


def lacking_sensors(names: Sequence[str]) -> str:
    """Return a line about those of the six sensors that are not among these names; "" if all are."""
    lacking = [name for name in PLACEMENTS if name not in names]
    return f"A rig without {', '.join(lacking)}: poses are less accurate." if lacking else ""


without_option = click.option(
    "--without",
    callback=_without,
    metavar="NAME[,NAME...]",
    help="Sensors of the six that the rig lacks, such as head; poses are less accurate without them. A map "
    "of --sensors without an entry for them says the same.",
)
"""The flag --without."""


def _network_flags() -> list[Callable[[Callable[..., Any]], Callable[..., Any]]]:
    """Return the flags for sensors without a serial port or CAN bus."""
    return [
        click.option(
            "--listen",
            metavar="HOST:PORT[,...]",
            help="Receive the sensors' UDP datagrams at this address of this machine, such as "
            "192.168.1.10:9000; 0.0.0.0 is all of its addresses.",
        ),
        click.option(
            "--connect",
            metavar="HOST:PORT[,...]",
            help="Connect to the sensors over TCP, such as 192.168.1.21:7000, in the order of --port.",
        ),
        click.option(
            "--ble",
            metavar="ADDRESS[,...]",
            help="Connect to these Movella DOT sensors over Bluetooth, such as D4:22:CD:00:12:34, in the "
            "order of --port. Needs edgepose[ble].",
        ),
        click.option(
            "--hid",
            metavar="NAME[,NAME...]",
            help="USB receivers of the trackers, by serial number or path as edgepose devices lists them, or "
            "slimevr for the only one. Needs edgepose[hid].",
        ),
    ]


def source_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags for the source of samples; the command gets them as `source: SourceConfig`."""
    flags: list[Callable[[Callable[..., Any]], Callable[..., Any]]] = [
        click.option(
            "--port",
            metavar="PORT[,PORT...]",
            help="Serial ports that the sensors send to, such as /dev/ttyUSB0 or COM3. With one port per "
            f"sensor, give them in the order {', '.join(PLACEMENTS)}.",
        ),
        click.option(
            "--baud",
            type=BITS_PER_SECOND,
            help="Bits per second of the ports.  [default: the protocol's usual speed, or 115200]",
        ),
        click.option(
            "--can",
            metavar="INTERFACE:CHANNEL",
            help="CAN bus that the sensors send to, in python-can's notation: socketcan:can0, "
            "slcan:/dev/ttyACM0, pcan:PCAN_USBBUS1.",
        ),
        click.option(
            "--bitrate",
            type=BITS_PER_SECOND,
            help="Bits per second of the CAN bus; with SocketCAN the system sets them.  [default: the "
            "protocol's usual speed, or 500000]",
        ),
        click.option("--fd", is_flag=True, help="Accept CAN FD frames, too."),
        *_network_flags(),
        click.option(
            "--file",
            type=click.Path(path_type=Path),
            help="Read a file instead: a recording ("
            f"{', '.join(reader.files for reader in READERS.values())}), a raw serial capture (.bin, .raw) "
            "or a log of a CAN bus (.asc, .blf, .log, .mf4, .trc, .csv of python-can).",
        ),
        click.option(
            "--realtime", is_flag=True, help="Replay --file at its own pace instead of as fast as possible."
        ),
        protocol_option,
        sensors_option,
    ]
    return gathered(command, flags, "source", SourceConfig)


def filter_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --filter and --no-mag; the command gets them as `filter: str` and `no_mag: bool`."""
    return _filter_option(default="none", show_default=True)(_no_mag_option(command))


def calibrated_filter_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --filter and --no-mag for a command whose calibration knows them; `filter` is None if not given."""
    return _filter_option(default=None, more="  [default: the calibration's]")(_no_mag_option(command))


def _filter_option(more: str = "", **how: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return click.option(
        "--filter",
        type=click.Choice(FILTERS),
        help="Compute orientations from gyroscope, accelerometer and, where available, magnetometer. none: "
        f"the sensors send orientations.{more}",
        **how,
    )


_no_mag_option = click.option("--no-mag", is_flag=True, help="Do not use magnetometers in --filter.")
