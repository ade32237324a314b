"""Descriptions of training motion and runs, kept in checkpoints and archives and shown in model cards."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

from edgepose_export.training.dataset import RATE
from edgepose_export.training.sources import SOURCES

_MOTION = ("summary", "licenses", "takes", "hours", "free", "motion")


def describe(
    licenses: Iterable[str], sources: Iterable[str], takes: Iterable[tuple[str, int]]
) -> dict[str, Any]:
    """Return the description of training motion.

    Args:
        licenses: licences of the motion.
        sources: names of its sources.
        takes: name and number of frames of each take.

    Returns:
        "summary", "licenses", number of "takes", "hours", "free": whether weights trained on each source may
        be used for anything, and "motion": checksums of lists of takes, see `further_run`.
    """
    licenses, takes = sorted(set(licenses)), sorted(takes)
    return {
        "summary": " and ".join(dict.fromkeys(text.split(",")[0].split(" (")[0] for text in licenses)),
        "licenses": licenses,
        "takes": len(takes),
        "hours": sum(frames for _, frames in takes) / RATE / 3600.0,
        "free": {name: name in SOURCES and SOURCES[name].free for name in sorted(set(sources))},
        "motion": [hashlib.sha256(repr(takes).encode()).hexdigest()],
    }


def further_run(before: dict[str, Any], steps: int, run: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a run that started from the weights of another one.

    Takes that both were trained on count once. Checkpoints of older versions tell neither sources nor takes.

    Args:
        before: description of the first run.
        steps: steps of the first run.
        run: description of the second run.
    """
    earlier = [*before.get("earlier", ()), {"run": before.get("run"), "steps": steps}]
    motion = run.get("motion", ())
    if motion and set(motion) <= set(before.get("motion", ())):
        return run | {key: before[key] for key in _MOTION} | {"earlier": earlier}
    known = before.get("free") and run.get("free")
    return run | {
        "summary": f"{before['summary']}, then {run['summary']}",
        "licenses": sorted({*before["licenses"], *run["licenses"]}),
        "takes": before["takes"] + run["takes"],
        "hours": before["hours"] + run["hours"],
        "free": before["free"] | run["free"] if known else None,
        "motion": [*before.get("motion", ()), *motion],
        "earlier": earlier,
    }


def averaged_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the description of the mean of several runs: that of the first, with the motion of all.

    Number and hours of takes are those of the run with the most hours, because runs that can be averaged
    started from each other.
    """
    most = max(runs, key=lambda run: float(run["hours"]))
    frees = [run.get("free") for run in runs]
    return runs[0] | {
        **{key: most[key] for key in ("summary", "takes", "hours")},
        "licenses": sorted({text for run in runs for text in run["licenses"]}),
        "free": {name: free for one in frees if one for name, free in one.items()} if all(frees) else None,
    }
