"""`edgepose synthesize`: recordings of virtual IMUs from motion capture."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.skeleton import Body
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import check_free
from edgepose_export.cli.journal import Journal
from edgepose_export.training.sources import OWN, UNKNOWN, TakeInfo, take_info

if TYPE_CHECKING:
    from edgepose_export.mocap import Mapping, Motion
    from edgepose_export.mocap.zeroing import Zero

KINDS = (".bvh", ".amc", ".npz")

MOST_HOLD_FRAMES = 100_000
"""Longest time of standing before a motion, samples of a sensor."""


class Job(NamedTuple):
    """Settings of a conversion: the command's flags, and the folder that paths are relative to.

    `license_note` is the licence of motion that no rule knows, `zero` that of the file's actor, or None for
    that of the source.
    """

    out: Path
    root: Path
    rate: float
    body: Body
    hold_s: float
    mounting_seed: int | None
    seated_seed: int | None
    rests_seed: int | None
    license_note: str
    overwrite: bool
    t_pose: Path | None = None
    mapping: Mapping | None = None
    zero: Zero | None = None


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
@click.option(
    "--rate", type=click.FloatRange(1, 1000), default=60.0, show_default=True, help="Samples per second."
)
@click.option(
    "--height",
    type=click.FloatRange(0.8, 2.5),
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
    type=click.FloatRange(0, 600),
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
    from edgepose_export.mocap.mapping import read_mapping

    if out is None and picture is None:
        raise click.UsageError("Missing option '--out', the folder for the recordings.")
    if hold * rate > MOST_HOLD_FRAMES:
        raise click.UsageError(
            f"--hold {hold:g} at --rate {rate:g} takes too much memory: at most {MOST_HOLD_FRAMES} samples"
        )
    if seated_seed is not None and rests_seed is not None:
        raise click.UsageError("--seated and --rests make different takes: call synthesize once for each")
    if body_path and height:
        raise click.UsageError("--body sets the height: omit --height")
    body = read_smpl(body_path) if body_path else default_body(height or 1.75)
    files = [(root, path) for root in inputs for path in motion_files(root)]
    everything = files
    request = click.get_current_context().obj or Request(None, {})
    if request.files is not None:
        files = [(root, path) for root, path in files if path in request.files]
    if not files:
        raise EdgeposeError(f"no motion files ({', '.join(KINDS)}) in {', '.join(map(str, inputs))}")
    mapping = read_mapping(mapping_path) if mapping_path else None
    if picture:
        from edgepose_export.cli.skeleton_check import draw_skeletons

        draw_skeletons(files, picture, body, t_pose=t_pose, mapping=mapping, overwrite=overwrite)
    if out is None:
        return
    journal = Journal(out, _settings(click.get_current_context())) if resume else None
    overwrite |= journal is not None and journal.begun  # pieces of the file at which it was interrupted
    job = Job(
        out,
        out,
        rate,
        body,
        hold,
        mounting_seed,
        seated_seed,
        rests_seed,
        license_note,
        overwrite,
        t_pose,
        mapping,
    )
    tasks = [(path, job._replace(root=root if root.is_dir() else root.parent)) for root, path in files]
    _check_targets(tasks, overwrite)
    if journal:
        journal.begin()
        tasks = [task for task in tasks if _name(*task) not in journal]
    if zero == "wearer" and tasks:
        tasks = _zeroed(tasks, everything, request.zeros, jobs)
    failed = _convert_all(tasks, jobs, journal)
    say(f"{len(files) - failed} of {len(files)} recordings written to {out}")
    if failed:
        raise NotAllConvertedError(failed, len(files))


def _convert_all(tasks: list[tuple[Path, Job]], jobs: int, journal: Journal | None) -> int:
    """Convert files, in several processes if `jobs` is more than 1; return how many cannot be converted."""
    from edgepose_export.cli.progress import progress

    failed = 0
    with ExitStack() as stack:
        if jobs == 1:
            results = [partial(convert, *task) for task in tasks]
        else:
            # Spawned, because a forked copy of a process with threads may hang.
            pool = stack.enter_context(ProcessPoolExecutor(jobs, mp_context=get_context("spawn")))
            results = [pool.submit(convert, *task).result for task in tasks]
        for result, task in progress(list(zip(results, tasks, strict=True)), "synthesizing"):
            problem = result()
            if problem:
                failed += 1
                say(f"skipped: {problem}")
            elif journal:
                journal.add(_name(*task))
    return failed


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


def _name(path: Path, job: Job) -> str:
    """Return the name of a motion file in the journal: its path below the folder of the motion."""
    return path.relative_to(job.root).as_posix()


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


def about_take(path: Path, job: Job) -> TakeInfo:
    """Return source, licence, actor and part of a motion file, by its path from the motion's folder on."""
    info = take_info((job.root.absolute().name / path.relative_to(job.root)).with_suffix(""))
    if info.source.name != OWN:
        return info
    return info._replace(source=info.source._replace(license=job.license_note))


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
        targets = (_target(path, job, part) for path, job in tasks for part in ("", ".part1"))
        check_free(targets, "give --overwrite or another --out")


