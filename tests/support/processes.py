"""Programs that tests start and end."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

SIMULATOR = Path(__file__).parents[2] / "tools" / "simulate.py"


def start(*words: object, **options: object) -> subprocess.Popen[str]:
    """The command line with these words; its messages can be read."""
    command = [sys.executable, "-m", "edgepose", *map(str, words)]
    return subprocess.Popen(command, text=True, **{"stderr": subprocess.PIPE} | options)


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and messages of a process that ends by itself."""
    try:
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()  # one that hangs would take the ports of other tests
    assert "Traceback" not in errors
    return process.returncode, errors


@contextlib.contextmanager
def simulated(recording: Path, *flags: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Simulated sensors, and their port or bus; killing them unplugs it."""
    command = [sys.executable, str(SIMULATOR), str(recording), *map(str, flags)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            yield process, process.stdout.readline().split()[1]
        finally:
            process.kill()
