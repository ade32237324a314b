"""Reliability of a network's predicted standard deviations, compared with its actual errors.

A joint's standard deviation is the root mean square angle between its predicted and its true rotation, with
isotropic errors. The rotation is local or relative to the root, depending on the network's targets.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.rotations import geodesic_angle
from edgepose.skeleton import JOINTS, global_rotations
from edgepose_export.evaluation.evaluate import Mode, groups, run_with_std
from edgepose_export.training.dataset import Take

Array = NDArray[np.float64]

BINS = 10

EXPECTED = (0.608, 0.993)
"""Shares of errors within one and two standard deviations if their three components are normally distributed
(chi-squared with three degrees of freedom at 3 and 12).
"""


class Reliability(NamedTuple):
    """Predicted against actual errors.

    Attributes:
        predicted_deg: (BINS,) root mean square of the predicted deviations in each of their quantiles.
        actual_deg: (BINS,) root mean square of the errors in the same quantiles.
        within: shares of the errors within one and two deviations.
        scale: common factor that would make the deviations right on average.
        values: number of errors, frames times joints.
    """

    predicted_deg: Array
    actual_deg: Array
    within: tuple[float, float]
    scale: float
    values: int


def errors_and_deviations(
    module: torch.jit.ScriptModule, metadata: Mapping[str, Any], takes: Iterable[Take], mode: Mode
) -> tuple[Array, Array]:
    """Return errors and predicted deviations (N, joints), rad, of an archive's joints in all frames."""
    joints = [JOINTS.index(name) for name in metadata["joints"]]
    errors, deviations = [], []
    for group in groups(takes):
        for take, (poses, std) in zip(group, run_with_std(module, group, mode), strict=True):
            pair = [poses, take.pose.astype(float)]
            if metadata["targets"] != "local-matrix":
                pair = [_relative_to_root(local) for local in pair]
            errors.append(geodesic_angle(pair[0][:, joints], pair[1][:, joints]))
            deviations.append(std[:, joints])
    return np.concatenate(errors), np.concatenate(deviations)


def _relative_to_root(local: Array) -> Array:
    local = local.copy()
    local[:, 0] = np.eye(3)
    return global_rotations(local)


def scales(errors: Array, deviations: Array) -> Array:
    """Return factors (joints,) that give deviations (N, joints) the same mean square as the errors, by joint.

    Maximum-likelihood factors, from the mean square of error over deviation, are dominated by the few frames
    in which a network is confident and wrong; on other takes they were too large by a factor of two.
    """
    return _rms(errors) / _rms(deviations)


def reliability(errors: Array, deviations: Array) -> Reliability:
    """Compare errors with deviations, two arrays of the same shape, rad."""
    errors, deviations = errors.ravel(), deviations.ravel()
    bins = np.array_split(np.argsort(deviations, kind="stable"), BINS)
    ratio = errors / deviations
    return Reliability(
        np.rad2deg([_rms(deviations[rows]) for rows in bins]),
        np.rad2deg([_rms(errors[rows]) for rows in bins]),
        (float((ratio <= 1.0).mean()), float((ratio <= 2.0).mean())),
        float(_rms(ratio)),
        len(errors),
    )


def describe(result: Reliability) -> str:
    """Format a result as lines of text."""
    rows = zip(result.predicted_deg, result.actual_deg, strict=True)
    one, two = (
        f"{100 * share:.1f} % ({100 * expected:.1f} % expected)"
        for share, expected in zip(result.within, EXPECTED, strict=True)
    )
    return "\n".join(
        [
            "predicted, deg  actual RMS error, deg",
            *(f"{predicted:14.2f}  {actual:21.2f}" for predicted, actual in rows),
            f"within one standard deviation {one}, within two {two}; scale {result.scale:.2f}; "
            f"{result.values} joint errors",
        ]
    )


def _rms(values: Array) -> Array:
    return np.sqrt(np.square(values).mean(axis=0))
