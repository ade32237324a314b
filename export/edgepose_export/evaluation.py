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


def run_archive(module: torch.jit.ScriptModule, take: Take, mode: Mode) -> Array:
    """Local poses (T, 24, 3, 3) of a take; every frame gets one, as in a run."""
    orientation, acceleration = torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration)
    with torch.inference_mode():
        if mode.name == "offline":
            return module(orientation[None], acceleration[None])[0][0].double().numpy()
        if mode.name == "stream":
            return _stream(module, orientation, acceleration, mode.future)
        return _window(module, orientation, acceleration, mode)


def _stream(
    module: torch.jit.ScriptModule, orientation: torch.Tensor, acceleration: torch.Tensor, future: int
) -> Array:
    state = module.start(1, future)
    parts = []
    for o, a in zip(orientation, acceleration, strict=True):
        rotations, _, state = module.stream(o[None], a[None], state)
        parts.append(rotations[0])
    parts.append(module.drain(state)[0][0])
    return torch.cat(parts).double().numpy()


def _window(
    module: torch.jit.ScriptModule, orientation: torch.Tensor, acceleration: torch.Tensor, mode: Mode
) -> Array:
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
    return result.double().numpy()


Table = dict[str, dict[str, Measure]]
"""Row name to measures."""


def evaluate(takes: Iterable[Take], methods: dict[str, Callable[[Take], Array]]) -> Table:
    """Measures of several methods over all frames of some takes, on the default body."""
    offsets = default_body().offsets
    values: dict[str, dict[str, list[Array]]] = {}
    for take in takes:
        for name, method in methods.items():
            errors = per_frame(method(take), take.pose.astype(float), offsets, RATE)
            for key, column in errors.items():
                values.setdefault(name, {}).setdefault(key, []).append(column)
    return {
        name: {key: measure(np.concatenate(v)) for key, v in rows.items()} for name, rows in values.items()
    }


def baseline_methods(learnt: baselines.Baselines) -> dict[str, Callable[[Take], Array]]:
    """The trivial baselines as methods for `evaluate`."""

    def method(name: str) -> Callable[[Take], Array]:
        return lambda take: baselines.poses(take, learnt)[name]

    return {
        name: method(name)
        for name in (
            "mean pose",
            "measured bones, others interpolated",
            "measured bones, others interpolated + mean offsets",
        )
    }


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
    progress: Callable[[list[Take]], Iterable[Take]] = iter,
) -> dict[str, Table]:
    """Tables of an archive, and of baselines learnt from the training takes, on parts of a folder.

    A part is one of HELD_OUT, or "all" for every take there is.
    """
    methods: dict[str, Callable[[Take], Array]] = {
        str(mode): lambda take, mode=mode: run_archive(module, take, mode) for mode in modes
    }
    if with_baselines:
        methods |= baseline_methods(baselines.learn(read_takes(data, "train")))
    return {part: evaluate(progress(read_takes(data, part)), methods) for part in parts}
