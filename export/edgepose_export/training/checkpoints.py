"""Checkpoints: written whole, read without running pickled code, averaged where they belong together."""

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

CHECKPOINT = "checkpoint.pt"


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes a checkpoint so that a crash leaves the old one or the new one, never half of one.

    Raises:
        EdgeposeError: it cannot be written (disk full).
    """
    content = io.BytesIO()
    torch.save(state, content)
    try:
        write_whole(path, content.getbuffer(), "the checkpoint", overwrite=True)
    except EdgeposeError as error:
        raise EdgeposeError(f"{path}: cannot be written: {reason(error)}") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's state, read without running pickled code.

    Raises:
        EdgeposeError: missing or not a checkpoint.
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
        raise EdgeposeError(f"{path}: not a checkpoint that this edgepose reads ({reason})") from error
    return state


RELATED = 0.9
"""Least cosine between the weights of checkpoints that have a mean. Those that began from one another have
0.97 and more, trainings of one seed from scratch up to 0.77, those of two seeds 0.02; their mean is nothing.
"""


def mean_of(states: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The first of some checkpoints by name, with the mean of their averaged weights (Wortsman et al. 2022).

    What the longest of them was trained on, and the licences of all, are noted.

    Raises:
        EdgeposeError: they did not begin from one another: networks, but for `smoothing`, or statistics
            differ, or weights are unlike.
    """
    (name, first), *others = states.items()
    for other, state in others:
        if not _related(first, state):
            raise EdgeposeError(
                f"{other}: did not begin from {name}, nor the reverse (train --init); they have no mean"
            )
    weights = [state["averaged"] for state in states.values()]
    mean = {key: torch.stack([one[key] for one in weights]).mean(dim=0) for key in weights[0]}
    about = [state["data"] for state in states.values()]
    licenses = sorted({text for data in about for text in data["licenses"]})
    data = max(about, key=lambda data: float(data["hours"])) | {"licenses": licenses}
    return first | {"averaged": mean, "data": data}


def _related(one: dict[str, Any], other: dict[str, Any]) -> bool:
    shape = shape_of(one)
    if shape_of(other)._replace(smoothing=shape.smoothing) != shape:
        return False
    numbers = zip(one["statistics"].values(), other["statistics"].values(), strict=True)
    a, b = (torch.cat([w.flatten() for w in state["averaged"].values()]) for state in (one, other))
    return all(torch.equal(x, y) for x, y in numbers) and bool(torch.cosine_similarity(a, b, dim=0) > RELATED)


def shape_of(state: dict[str, Any]) -> NetworkShape:
    """The shape of the network that a checkpoint holds."""
    return config_from(json.loads(state["config"])).network


WEIGHTS_ONLY = ("config", "statistics", "averaged", "step", "data")
"""Entries of `best.pt`: what `export` and fine-tuning need."""
