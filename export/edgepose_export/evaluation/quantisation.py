"""Rounded weights, and what packing an archive's weights does to its poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from edgepose.errors import EdgeposeError
from edgepose.inference.quantisation import PRECISIONS, pack_weights
from edgepose_export.evaluation.evaluate import (
    GROUP,
    Mode,
    Progress,
    collect,
    groups,
    run_archive,
    summarise,
    takes_of,
)
from edgepose_export.training.dataset import Take

STEPS = 32
"""Steps in a typical weight once weights are rounded."""

KEYS = ("sip_error_deg", "joint_angle_error_10_deg")


@torch.no_grad()
def round_weights(network: nn.Module) -> None:
    """Makes a network's weights whole multiples of powers of two, one for each parameter, near 1 / STEPS of
    its root mean square.

    They move by about a hundredth of their size. fp16 holds such numbers exactly (below 2048 steps), and an
    archive of them compresses to two fifths of what it would.
    """
    for weight in network.parameters():
        typical = weight.square().mean().sqrt()
        if typical > 0:
            step = torch.exp2(torch.log2(typical / STEPS).round())
            weight.copy_((weight / step).round() * step)


def compare(
    new_module: Callable[[], torch.jit.ScriptModule],
    data: Path,
    parts: Iterable[str],
    mode: Mode,
    progress: Progress = iter,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Errors of each precision over the takes of some parts, and how far its poses are from those in f32.

    Args:
        new_module: gives the archive anew, its weights not packed.
        data: folder of takes.
        parts: of the split.
        mode: how the archive runs.
        progress: wraps the list of takes.

    Returns:
        For each part and precision that this machine has: "errors" against the truth and "away" from the f32
        poses, each [mean, deviation, frames] for each of `KEYS`, degrees.
    """
    modules = {"f32": new_module()}
    for precision in PRECISIONS[1:]:
        module = new_module()
        try:
            pack_weights(module, precision)
        except EdgeposeError:  # not on this machine, or not for this kind of network
            continue
        modules[precision] = module
    return {part: _part(modules, takes_of(data, part, progress), mode) for part in parts}


def _part(
    modules: dict[str, torch.jit.ScriptModule], takes: Iterable[Take], mode: Mode
) -> dict[str, dict[str, Any]]:
    takes = list(takes)
    reference = [
        take._replace(pose=pose)
        for group in groups(takes)
        for take, pose in zip(group, run_archive(modules["f32"], group, mode), strict=True)
    ]
    methods = {
        # Inputs rounded to int8 share a scale with all that is computed at once; a run has one wearer.
        name: lambda group, module=module, size=1 if name == "int8" else GROUP: [
            poses
            for i in range(0, len(group), size)
            for poses in run_archive(module, group[i : i + size], mode)
        ]
        for name, module in modules.items()
    }
    errors, away = (summarise(collect(some, methods)) for some in (takes, reference))
    return {
        name: {
            "errors": {key: list(errors[name][key]) for key in KEYS},
            "away": {key: list(away[name][key]) for key in KEYS},
        }
        for name in modules
    }
