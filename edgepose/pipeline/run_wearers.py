"""All wearers of a run: opening them, running them to their ends, and reporting on them."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from edgepose.config import WearerConfig
from edgepose.errors import EdgeposeError
from edgepose.inference.engine import Engine, MultiWearerEngine
from edgepose.pipeline.build import Notify, OpenWearer, load_wearer
from edgepose.pipeline.multi_wearer import POLL_S, Wearer, run_together
from edgepose.pipeline.network import Network
from edgepose.pipeline.remote_control import key_requests
from edgepose.pipeline.run import run as run_alone
from edgepose.pipeline.run_report import RunReport
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline
from edgepose.utils.freed_memory import keep_freed_memory


def open_wearers(
    stack: ExitStack, wearers: Sequence[WearerConfig], pressed: Callable[[], str], notify: Notify
) -> list[OpenWearer]:
    """Load the calibrations of all wearers, then open their sources.

    Args:
        stack: closes the sources.
        wearers: one or several.
        pressed: returns the keys pressed since its last call.
        notify: called with one message per warning or event.

    Raises:
        EdgeposeError: a calibration cannot be read or does not fit the run, or a source cannot be opened.
    """
    loaded = [load_wearer(wearer, notify) for wearer in wearers]
    keys = key_requests(len(wearers), pressed)
    return [
        OpenWearer(stack, wearer, calibration, by_key, len(wearers) == 1, notify)
        for (wearer, calibration), by_key in zip(loaded, keys, strict=True)
    ]


def run_wearers(
    opened: Sequence[OpenWearer],
    engine: Engine | MultiWearerEngine,
    network: Network,
    live: bool,
    stopped: Callable[[], bool],
    on_progress: Callable[[RunSummary], None],
) -> list[WearerPipeline]:
    """Run all wearers until their sources end or the run is stopped, and return their finished pipelines.

    Args:
        opened: wearers with open outputs.
        engine: for as many wearers.
        network: the wearers' network.
        live: whether samples arrive at their own pace.
        stopped: whether the run is to end.
        on_progress: called with the counts so far: after each pose of a single wearer, or after each round of
            several.
    """
    several = isinstance(engine, MultiWearerEngine)
    on_pose = _ignore if several else on_progress
    pipelines = [
        wearer.pipeline(network.rate_hz, network.future, several, on_pose, i / len(opened), len(opened))
        for i, wearer in enumerate(opened)
    ]
    # All objects alive now stay alive; a full collection that visits them would delay a frame by 0.1 s.
    gc.collect()
    gc.freeze()
    keep_freed_memory()
    if isinstance(engine, MultiWearerEngine):
        wearers = [
            Wearer(wearer.source, pipeline, wearer.notify)
            for wearer, pipeline in zip(opened, pipelines, strict=True)
        ]
        run_together(wearers, engine, POLL_S if live else 0.0, stopped, on_progress)
    else:
        run_alone(pipelines[0], opened[0].source, engine, stopped)
        pipelines[0].close()
    return pipelines


def _ignore(summary: RunSummary) -> None:
    pass


def report_wearers(
    opened: Sequence[OpenWearer], pipelines: Sequence[WearerPipeline], network: Network
) -> list[RunReport]:
    """Report the counts of all wearers to their users, and return the reports."""
    reports = []
    for wearer, pipeline in zip(opened, pipelines, strict=True):
        reports.append(wearer.report(pipeline, network.rate_hz, network.future))
        for line in reports[-1].lines():
            wearer.notify(line)
    return reports


def raise_failures(reports: Sequence[RunReport]) -> None:
    """Raise EdgeposeError if a wearer's run ended in an error, or a part of the source was damaged."""
    failed = {report.wearer: report.error for report in reports if report.error is not None}
    if not failed:
        return
    first = next(iter(failed.values()))
    if len(reports) == 1:
        raise first
    details = "; ".join(f"{name}: {error}" for name, error in failed.items())
    raise EdgeposeError(f"{len(failed)} of {len(reports)} wearers failed: {details}") from first
