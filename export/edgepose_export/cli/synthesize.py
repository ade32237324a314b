"""`edgepose synthesize`: recordings of virtual IMUs from motion capture."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from edgepose.cli.options.outputs import overwrite_option
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError
from edgepose.skeleton import Body
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import check_free

if TYPE_CHECKING:
    from edgepose_export.mocap import Mapping

KINDS = (".bvh", ".amc", ".npz")

MOST_HOLD_FRAMES = 100_000
"""Longest time of standing before a motion, samples of a sensor."""

LICENSES = {
    "cmu": "CMU Graphics Lab Motion Capture Database (mocap.cs.cmu.edu, NSF EIA-0196217), free for all use",
    "bandai-namco": "Bandai-Namco Research Motiondataset, CC BY-NC 4.0",
    "amass": "the licence of the AMASS subset",
}
UNKNOWN_LICENSE = "unknown"


class Job(NamedTuple):
    """Settings of a conversion: the command's flags, and the folder that paths are relative to."""

    out: Path
    root: Path
    rate: float
    body: Body
    hold_s: float
    mounting_seed: int | None
    seated_seed: int | None
    overwrite: bool
    t_pose: Path | None = None
    mapping: Mapping | None = None


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
    "rise at random, drawn with this seed; about half a minute per take.",
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
@overwrite_option
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
    t_pose: Path | None,
    mapping_path: Path | None,
    picture: Path | None,
    overwrite: bool,
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
    if body_path and height:
        raise click.UsageError("--body sets the height: omit --height")
    body = read_smpl(body_path) if body_path else default_body(height or 1.75)
    files = [(root, path) for root in inputs for path in motion_files(root)]
    if not files:
        raise EdgeposeError(f"no motion files ({', '.join(KINDS)}) in {', '.join(map(str, inputs))}")
    mapping = read_mapping(mapping_path) if mapping_path else None
    if picture:
        from edgepose.analysis.figures import check_picture
        from edgepose_export.cli.skeleton_check import draw_skeletons

        check_picture(picture, "--check", overwrite)
        draw_skeletons(files, picture, body, t_pose=t_pose, mapping=mapping, overwrite=overwrite)
    if out is None:
        return
    flags = (rate, body, hold, mounting_seed, seated_seed, overwrite, t_pose, mapping)
    tasks = [(path, Job(out, root if root.is_dir() else root.parent, *flags)) for root, path in files]
    _check_targets(tasks, overwrite)
    _convert_all(tasks, jobs)


def _convert_all(tasks: list[tuple[Path, Job]], jobs: int) -> None:
    """Convert files in parallel, and report those that cannot be converted.

    Raises:
        EdgeposeError: a file could not be converted.
    """
    from edgepose_export.cli.progress import progress

    failed = 0
    with ExitStack() as stack:
        if jobs == 1:
            results = [partial(convert, *task) for task in tasks]
        else:
            # Spawned, because a forked copy of a process with threads may hang.
            pool = stack.enter_context(ProcessPoolExecutor(jobs, mp_context=get_context("spawn")))
            results = [pool.submit(convert, *task).result for task in tasks]
        for result in progress(results, "synthesizing"):
            problem = result()
            if problem:
                failed += 1
                say(f"skipped: {problem}")
    say(f"{len(tasks) - failed} of {len(tasks)} recordings written to {tasks[0][1].out}")
    if failed:
        raise EdgeposeError(f"{failed} of {len(tasks)} files could not be converted; see the messages above")


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
    from edgepose_export.training.dataset import SEATED

    kind = "" if job.seated_seed is None else SEATED
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

    from edgepose_export.mocap import fault, pieces, read_motion, resample, scaled_to
    from edgepose_export.synthesis.sitting import seated
    from edgepose_export.synthesis.virtual_imus import (
        random_mounting,
        recording_arrays,
        virtual_imus,
        with_hold,
    )

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
            if job.seated_seed is not None:
                # Seeded by name, so that a take does not depend on the others in the call.
                rng = np.random.default_rng([job.seated_seed, i, *path.stem.encode()])
                motion = seated(motion, job.body, rng)
            if job.hold_s:
                motion = with_hold(motion, job.hold_s)
            imus = virtual_imus(motion, job.body, mounting)
            part = f".part{i + 1}" if len(takes) > 1 else ""
            target = _target(path, job, part)
            target.parent.mkdir(parents=True, exist_ok=True)
            arrays = recording_arrays(motion, imus, LICENSES.get(motion.source, UNKNOWN_LICENSE))
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
