"""`edgepose calibrate IN...`: a calibration from each of many recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import click

from edgepose import calibration
from edgepose.cli.calibration_job import CalibrationJob, calibration_of
from edgepose.cli.calibration_session import measure_recorded
from edgepose.cli.calibration_verdict import values, values_of_failed
from edgepose.cli.many_files import Outcome, raise_failures, text_table, with_progress
from edgepose.cli.options.json_result import show_json
from edgepose.cli.terminal.messages import show, warnings_to
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.errors import as_edgepose_error
from edgepose.orientation.stage import OrientationStage
from edgepose.sources.input_files import expand, recordings
from edgepose.utils.durable_files import make_folder
from edgepose.utils.jobs import run_jobs
from edgepose.utils.output_targets import check_free


class _Task(NamedTuple):
    """A recording, and the calibration file to write."""

    source: Path
    out: Path


class _Result(NamedTuple):
    """The result for one recording, with the keys of `calibration_verdict.values`."""

    task: _Task
    values: dict[str, Any]


def calibrate_recordings(
    inputs: Sequence[Path], job: CalibrationJob, out: str, overwrite: bool, workers: int, as_json: bool
) -> None:
    """Calibrate from recordings, and show a table of results, or a JSON document.

    Args:
        inputs: files, patterns and folders.
        job: what to do with each.
        out: folder for the calibrations.
        overwrite: replace existing files.
        workers: number of processes.
        as_json: show JSON.

    Raises:
        EdgeposeError: a recording gave no calibration, or a file exists; the other calibrations are written.
    """
    tasks = _plan(inputs, out)
    if not overwrite:
        check_free((task.out for task in tasks), "add --overwrite, or choose another --out")
    results: dict[_Task, _Result] = {}
    try:
        with StopSignal() as stop:
            work = partial(_calibrate, job=job, overwrite=overwrite)
            found = run_jobs(work, tasks, workers, _killed, lambda: stop.asked)
            for result in with_progress(found, len(tasks), "Calibrating", _outcome):
                results[result.task] = result
            if stop.asked:
                raise KeyboardInterrupt
    finally:
        _show([results[task] for task in tasks if task in results], len(tasks), as_json)
    failed = sum(result.values["problem"] is not None for result in results.values())
    raise_failures(failed, len(tasks), "gave no calibration, or one from a part of them")


def _plan(inputs: Sequence[Path], out: str) -> list[_Task]:
    if out == "-" or Path(out).suffix == ".json" or Path(out).is_file():
        raise click.UsageError(
            f"--out {out}: recordings named as IN take a folder, such as --out calibrations"
        )
    return [
        _Task(file.path, Path(out) / file.name.parent / f"{file.name.name}.json")
        for file in expand(inputs, [Path(out)], recordings())
    ]


def _calibrate(task: _Task, job: CalibrationJob, overwrite: bool) -> _Result:
    """Calibrate from one recording."""
    source = dataclasses.replace(job.source, file=task.source)
    job = job._replace(source=source)
    logged: list[str] = []
    try:
        with warnings_to(logged.append, hidden=True):
            orient = OrientationStage(job.filter, job.magnetometer)
            measured = measure_recorded(source, job.plan, orient, lambda line: None)
            measured, result, warnings = calibration_of(job, orient, measured, lambda line: None)
        make_folder(task.out.parent)
        calibration.save(result, str(task.out), overwrite)
    except Exception as error:
        problem = str(as_edgepose_error(error))
        return _Result(task, values_of_failed(task.source, task.out, problem, logged))
    found = values(source, str(task.out), measured, result, [*logged, *warnings])
    return _Result(task, found)


def _killed(task: _Task, reason: str) -> _Result:
    return _Result(task, values_of_failed(task.source, task.out, reason))


def _word(result: _Result) -> str:
    word: str = result.values["result"]
    return word if result.values["verdict"] is None else f"{word}, {result.values['verdict']}"


def _outcome(result: _Result) -> Outcome:
    return Outcome(
        str(result.task.source), _word(result), result.values["problem"], tuple(result.values["warnings"])
    )


def _show(results: Sequence[_Result], planned: int, as_json: bool) -> None:
    if as_json:
        show_json("calibrate", {"planned": planned, "calibrations": [result.values for result in results]})
        return
    rows = []
    for result in results:
        sensors, start_s = result.values["sensors"], result.values["hold_from_s"]
        residual = f"{max(sensor['residual_deg'] for sensor in sensors):.2f}" if sensors else "-"
        start = "-" if start_s is None else f"{start_s:.2f}"
        rows.append((str(result.task.source), start, residual, _word(result)))
    show(text_table(("file", "hold, s", "sway, deg", "result"), rows))
