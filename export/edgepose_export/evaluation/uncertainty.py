"""Whether a network errs as much as it says: predicted standard deviations against actual errors.

A joint's standard deviation is the root mean square size of the small turn, in three directions alike,
between predicted and true rotation. Which rotation that is depends on the network's targets: the joint's
local one, or the one seen from the root.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.rotations import geodesic_angle
from edgepose.skeleton import JOINTS, forward_kinematics
from edgepose_export.evaluation.evaluate import Mode, groups, run_with_std
from edgepose_export.training.dataset import Take

Array = NDArray[np.float64]

BINS = 10

EXPECTED = (0.608, 0.993)
"""Share of turns within one and two standard deviations if their three components are normally distributed
(chi-squared with three degrees of freedom at 3 and 12).
"""


class Reliability(NamedTuple):
    """Predicted against actual errors.

    Attributes:
        predicted_deg: (BINS,) root mean square of the predicted deviations in each of their quantiles.
        actual_deg: (BINS,) root mean square errors there.
        within: shares of the errors within one and two deviations.
        scale: factor of all deviations that would make them right on average.
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
    """Errors and predicted deviations (N, joints), rad, of an archive's joints in all frames of takes."""
    joints = [JOINTS.index(name) for name in metadata["joints"]]
    errors, deviations = [], []
    for group in groups(takes):
        for take, (poses, std) in zip(group, run_with_std(module, group, mode), strict=True):
            pair = [poses, take.pose.astype(float)]
            if metadata["targets"] != "local-matrix":
                pair = [_seen_from_root(local) for local in pair]
            errors.append(geodesic_angle(pair[0][:, joints], pair[1][:, joints]))
            deviations.append(std[:, joints])
    return np.concatenate(errors), np.concatenate(deviations)


def _seen_from_root(local: Array) -> Array:
    local = local.copy()
    local[:, 0] = np.eye(3)
    return forward_kinematics(local, np.zeros((24, 3)))[0]


def scales(errors: Array, deviations: Array) -> Array:
    """Factors (joints,) that make deviations (N, joints) as large as the errors in the mean square, by joint.

    The most likely factors, of the mean square of each error over its deviation, would follow the few frames
    in which a network is surest and wrong; on other takes they were twice too large.
    """
    return _rms(errors) / _rms(deviations)


def reliability(errors: Array, deviations: Array) -> Reliability:
    """Sums up errors and deviations of any shape alike, rad."""
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
    """Lines for a person."""
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
            f"{result.values} errors of joints",
        ]
    )


def _rms(values: Array) -> Array:
    return np.sqrt(np.square(values).mean(axis=0))
