"""Flags that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.errors import EdgeposeError
from edgepose.imu import FILTERS, ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources.protocol_detection import protocol_named
from firmware_protocols.registry import PROTOCOLS

if TYPE_CHECKING:
    from edgepose.orientation import Orienter
    from edgepose.sources import Source

BITS_PER_SECOND = click.IntRange(1)


class SourceFlags(NamedTuple):
    """Where samples come from; the fields are the arguments of `edgepose.sources.open_source`."""

    port: str | None
    baud: int | None
    can: str | None
    bitrate: int | None
    fd: bool
    file: Path | None
    realtime: bool
    protocol: str
    sensors: Path | None

    @property
    def live(self) -> bool:
        """Whether samples come at their own pace."""
        return self.file is None or self.realtime

    @property
    def name(self) -> str:
        """The source, for people."""
        return ",".join(
            str(name) for name in (self.file, self.port, self.can, self.sensors) if name is not None
        )

    def open(self, raw: list[tuple[float, Any]] | None = None, waits: bool = True) -> Source:
        """The source; nothing is opened before it is entered.

        Args:
            raw: filled with what comes over live lines.
            waits: see `edgepose.sources.open_source`.

        Raises:
            EdgeposeError: a flag or the map of sensors means nothing.
        """
        from edgepose.sources import open_source

        return open_source(**self._asdict(), raw=raw, waits=waits)


def _protocol(ctx: click.Context, param: click.Parameter, value: str) -> str:
    # The file of a pattern is read later.
    if value != "auto" and not value.endswith(".toml"):
        try:
            protocol_named(value)
        except EdgeposeError as error:
            raise click.BadParameter(str(error)) from None
    return value


protocol_option = click.option(
    "--protocol",
    metavar="NAME|auto",
    callback=_protocol,
    default="auto",
    show_default=True,
    help=f"Wire format: {', '.join(PROTOCOLS)}, or a .toml file that describes text lines. auto "
    "listens and decides.",
)
"""The flag --protocol."""

sensors_option = click.option(
    "--sensors",
    type=click.Path(path_type=Path, dir_okay=False),
    help="TOML file that says which port, bus and id is worn where; see docs/guide/sensors.md. Names of "
    "ports and buses in it need no --port and --can.  [default: ids in the usual order]",
)
"""The flag --sensors."""


def source_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the flags that say where samples come from; the command gets them as `source: SourceFlags`."""
    flags = [
        click.option(
            "--port",
            metavar="PORT[,PORT...]",
            help="Serial ports that the sensors send to, such as /dev/ttyUSB0 or COM3. Where each sensor has "
            f"a port to itself: {', '.join(PLACEMENTS)}, in this order.",
        ),
        click.option(
            "--baud",
            type=BITS_PER_SECOND,
            help="Bits per second of the ports.  [default: the protocol's usual speed, or 115200]",
        ),
        click.option(
            "--can",
            metavar="INTERFACE:CHANNEL",
            help="CAN bus that the sensors send to, as python-can names it: socketcan:can0, "
            "slcan:/dev/ttyACM0, pcan:PCAN_USBBUS1.",
        ),
        click.option(
            "--bitrate",
            type=BITS_PER_SECOND,
            help="Bits per second of the CAN bus; SocketCAN has its own.  [default: the protocol's usual "
            "speed, or 500000]",
        ),
        click.option("--fd", is_flag=True, help="Take CAN FD frames too."),
        click.option(
            "--file",
            type=click.Path(path_type=Path),
            help="Read instead: a recording (.csv, .npz), a raw serial capture (.bin, .raw) or a log of a "
            "CAN bus (.asc, .blf, .log, .mf4, .trc, .csv of python-can).",
        ),
        click.option(
            "--realtime", is_flag=True, help="Replay --file at its own pace instead of as fast as possible."
        ),
        protocol_option,
        sensors_option,
    ]

    @functools.wraps(command)
    def with_source(**words: Any) -> Any:
        source = SourceFlags(*(words.pop(name) for name in SourceFlags._fields))
        _check(source)
        return command(source=source, **words)

    for flag in reversed(flags):
        with_source = flag(with_source)
    return with_source


def _check(source: SourceFlags) -> None:
    """Raises click.UsageError unless the flags name one source."""
    lines = source.port is not None or source.can is not None
    if (source.file is not None and lines) or not (lines or source.file or source.sensors):
        raise click.UsageError("give one source: --port PORT, --can INTERFACE:CHANNEL or --file PATH")


class Orientations:
    """Turns samples into oriented ones as the flags of `filter_options` say."""

    def __init__(self, filter: str, magnetometer: bool) -> None:
        """No sample has come.

        Args:
            filter: one of FILTERS.
            magnetometer: use magnetometers, where there are any.
        """
        self._filter, self._magnetometer = filter, magnetometer
        self._with_north: set[int] = set()
        self._made: set[int] = set()  # sensors that have been oriented
        self._orienter: Orienter | None = None
        if filter != "none":
            from edgepose.orientation import Orienter

            self._orienter = Orienter(filter, magnetometer)

    @property
    def passes(self) -> bool:
        """Whether samples pass as they are."""
        return self._orienter is None

    def anew(self) -> Orientations:
        """The same, with no sample seen, for another recording."""
        return Orientations(self._filter, self._magnetometer)

    @property
    def north(self) -> bool:
        """Whether all sensors have a heading that counts from north, as far as the samples have shown.

        What devices with a filter of their own do is not known here: it is taken for granted.
        """
        return self._orienter is None or (self._magnetometer and len(self._with_north) == len(PLACEMENTS))

    @property
    def mixed(self) -> bool:
        """Whether some sensors have sent a magnetic field and others none, all being wanted."""
        return self._magnetometer and 0 < len(self._with_north) < len(PLACEMENTS)

    def remarks(self) -> list[str]:
        """What happened to the samples of each sensor, for the end of a run."""
        status = {} if self._orienter is None else self._orienter.status()
        return [
            f"filter   {PLACEMENTS[sensor]}: "
            + ", ".join(
                f"{count} {str(event.name).lower().replace('_', ' ')}" for event, count in own.events.items()
            )
            for sensor, own in status.items()
            if own.events
        ]

    def __call__(self, samples: list[ImuSample]) -> list[ImuSample]:
        """The samples, oriented; without those of oriented sensors that cannot be."""
        if self._orienter is None:
            return samples
        if len(self._with_north) < len(PLACEMENTS):
            self._with_north.update(sample.sensor for sample in samples if sample.mag is not None)
        oriented = self._orienter.orient(samples)
        self._made.update(sample.sensor for sample in oriented if sample.quat is not None)
        # What only brought a field, or lost its rate on the way, has no orientation to give.
        return [
            sample
            for sample in oriented
            if sample.quat is not None or (sample.acc is not None and sample.sensor not in self._made)
        ]


def filter_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds --filter and --no-mag; the command gets them as `filter: str` and `no_mag: bool`."""
    chosen = click.option(
        "--filter",
        type=click.Choice(FILTERS),
        default="none",
        show_default=True,
        help="Make orientations here of gyroscope, accelerometer and, where there is one, magnetometer; "
        "none: the sensors send them.",
    )
    no_mag = click.option("--no-mag", is_flag=True, help="Leave magnetometers out of --filter.")
    return chosen(no_mag(command))
