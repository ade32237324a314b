"""Conflicts: lines that two wearers cannot share, inputs that an output must not replace."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.options.outputs import check_files
from edgepose.errors import EdgeposeError, prefix_errors
from edgepose.utils.output_targets import has_reader

if TYPE_CHECKING:
    from edgepose.config import WearerConfig
    from edgepose.sources.sensor_map import SensorMap


def check_lines(rigs: Sequence[WearerConfig]) -> None:
    """Raises EdgeposeError where two wearers listen to one line, unless it is a bus on which each has ids."""
    for (rig, lines), (other, others) in combinations([(rig, _lines(rig)) for rig in rigs], 2):
        for line in lines.keys() & others.keys():
            ids = lines[line] + others[line]
            apart = lines[line] and others[line] and None not in ids and len(set(ids)) == len(ids)
            if not apart:
                hint = ", or ids of its own there with sensors" if line.startswith("bus") else ""
                raise EdgeposeError(
                    f"{rig.path}, {other.path}: two of them have the {line}; give each its own{hint}"
                )


def check_all_files(rigs: Sequence[WearerConfig], model: Path) -> None:
    """Raises click.UsageError where a file to write is one to read, or would hold up or meet another's.

    Args:
        rigs: the wearers.
        model: archive that is loaded.
    """
    if sum(rig.outputs.csv == "-" for rig in rigs) > 1:
        raise click.UsageError("several wearers write CSV to standard output; give all but one a file")
    outputs: dict[str, str | Path | None] = {}
    inputs: dict[str, Path | None] = {"--model": model}
    for rig in rigs:
        whose = f"{rig.name}: " if rig.name else ""
        outputs |= {whose + flag: file for flag, file in rig.outputs.files.items()}
        inputs |= {whose + flag: file for flag, file in _inputs(rig).items()}
    check_files(outputs, inputs)
    for rig in rigs:
        with prefix_errors(rig.name):
            rig.outputs.check()
    if len(rigs) > 1:
        for flag, file in outputs.items():
            if file is not None and has_reader(file):
                raise click.UsageError(
                    f"{flag} {file} is no file on a disk: a slow reader of it would hold up every wearer; "
                    "give each a file, --udp or --tcp"
                )


def _inputs(rig: WearerConfig) -> dict[str, Path | None]:
    """Files that are read for a wearer, by flag."""
    source, sensor_map = rig.source, _map(rig)
    spoken = [source.protocol]
    spoken += [port.protocol or "" for port in sensor_map.ports.values()] if sensor_map is not None else []
    patterns = {f"--protocol {name}": Path(name) for name in spoken if name.endswith(".toml")}
    return {
        "--rig": rig.path,
        "--file": source.file,
        "--sensors": source.sensors,
        "--calibration": rig.calibration,
        **patterns,
    }


def _lines(rig: WearerConfig) -> dict[str, list[int | None]]:
    """The lines that a wearer listens to, and the ids of their sensors on them as far as a map tells."""
    from edgepose.sources.line_config import line_specs

    source = rig.source
    if source.file is not None:
        return {"standard input": []} if str(source.file) == "-" else {}
    with prefix_errors(rig.name):
        sensor_map = _map(rig)
        found = line_specs(
            *(source.port, source.baud, source.can, source.bitrate, source.fd, source.protocol), sensor_map
        )
    lines: dict[str, list[int | None]] = {}
    for link in found:
        if link.unit == "bytes":
            lines[f"port {link.name}"] = []  # which only one may open
        else:
            lines[f"bus {link.name}"] = [] if sensor_map is None else list(sensor_map.places(link.name))
    return lines


def _map(rig: WearerConfig) -> SensorMap | None:
    from edgepose.sources.sensor_map import read_map

    return None if rig.source.sensors is None else read_map(rig.source.sensors)
