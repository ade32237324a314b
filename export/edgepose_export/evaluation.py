"""Measures of an exported archive on takes with known poses, run the way `edgepose run` runs it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.metrics import Measure, measure, per_frame
from edgepose.skeleton import default_body
from edgepose_export import baselines
from edgepose_export.dataset import HELD_OUT, RATE, Take, read_takes

Array = NDArray[np.float64]

BATCH = 512
"""Windows run at once."""

GROUP = 64
"""Takes run at once."""

Progress = Callable[[list[list[Take]]], Iterable[list[Take]]]


class Mode(NamedTuple):
    """How an archive is run: "offline" (the whole take), "window" or "stream"; past and future frames."""

    name: str
    past: int = 0
    future: int = 0

    def __str__(self) -> str:
        """For a person."""
        if self.name == "offline":
            return "offline, whole take"
        if self.name == "window":
            return f"online, window ({self.past}, {self.future})"
        return f"online, stream ({self.future} future)" if self.future else "online, step by step"


def run_archive(module: torch.jit.ScriptModule, takes: list[Take], mode: Mode) -> list[Array]:
    """Local poses (T, 24, 3, 3) of each take; every frame gets one, as in a run."""
    with torch.inference_mode():
        if mode.name == "stream":
            return _stream(module, takes, mode.future)
        run = _offline if mode.name == "offline" else _window
        pairs = [(torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration)) for take in takes]
        return [run(module, *pair, mode).double().numpy() for pair in pairs]


def _offline(
    module: torch.jit.ScriptModule, orientation: torch.Tensor, acceleration: torch.Tensor, mode: Mode
) -> torch.Tensor:
    poses: torch.Tensor = module(orientation[None], acceleration[None])[0][0]
    return poses


def _stream(module: torch.jit.ScriptModule, takes: list[Take], future: int) -> list[Array]:
    """Frame by frame, all takes side by side as if each were a wearer, the longest first."""
    order = sorted(range(len(takes)), key=lambda i: -len(takes[i].pose))
    lengths = [len(takes[i].pose) for i in order]
    poses: list[list[torch.Tensor]] = [[] for _ in order]
    state, active = module.start(len(order), future), len(order)
    for t in range(lengths[0] + 1):
        while active and lengths[active - 1] == t:
            active -= 1
            poses[active].extend(module.drain(_wearers(state, slice(active, active + 1)))[0][0])
            state = _wearers(state, slice(0, active))
        if active:
            frames = [takes[i] for i in order[:active]]
            orientation = torch.from_numpy(np.stack([take.orientation[t] for take in frames]))
            acceleration = torch.from_numpy(np.stack([take.acceleration[t] for take in frames]))
            rotations, _, state = module.stream(orientation, acceleration, state)
            for k, new in enumerate(rotations):
                poses[k].extend(new)
    result: list[Array] = [np.empty(0)] * len(takes)
    for i, rotations in zip(order, poses, strict=True):
        result[i] = torch.stack(rotations).double().numpy()
    return result


def _wearers(state: list[torch.Tensor], rows: slice) -> list[torch.Tensor]:
    """The state of some wearers; a bidirectional state's last tensor is common to all."""
    return [s if k == 7 else s[rows] for k, s in enumerate(state)]


def _window(
    module: torch.jit.ScriptModule, orientation: torch.Tensor, acceleration: torch.Tensor, mode: Mode
) -> torch.Tensor:
    """Many windows of equal length at once; each is the window that a run computes for that frame."""
    frames, result = len(orientation), torch.empty(len(orientation), 24, 3, 3)
    length = mode.past + 1 + mode.future
    for first in range(0, frames - length + 1, BATCH):
        index = torch.arange(first, min(first + BATCH, frames - length + 1))
        rows = index[:, None] + torch.arange(length)
        result[index + mode.past] = module.window(orientation[rows], acceleration[rows], mode.past)[0]
    for t in [*range(min(mode.past, frames)), *range(max(mode.past, frames - mode.future), frames)]:
        low, high = max(0, t - mode.past), min(frames, t + mode.future + 1)
        result[t] = module.window(orientation[None, low:high], acceleration[None, low:high], t - low)[0][0]
    return result


Table = dict[str, dict[str, Measure]]
"""Row name to measures."""


Method = Callable[[list[Take]], list[Array]]
"""Poses (T, 24, 3, 3) of some takes."""


def evaluate(takes: list[Take], methods: dict[str, Method], progress: Progress = iter) -> Table:
    """Measures of several methods over all frames of some takes, on the default body."""
    offsets = default_body().offsets
    values: dict[str, dict[str, list[Array]]] = {}
    for group in progress([takes[i : i + GROUP] for i in range(0, len(takes), GROUP)]):
        for name, method in methods.items():
            for take, poses in zip(group, method(group), strict=True):
                for key, column in per_frame(poses, take.pose.astype(float), offsets, RATE).items():
                    values.setdefault(name, {}).setdefault(key, []).append(column)
    return {
        name: {key: measure(np.concatenate(v)) for key, v in rows.items()} for name, rows in values.items()
    }


def baseline_methods(learnt: baselines.Baselines) -> dict[str, Method]:
    """The trivial baselines as methods for `evaluate`."""

    def method(name: str) -> Method:
        return lambda takes: [baselines.poses(take, learnt)[name] for take in takes]

    return {name: method(name) for name in baselines.NAMES}


def modes_of(metadata: dict[str, Any]) -> list[Mode]:
    """The ways in which an archive is worth measuring."""
    if metadata["kind"] == "rnn":
        return [Mode("stream"), Mode("offline")]
    past, future = metadata["past"], metadata["future"]
    return [Mode("window", past, future), Mode("stream", 0, future), Mode("offline")]


def held_out_tables(
    module: torch.jit.ScriptModule,
    modes: list[Mode],
    data: Path,
    with_baselines: bool,
    parts: Iterable[str] = HELD_OUT,
    progress: Progress = iter,
) -> dict[str, Table]:
    """Tables of an archive, and of baselines learnt from the training takes, on parts of a folder.

    A part is one of HELD_OUT, or "all" for every take there is.
    """
    methods: dict[str, Method] = {
        str(mode): lambda takes, mode=mode: run_archive(module, takes, mode) for mode in modes
    }
    if with_baselines:
        methods |= baseline_methods(baselines.learn(read_takes(data, "train")))
    return {part: evaluate(read_takes(data, part), methods, progress) for part in parts}
