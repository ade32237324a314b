"""Many jobs of one kind, in this process or in several; a bad one does not stop the rest."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")


def run_jobs(
    work: Callable[[JobT], ResultT],
    jobs: Sequence[JobT],
    workers: int,
    failed: Callable[[JobT, str], ResultT],
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[ResultT]:
    """Do jobs, and yield their results as they finish.

    Args:
        work: does a job; a function of a module, with arguments that can be pickled. An error that it
            raises ends all of them.
        jobs: the jobs.
        workers: number of processes; 1 works in this process.
        failed: returns the result of a job whose process was killed, given the reason.
        stopped: whether no further jobs are to begin; those in progress are finished. Asked after each.
    """
    if workers == 1 or len(jobs) < 2:
        for job in jobs:
            yield work(job)
            if stopped():
                return
        return
    # Forking a process with threads may hang; spawned processes behave alike on every system.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _ignore_interrupts) as pool:
        # Worker processes inherit this, and so ignore Ctrl-C from the start.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            futures: dict[Future[ResultT], JobT] = {pool.submit(work, job): job for job in jobs}
        finally:
            signal.signal(signal.SIGINT, before)
        try:
            for future in as_completed(futures):
                if future.cancelled():
                    continue
                try:
                    yield future.result()
                except BrokenProcessPool:
                    reason = "its process was killed, perhaps for lack of memory; use fewer --jobs"
                    yield failed(futures[future], reason)
                if stopped():
                    for other in futures:
                        other.cancel()
        finally:
            # After an interrupt, jobs in progress are finished, so that no file is left incomplete.
            pool.shutdown(cancel_futures=True)


def _ignore_interrupts() -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes: the main process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
