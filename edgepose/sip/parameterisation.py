"""Parameterisations of a pose: SMPL's joints as far as sensors observe them, or a hand-rigged skeleton.

A rig maps its parameters to exponential coordinates, `coordinates = rest + basis @ parameters`, and carries
the prior in these parameters. The first three are the pelvis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose import rotations as rot
from edgepose.sip.kinematics import JOINT_COUNT, TURNS
from edgepose.sip.prior import Prior
from edgepose.skeleton import JOINTS

Array = NDArray[np.float64]

WIDTH = 3 * JOINT_COUNT
"""Number of exponential coordinates of a pose."""


class PoseParameterisation(NamedTuple):
    """A rig of P parameters.

    Attributes:
        basis: (72, P) change of the exponential coordinates with the parameters.
        mean: (P - 3,) prior mean of the parameters after the pelvis, rad.
        root: (P - 3, P - 3) L of SIP eq. 29: squares of L (x - mean) sum up to the Mahalanobis distance.
        lower: (P - 3,) lower limits, rad.
        upper: (P - 3,) upper limits, rad.
        regression: (72, P - 3) regression, by the prior, of coordinates that no parameter moves on the
            parameters; other rows are zero.
        rest: (72,) prior expectation of these coordinates at the mean; other rows are zero.
    """

    basis: Array
    mean: Array
    root: Array
    lower: Array
    upper: Array
    regression: Array
    rest: Array


def smpl_rig(prior: Prior, bones: ArrayLike) -> PoseParameterisation:
    """Return a rig of SMPL's joints with three degrees of freedom each, for sensors on some bones.

    A joint that moves none of these bones affects only the residual of the prior, which is Gaussian: its best
    value follows from the other joints, without a search.
    """
    observed = np.asarray(TURNS[np.asarray(bones)].any(axis=0))
    observed[0] = True
    chosen = np.flatnonzero(np.repeat(observed, 3))
    inner, others = chosen[3:] - 3, np.flatnonzero(np.repeat(~observed, 3)) - 3
    covariance = prior.covariance[np.ix_(inner, inner)]
    gain = np.linalg.solve(covariance, prior.covariance[np.ix_(inner, others)]).T
    regression, rest = np.zeros((WIDTH, len(inner))), np.zeros(WIDTH)
    regression[others + 3] = gain
    rest[others + 3] = prior.mean[others]
    return PoseParameterisation(
        np.eye(WIDTH)[:, chosen],
        prior.mean[inner],
        _root(covariance),
        prior.lower[inner],
        prior.upper[inner],
        regression,
        rest,
    )


def network_rig(prior: Prior, bones: ArrayLike) -> PoseParameterisation:
    """Return `smpl_rig` for a network's poses as the prior.

    Joints that no sensor sees are at rest, as in the network's poses. Only the prior's limits count.
    """
    rig = smpl_rig(prior, bones)
    return rig._replace(regression=np.zeros_like(rig.regression), rest=np.zeros_like(rig.rest))


_HINGES: Sequence[tuple[str, str]] = (
    ("spine2", "xyz"), ("head", "xy"),
    ("left_hip", "xyz"), ("left_knee", "x"), ("left_ankle", "x"),
    ("right_hip", "xyz"), ("right_knee", "x"), ("right_ankle", "x"),
    ("left_shoulder", "xyz"), ("left_elbow", "xy"),
    ("right_shoulder", "xyz"), ("right_elbow", "xy"),
)  # fmt: skip
"""Joints of the hand-rigged skeleton and their axes of rotation: one waist, a head that nods and shakes,
hinges at knees and ankles, elbows that bend and twist."""


def hinge_rig(prior: Prior) -> PoseParameterisation:
    """Return the rig of SIP-M (SIP 5.2): a hand-rigged skeleton, 28 angles (31 with the translation).

    The prior of an angle is that of the same coordinate of SMPL; the other joints are rigid.
    """
    rows = [0, 1, 2] + [3 * JOINTS.index(name) + "xyz".index(axis) for name, axes in _HINGES for axis in axes]
    inner = np.array(rows[3:]) - 3
    none = np.zeros((WIDTH, len(inner)))
    return PoseParameterisation(
        np.eye(WIDTH)[:, rows],
        prior.mean[inner],
        _root(prior.covariance[np.ix_(inner, inner)]),
        prior.lower[inner],
        prior.upper[inner],
        none,
        np.zeros(WIDTH),
    )


def _root(covariance: Array) -> Array:
    """Return L with inverse(covariance) = L^T L."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def coordinates(rig: PoseParameterisation, parameters: Array) -> Array:
    """Return exponential coordinates (T, 24, 3) for parameters (T, P); the rest as the prior expects."""
    expected = rig.rest + (parameters[:, 3:] - rig.mean) @ rig.regression.T
    return (parameters @ rig.basis.T + expected).reshape(-1, JOINT_COUNT, 3)


def parameters_of(rig: PoseParameterisation, rotations: Array) -> Array:
    """Return the parameters (T, P) nearest to local rotations (T, 24, 3, 3)."""
    return rot.matrix_to_rotvec(rotations).reshape(len(rotations), WIDTH) @ rig.basis
