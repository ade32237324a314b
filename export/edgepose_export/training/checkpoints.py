"""Checkpoints: atomic writing, reading without running pickled code, averaging of related ones."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from edgepose.errors import EdgeposeError
from edgepose.utils.durable_files import reason, write_whole
from edgepose_export.archive.torchscript import Statistics, new_network
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.config import config_from
from edgepose_export.training.description import averaged_runs

CHECKPOINT = "checkpoint.pt"


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Write a checkpoint so that a crash leaves either the old one or the new one, never a part of one.

    Raises:
        EdgeposeError: the file cannot be written, for example because the disk is full.
    """
    content = io.BytesIO()
    torch.save(state, content)
    try:
        write_whole(path, content.getbuffer(), "the checkpoint", overwrite=True)
    except EdgeposeError as error:
        raise EdgeposeError(f"{path}: cannot be written: {reason(error)}") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint's state without running pickled code.

    Raises:
        EdgeposeError: the file is missing or not a checkpoint.
    """
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except OSError as error:
        raise EdgeposeError(f"{path}: {error.strerror or error}") from error
    except Exception as error:
        raise EdgeposeError(f"{path}: not a checkpoint of edgepose train ({type(error).__name__})") from error
    if not isinstance(state, dict) or not set(WEIGHTS_ONLY) <= set(state):
        raise EdgeposeError(f"{path}: not a checkpoint of edgepose train (entries are missing)")
    try:
        network = new_network(shape_of(state))
        network.load_state_dict(state["averaged"])
        Statistics(**state["statistics"])
    except (TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise EdgeposeError(
            f"{path}: not a checkpoint that this version of edgepose can read ({reason})"
        ) from error
    return state


RELATED = 0.9
"""Least cosine between the weights of checkpoints that may be averaged. Runs that started from each other
have 0.97 and more. Runs from scratch have up to 0.77 with the same seed and 0.02 with different seeds, and
their means are useless.
"""


def mean_of(states: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the first of some checkpoints, with the mean of all averaged weights (Wortsman et al. 2022).

    The description of the training is that of the first, with the motion of all, see `averaged_runs`.

    Args:
        states: the checkpoints by name.

    Raises:
        EdgeposeError: the checkpoints did not start from each other: networks (apart from `smoothing`) or
            statistics differ, or the weights are not alike.
    """
    (name, first), *others = states.items()
    for other, state in others:
        if not _related(first, state):
            raise EdgeposeError(
                f"{other}: cannot be averaged with {name}: neither started from the other (train --init)"
            )
    weights = [state["averaged"] for state in states.values()]
    mean = {key: torch.stack([one[key] for one in weights]).mean(dim=0) for key in weights[0]}
    return first | {"averaged": mean, "data": averaged_runs([state["data"] for state in states.values()])}


def _related(one: dict[str, Any], other: dict[str, Any]) -> bool:
    shape = shape_of(one)
    if shape_of(other)._replace(smoothing=shape.smoothing) != shape:
        return False
    numbers = zip(one["statistics"].values(), other["statistics"].values(), strict=True)
    a, b = (torch.cat([w.flatten() for w in state["averaged"].values()]) for state in (one, other))
    return all(torch.equal(x, y) for x, y in numbers) and bool(torch.cosine_similarity(a, b, dim=0) > RELATED)


def shape_of(state: dict[str, Any]) -> NetworkShape:
    """Return the shape of the network in a checkpoint."""
    return config_from(json.loads(state["config"])).network


WEIGHTS_ONLY = ("config", "statistics", "averaged", "step", "data")
"""Entries of `best.pt`, which suffice for `export` and fine-tuning."""