def _target(path: Path, job: Job, part: str) -> Path:
    """Return the path of the recording made of a motion file, or of a part of it."""
    from edgepose_export.training.dataset import RESTS, SEATED

    kind = SEATED if job.seated_seed is not None else RESTS if job.rests_seed is not None else ""
    return job.out / path.relative_to(job.root).with_name(f"{path.stem}{part}{kind}.npz")


def motion_files(root: Path) -> list[Path]:
    """Return the motion files below a folder, or the file itself; T-poses of others are no motion."""
    from edgepose_export.mocap.rest_search import is_t_pose_file

    if root.is_file():
        return [root]
    return sorted(
        path for path in root.rglob("*") if path.suffix.lower() in KINDS and not is_t_pose_file(path)
    )


def convert(path: Path, job: Job) -> str | None:
    """Convert one file, cut into parts where the source jumps; return what was wrong with it, or None."""
    import numpy as np

    from edgepose.rotations import transpose
    from edgepose_export.mocap import fault, pieces, read_motion, resample, scaled_to
    from edgepose_export.synthesis.virtual_imus import (
        random_mounting,
        recording_arrays,
        virtual_imus,
        with_hold,
    )

    info = about_take(path, job)
    try:
        mounting = None if job.mounting_seed is None else random_mounting(job.mounting_seed)
        whole = read_motion(path, job.t_pose, job.mapping)
        problem = fault(whole, job.rate)
        if problem:
            return f"{path}: {problem}"
        takes = pieces(whole)
        if not takes:
            return f"{path}: no part between two jumps is as long as a second"
        for i, take in enumerate(takes):
            motion = resample(scaled_to(take, job.body.leg_length_m), job.rate)
            directions = None
            if job.zero:
                motion = motion._replace(rotations=motion.rotations @ job.zero.straight)
                directions = transpose(job.zero.straight) @ job.zero.directions
            if job.seated_seed is not None:
                directions = None  # the legs are made on the body as it is zeroed
            motion = _with_made_parts(motion, job, [i, *path.stem.encode()])
            if job.hold_s:
                motion = with_hold(motion, job.hold_s)
            imus = virtual_imus(motion, job.body, mounting, directions)
            part = f".part{i + 1}" if len(takes) > 1 else ""
            target = _target(path, job, part)
            target.parent.mkdir(parents=True, exist_ok=True)
            arrays = recording_arrays(motion, imus, info.source.license, info.source.name, info.actor)
            arrays["zero"] = np.array(job.zero.evidence if job.zero else "source")
            replace_file(
                target,
                lambda file, arrays=arrays: np.savez(file, **arrays),
                "recording",
                overwrite=job.overwrite,
            )
    except EdgeposeError as error:
        return str(error)
    except OSError as error:
        return f"{path}: {error}"
    return None


def _with_made_parts(motion: Motion, job: Job, key: list[int]) -> Motion:
    """Return a motion with synthetic sitting or rests if the job asks for them.

    The key, numbers made of the take's name, is part of the seed, so that a take does not depend on the
    others in the call.
    """
    import numpy as np

    from edgepose_export.synthesis.floor import SHARE, on_the_floor
    from edgepose_export.synthesis.rests import with_rests
    from edgepose_export.synthesis.sitting import seated

    if job.seated_seed is not None:
        seed = [job.seated_seed, *key]
        make = on_the_floor if np.random.default_rng([1, *seed]).random() < SHARE else seated
        return make(motion, job.body, np.random.default_rng(seed))
    if job.rests_seed is not None:
        return with_rests(motion, job.body, np.random.default_rng([job.rests_seed, *key]))
    return motion
