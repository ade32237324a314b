"""`edgepose synthesize`: recordings of virtual IMUs from motion capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.body import HEIGHT
from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.utils.jobs import run_jobs
from edgepose.utils.output_targets import check_free
from edgepose_export.cli.journal import Journal
from edgepose_export.cli.recording_jobs import (
    KINDS,
    Job,
    about_take,
    convert,
    file_name,
    motion_files,
    recording_path,
)
from edgepose_export.training.sources import UNKNOWN

if TYPE_CHECKING:
    from edgepose_export.mocap.zeroing import Zero

MOST_HOLD_FRAMES = 100_000
"""Longest time of standing before a motion, samples of a sensor."""


class Request(NamedTuple):
    """What a recipe of `edgepose train` hands over beside the flags.

    Attributes:
        files: the motion files to convert; None for all below the inputs.
        zeros: zeros of actors that are known already; those of other actors are added.
    """

    files: frozenset[Path] | None
    zeros: dict[str, Zero]


@click.command(short_help="Make recordings from motion capture.")
@click.argument("inputs", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the recordings (.npz); needed unless there is --check.",
)
@click.option("--rate", type=FloatRange(1, 1000), default=60.0, show_default=True, help="Samples per second.")
@click.option(
    "--height",
    type=HEIGHT,
    help="Height of the default body, metres  [default: 1.75]",
)
@click.option(
    "--body",
    "body_path",
    type=click.Path(path_type=Path),
    help="Your own SMPL model file (.npz or .pkl) instead of the default body; a .pkl's code is not run.",
)
@click.option(
    "--hold",
    type=FloatRange(0, 600),
    default=0.0,
    show_default=True,
    help="Seconds of standing straight before the motion.",
)
@click.option(
    "--mounting",
    "mounting_seed",
    type=click.IntRange(0),
    metavar="SEED",
    help="Strap the sensors on at random angles drawn with this seed  [default: aligned with the bones]",
)
@click.option(
    "--seated",
    "seated_seed",
    type=click.IntRange(0),
    metavar="SEED",
    help="Keep only the motion of the upper body, play it to and fro, and let the wearer sit down, squat and "
    "rise, or kneel and sit on the floor, at random, drawn with this seed; about half a minute per take.",
)
@click.option(
    "--rests",
    "rests_seed",
    type=click.IntRange(0),
    metavar="SEED",
    help="Let the wearer slow down, rest and go on, forwards or backwards, at random, drawn with this seed; "
    "mostly where the body is low; about half a minute per take.",
)
@click.option(
    "--zero",
    type=click.Choice(["wearer", "source"]),
    default="wearer",
    show_default=True,
    help="wearer: each actor is zeroed in the straight pose, found in all of the actor's takes, as a "
    "calibration zeroes a wearer; source: the bones' zero is that of the motion capture.",
)
@click.option(
    "--t-pose",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="BVH file of the same skeleton with a T-pose in it, for files whose zero pose is none.  [default: "
    "t_pose*.bvh beside, frame 0 or the zero pose]",
)
@click.option(
    "--mapping",
    "mapping_path",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="TOML file that says which joint is which where a skeleton is not understood: lines such as "
    'left_thigh = "Bone12"; also unit = "cm", up = "z".',
)
@click.option(
    "--check",
    "picture",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="PICTURE",
    help="Draw a take of each skeleton beside the body that follows it (.png, .pdf, .svg), to look at.",
)
@click.option(
    "--license",
    "license_note",
    metavar="TEXT",
    default=UNKNOWN,
    show_default=True,
    help="Licence of your own motion, for the cards of models trained on it; the licences of published "
    "motion are known by the names of its files.",
)
@overwrite_option
@click.option(
    "--resume",
    is_flag=True,
    help="Go on with an interrupted call that had --resume and the same flags: files that it completed are "
    "left as they are.",
)
@click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, help="Files to process in parallel."
)
def synthesize(
    inputs: tuple[Path, ...],
    out: Path | None,
    rate: float,
    height: float | None,
    body_path: Path | None,
    hold: float,
    mounting_seed: int | None,
    seated_seed: int | None,
    rests_seed: int | None,
    zero: str,
    t_pose: Path | None,
    mapping_path: Path | None,
    picture: Path | None,
    license_note: str,
    overwrite: bool,
    resume: bool,
    jobs: int,
) -> None:
    """Make IMU recordings with true poses from motion capture (.bvh, .amc, AMASS .npz; folders are searched).

    Recordings made with the default flags are for training. One made with --hold can be calibrated and run
    like a real one.

    \b
    Examples:
      edgepose synthesize mocap/ --out recordings/ --jobs 2
      edgepose synthesize walk.bvh --out . --hold 6 --mounting 1 --rate 100
      edgepose synthesize mocap/ --out recordings/seated --seated 1
      edgepose synthesize mocap/ --out recordings/rests --rests 1
      edgepose synthesize mocap/ --check skeletons.png
    """
    from edgepose.formats.smpl_model import read_smpl
    from edgepose.skeleton import default_body
    from edgepose_export.cli.skeleton_check import draw_skeletons
    from edgepose_export.mocap.mapping import read_mapping

    _check_usage(click.get_current_context())
    body = read_smpl(body_path) if body_path else default_body(height or 1.75)
    request = click.get_current_context().obj or Request(None, {})
    everything = [(root, path) for root in inputs for path in motion_files(root)]
    files = [pair for pair in everything if request.files is None or pair[1] in request.files]
    if not files:
        raise EdgeposeError(f"no motion files ({', '.join(KINDS)}) in {', '.join(map(str, inputs))}")
    mapping = read_mapping(mapping_path) if mapping_path else None
    if picture:
        draw_skeletons(files, picture, body, t_pose=t_pose, mapping=mapping, overwrite=overwrite)
    if out is None:
        return
    journal = Journal(out, _settings(click.get_current_context())) if resume else None
    overwrite |= journal is not None and journal.begun  # pieces of the file at which it was interrupted
    seeds = (mounting_seed, seated_seed, rests_seed)
    job = Job(out, out, rate, body, hold, *seeds, license_note, overwrite, t_pose, mapping)
    tasks = [(path, job._replace(root=root if root.is_dir() else root.parent)) for root, path in files]
    _check_targets(tasks, overwrite)
    if journal:
        journal.begin()
        tasks = [task for task in tasks if file_name(*task) not in journal]
    zeroed = _zeroed(tasks, everything, request.zeros, jobs) if zero == "wearer" and tasks else tasks
    _convert_all(zeroed, len(files), out, jobs, journal)


def _check_usage(context: click.Context) -> None:
    """Raise click.UsageError if flags do not go together."""
    flags = context.params
    if flags["out"] is None and flags["picture"] is None:
        raise click.UsageError("Missing option '--out', the folder for the recordings.")
    if flags["hold"] * flags["rate"] > MOST_HOLD_FRAMES:
        raise click.UsageError(
            f"--hold {flags['hold']:g} at --rate {flags['rate']:g} takes too much memory: at most "
            f"{MOST_HOLD_FRAMES} samples"
        )
    if flags["seated_seed"] is not None and flags["rests_seed"] is not None:
        raise click.UsageError("--seated and --rests make different takes: call synthesize once for each")
    if flags["body_path"] and flags["height"]:
        raise click.UsageError("--body sets the height: omit --height")


def _convert_all(
    tasks: list[tuple[Path, Job]], files: int, out: Path, jobs: int, journal: Journal | None
) -> None:
    """Convert files, in several processes if `jobs` is more than 1, and report those that cannot be.

    Raises:
        NotAllConvertedError: a file could not be converted.
    """
    from edgepose_export.cli.progress import progress

    failed = 0
    results = run_jobs(_convert, tasks, jobs, lambda task, reason: (task, f"{task[0]}: {reason}"))
    for task, problem in progress(results, "synthesizing", len(tasks)):
        if problem:
            failed += 1
            say(f"skipped: {problem}")
        elif journal:
            journal.add(file_name(*task))
    say(f"{files - failed} of {files} recordings written to {out}")
    if failed:
        raise NotAllConvertedError(failed, files)


def _convert(task: tuple[Path, Job]) -> tuple[tuple[Path, Job], str | None]:
    """Return a task, and what was wrong with its file."""
    return task, convert(*task)


class NotAllConvertedError(EdgeposeError):
    """Some motion files could not be converted; the recordings of the others are complete.

    Attributes:
        count: number of these files.
    """

    def __init__(self, count: int, files: int) -> None:
        """Create the error; `files` is the number of all files."""
        super().__init__(f"{count} of {files} files could not be converted; see the messages above")
        self.count = count


def _settings(context: click.Context) -> dict[str, Any]:
    """Return the inputs and flags that decide what the recordings are."""
    return {
        name: value
        for name, value in context.params.items()
        if name not in ("out", "overwrite", "resume", "jobs")
    }


def _zeroed(
    tasks: list[tuple[Path, Job]], files: list[tuple[Path, Path]], zeros: dict[str, Zero], jobs: int
) -> list[tuple[Path, Job]]:
    """Return the tasks with the zero of each actor, which is found in all files, not in the tasks' alone."""
    from edgepose_export.cli.actor_zeros import find_zeros

    job = tasks[0][1]
    wanted = {about_take(*task).actor for task in tasks} - set(zeros)
    actors: dict[str, list[Path]] = {}
    for root, path in files:
        actor = about_take(path, job._replace(root=root if root.is_dir() else root.parent)).actor
        if actor in wanted:
            actors.setdefault(actor, []).append(path)
    zeros |= find_zeros(actors, job.t_pose, job.mapping, jobs) if actors else {}
    return [(path, job._replace(zero=zeros.get(about_take(path, job).actor))) for path, job in tasks]


def _check_targets(tasks: list[tuple[Path, Job]], overwrite: bool) -> None:
    """Check that no recording would overwrite another file.

    Raises:
        EdgeposeError: two files would become one recording, such as a take's .amc and .bvh; or a recording
            exists and may not be overwritten.
    """
    seen: dict[Path, Path] = {}
    for path, job in tasks:
        target = job.out / path.relative_to(job.root).with_suffix(".npz")
        if target in seen:
            raise EdgeposeError(
                f"{seen[target]} and {path} would both become {target}; give only one of them"
            )
        if target.resolve() == path.resolve():
            raise EdgeposeError(f"{path} would be overwritten by its recording; give another --out")
        seen[target] = path
    if not overwrite:
        targets = (recording_path(path, job, part) for path, job in tasks for part in ("", ".part1"))
        check_free(targets, "give --overwrite or another --out")
