"""Terms of SIP's energy (eq. 9) and their derivatives, for all frames of a sequence at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.sip.kinematics import (
    SensorPoints,
    SensorStates,
    orientation_jacobian,
    pose_sensors,
    position_jacobian,
)
from edgepose.sip.network_prior import NetworkPrior
from edgepose.sip.parameterisation import PoseParameterisation, coordinates

Array = NDArray[np.float64]


class Weights(NamedTuple):
    """Weights of the energy's terms; the defaults are those of SIP's table 1, for the statistical prior."""

    ori: float = 1.0
    acc: float = 0.05
    anthro: float = 1.0
    mahal: float = 0.003
    limits: float = 0.1


WITH_NETWORK = Weights(acc=0.02, mahal=3e-4)
"""Weights with a network's poses as the prior, tuned on takes for validation."""


class Problem(NamedTuple):
    """Measurements that poses have to explain, and the parameterisation of the poses.

    Attributes:
        rig: parameters of a pose and their prior.
        body: positions of the sensors on it.
        orientation: (T, N, 3, 3) measured R_TB.
        acceleration: (T, N, 3) measured in T without gravity, m/s^2.
        valid: (T, N) float, 1 where the acceleration counts; in the first and last frame it never does.
        rate: frames a second.
        weights: of the terms.
        network: poses that a network expects, the prior instead of the rig's.
    """

    rig: PoseParameterisation
    body: SensorPoints
    orientation: Array
    acceleration: Array
    valid: Array
    rate: float
    weights: Weights
    network: NetworkPrior | None = None


class Costs(NamedTuple):
    """Weighted cost of each term and frame (T,); their sum over frames and terms, over T, is SIP eq. 9."""

    ori: Array
    acc: Array
    mahal: Array
    limits: Array

    @property
    def total(self) -> float:
        """Sum over terms and frames."""
        return float(sum(term.sum() for term in self))


class Evaluation(NamedTuple):
    """Residuals and costs at some parameters.

    Attributes:
        states: sensors of the posed body, from which derivatives are computed.
        orientation_residual: (T, N, 3) rad (SIP eq. 11).
        acceleration_residual: (T, N, 3) m/s^2 (SIP eq. 16), see `project`.
        prior_residual: (T, P - 3) L (x - mean) (SIP eq. 30); with a network see `_network_residual`.
        limit_residual: (T, P - 3) excess of each parameter over its limits, rad (SIP eq. 19).
        costs: of all residuals.
    """

    states: SensorStates
    orientation_residual: Array
    acceleration_residual: Array
    prior_residual: Array
    limit_residual: Array
    costs: Costs


def project(values: Array, valid: Array) -> Array:
    """Subtract from values (T, N, ...) their mean over each frame's valid sensors; zero for the others.

    The body's translation is free and accelerates all sensors alike, so it absorbs any common part of their
    residuals. Subtracting that part minimises over the translation in closed form.
    """
    shape = (*valid.shape, *(1,) * (values.ndim - 2))
    weights = valid.reshape(shape)
    count = np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return weights * (values - (weights * values).sum(axis=1, keepdims=True) / count)


def second_difference(positions: Array, rate: float) -> Array:
    """Return accelerations (T, ...) of positions (T, ...) by SIP eq. 14; zero in the first and last frame."""
    result = np.zeros_like(positions)
    result[1:-1] = (positions[2:] - 2.0 * positions[1:-1] + positions[:-2]) * rate**2
    return result


