"""Windows of a tape: their first frames, random choice, and data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import accumulate

import torch
from torch import Tensor

from edgepose_export.training.dataset import SEATED, Batch, PackedTakes

Starts = dict[str, Tensor]
"""First frames of the windows by the source of their takes; the key "" is all sources without a share."""


def window_starts(
    tape: PackedTakes,
    window: int,
    joined: bool,
    chosen: Callable[[int], bool] = lambda take: True,
    shares: Iterable[str] = (),
) -> Starts:
    """Return the first frames of all windows in the chosen takes of a tape.

    Args:
        tape: the takes.
        window: frames per window.
        joined: whether windows may cross the ends of takes.
        chosen: returns whether a take, by its index, is used.
        shares: sources that have a share of their own, see `TrainConfig`.
    """
    names = tuple(shares)
    groups: dict[str, list[Tensor]] = {name: [] for name in ("", *names)}
    last = int(tape.starts[-1]) - window
    for i, source in enumerate(tape.sources):
        if not chosen(i):
            continue
        start, end = int(tape.starts[i]), int(tape.starts[i + 1])
        end = min(end - 1, last) if joined else end - window
        if end >= start:
            groups[_group(source, names)].append(torch.arange(start, end + 1))
    empty = torch.zeros(0, dtype=torch.long)
    return {name: torch.cat([empty, *group]) for name, group in groups.items()}


def _group(source: str, names: tuple[str, ...]) -> str:
    """Return the name in `[shares]` that stands for a source: its own, or its part before a dash."""
    return next((name for name in (source, source.split("-")[0]) if name in names), "")


def windows_with_sitting(tape: PackedTakes, window: int) -> Tensor:
    """Return whether the windows starting at each frame (T,) of a tape have frames of synthetic sitting."""
    frames = torch.zeros(int(tape.starts[-1]) + 1, dtype=torch.int32)
    for i in (i for i, kind in enumerate(tape.made) if kind == SEATED):
        frames[int(tape.starts[i]) + 1 : int(tape.starts[i + 1]) + 1] = 1
    before = frames.cumsum(0)
    first = torch.arange(len(before) - 1)
    return before[(first + window).clamp(max=len(before) - 1)] > before[first]


def sample_windows(
    starts: Starts, count: int, shares: Mapping[str, float], generator: torch.Generator
) -> Tensor:
    """Return the first frames (count,) of random windows, with the given shares of sources.

    Shares of sources without windows go to the others, those without a share first.
    """
    chosen = {name: share for name, share in shares.items() if len(starts[name])}
    if len(starts[""]):
        chosen[""] = max(0.0, 1.0 - sum(chosen.values()))
    # Rounded sums, so that small shares of small batches add up.
    total = sum(chosen.values())
    if not total:
        chosen, total = dict.fromkeys(chosen, 1.0), float(len(chosen))
    ends = [round(count * part / total) for part in accumulate(chosen.values())]
    parts = [
        starts[name][torch.randint(len(starts[name]), (end - first,), generator=generator)]
        for name, first, end in zip(chosen, (0, *ends), ends, strict=False)
    ]
    return torch.cat(parts)


def windows(tape: PackedTakes, starts: Tensor, length: int) -> Batch:
    """Return windows of some length by their first frames."""
    return tape.at(starts[:, None] + torch.arange(length))
