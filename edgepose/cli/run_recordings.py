"""`edgepose run IN...`: many recordings, each with files of its own, with one start of the network."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import click

from edgepose.cli.many_files import Outcome, raise_failures, text_table, with_progress
from edgepose.cli.options.json_result import show_json
from edgepose.cli.terminal.messages import say, show, warnings_to
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.config import WearerConfig
from edgepose.errors import EdgeposeError, as_edgepose_error
from edgepose.pipeline.network import Network, NetworkConfig, ReadyNetwork
from edgepose.pipeline.run_report import RunReport
from edgepose.sinks.registry import SINKS, target_texts
from edgepose.sources.input_files import InputFile, expand, recordings
from edgepose.utils.durable_files import make_folder
from edgepose.utils.jobs import run_jobs
from edgepose.utils.output_targets import check_free, is_stream


class Job(NamedTuple):
    """A recording, and the configuration of its run."""

    source: Path
    wearer: WearerConfig


class Result(NamedTuple):
    """The result for one recording.

    Attributes:
        job: the recording.
        report: counts of its run.
        messages: lines about the wearer and the sensors.
        about_network: lines about the network, which are the same for all recordings.
    """

    job: Job
    report: RunReport
    messages: tuple[str, ...] = ()
    about_network: tuple[str, ...] = ()


def run_recordings(
    inputs: Sequence[Path], wearer: WearerConfig, network: Network, workers: int, as_json: bool
) -> None:
    """Run recordings, and show a table of results, or a JSON document.

    Args:
        inputs: files, patterns and folders.
        wearer: configuration of all runs, whose output files, and perhaps the calibration, name folders.
        network: the network, not loaded yet.
        workers: number of processes.
        as_json: show JSON.

    Raises:
        EdgeposeError: a recording was not run to its end, or a file exists; other recordings are whole.
    """
    jobs = _plan(inputs, wearer)
    _check(jobs, network)
    results: dict[Job, Result] = {}
    about_network: list[str] = []
    try:
        with StopSignal() as stop:
            work = partial(_run, settings=network.config)
            runs = run_jobs(work, jobs, workers, _killed, lambda: stop.asked)
            for result in with_progress(runs, len(jobs), "Running", _outcome):
                results[result.job] = result
                for line in result.about_network:
                    if line not in about_network:
                        say(line)
                        about_network.append(line)
            if stop.asked:
                raise KeyboardInterrupt
    finally:
        finished = [results[job] for job in jobs if job in results]
        _show(finished, network, about_network, len(jobs), as_json)
    failed = sum(result.report.error is not None for result in results.values())
    raise_failures(failed, len(jobs), "not run, or only in part")


# --- plan ---------------------------------------------------------------------------------------------------


def _plan(inputs: Sequence[Path], wearer: WearerConfig) -> list[Job]:
    """Return a job for each recording.

    Raises:
        click.UsageError: an output is no folder of files.
        EdgeposeError: an input is missing or empty, or a file would be written twice.
    """
    for name, _ in wearer.outputs.targets:
        if name not in SINKS or not SINKS[name].suffix:
            flags = ", ".join(f"--{name}" for name, output in SINKS.items() if output.suffix)
            raise click.UsageError(f"--{name} is for one source; recordings named as IN take {flags}")
    folders = [Path(folder) for _, folder in target_texts(wearer.outputs.targets)]
    for folder in folders:
        if str(folder) == "-" or is_stream(folder) or folder.is_file():
            raise click.UsageError(
                f"{folder}: recordings named as IN take a folder for each output, such as --csv poses"
            )
    return [_job(file, wearer) for file in expand(inputs, folders, recordings())]


def _job(file: InputFile, wearer: WearerConfig) -> Job:
    outputs = replace(
        wearer.outputs,
        targets=tuple(
            (name, SINKS[name].in_folder(target, file.name)) for name, target in wearer.outputs.targets
        ),
    )
    calibration = wearer.calibration
    if calibration.is_dir():
        calibration = calibration / file.name.parent / f"{file.name.name}.json"
    source = replace(wearer.source, file=file.path)
    return Job(file.path, replace(wearer, source=source, outputs=outputs, calibration=calibration))


def _check(jobs: Sequence[Job], network: Network) -> None:
    """Raise EdgeposeError if a job would replace a file that it must not replace."""
    outputs = [job.wearer.outputs for job in jobs]
    written = [Path(name) for each in outputs for _, name in target_texts(each.targets)]
    inputs = {path.resolve() for job in jobs for path in (job.source, job.wearer.calibration)}
    inputs.add(network.info.path.resolve())
    for path in written:
        if path.resolve() in inputs:
            raise EdgeposeError(f"{path} would be written over an input; name another folder")
    if not outputs[0].overwrite:
        check_free(written, "add --overwrite, or name other folders")


# --- work ---------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _ready(settings: NetworkConfig, no_place: bool) -> tuple[ReadyNetwork, tuple[str, ...]]:
    """Return the network, which a process loads once, and what there is to say about it."""
    lines: list[str] = []
    return Network.read(settings, 1).load(no_place, lines.append), tuple(lines)


def _run(job: Job, settings: NetworkConfig) -> Result:
    """Run one recording.

    Raises:
        ModelError: the network cannot be loaded, for any recording.
    """
    from edgepose.pipeline.run import run as run_pipeline
    from edgepose.pipeline.run_wearers import open_wearers

    lines: list[str] = []
    ready, about = _ready(settings, job.wearer.no_place)
    network = ready.network
    try:
        with warnings_to(lines.append, hidden=True), ExitStack() as stack:
            (opened,) = open_wearers(stack, [job.wearer], lambda: "", lines.append)
            for _, target in target_texts(job.wearer.outputs.targets):
                make_folder(Path(target).parent)
            opened.open_outputs(stack, network, lambda: False)
            pipeline = opened.pipeline(network.rate_hz, network.future, False, lambda summary: None)
            run_pipeline(pipeline, opened.source, ready.engine(job.wearer))
            pipeline.close()
            report = opened.report(pipeline, network.rate_hz, network.future)
    except Exception as error:
        report = RunReport.of_failed(job.wearer, as_edgepose_error(error))
    if report.error is None and not report.summary.poses:
        nothing = EdgeposeError("no poses: the recording is too short, or has no samples of some sensor")
        report = replace(report, error=nothing)
    return Result(job, report, tuple(lines), about)


def _killed(job: Job, reason: str) -> Result:
    return Result(job, RunReport.of_failed(job.wearer, EdgeposeError(reason)))


# --- results ------------------------------------------------------------------------------------------------


def _outcome(result: Result) -> Outcome:
    report = result.report
    problem = None if report.error is None else str(report.error)
    return Outcome(str(result.job.source), report.result, problem, result.messages)


def _show(
    results: Sequence[Result], network: Network, about_network: Sequence[str], planned: int, as_json: bool
) -> None:
    if as_json:
        of_files = [f"{result.job.source}: {line}" for result in results for line in result.messages]
        messages = [*about_network, *of_files]
        runs = [result.report.values() for result in results]
        show_json("run", {**network.values(), "messages": messages, "planned": planned, "runs": runs})
        return
    rows = []
    for result in results:
        poses = result.report.summary.poses
        counts = (str(poses), f"{poses / network.rate_hz:.1f}") if poses else ("-", "-")
        rows.append((str(result.job.source), *counts, result.report.result))
    show(text_table(("file", "poses", "seconds", "result"), rows))
