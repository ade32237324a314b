"""Conversion of recordings and poses between formats, many at once; a bad file does not stop the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.formats.gltf import write_glb
from edgepose.formats.poses.missing_frames import fill_missing_frames
from edgepose.formats.poses.npz_amass import write_npz as write_poses_npz
from edgepose.formats.poses.registry import is_poses, salvage_poses
from edgepose.formats.poses.resampling import resample
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseSequence
from edgepose.sinks.base import SinkContext
from edgepose.sinks.registry import SINKS, sink_factory
from edgepose.skeleton import default_body
from edgepose.sources.input_files import expand, recordings_and_poses
from edgepose.sources.whole_file import read_file
from edgepose.utils.durable_files import make_folder, replace_file
from edgepose.utils.jobs import run_jobs
from edgepose.utils.output_targets import FileTarget

WRITERS: dict[str, Callable[[Path, Recording], None]] = {"csv": write_csv, "npz": write_npz}
"""Writers of recordings, by ending."""

_OF_POSES = {name for name, output in SINKS.items() if output.suffix} - WRITERS.keys()


class Job(NamedTuple):
    """One recording, or file of poses, to convert.

    Attributes:
        source: file, or folder of a session of x-io's software or MT Manager.
        target: file to write.
    """

    source: Path
    target: Path


class Options(NamedTuple):
    """Options of a conversion.

    Attributes:
        protocol: protocol of raw captures and CAN logs.
        sensors: map of devices to placements, for captures, CAN logs and sessions.
        filter: orientation filter, see `orient_recording`; "none" keeps the file's orientations.
        height_m: the wearer's stature, for the bones of BVH files, metres.
        overwrite: replace existing files.
        unit: of lengths in BVH files to read, a key of `UNITS` in `formats.poses.bvh`; None infers it.
        leg_length_m: length of the wearer's thigh and shank, metres; None for the average at `height_m`.
        form: options of the files of poses to write, see `Output` in `sinks.registry`; others have defaults.
        rate: poses per second to write; None keeps those of the file.
    """

    protocol: str = "auto"
    sensors: Path | None = None
    filter: str = "none"
    height_m: float = 1.75
    overwrite: bool = True
    unit: str | None = None
    leg_length_m: float | None = None
    form: Mapping[str, str] = MappingProxyType({})
    rate: float | None = None


_DEFAULTS = Options()


class Result(NamedTuple):
    """The result of one conversion.

    Attributes:
        job: the conversion.
        samples: number of samples or poses written.
        seconds: time from the first sample to the last.
        problem: one line for the user if all or part of the source could not be read; None otherwise.
        sensors: number of sensors with samples, if it is a recording.
        skipped: the target existed already.
    """

    job: Job
    samples: int = 0
    seconds: float = 0.0
    problem: str | None = None
    sensors: int = len(PLACEMENTS)
    skipped: bool = False


def plan(inputs: Sequence[Path], to: str, out: Path) -> list[Job]:
    """Return the conversions for the user's inputs.

    Args:
        inputs: files ("-" is CSV on standard input), folders that hold them at any depth, and x-io sessions;
            a name with `*`, `?` or `[` that is not a file is a pattern.
        to: ending of the files to write.
        out: folder to write to; files in an input folder keep their relative paths in it.

    Raises:
        EdgeposeError: an input is missing or empty, or a file would be written twice or over an input.
    """
    files = expand(inputs, [out], recordings_and_poses())
    jobs = [Job(source, out / name.parent / f"{name.name}.{to}") for source, name in files]
    sources = {job.source.resolve() for job in jobs}
    for job in jobs:
        if job.target.resolve() in sources:
            raise EdgeposeError(f"{job.target} would be written over an input; choose another --out")
    return jobs


def convert(job: Job, options: Options = _DEFAULTS) -> Result:
    """Convert one file, keeping its good part if it is damaged."""
    try:
        if job.target.suffix[1:] in _OF_POSES or is_poses(job.source):
            if options.filter != "none":
                raise EdgeposeError(f"{job.source}: --filter is for recordings, not for poses; leave it out")
            make_folder(job.target.parent)
            return Result(job, *convert_poses(job.source, job.target, options))
        if options.rate is not None:
            raise EdgeposeError(f"{job.source}: --rate is for poses, not for recordings; leave it out")
        recording = read_file(job.source, options.protocol, options.sensors)
        data = recording.sensors.values()
        if not data:
            raise EdgeposeError(recording.damage or f"{job.source}: no samples")
        if options.filter != "none":
            from edgepose.orientation.offline import orient_recording

            recording = orient_recording(recording, options.filter, name=str(job.source))
        make_folder(job.target.parent)
        write = WRITERS[job.target.suffix[1:]]
        replace_file(
            job.target, lambda path: write(path, recording), "recording", overwrite=options.overwrite
        )
    except EdgeposeError as error:
        return Result(job, problem=str(error))
    except MemoryError:
        return Result(job, problem=f"{job.source}: not enough memory; convert it with fewer --jobs")
    except OSError as error:
        return Result(job, problem=f"{error.filename or job.target}: {error.strerror or error}")
    except Exception as error:  # a bug, which must not stop the other files
        return Result(job, problem=f"{job.source}: cannot be converted, please report it: {error!r}")
    return Result(
        job,
        samples=sum(len(d.time_s) for d in data),
        seconds=float(max(d.time_s[-1] for d in data) - min(d.time_s[0] for d in data)),
        sensors=len(data),
        problem=recording.damage,
    )


def convert_all(jobs: Sequence[Job], options: Options = _DEFAULTS, workers: int = 1) -> Iterator[Result]:
    """Run conversions, and yield their results as they finish.

    Args:
        jobs: the conversions.
        options: options of all of them.
        workers: number of processes; 1 works in this process.
    """
    work = partial(convert, options=options)
    # Worker processes have no standard input.
    yield from map(work, (job for job in jobs if str(job.source) == "-"))
    jobs = [job for job in jobs if str(job.source) != "-"]
    yield from run_jobs(
        work, jobs, workers, lambda job, reason: Result(job, problem=f"{job.source}: {reason}")
    )


# --- poses --------------------------------------------------------------------------------------------------


def _write_poses(path: Path, poses: PoseSequence, options: Options) -> None:
    kind = path.suffix[1:]
    form = {name: options.form.get(name, values[0]) for name, values in SINKS[kind].options.items()}
    body = default_body(options.height_m, leg_length_m=options.leg_length_m)
    if kind == "npz":
        write_poses_npz(path, [poses], len(poses.frames), poses.rate, int(form["joints"]), poses.about)
    elif kind == "glb":
        write_glb(path, [poses], len(poses.frames), poses.rate, body.offsets, form["names"], poses.about)
    else:
        context = SinkContext(
            body=body,
            rate=poses.rate,
            translation=poses.translation is not None,
            contacts=poses.contacts is not None,
            overwrite=True,  # of the temporary file
        )
        with sink_factory(kind)(
            FileTarget(str(path), tuple(form.items())) if form else str(path), context
        ) as sink:
            for pose in poses.pose_frames():
                sink.write(pose)


def convert_poses(source: Path, target: Path, options: Options = _DEFAULTS) -> tuple[int, float, str | None]:
    """Convert the good part of a file of poses; the target appears once it is complete.

    Args:
        source: file that `edgepose.formats.poses.registry.read_poses` reads.
        target: file with the ending of an output.
        options: options of the conversion.

    Returns:
        Number of poses, seconds from the first to the last, and one line about the bad part, if any.

    Raises:
        EdgeposeError: no part of the source is good, or the target cannot be written.
    """
    poses, damage = salvage_poses(source, options.unit)
    read = poses
    # Formats other than CSV hold no frame numbers, or programs ignore them.
    if target.suffix != ".csv" or options.rate is not None:
        poses, missing = fill_missing_frames(poses, str(source))
        if missing:
            gaps = f"{source}: {missing} frames are missing between its poses; they are interpolated"
            damage = gaps if damage is None else f"{damage}; {gaps}"
    if options.rate is not None:
        poses = resample(poses, options.rate)
    replace_file(
        target, lambda path: _write_poses(path, poses, options), "poses", overwrite=options.overwrite
    )
    count = len(read.frames) if options.rate is None else len(poses.frames)
    return count, float(read.time_s[-1] - read.time_s[0]), damage


def state(result: Result) -> str:
    """Return the outcome of a conversion in a word: "ok", "damaged", "failed" or "skipped"."""
    if result.skipped:
        return "skipped"
    if not result.samples:
        return "failed"
    return "damaged" if result.problem else "ok"


def outcome(result: Result) -> str:
    """Return the outcome of a conversion in a few words."""
    if result.skipped:
        return "skipped, already exists"
    few = result.samples and result.sensors < len(PLACEMENTS)
    return state(result) + (f", {result.sensors} of {len(PLACEMENTS)} sensors" if few else "")
