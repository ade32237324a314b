"""What training minimises."""

from __future__ import annotations

import torch
from torch import Tensor


def likelihood_loss(mean: Tensor, deviation: Tensor, target: Tensor, beta: float) -> Tensor:
    """Negative Gaussian log-likelihood (DIP eq. 4 and 5), each term weighted by deviation^(2 beta) without
    gradient; a scalar.
    """
    loss = torch.log(deviation) + 0.5 * ((target - mean) / deviation).square()
    if beta:
        loss = loss * deviation.detach() ** (2.0 * beta)
    return loss.mean()


def smoothness_loss(mean: Tensor, target: Tensor) -> Tensor:
    """Mean square of the second differences in time of the error of (B, T, numbers); a scalar.

    Of two poses that are as wrong it prefers that whose error changes slowly, so that motion stays as smooth
    as it was.
    """
    error = mean - target
    return (error[:, 2:] - 2.0 * error[:, 1:-1] + error[:, :-2]).square().mean()
