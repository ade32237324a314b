"""Recordings and poses of any kind to other kinds of files, many at once; a broken one costs only itself."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.npz_amass import write_npz as write_poses_npz
from edgepose.formats.poses.registry import is_poses, pose_suffixes, salvage_poses
from edgepose.formats.recordings import xio_session
from edgepose.formats.recordings.base import recording_from_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import find_format, recording_suffixes, salvage_recording
from edgepose.imu import ImuSample, Recording
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseSequence
from edgepose.sinks.base import Sink
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv import CsvSink
from edgepose.skeleton import default_body
from edgepose.sources import open_source
from edgepose.sources.replay import CAN_LOGS, CAPTURES, is_can_log, is_recording
from edgepose.sources.sensor_map import read_map
from edgepose.utils.durable_files import replace_file

WRITERS: dict[str, Callable[[Path, Recording], None]] = {"csv": write_csv, "npz": write_npz}
"""What is written, by ending."""


def _endings() -> tuple[str, ...]:
    """Endings of the files that are looked for in a folder."""
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
    """How recordings are converted.

    Attributes:
        protocol: what raw captures and CAN logs speak.
        sensors: map of devices to placements, for captures, CAN logs and sessions.
        filter: what makes orientations, see `orient_recording`; "none" leaves them as they are.
        height_m: the wearer's stature, for the bones of BVH files, metres.
        overwrite: whether a recording may take the place of a file.
    """

    protocol: str = "auto"
    sensors: Path | None = None
    filter: str = "none"
    height_m: float = 1.75
    overwrite: bool = True


_DEFAULTS = Options()


class Result(NamedTuple):
    """What became of a recording.

    Attributes:
        job: the recording.
        samples: written, or poses.
        seconds: from the first sample to the last.
        problem: one line for the user if it could not be read, or not all of it; None if all is well.
        sensors: of which there are samples, if it is a recording.
        skipped: the target was there already.
    """

    job: Job
    samples: int = 0
    seconds: float = 0.0
    problem: str | None = None
    sensors: int = len(PLACEMENTS)
    skipped: bool = False


def plan(inputs: Sequence[Path], to: str, out: Path) -> list[Job]:
    """What is to be converted.

    Args:
        inputs: files ("-" is CSV on standard input), folders of them at any depth, and x-io sessions; names
            with `*`, `?` or `[` that are no file are patterns.
        to: ending of what is to be written.
        out: folder to write to; what is in an input folder keeps its place in that.

    Raises:
        EdgeposeError: an input is not there or empty, or a file would be written twice or over an input.
    """
    jobs: dict[Path, Job] = {}
    for given in inputs:
        for source, place in _expand(given, out):
            # With its folder: an x-io session has no ending, though there may be dots in its name.
            name = place.name if source.is_dir() else place.stem
            job = Job(source, out / place.parent / f"{name}.{to}")
            other = jobs.setdefault(job.target, job)
            if other.source != source:
                raise EdgeposeError(
                    f"{other.source} and {source} would both become {job.target}; convert them apart, each "
                    "with an --out of its own"
                )
    sources = {job.source.resolve() for job in jobs.values()}
    for job in jobs.values():
        if job.target.resolve() in sources:
            raise EdgeposeError(f"{job.target} would be written over an input; choose another --out")
    return list(jobs.values())


def _expand(given: Path, out: Path) -> Iterator[tuple[Path, Path]]:
    """Recordings that an input stands for, and their places below the output folder."""
    if given.is_dir():
        endings = _endings()
        try:
            found = sorted(_walk(given, out.resolve(), endings))
        except OSError as error:
            raise EdgeposeError(f"{error.filename}: cannot look into it: {error.strerror}") from None
        if not found:
            raise EdgeposeError(
                f"{given}: no recording in this folder; names end in {', '.join(endings)}, or .gz of a log"
            )
        for path in found:
            # The session that is itself given has its own name.
            yield path, Path(given.resolve().name) if path == given else path.relative_to(given)
    elif str(given) == "-":
        if sys.stdin is None:
            raise EdgeposeError("-: there is no standard input; name a file")
        yield given, Path("stdin")
    elif given.exists():
        if not given.is_file():
            raise EdgeposeError(
                f"{given}: not a file; convert what comes out of it as -: convert - < {given}"
            )
        yield given, Path(given.name)
    elif any(mark in str(given) for mark in "*?["):
        # The shell has left it alone: it is quoted, or the shell is that of Windows.
        root = Path(given.anchor or ".")
        found = sorted(root.glob(str(given.relative_to(given.anchor) if given.anchor else given)))
        if not found:
            raise EdgeposeError(f"{given}: no file fits this pattern")
        for path in found:
            yield from _expand(path, out)
    else:
        raise EdgeposeError(f"{given}: no such file or folder")


def _walk(folder: Path, out: Path, endings: tuple[str, ...]) -> Iterator[Path]:
    """Recordings in a folder, save those of an earlier conversion."""
    if find_format(folder) is not None:
        yield folder
    elif xio_session.is_sensor(folder):
        raise EdgeposeError(f"{folder}: one sensor of an x-io session; give the folder above it")
    for path in folder.iterdir():
        if path.is_dir():
            of_session = xio_session.is_sensor(path)
            if not of_session and not path.is_symlink() and path.resolve() != out:
                yield from _walk(path, out, endings)
        # A pipe could be waited for in vain.
        elif not path.is_fifo() and (path.suffix.lower() in endings or is_can_log(path)):
            yield path


def convert(job: Job, options: Options = _DEFAULTS) -> Result:
    """Write what is good in a recording."""
    try:
        if job.target.suffix == ".bvh" or is_poses(job.source):
            if options.filter != "none":
                raise EdgeposeError(f"{job.source}: --filter is for recordings, not for poses; leave it out")
            _make(job.target.parent)
            return Result(job, *convert_poses(job.source, job.target, options.height_m, options.overwrite))
        recording = _read(job.source, options.protocol, options.sensors)
        data = recording.sensors.values()
        if not data:
            raise EdgeposeError(recording.damage or f"{job.source}: no samples")
        if options.filter != "none":
            from edgepose.orientation.offline import orient_recording

            recording = orient_recording(recording, options.filter, name=str(job.source))
        _make(job.target.parent)
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
    except Exception as error:  # a fault of ours, which must not cost the other files
        return Result(job, problem=f"{job.source}: cannot be converted, please report it: {error!r}")
    return Result(
        job,
        samples=sum(len(d.time_s) for d in data),
        seconds=float(max(d.time_s[-1] for d in data) - min(d.time_s[0] for d in data)),
        sensors=len(data),
        problem=recording.damage,
    )


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise EdgeposeError(f"cannot make the folder {folder}: {reason}; choose another --out") from None


def _read(path: Path, protocol: str, sensors: Path | None) -> Recording:
    if is_recording(path):
        return salvage_recording(path, None if sensors is None else read_map(sensors).serial_numbers())
    problems: list[str] = []
    rows = list(_samples(path, protocol, sensors, problems))
    # Names need not be text.
    name = os.fsencode(path.name).decode(errors="replace")
    recording = recording_from_samples(rows, {"source": name}, name=str(path), salvage=True)
    problems += [recording.damage] if recording.damage else []
    return recording._replace(damage="; ".join(problems) or None)


def _samples(path: Path, protocol: str, sensors: Path | None, problems: list[str]) -> Iterator[ImuSample]:
    """Samples of a capture or a log; an error ends them and is added to the problems."""
    with open_source(file=path, protocol=protocol, sensors=sensors) as source:
        try:
            yield from chain.from_iterable(batch.samples for batch in source)
        except EdgeposeError as error:
            problems.append(str(error))
        if source.damage:
            problems.append(source.damage)


def convert_all(jobs: Sequence[Job], options: Options = _DEFAULTS, workers: int = 1) -> Iterator[Result]:
    """Results as they come.

    Args:
        jobs: recordings.
        options: of all of them.
        workers: processes; one works in this process.
    """
    work = partial(convert, options=options)
    # Other processes have no standard input.
    yield from map(work, (job for job in jobs if str(job.source) == "-"))
    jobs = [job for job in jobs if str(job.source) != "-"]
    if workers == 1 or len(jobs) < 2:
        yield from map(work, jobs)
        return
    # A fork of a process with threads may hang; a process of its own is the same on every system.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _ignore_interrupts) as pool:
        # A new process ignores Ctrl-C from its first moment on where this one does.
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
                    why = "its process was ended, perhaps for want of memory; use fewer --jobs"
                    yield Result(job, problem=f"{job.source}: {why}")
        finally:
            # After an interrupt: what is under way is finished, so that no file is left half.
            pool.shutdown(cancel_futures=True)


def _ignore_interrupts() -> None:
    """Ctrl-C goes to all processes of a terminal; the one that started the others handles it for them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


