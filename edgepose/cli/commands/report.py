"""`edgepose report`: make a page with the angles, steps and sensors of poses."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

import click

from edgepose.cli.options.body import HEIGHT, leg_length_option
from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import show
from edgepose.sinks.output_files import check_output


@click.command()
@click.argument("poses", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="HTML file to write.  [default: POSES with the ending .html]",
)
@click.option(
    "--height",
    type=HEIGHT,
    default=1.75,
    show_default=True,
    help="The wearer's height, metres, for the figures and for finding steps.",
)
@leg_length_option
@overwrite_option
def report(poses: Path, out: Path | None, height: float, leg_length: float | None, overwrite: bool) -> None:
    """Make one HTML page about the poses of a file (CSV, BVH, or NPZ with the keys of AMASS): figures, steps
    and cadence, joint angles over time, ranges of motion, and how often each sensor was silent.

    The page is one self-contained file. The command needs `pip install 'edgepose[plot]'`.

    \b
    Examples:
      edgepose report poses.csv
      edgepose report poses.npz --out anna.html --height 1.68
    """
    from edgepose.analysis.report import write_report
    from edgepose.formats.poses.registry import read_poses
    from edgepose.skeleton import default_body

    if poses.is_dir():
        raise click.UsageError(f"{poses} is a folder: give a file of poses")
    path = poses.with_suffix(".html") if out is None else out
    if os.path.realpath(path) == os.path.realpath(poses):
        raise click.UsageError(f"--out would overwrite {poses}; name another file")
    check_output(path, "the report", (".html", ".htm"), overwrite)
    body = default_body(height, leg_length_m=leg_length)
    sequence = read_poses(poses)
    made = datetime.fromtimestamp(poses.stat().st_mtime).astimezone() if poses.is_file() else None
    date = "" if made is None else made.isoformat(" ", "minutes")
    write_report(path, sequence, body, poses.name, overwrite, date)
    show(f"Wrote {path}.")
