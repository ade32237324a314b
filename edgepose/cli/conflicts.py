"""Conflicts between wearers, and between the files that a run reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.options.gathered import usage_errors
from edgepose.cli.options.outputs import check_files
from edgepose.errors import EdgeposeError, prefix_errors
from edgepose.sinks.receivers import check_receivers
from edgepose.utils.output_targets import has_reader

if TYPE_CHECKING:
    from edgepose.config import WearerConfig
    from edgepose.sources.sensor_map import SensorMap

_KINDS = {
    "bytes": "port",
    "frames": "bus",
    "datagrams": "address",
    "notifications": "address",
    "reports": "receiver",
}
"""Names of lines by the unit of their data."""

_SHARED = ("bus", "receiver")
"""Lines that several programs can read, each all of it."""


def check_lines(wearers: Sequence[WearerConfig]) -> None:
    """Raise EdgeposeError if two wearers use one line, unless it can be shared and they have separate ids."""
    with_lines = [(wearer, _lines(wearer)) for wearer in wearers]
    for (wearer, lines), (other, other_lines) in combinations(with_lines, 2):
        for line in lines.keys() & other_lines.keys():
            ids = lines[line] + other_lines[line]
            separate = lines[line] and other_lines[line] and None not in ids and len(set(ids)) == len(ids)
            if not separate:
                hint = ", or ids of its own in a sensor map" if line.startswith(_SHARED) else ""
                raise EdgeposeError(
                    f"{wearer.path}, {other.path}: both use the {line}; give each its own{hint}"
                )


def check_pages(wearers: Sequence[WearerConfig]) -> None:
    """Raise EdgeposeError if two wearers want their pages at the same port."""
    for wearer, other in combinations(wearers, 2):
        port = wearer.outputs.page_port
        if port is not None and port == other.outputs.page_port:
            raise EdgeposeError(f"{wearer.path}, {other.path}: both have page-port {port}; give each its own")


def check_all_live(wearers: Sequence[WearerConfig]) -> None:
    """Raise click.UsageError if some wearers are live and others are read at once."""
    live = wearers[0].source.live
    if different := [wearer.name for wearer in wearers if wearer.source.live != live]:
        raise click.UsageError(
            f"{wearers[0].name} and {different[0]}: a recording beside live sensors needs  realtime = true"
        )


def check_all_files(wearers: Sequence[WearerConfig], model: Path) -> None:
    """Raise click.UsageError if an output would replace an input or another output, or delay other wearers.

    Args:
        wearers: one or several.
        model: the archive that is loaded.
    """
    if sum(any(file == "-" for _, file in wearer.outputs.files) for wearer in wearers) > 1:
        raise click.UsageError("several wearers write to standard output; give all but one a file")
    outputs: list[tuple[str, str | Path]] = []
    inputs: dict[str, Path | None] = {"--model": model}
    for wearer in wearers:
        prefix = f"{wearer.name}: " if wearer.name else ""
        outputs += [(prefix + flag, file) for flag, file in wearer.outputs.files]
        inputs |= {prefix + flag: file for flag, file in _inputs(wearer).items()}
    check_files(outputs, inputs)
    for wearer in wearers:
        with prefix_errors(wearer.name):
            wearer.outputs.check()
    with usage_errors():
        check_receivers((wearer.name, *output) for wearer in wearers for output in wearer.outputs.targets)
    if len(wearers) > 1:
        for flag, file in outputs:
            if has_reader(file):
                raise click.UsageError(
                    f"{flag} {file} is not a file on a disk: a slow reader of it would delay every wearer; "
                    "give each a file, --udp or --tcp"
                )


def _inputs(wearer: WearerConfig) -> dict[str, Path | None]:
    """Return the files that are read for a wearer, by flag."""
    source, sensor_map = wearer.source, _sensor_map(wearer)
    protocols = [source.protocol]
    if sensor_map is not None:
        protocols += [port.protocol or "" for port in sensor_map.ports.values()]
    patterns = {f"--protocol {name}": Path(name) for name in protocols if name.endswith(".toml")}
    return {
        "--rig": wearer.path,
        "--file": source.file,
        "--sensors": source.sensors,
        "--calibration": wearer.calibration,
        **patterns,
    }


def _lines(wearer: WearerConfig) -> dict[str, list[int | None]]:
    """Return the lines that a wearer uses, each with the sensor ids that the sensor map lists on it."""
    from edgepose.sources.line_config import line_specs

    source = wearer.source
    if source.file is not None:
        return {"standard input": []} if str(source.file) == "-" else {}
    with prefix_errors(wearer.name):
        sensor_map = _sensor_map(wearer)
        specs = line_specs(
            *(source.port, source.baud, source.can, source.bitrate, source.fd, source.protocol),
            *(sensor_map, source.listen, source.connect, source.ble, source.hid),
        )
    lines: dict[str, list[int | None]] = {}
    for spec in specs:
        line = f"{_KINDS[spec.unit]} {spec.name}"
        lines[line] = []
        if sensor_map is not None and line.startswith(_SHARED):  # others can only be opened once
            lines[line] = list(sensor_map.places(spec.name))
    return lines


def _sensor_map(wearer: WearerConfig) -> SensorMap | None:
    from edgepose.sources.sensor_map import read_map

    return None if wearer.source.sensors is None else read_map(wearer.source.sensors)
