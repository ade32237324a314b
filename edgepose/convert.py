"""Conversion of recordings and poses between formats, many at once; a bad file does not stop the rest."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.formats.gltf import write_glb
from edgepose.formats.poses.missing_frames import fill_missing_frames
from edgepose.formats.poses.npz_amass import write_npz as write_poses_npz
from edgepose.formats.poses.registry import is_poses, pose_suffixes, salvage_poses
from edgepose.formats.poses.resampling import resample
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import (
    check_no_part,
    find_format,
    find_whole,
    recording_suffixes,
)
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseSequence
from edgepose.sinks.base import SinkContext
from edgepose.sinks.registry import SINKS, sink_factory
from edgepose.skeleton import default_body
from edgepose.sources.replay import CAN_LOGS, CAPTURES, is_can_log
from edgepose.sources.whole_file import read_file
from edgepose.utils.durable_files import replace_file
from edgepose.utils.output_targets import FileTarget

WRITERS: dict[str, Callable[[Path, Recording], None]] = {"csv": write_csv, "npz": write_npz}
"""Writers of recordings, by ending."""

_OF_POSES = {name for name, output in SINKS.items() if output.suffix} - WRITERS.keys()


def _endings() -> tuple[str, ...]:
    """Return the endings of the files to look for in a folder."""
    return tuple(
        dict.fromkeys([".csv", ".npz", *CAPTURES, *CAN_LOGS, *recording_suffixes(), *pose_suffixes()])
    )


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
    jobs: dict[Path, Job] = {}
    for input_path in inputs:
        for source, relative in _expand(input_path, out):
            # The whole name of a folder: an x-io session has no ending, but there may be dots in its name.
            name = relative.name if source.is_dir() else relative.stem
            job = Job(source, out / relative.parent / f"{name}.{to}")
            other = jobs.setdefault(job.target, job)
            if other.source != source:
                raise EdgeposeError(
                    f"{other.source} and {source} would both become {job.target}; convert them separately, "
                    "each with its own --out"
                )
    sources = {job.source.resolve() for job in jobs.values()}
    for job in jobs.values():
        if job.target.resolve() in sources:
            raise EdgeposeError(f"{job.target} would be written over an input; choose another --out")
    return list(jobs.values())


def _expand(source: Path, out: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the recordings that an input stands for, and their relative paths in the output folder."""
    if source.is_dir():
        endings = _endings()
        try:
            found = sorted(_find_recordings(source, out.resolve(), endings))
        except OSError as error:
            raise EdgeposeError(f"{error.filename}: cannot list it: {error.strerror}") from None
        if not found:
            raise EdgeposeError(
                f"{source}: no recording in this folder; names end in {', '.join(endings)}, or .gz of a log"
            )
        for path in found:
            # A session folder given by itself keeps its own name.
            yield path, Path(source.resolve().name) if path == source else path.relative_to(source)
    elif str(source) == "-":
        if sys.stdin is None:
            raise EdgeposeError("-: there is no standard input; name a file")
        yield source, Path("stdin")
    elif source.exists():
        if not source.is_file():
            raise EdgeposeError(
                f"{source}: not a regular file; convert its output from standard input: convert - < {source}"
            )
        yield source, Path(source.name)
    elif any(mark in str(source) for mark in "*?["):
        # A pattern that the shell has not expanded: it was quoted, or the shell is that of Windows.
        root = Path(source.anchor or ".")
        pattern = str(source.relative_to(source.anchor) if source.anchor else source)
        found = sorted(path for path in root.glob(pattern) if not _is_hidden(path) or _is_hidden(source))
        if not found:
            raise EdgeposeError(f"{source}: no file matches this pattern")
        for path in found:
            yield from _expand(path, out)
    else:
        raise EdgeposeError(f"{source}: no such file or folder")


def _find_recordings(folder: Path, out: Path, endings: tuple[str, ...]) -> Iterator[Path]:
    """Yield the recordings in a folder, except hidden ones and those in the output folder.

    A folder below it that cannot be listed is yielded itself, so that its conversion fails, not the others.
    """
    if find_format(folder) is not None:
        yield folder
    else:
        check_no_part(folder)
    for path in folder.iterdir():
        try:
            found = list(_find_recordings_at(path, out, endings))
        except OSError:
            found = [path]
        yield from found


def _find_recordings_at(path: Path, out: Path, endings: tuple[str, ...]) -> Iterator[Path]:
    """Yield a file if it is a recording, or the recordings in a folder."""
    if _is_hidden(path) or find_whole(path) is not None:
        return
    if path.is_dir():
        if not path.is_symlink() and path.resolve() != out:
            yield from _find_recordings(path, out, endings)
    # Reading a pipe could block forever.
    elif not path.is_fifo() and (path.suffix.lower() in endings or is_can_log(path)):
        yield path


def _is_hidden(path: Path) -> bool:
    """Return whether a file is a system's own, such as macOS's `._walk.csv` beside `walk.csv`."""
    return path.name.startswith(".") or path.name.lower() == "thumbs.db"


def convert(job: Job, options: Options = _DEFAULTS) -> Result:
    """Convert one file, keeping its good part if it is damaged."""
    try:
        if job.target.suffix[1:] in _OF_POSES or is_poses(job.source):
            if options.filter != "none":
                raise EdgeposeError(f"{job.source}: --filter is for recordings, not for poses; leave it out")
            _make_folder(job.target.parent)
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
        _make_folder(job.target.parent)
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


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise EdgeposeError(f"cannot make the folder {folder}: {reason}; choose another --out") from None


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
    if workers == 1 or len(jobs) < 2:
        yield from map(work, jobs)
        return
    # Forking a process with threads may hang; spawned processes behave alike on every system.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _ignore_interrupts) as pool:
        # Worker processes inherit this, and so ignore Ctrl-C from the start.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            futures: dict[Future[Result], Job] = {pool.submit(work, job): job for job in jobs}
        finally:
            signal.signal(signal.SIGINT, before)
        try:
            for future in as_completed(futures):
                try:
                    yield future.result()
                except BrokenProcessPool:
                    job = futures[future]
                    problem = "its process was killed, perhaps for lack of memory; use fewer --jobs"
                    yield Result(job, problem=f"{job.source}: {problem}")
        finally:
            # After an interrupt, conversions in progress are finished, so that no file is left incomplete.
            pool.shutdown(cancel_futures=True)


def _ignore_interrupts() -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes: the main process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


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


def outcome(result: Result) -> str:
    """Return the outcome of a conversion in a few words."""
    if result.skipped:
        return "skipped, already exists"
    if not result.samples:
        return "failed"
    few = "" if result.sensors == len(PLACEMENTS) else f", {result.sensors} of {len(PLACEMENTS)} sensors"
    return f"damaged{few}" if result.problem else f"ok{few}"


def describe(result: Result) -> str:
    """Return the outcome of a conversion with its problem, without the name of the source."""
    if result.problem is None:
        return outcome(result)
    return f"{outcome(result)}: {result.problem.replace(f'{result.job.source}: ', '')}"
