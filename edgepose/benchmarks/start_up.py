"""Time and memory of a new process until a model is ready, with torch and with numpy."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import NamedTuple

from edgepose.errors import EdgeposeError, ModelError
from edgepose.inference import archive, loading


class Start(NamedTuple):
    """Cost of a fresh process until a model is ready to run.

    Attributes:
        imports_s: importing edgepose's steps with numpy, and torch if that runs the model, seconds.
        load_s: loading, packing and warming up the model, seconds.
        memory_mb: resident memory then, megabytes; None if unknown.
    """

    imports_s: float
    load_s: float
    memory_mb: float | None


_FRESH = """
import json, os, sys, time
path, runtime = sys.argv[1:]
started = time.perf_counter()
import edgepose.pipeline.run_wearers
from edgepose.inference.model import Model
if runtime == "torch":
    import torch
imported = time.perf_counter()
model = Model(path, trust=True, runtime=runtime)
engine = model.engine()
times = imported - started, time.perf_counter() - imported
statm = "/proc/self/statm"
pages = int(open(statm).read().split()[1]) if os.path.exists(statm) else None
print(json.dumps([*times, pages and pages * os.sysconf("SC_PAGE_SIZE") / 1e6]))
"""


def starts(info: archive.ArchiveInfo, trust: bool) -> dict[str, dict[str, float | None]]:
    """Measure new processes that load a model, for each runtime that can run it: the fields of `Start`.

    Raises:
        EdgeposeError: the model is not trusted, or a process fails.
    """
    return {
        runtime: _start(info, runtime)._asdict()
        for runtime in ("torch", "numpy")
        if _runs(info, trust, runtime)
    }


def _runs(info: archive.ArchiveInfo, trust: bool, runtime: str) -> bool:
    try:
        loading.load(info, trust, runtime, "auto")
    except ModelError:
        if runtime == "torch":
            raise
        return False
    return True


def _start(info: archive.ArchiveInfo, runtime: str) -> Start:
    command = [sys.executable, "-c", _FRESH, str(info.path), runtime]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode:
        raise EdgeposeError(f"{info.path}: a new process cannot load it: {process.stderr.strip()[-200:]}")
    return Start(*json.loads(process.stdout))
