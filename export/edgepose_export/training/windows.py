"""Windows of a tape: their first frames, random choice, and data."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from edgepose_export.training.dataset import SEATED, Batch, PackedTakes

Starts = tuple[Tensor, Tensor]
"""First frames of the windows in other takes, and in CMU's takes."""


def window_starts(
    tape: PackedTakes, window: int, joined: bool, chosen: Callable[[int], bool] = lambda take: True
) -> Starts:
    """Return the first frames of all windows in the chosen takes of a tape.

    Args:
        tape: the takes.
        window: frames per window.
        joined: whether windows may cross the ends of takes.
        chosen: returns whether a take, by its index, is used.
    """
    groups: tuple[list[Tensor], list[Tensor]] = ([], [])
    last = int(tape.starts[-1]) - window
    for i, free in enumerate(tape.free):
        if not chosen(i):
            continue
        start, end = int(tape.starts[i]), int(tape.starts[i + 1])
        end = min(end - 1, last) if joined else end - window
        if end >= start:
            groups[free].append(torch.arange(start, end + 1))
    empty = torch.zeros(0, dtype=torch.long)
    return torch.cat([empty, *groups[0]]), torch.cat([empty, *groups[1]])


def windows_with_sitting(tape: PackedTakes, window: int) -> Tensor:
    """Return whether the windows starting at each frame (T,) of a tape have frames of synthetic sitting."""
    frames = torch.zeros(int(tape.starts[-1]) + 1, dtype=torch.int32)
    for i in (i for i, kind in enumerate(tape.made) if kind == SEATED):
        frames[int(tape.starts[i]) + 1 : int(tape.starts[i + 1]) + 1] = 1
    before = frames.cumsum(0)
    first = torch.arange(len(before) - 1)
    return before[(first + window).clamp(max=len(before) - 1)] > before[first]


def sample_windows(starts: Starts, count: int, free_share: float, generator: torch.Generator) -> Tensor:
    """Return the first frames (count,) of random windows, with the given share of CMU's."""
    other, cmu = starts
    if free_share == 0.0 or len(other) == 0 or len(cmu) == 0:
        pool = torch.cat([other, cmu])
        return pool[torch.randint(len(pool), (count,), generator=generator)]
    free = round(count * free_share)
    return torch.cat(
        [
            cmu[torch.randint(len(cmu), (free,), generator=generator)],
            other[torch.randint(len(other), (count - free,), generator=generator)],
        ]
    )


def windows(tape: PackedTakes, starts: Tensor, length: int) -> Batch:
    """Return windows of some length by their first frames."""
    return tape.at(starts[:, None] + torch.arange(length))
