"""Many jobs of one kind, in this process or in several."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from edgepose.errors import EdgeposeError

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

_KILLED = "process was killed, perhaps for lack of memory; use fewer --jobs"


def run_jobs(
    work: Callable[[JobT], ResultT],
    jobs: Sequence[JobT],
    workers: int,
    failed: Callable[[JobT, str], ResultT],
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[ResultT]:
    """Do jobs, and yield their results as they finish; a bad one does not stop the rest.

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
    with _submitted(work, jobs, workers) as submitted:
        futures = dict(zip(submitted, jobs, strict=True))
        for future in as_completed(futures):
            if future.cancelled():
                continue
            try:
                yield future.result()
            except BrokenProcessPool:
                yield failed(futures[future], f"its {_KILLED}")
            if stopped():
                for other in futures:
                    other.cancel()


def run_in_order(work: Callable[[JobT], ResultT], jobs: Sequence[JobT], workers: int) -> Iterator[ResultT]:
    """Do jobs, and yield their results in the order of the jobs.

    Args:
        work: see `run_jobs`.
        jobs: the jobs.
        workers: number of processes; 1 works in this process.

    Raises:
        EdgeposeError: a process was killed.
    """
    if workers == 1 or len(jobs) < 2:
        yield from map(work, jobs)
        return
    with _submitted(work, jobs, workers) as futures:
        try:
            while futures:  # without keeping the results, which may be large
                yield futures.pop(0).result()
        except BrokenProcessPool as error:
            raise EdgeposeError(f"a {_KILLED}") from error


@contextmanager
def _submitted(
    work: Callable[[JobT], ResultT], jobs: Sequence[JobT], workers: int
) -> Iterator[list[Future[ResultT]]]:
    """Submit jobs to processes of their own; on leaving, finish those in progress and cancel the others."""
    # Forking a process with threads may hang; spawned processes behave alike on every system.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _ignore_interrupts) as pool:
        # Worker processes inherit this, and so ignore Ctrl-C from the start.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            futures = [pool.submit(work, job) for job in jobs]
        finally:
            signal.signal(signal.SIGINT, before)
        try:
            yield futures
        finally:
            # After an interrupt, jobs in progress are finished, so that no file is left incomplete.
            pool.shutdown(cancel_futures=True)


def _ignore_interrupts() -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes: the main process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