# --- poses --------------------------------------------------------------------------------------------------


def _write_poses(path: Path, poses: PoseSequence, height_m: float) -> None:
    if path.suffix == ".npz":
        write_poses_npz(path, [poses], len(poses.frames), poses.rate)
        return
    sink: Sink
    if path.suffix == ".bvh":
        sink = BvhSink(path, poses.rate, default_body(height_m))
    else:
        sink = CsvSink(path, translation=poses.translation is not None)
    with sink:
        for pose in poses.pose_frames():
            sink.write(pose)


def convert_poses(
    source: Path, target: Path, height_m: float, overwrite: bool = True
) -> tuple[int, float, str | None]:
    """Write what is good in a file of poses; the target appears when it is whole.

    Args:
        source: file that `edgepose.formats.poses.registry.read_poses` reads.
        target: .csv, .npz or .bvh file.
        height_m: the wearer's stature, for the bones of a BVH file, metres.
        overwrite: whether it may take the place of a file.

    Returns:
        Number of poses, seconds from the first to the last, and one line on what was not good.

    Raises:
        EdgeposeError: nothing is good, or it cannot be written.
    """
    poses, damage = salvage_poses(source)
    replace_file(target, lambda path: _write_poses(path, poses, height_m), "poses", overwrite=overwrite)
    return len(poses.frames), float(poses.time_s[-1] - poses.time_s[0]), damage


def describe(result: Result) -> str:
    """What became of a recording, in a few words and its problem."""
    if result.skipped:
        return "skipped, there already"
    if not result.samples:
        return f"failed: {result.problem}"
    few = "" if result.sensors == len(PLACEMENTS) else f", {result.sensors} of {len(PLACEMENTS)} sensors"
    return f"damaged{few}: {result.problem}" if result.problem else f"ok{few}"
