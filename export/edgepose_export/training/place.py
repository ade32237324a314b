"""Loss and accuracy of the head for the place: contacts and velocity of the pelvis, see `dataset.Batch`.

Outputs are (..., 10): seven logits of contacts and three velocities, m/s. Targets are NaN where they are
unknown, as in recordings without labels; such frames do not count.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose.pose import CONTACTS
from edgepose_export.training.dataset import PackedTakes
from edgepose_export.training.distributed import ALONE, Processes

FEET = slice(0, 4)
"""Contacts of ankles and toes."""

HUBER = 0.1
"""Error of the velocity, m/s, up to which its loss is quadratic."""


def contact_weights(tape: PackedTakes, processes: Processes = ALONE) -> Tensor:
    """Return weights (7,) of the contacts' losses: the inverse entropy of each contact's share of all frames.

    A network that only knows these shares has the same loss for each contact, however rare. Weights for the
    rarer class of each contact would have that effect, too, but they would bias the probabilities.
    """
    known = tape.place[:, 0].isfinite()
    contacts = tape.place[:, : len(CONTACTS)][known].double()
    sums = processes.total(torch.cat([contacts.sum(0), known.sum()[None].double()]))
    share = (sums[:-1] / sums[-1].clamp_min(1.0)).clamp(0.05, 0.95)
    return (1.0 / torch.distributions.Bernoulli(share).entropy()).float()


def place_loss(output: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """Return the mean of cross entropy (contacts) and Huber loss (velocity), a scalar; 0 if nothing is known.

    Args:
        output: (..., 10) outputs of the head.
        target: (..., 10) contacts and velocity, NaN where unknown.
        weights: (7,) weights of the contacts, see `contact_weights`.
    """
    known = target[..., :1].isfinite()
    # Replaced before the losses, because the gradient of 0 * NaN is NaN.
    target = torch.where(known, target, 0.0)
    logits, velocity = output.split([len(CONTACTS), 3], dim=-1)
    true_contacts, true_velocity = target.split([len(CONTACTS), 3], dim=-1)
    contact = nn.functional.binary_cross_entropy_with_logits(logits, true_contacts, reduction="none")
    moving = nn.functional.smooth_l1_loss(velocity, true_velocity, reduction="none", beta=HUBER)
    frames = known.sum().clamp_min(1)
    return ((contact * weights * known).mean(-1).sum() + (moving * known).mean(-1).sum()) / frames


def place_counts(output: Tensor, target: Tensor, threshold: float = 0.0) -> Tensor:
    """Return sums (6,) over frames (..., 10), which add up to those of more frames, for `place_accuracy`.

    They are: feet in contact, found; feet in contact; feet not in contact, found; feet not in contact;
    velocity errors, m/s; frames. `threshold` is the least output that means contact: 0 for logits, 0.5 for
    probabilities.
    """
    known = target[..., 0].isfinite()
    output, target = output[known], target[known]
    found, true = output[:, FEET] > threshold, target[:, FEET] > 0.5
    error = (output[:, len(CONTACTS) :] - target[:, len(CONTACTS) :]).norm(dim=-1)
    sums = [(found & true).sum(), true.sum(), (~found & ~true).sum(), (~true).sum(), error.sum(), known.sum()]
    return torch.stack([number.double() for number in sums])


def place_accuracy(counts: Tensor) -> dict[str, float]:
    """Return the balanced accuracy of the feet's contacts, and the mean velocity error, m/s; {} if unknown.

    The balanced accuracy is the mean of the shares of contacts and of the other frames that are found.
    """
    found, true, found_free, free, error, frames = counts.tolist()
    if not (true and free):
        return {}
    return {"contact": 0.5 * (found / true + found_free / free), "velocity": error / frames}
