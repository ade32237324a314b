"""Accuracy of an archive's head for the place: contacts of the feet, and velocity of the pelvis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from edgepose_export.training.dataset import Take
from edgepose_export.training.place import place_accuracy, place_counts

FRAMES = 256
"""Frames that run together."""


def streamed_place(module: torch.jit.ScriptModule, take: Take, future: int) -> Tensor:
    """Return the place (T, 10) for every frame of a take, streamed as in a run."""
    orientation, acceleration = torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration)
    state, places = module.start(1, future), []
    for part in zip(orientation[None].split(FRAMES, 1), acceleration[None].split(FRAMES, 1), strict=True):
        _, _, place, state = module.stream_many_place(*part, state)
        places.append(place)
    places.append(module.drain_place(state)[2])
    return torch.cat(places, dim=1)[0]


def accuracy(
    module: torch.jit.ScriptModule, metadata: Mapping[str, Any], takes: Iterable[Take]
) -> dict[str, float]:
    """Return the measures of `place_accuracy` over some takes; {} if archive or takes have no place."""
    if "place" not in metadata:
        return {}
    counts = torch.zeros(6, dtype=torch.double)
    with torch.inference_mode():
        for take in takes:
            if take.place is not None:
                place = streamed_place(module, take, metadata["future"])
                counts += place_counts(place, torch.from_numpy(take.place), threshold=0.5)
    return place_accuracy(counts)


def describe(measures: Mapping[str, float]) -> str:
    """Return the measures in words."""
    return (
        f"contacts of the feet {100.0 * measures['contact']:.1f} % right, "
        f"velocity off by {measures['velocity']:.2f} m/s"
    )
