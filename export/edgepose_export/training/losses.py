"""Loss functions of training."""

from __future__ import annotations

import torch
from torch import Tensor


def likelihood_loss(mean: Tensor, deviation: Tensor, target: Tensor, beta: float) -> Tensor:
    """Return the negative Gaussian log-likelihood (DIP eq. 4 and 5), a scalar.

    Each term is weighted by deviation^(2 beta), without a gradient through the weight.
    """
    loss = torch.log(deviation) + 0.5 * ((target - mean) / deviation).square()
    if beta:
        loss = loss * deviation.detach() ** (2.0 * beta)
    return loss.mean()


def smoothness_loss(mean: Tensor, target: Tensor) -> Tensor:
    """Return the mean square of the second differences in time of the error of (B, T, numbers), a scalar.

    This jitter penalty prefers errors that change slowly, so that the motion stays as smooth as the true one.
    """
    error = mean - target
    return (error[:, 2:] - 2.0 * error[:, 1:-1] + error[:, :-2]).square().mean()
