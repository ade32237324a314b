"""`edgepose record`: record what the sensors send."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from math import inf
from typing import TYPE_CHECKING

import click

from edgepose import __version__
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.outputs import check_files, overwrite_option
from edgepose.cli.options.source import source_options
from edgepose.cli.terminal.messages import end_status, has_terminal, say, status
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.placements import LACKING, PLACEMENTS, SENSORS

if TYPE_CHECKING:
    from edgepose.record import RecordSummary
    from edgepose.sources import Source


@click.command()
@click.argument("out")
@source_options
@click.option(
    "--seconds",
    type=FloatRange(0, min_open=True),
    help="Length of the recording from the first sample on, seconds.  [default: until Ctrl-C or the end of "
    "--file]",
)
@overwrite_option
def record(source: SourceConfig, out: str, seconds: float | None, overwrite: bool) -> None:
    """Write what arrives to OUT until Ctrl-C. A power cut loses at most the last second.

    The ending of OUT decides what is written. .csv, .npz: samples. .bin: the bytes of one port as they
    arrive, with their times in OUT.times. .log, .asc, .blf: the frames of CAN buses. --file reads all of
    them. - writes CSV to standard output.

    \b
    Examples:
      edgepose record walk.csv --port /dev/ttyUSB0
      edgepose record walk.npz --port COM3 --seconds 60
      edgepose record walk.bin --port /dev/ttyUSB0 --baud 921600
      edgepose record walk.blf --can socketcan:can0
    """
    from edgepose import record as recorder
    from edgepose.sources import open_source

    kind = recorder.kind(out)
    streams = ",".join(filter(None, (source.port, source.connect)))
    others = source.listen or source.ble or source.hid or (source.can if kind == "port" else streams)
    if kind == "port" and (not streams or "," in streams or others):
        raise click.UsageError(
            f"{out} stores the bytes of one line: give --port or --connect, or name it .csv or .npz"
        )
    if kind == "bus" and (source.can is None or others):
        raise click.UsageError(f"{out} stores the frames of a CAN bus: give --can, or name it .csv or .npz")
    with ExitStack() as stack:
        outputs = [("OUT", out), ("OUT (while it grows)", recorder.growing(out))]
        check_files(outputs, {"--file": source.file, "--sensors": source.sensors})
        recorder.check_free(out, overwrite)
        opened = stack.enter_context(open_source(**source.arguments()))
        stop = stack.enter_context(StopSignal())
        output = recorder.open_output(out, _metadata(source, opened.metadata), overwrite)
        names = _names(source)
        say(f"recording to {out}; Ctrl-C ends it. Sample counts are in the order {', '.join(names)}")
        summary = recorder.record(
            opened,
            output,
            inf if seconds is None else seconds,
            _progress(opened, names),
            stopped=lambda: stop.asked,
        )
    _report(out, summary, opened, names)
    if summary.error:
        raise summary.error
    if opened.damage:
        raise EdgeposeError(opened.damage)


def _metadata(source: SourceConfig, of_file: Mapping[str, str]) -> dict[str, str]:
    """Return the metadata of a recording; those of the file that is read are kept."""
    written = {"program": f"edgepose {__version__}", "frame": "Z up", "units": "s, m/s^2, rad/s, uT"}
    about = {"source": source.name, "protocol": source.protocol}
    if source.file is not None:
        return {**about, **of_file, **written}
    return {**about, "started": datetime.now(timezone.utc).isoformat(timespec="seconds"), **written}


def _names(source: SourceConfig) -> list[str]:
    """Return the sensors that are expected: those of the map, or the six."""
    from edgepose.sources.sensor_map import read_map

    return list(PLACEMENTS if source.sensors is None else read_map(source.sensors).devices)


def _progress(source: Source, names: Sequence[str]) -> Callable[[RecordSummary], None]:
    """Return a callback that updates one line on a terminal; elsewhere it writes a line every 10 s."""
    every_s = 1.0 if has_terminal() else 10.0
    shown_s, shown_total = time.monotonic(), 0

    def show(summary: RecordSummary) -> None:
        nonlocal shown_s, shown_total
        now_s = time.monotonic()
        if now_s - shown_s >= every_s:
            total = sum(summary.samples)
            rate = (total - shown_total) / (now_s - shown_s)
            shown_s, shown_total = now_s, total
            counts = [summary.samples[SENSORS.index(name)] for name in names]
            status(
                f"{summary.seconds:.0f} s, {' '.join(map(str, counts))}, {rate:.0f} a second, "
                f"{source.counters.lost} lost"
            )

    return show


def _report(out: str, summary: RecordSummary, source: Source, names: Sequence[str]) -> None:
    """Report the counts of a finished recording."""
    end_status()
    total = sum(summary.samples)
    rate = total / summary.seconds if summary.seconds else 0.0
    counts = source.counters
    say(f"samples  {total} in {summary.seconds:.1f} s, {rate:.0f} a second; to {out}")
    by_name = {name: n for name, n in zip(SENSORS, summary.samples, strict=True) if n or name in names}
    say(f"sensors  {', '.join(f'{n} {name}' for name, n in by_name.items())}")
    say(f"packets  {counts.packets} good, {counts.lost} lost, {counts.bad} bad, {counts.unknown} unknown")
    silent = [name for name, n in by_name.items() if not n]
    if total and silent:
        hint = "check power, link and id"
        if LACKING.issuperset(silent):
            hint += f", or calibrate with --without {','.join(silent)}"
        say(f"warning: nothing arrived from {', '.join(silent)}; {hint}")
