"""Rounding of weights, and the effect of packed weights on an archive's poses."""

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
"""Size of a typical rounded weight, in rounding steps."""

KEYS = ("sip_error_deg", "joint_angle_error_10_deg")


@torch.no_grad()
def round_weights(network: nn.Module) -> None:
    """Round each parameter to multiples of a power of two near 1 / STEPS of its root mean square.

    Weights change by about a hundredth of their size. fp16 represents such numbers exactly (below 2048
    steps), and their archive compresses to two fifths of the size it has otherwise.
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
    """Measure each precision on the takes of some parts: its errors, and its distance to the poses in f32.

    Args:
        new_module: returns a fresh copy of the archive with unpacked weights.
        data: folder of takes.
        parts: parts of the split.
        mode: mode in which the archive runs.
        progress: wraps the list of takes.

    Returns:
        By part and precision that this machine supports: "errors" against the true poses, and "away", the
        distance to the f32 poses; each holds [mean, deviation, frames] for each of `KEYS`, degrees.
    """
    modules = {"f32": new_module()}
    for precision in PRECISIONS[1:]:
        module = new_module()
        try:
            pack_weights(module, precision)
        except EdgeposeError:  # not supported on this machine or for this kind of network
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
        # int8 activations share one scale per batch, so batching would change results; a run has one wearer.
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
