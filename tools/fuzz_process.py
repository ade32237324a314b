"""Commands of edgepose in processes that are forked from this one, with limits of time and memory."""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import pkgutil
import re
import resource
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple, TypeVar

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.warm_python import LIBRARIES, run_program

LIMIT_S = 10.0
"""Longest time of a command: seconds of the processor, of which a busy machine gives it only a part."""

WAIT_S = 60.0
"""Longest time of a command that waits, or is kept waiting, seconds."""

LIMIT_BYTES = 1 << 30
"""Most memory of a command: pages that are resident."""

_HARD_LIMIT_BYTES = 3 << 30
"""What a command can reserve at all, so that the machine survives it."""

_BATCH = 50
"""Items that one process works on: a fork costs more than most commands."""

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Ended(NamedTuple):
    """A command that has ended.

    Attributes:
        code: exit code.
        out: standard output.
        errors: standard error.
        seconds: time of the processor that it took.
        peak_bytes: most memory that was resident.
    """

    code: int
    out: str
    errors: str
    seconds: float
    peak_bytes: int


class Lost(NamedTuple):
    """A process that was killed while it worked on an item.

    Attributes:
        code: exit code of the process, or minus the number of the signal; None if it took too long.
    """

    code: int | None


def warm_up() -> None:
    """Import all that the commands do, so that they start fast; no thread must run afterwards."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TORCH_CPP_LOG_LEVEL": "ERROR"}
    for name in (*LIBRARIES, "matplotlib.backends.backend_agg", "matplotlib.figure"):
        importlib.import_module(name)
    for package in ("edgepose", "firmware_protocols", "edgepose_export"):
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    gc.collect()
    gc.freeze()


def supervised(work: Callable[[Item], Answer], items: Sequence[Item]) -> Iterator[tuple[Item, Answer | Lost]]:
    """Yield each item with what a forked process makes of it; one that is killed costs only its item."""
    done = 0
    while done < len(items):
        for item, answer in _until_lost(work, items[done : done + _BATCH]):
            done += 1
            yield item, answer


def _until_lost(
    work: Callable[[Item], Answer], items: Sequence[Item]
) -> Iterator[tuple[Item, Answer | Lost]]:
    """Yield items with what a forked process makes of them, up to one that kills it."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(work, items, theirs))
    process.start()
    theirs.close()
    try:
        for item in items:
            if not ours.poll(WAIT_S):
                yield item, Lost(None)
                return
            try:
                answer = ours.recv()
            except EOFError:
                process.join()
                yield item, Lost(process.exitcode)
                return
            yield item, answer
    finally:
        process.kill()
        process.join()
        ours.close()


def _serve(work: Callable[[Item], Answer], items: Sequence[Item], line: Connection) -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (_HARD_LIMIT_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES,) * 2)
    for item in items:
        line.send(work(item))


def run_command(words: list[str], folder: Path) -> Ended:
    """Run `edgepose WORD ...` in this process and in a folder, to which it leaves `stdout` and `stderr`."""
    streams = [os.dup(1), os.dup(2)]
    for number, name in enumerate(("stdout", "stderr"), start=1):
        file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins again
    start = time.process_time()
    code = _run([*words], folder)
    seconds = time.process_time() - start
    for number, stream in enumerate(streams, start=1):
        os.dup2(stream, number)
        os.close(stream)
    out, errors = ((folder / name).read_text(errors="replace") for name in ("stdout", "stderr"))
    (peak,) = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return Ended(code, out, errors, seconds, 1024 * int(peak))


def _run(words: list[str], folder: Path) -> int:
    environment = os.environ | {"HOME": str(folder)}
    request = {"words": ["-m", "edgepose", *words], "folder": str(folder), "environment": environment}
    try:
        run_program(request | {"session": False, "first": ""})
        return 0
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()


def run_forked(words: list[str], folder: Path) -> Ended:
    """Run `edgepose WORD ...` in a process of its own.

    Raises:
        RuntimeError: it was killed.
    """
    ((_, answer),) = supervised(lambda words: run_command(words, folder), [words])
    if isinstance(answer, Lost):
        raise RuntimeError(f"{words}: {answer}")
    return answer
