"""Accuracy of an archive on takes with known poses, run the way `edgepose run` runs it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.analysis.metrics import Metric, measure, per_frame, sip_error
from edgepose.inference.archive import is_windowed
from edgepose.skeleton import default_body
from edgepose_export.datasets import read_published
from edgepose_export.evaluation import baselines
from edgepose_export.training.dataset import RATE, Take, parts_of, read_take, take_paths
from edgepose_export.training.sources import GROUPS

Array = NDArray[np.float64]
Tensors = tuple[torch.Tensor, torch.Tensor]

BATCH = 512
"""Windows that run together."""

GROUP = 64
"""Takes that run together and are in memory at the same time."""

Progress = Callable[[list[Path]], Iterable[Path]]


class Mode(NamedTuple):
    """A way to run an archive: "offline" (whole takes), "window" or "stream"; past and future frames."""

    name: str
    past: int = 0
    future: int = 0

    def __str__(self) -> str:
        """Return the name shown in tables."""
        if self.name == "offline":
            return "offline, whole take"
        if self.name == "window":
            return f"online, window ({self.past}, {self.future})"
        return f"online, stream ({self.future} future)" if self.future else "online, step by step"


def modes_of(metadata: dict[str, Any]) -> list[Mode]:
    """Return the modes in which an archive is measured."""
    past, future = metadata["past"], metadata["future"]
    if not is_windowed(metadata):
        return [Mode("stream", 0, future), Mode("offline")]
    return [Mode("window", past, future), Mode("stream", 0, future), Mode("offline")]


# --- runs ---------------------------------------------------------------------------------------------------


def run_archive(module: torch.jit.ScriptModule, takes: list[Take], mode: Mode) -> list[Array]:
    """Return local poses (T, 24, 3, 3) for each take, one for every frame, as in a run."""
    return [poses for poses, _ in run_with_std(module, takes, mode)]


def run_with_std(module: torch.jit.ScriptModule, takes: list[Take], mode: Mode) -> list[tuple[Array, Array]]:
    """Return local poses (T, 24, 3, 3) and their standard deviations (T, 24), rad, for each take."""
    with torch.inference_mode():
        if mode.name == "stream":
            results = _stream(module, takes, mode.future)
        elif mode.name == "offline":
            results = [_offline(module, *_sensors(take)) for take in takes]
        else:
            results = [
                run_windows(module, take, np.arange(len(take.pose)), mode.past, mode.future) for take in takes
            ]
    return [(poses.double().numpy(), std.double().numpy()) for poses, std in results]


def _sensors(take: Take) -> Tensors:
    return torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration)


def _offline(
    module: torch.jit.ScriptModule, orientation: torch.Tensor, acceleration: torch.Tensor
) -> Tensors:
    poses, std = module(orientation[None], acceleration[None])
    return poses[0], std[0]


def _stream(module: torch.jit.ScriptModule, takes: list[Take], future: int) -> list[Tensors]:
    """Run frame by frame, with all takes side by side as if each were a wearer, the longest first."""
    order = sorted(range(len(takes)), key=lambda i: -len(takes[i].pose))
    lengths = [len(takes[i].pose) for i in order]
    outputs: list[list[Tensors]] = [[] for _ in order]
    state, active = module.start(len(order), future), len(order)
    for t in range(lengths[0] + 1):
        while active and lengths[active - 1] == t:
            active -= 1
            poses, std = module.drain(_wearers(state, slice(active, active + 1)))
            outputs[active].append((poses[0], std[0]))
            state = _wearers(state, slice(0, active))
        if active:
            frames = [takes[i] for i in order[:active]]
            orientation = torch.from_numpy(np.stack([take.orientation[t] for take in frames]))
            acceleration = torch.from_numpy(np.stack([take.acceleration[t] for take in frames]))
            poses, std, state = module.stream(orientation, acceleration, state)
            for k in range(active):
                outputs[k].append((poses[k], std[k]))
    results = {
        i: (torch.cat([pose for pose, _ in rows]), torch.cat([std for _, std in rows]))
        for i, rows in zip(order, outputs, strict=True)
    }
    return [results[i] for i in range(len(takes))]


def _wearers(state: list[torch.Tensor], rows: slice) -> list[torch.Tensor]:
    """Return the state of some wearers; the tensor whose length is `future` is shared by all of them."""
    return [s if s.dim() == 1 else s[rows] for s in state]


def run_windows(
    module: torch.jit.ScriptModule, take: Take, frames: NDArray[np.intp], past: int, future: int
) -> Tensors:
    """Return poses (N, 24, 3, 3) and deviations (N, 24) of some frames (N,), each from its own window.

    Windows of full length run in batches. Windows cut by one end of the take run alone. Windows cut by both
    ends are the whole take, which runs once.
    """
    orientation, acceleration = _sensors(take)
    total, length = len(orientation), past + 1 + future
    poses, stds = torch.empty(len(frames), 24, 3, 3), torch.empty(len(frames), 24)
    low, high = frames - past, frames + future + 1
    full = np.flatnonzero((low >= 0) & (high <= total))
    for part in np.split(full, range(BATCH, len(full), BATCH)) if len(full) else ():
        rows = torch.from_numpy(low[part])[:, None] + torch.arange(length)
        index = torch.from_numpy(part)
        poses[index], stds[index] = module.window(orientation[rows], acceleration[rows], past)
    whole = np.flatnonzero((low <= 0) & (high >= total))
    if len(whole):
        every = _offline(module, orientation, acceleration)
        chosen = torch.from_numpy(frames[whole])
        poses[torch.from_numpy(whole)], stds[torch.from_numpy(whole)] = every[0][chosen], every[1][chosen]
    for k in np.setdiff1d(np.arange(len(frames)), np.concatenate([full, whole])):
        cut = slice(max(0, low[k]), min(total, high[k]))
        one = module.window(orientation[None, cut], acceleration[None, cut], int(frames[k]) - cut.start)
        poses[k], stds[k] = one[0][0], one[1][0]
    return poses, stds


# --- measures -----------------------------------------------------------------------------------------------

Table = dict[str, dict[str, Metric]]
"""Measures by row name."""

Columns = dict[str, dict[str, Array]]
"""Measures of each frame by row name."""

Method = Callable[[list[Take]], list[Array]]
"""A function that returns poses (T, 24, 3, 3) for each of some takes."""


def collect(takes: Iterable[Take], methods: Mapping[str, Method]) -> Columns:
    """Measure several methods on every frame of some takes, on the default body."""
    offsets = default_body().offsets
    values: dict[str, dict[str, list[Array]]] = {}
    for group in groups(takes):
        for name, method in methods.items():
            for take, poses in zip(group, method(group), strict=True):
                for key, column in per_frame(poses, take.pose.astype(float), offsets, RATE).items():
                    values.setdefault(name, {}).setdefault(key, []).append(column)
    return {name: {key: np.concatenate(v) for key, v in rows.items()} for name, rows in values.items()}


def groups(takes: Iterable[Take]) -> Iterator[list[Take]]:
    """Yield lists of takes to run together, at most `GROUP` each."""
    iterator = iter(takes)
    while group := list(islice(iterator, GROUP)):
        yield group


def summarise(columns: Columns) -> Table:
    """Return means, standard deviations and numbers of frames."""
    return {name: {key: measure(v) for key, v in rows.items()} for name, rows in columns.items()}


def archive_methods(module: torch.jit.ScriptModule, modes: list[Mode]) -> dict[str, Method]:
    """Return an archive's modes as methods for `collect`."""
    return {str(mode): lambda takes, mode=mode: run_archive(module, takes, mode) for mode in modes}


