"""`edgepose convert`: convert recordings, captures and poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.many_files import Outcome, raise_failures, text_table, with_progress
from edgepose.cli.options.body import HEIGHT, leg_length_option
from edgepose.cli.options.json_result import json_option, show_json
from edgepose.cli.options.outputs import overwrite_option, rate_option
from edgepose.cli.options.source import protocol_option, sensors_option
from edgepose.cli.terminal.messages import show
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.bvh import UNITS
from edgepose.formats.poses.registry import READERS as POSES
from edgepose.formats.recordings.registry import READERS as RECORDINGS
from edgepose.sinks.output_files import check_output
from edgepose.sinks.registry import SINKS
from edgepose.utils.output_targets import FileTarget, check_free, parse_file
from edgepose.utils.similar_names import choices

if TYPE_CHECKING:
    from edgepose.convert import Job, Result

_FORMATS = {name: output.options for name, output in SINKS.items() if output.suffix}
_OF_POSES = [name for name in _FORMATS if name not in ("csv", "npz")]


def _format(ctx: click.Context, param: click.Parameter, value: str) -> FileTarget:
    """Parse the value of --to: a name and options."""
    name = value.partition(",")[0]
    try:
        if name not in _FORMATS:
            raise EdgeposeError(f"unknown format {name!r}; {choices(name, _FORMATS)}")
        target = parse_file(value, _FORMATS[name])
        if target.path != name:
            raise EdgeposeError(f"{value!r}: write options as {name},OPTION=VALUE")
        return target
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


@click.command()
@click.argument(
    "inputs", nargs=-1, required=True, metavar="IN...", type=click.Path(path_type=Path, allow_dash=True)
)
@click.option(
    "--to",
    required=True,
    callback=_format,
    shell_complete=lambda ctx, param, typed: [name for name in _FORMATS if name.startswith(typed)],
    metavar="FORMAT[,OPTION=VALUE ...]",
    help=f"Format to write: csv or npz, and of poses also {', '.join(_OF_POSES)}. Those of poses take the "
    "options of the flags of `run`: npz,joints=52 or bvh,names=unity,unit=m.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder to write to; created if it does not exist.",
)
@click.option(
    "--filter",
    type=click.Choice(["none", "kalman", "smoother", "vqf"]),
    default="none",
    show_default=True,
    help="Compute orientations from gyroscope, accelerometer and, where available, magnetometer; smoother "
    "uses later samples, too. none: keep the orientations that the sensors sent.",
)
@click.option(
    "--height",
    type=HEIGHT,
    default=1.75,
    show_default=True,
    help="The wearer's height, metres, for the bones of BVH, GLB and MOT files.",
)
@leg_length_option
@click.option(
    "--unit",
    type=click.Choice(list(UNITS)),
    help="Unit of lengths in the BVH files to read.  [default: inferred from the length of the shanks]",
)
@rate_option
@protocol_option
@sensors_option
@click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of processes, each of which converts one recording at a time.",
)
@click.option("--skip-existing", is_flag=True, help="Skip recordings whose output exists.")
@overwrite_option
@json_option
def convert(
    inputs: tuple[Path, ...],
    to: FileTarget,
    out: Path,
    filter: str,
    height: float,
    leg_length: float | None,
    unit: str | None,
    rate: float | None,
    protocol: str,
    sensors: Path | None,
    jobs: int,
    skip_existing: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Convert recordings ({recordings}), raw captures of a port, logs of a CAN bus, and poses ({poses}).

    IN are files, patterns and folders. A folder stands for all recordings in it, at any depth. A folder with
    one subfolder per x-io sensor is one recording; the names of the subfolders contain the placements, or
    --sensors maps their serial numbers as ids (id = 0x64F61CB3). The good part of a damaged recording is
    written, and the poses of a BVH file before the first bad one; the exit code is then 1.

    Poses become CSV, NPZ, BVH, GLB, STO or MOT. From a recording with true poses, such as DIP-IMU's, the last
    four take these.
    - reads CSV from standard input.

    \b
    Examples:
      edgepose convert walk.npz --to csv --out .
      edgepose convert sessions/ "more/*.bin" --to npz --out recordings --jobs 4
      edgepose convert raw.csv --to npz --out oriented --filter smoother
      edgepose convert poses/ --to bvh,names=mixamo --out blender --height 1.68
      edgepose convert poses.csv --to npz,joints=52 --out amass --rate 30
      edgepose run ... --csv - | edgepose convert - --to bvh --out .
    """
    from edgepose.convert import Options, Result, convert_all, plan
    from edgepose.skeleton import default_body
    from edgepose.sources.sensor_map import read_map

    if skip_existing and overwrite:
        raise click.UsageError("--skip-existing keeps what --overwrite replaces: give one of them")
    # Checked here, so that a mistake in them is reported once and not for each recording.
    default_body(height, leg_length_m=leg_length)
    if sensors is not None:
        read_map(sensors)
    planned = plan(inputs, to.path, out)
    done = {job: Result(job, skipped=True) for job in planned if skip_existing and job.target.exists()}
    todo = [job for job in planned if job not in done]
    _check_targets(todo, to.path, overwrite)
    try:
        flags = protocol, sensors, filter, height, overwrite, unit, leg_length, dict(to.options), rate
        results = convert_all(todo, Options(*flags), jobs)
        for result in with_progress(results, len(todo), "Converting", _outcome):
            done[result.job] = result
    finally:
        _show([done[job] for job in planned if job in done], len(planned), as_json)
    failed = sum(result.problem is not None for result in done.values())
    raise_failures(failed, len(planned), "not converted, or only in part")


convert.help = (convert.help or "").format(
    recordings=", ".join(reader.files for reader in RECORDINGS.values()),
    poses=", ".join(reader.files for reader in POSES.values()),
)


def _check_targets(jobs: Sequence[Job], to: str, overwrite: bool) -> None:
    """Raise EdgeposeError if a job would replace a file that it must not replace."""
    if not overwrite:
        check_free((job.target for job in jobs), "give --skip-existing, --overwrite or another --out")
    for job in jobs:
        if job.target.is_symlink():  # it may lead to a file of another kind
            check_output(job.target, "the output", (f".{to}",), overwrite)


def _outcome(result: Result) -> Outcome:
    from edgepose.convert import outcome

    return Outcome(str(result.job.source), outcome(result), result.problem)


def _show(results: Sequence[Result], planned: int, as_json: bool) -> None:
    """Show the results."""
    from edgepose.convert import outcome, state

    if as_json:
        files = [
            {
                "source": result.job.source,
                "target": result.job.target,
                "result": state(result),
                "samples": result.samples,
                "seconds": result.seconds,
                "sensors": result.sensors if result.samples else 0,
                "problem": result.problem,
            }
            for result in results
        ]
        show_json("convert", {"planned": planned, "files": files})
        return
    rows = [
        (
            str(result.job.source),
            *((str(result.samples), f"{result.seconds:.1f}") if result.samples else ("-", "-")),
            outcome(result),
        )
        for result in results
    ]
    show(text_table(("file", "samples", "seconds", "result"), rows))