def evaluate(problem: Problem, parameters: Array) -> Evaluation:
    """Compute residuals and costs at parameters (T, P)."""
    rig, weights = problem.rig, problem.weights
    states = pose_sensors(coordinates(rig, parameters), problem.body)
    orientation = rot.matrix_to_rotvec(states.orientation @ rot.transpose(problem.orientation))
    acceleration = project(
        second_difference(states.position, problem.rate) - problem.acceleration, problem.valid
    )
    inner = parameters[:, 3:]
    if problem.network is None:
        prior = (inner - rig.mean) @ rig.root.T
    else:
        prior = _network_residual(problem.network, states)
    limits = np.minimum(inner - rig.lower, 0.0) + np.maximum(inner - rig.upper, 0.0)
    sensors = orientation.shape[1]
    costs = Costs(
        weights.ori / sensors * np.sum(orientation**2, axis=(1, 2)),
        weights.acc / sensors * np.sum(acceleration**2, axis=(1, 2)),
        weights.anthro * weights.mahal * np.sum(prior**2, axis=1),
        weights.anthro * weights.limits * np.sum(limits**2, axis=1),
    )
    return Evaluation(states, orientation, acceleration, prior, limits, costs)


def frame_system(problem: Problem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Return the normal equations of the single-frame terms: (T, P, P) matrices, (T, P) gradients.

    Gauss-Newton's approximation; half the second and first derivatives of the costs.
    """
    rig, weights = problem.rig, problem.weights
    # e(x + d) = log(exp(J d) R_est R^-1), exactly; SIP eq. 24 approximates the inverse Jacobian by identity.
    rotations = rot.inverse_left_jacobian(evaluation.orientation_residual) @ _rows(
        orientation_jacobian(evaluation.states, problem.body.bones)
    )
    jacobian = _on_rig(rig, rotations)
    scaled = weights.ori / rotations.shape[1] * np.swapaxes(jacobian, 1, 2)
    matrix = scaled @ jacobian
    gradient = (scaled @ evaluation.orientation_residual.reshape(len(jacobian), -1, 1))[..., 0]
    mahal, limits = weights.anthro * weights.mahal, weights.anthro * weights.limits
    if problem.network is None:
        matrix[:, 3:, 3:] += mahal * rig.root.T @ rig.root
        gradient[:, 3:] += mahal * evaluation.prior_residual @ rig.root
    else:
        jacobian = _network_jacobian(rig, problem.network, evaluation)
        scaled = mahal * np.swapaxes(jacobian, 1, 2)
        matrix += scaled @ jacobian
        gradient += (scaled @ evaluation.prior_residual[..., None])[..., 0]
    gradient[:, 3:] += limits * evaluation.limit_residual
    inner = np.arange(3, matrix.shape[1])
    matrix[:, inner, inner] += limits * (evaluation.limit_residual != 0.0)
    return matrix, gradient


def _network_residual(network: NetworkPrior, states: SensorStates) -> Array:
    """Return the angles (T, 3 J) from the network's bones to the posed body's, in standard deviations."""
    angles = rot.matrix_to_rotvec(states.bones[:, network.joints] @ rot.transpose(network.orientation))
    return (angles * network.precision[..., None]).reshape(len(angles), -1)


def _network_jacobian(rig: PoseParameterisation, network: NetworkPrior, evaluation: Evaluation) -> Array:
    """Return the Jacobian (T, 3 J, P) of `_network_residual`."""
    precision = network.precision[..., None]
    angles = evaluation.prior_residual.reshape(*precision.shape[:2], 3) / precision
    rotations = rot.inverse_left_jacobian(angles) @ _rows(
        orientation_jacobian(evaluation.states, network.joints)
    )
    return _on_rig(rig, precision[..., None] * rotations)


def sensor_movement(problem: Problem, evaluation: Evaluation) -> Array:
    """Return the Jacobian (T, 3 N, P) of the sensors' positions relative to the pelvis, metres."""
    return _on_rig(problem.rig, _rows(position_jacobian(evaluation.states, problem.body)))


def _rows(jacobian: Array) -> Array:
    return jacobian.reshape(*jacobian.shape[:3], -1)


def _on_rig(rig: PoseParameterisation, jacobian: Array) -> Array:
    """Convert a Jacobian (T, N, 3, 72) by exponential coordinates to one (T, 3 N, P) by parameters."""
    frames, sensors = jacobian.shape[:2]
    return (jacobian.reshape(-1, jacobian.shape[-1]) @ rig.basis).reshape(frames, 3 * sensors, -1)