def baseline_methods(trained: baselines.Baselines) -> dict[str, Method]:
    """Return the trivial baselines as methods for `collect`."""
    return {
        name: lambda takes, method=method: [method(take, trained) for take in takes]
        for name, method in baselines.METHODS.items()
    }


def takes_of(data: Path, part: str, progress: Progress = iter) -> Iterator[Take]:
    """Read takes one by one: those of a part of the split, of "all" parts, or "published" recordings."""
    if part == "published":
        return map(_with_mean_acceleration, read_published(data))
    return (read_take(path, data) for path in progress(take_paths(data, part)))


def _with_mean_acceleration(take: Take) -> Take:
    """Return the take with accelerations averaged since the previous frame, as `FrameSynchronizer` does."""
    acceleration = take.acceleration.copy()
    acceleration[1:] = 0.5 * (take.acceleration[1:] + take.acceleration[:-1])
    return take._replace(acceleration=acceleration)


def columns_of_parts(
    methods: Mapping[str, Method], data: Path, parts: Iterable[str], progress: Progress = iter
) -> dict[str, Columns]:
    """Return the results of `collect` for each of some parts of the takes below a folder.

    A group of parts is measured part by part, and each part once.
    """
    present, measured = set(parts_of(data).values()), dict[str, Columns]()

    def columns(part: str) -> Columns:
        if part not in measured:
            members = [member for member in GROUPS.get(part, ()) if member in present]
            measured[part] = (
                _joined([columns(member) for member in members])
                if members
                else collect(takes_of(data, part, progress), methods)
            )
        return measured[part]

    return {part: columns(part) for part in parts}


def _joined(tables: list[Columns]) -> Columns:
    """Return the measures of all frames of several tables with the same rows."""
    return {
        name: {key: np.concatenate([table[name][key] for table in tables]) for key in rows}
        for name, rows in tables[0].items()
    }


def window_errors(
    module: torch.jit.ScriptModule, takes: Iterable[Take], past: list[int], future: list[int], every: int = 1
) -> tuple[Array, int]:
    """Return the mean SIP error for each window length of a bidirectional network (DIP figure 6).

    Args:
        module: the archive.
        takes: takes to measure.
        past: numbers of past frames.
        future: numbers of future frames.
        every: measure each `every`-th frame.

    Returns:
        (len(future), len(past)) degrees, and the number of measured frames.
    """
    totals, count = np.zeros((len(future), len(past))), 0
    for take in takes:
        frames = np.arange(every // 2, len(take.pose), every)
        count += len(frames)
        for (row, column), _ in np.ndenumerate(totals):
            with torch.inference_mode():
                poses, _ = run_windows(module, take, frames, past[column], future[row])
            totals[row, column] += sip_error(poses.double().numpy(), take.pose[frames]).sum()
    return totals / count, count
