"""The terms of SIP's energy (eq. 9) and their derivatives, all frames of a sequence at once."""

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
from edgepose.sip.parameterisation import PoseParameterisation, coordinates

Array = NDArray[np.float64]


class Weights(NamedTuple):
    """Weights of the energy's terms; the defaults are those of SIP's table 1."""

    ori: float = 1.0
    acc: float = 0.05
    anthro: float = 1.0
    mahal: float = 0.003
    limits: float = 0.1


class Problem(NamedTuple):
    """What poses are to explain, and how they are described.

    Attributes:
        rig: parameters of a pose and their prior.
        body: where the sensors sit.
        orientation: (T, N, 3, 3) measured R_TB.
        acceleration: (T, N, 3) measured in T without gravity, m/s^2.
        valid: (T, N) float, 1 where the acceleration counts; the first and last frame never do.
        rate: frames a second.
        weights: of the terms.
    """

    rig: PoseParameterisation
    body: SensorPoints
    orientation: Array
    acceleration: Array
    valid: Array
    rate: float
    weights: Weights


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
    """Residuals at some parameters, and what their derivatives are made of.

    Attributes:
        posed: sensors of the posed body.
        turn: (T, N, 3) orientation residuals, rad (SIP eq. 11).
        pull: (T, N, 3) acceleration residuals, m/s^2 (SIP eq. 16), see `project`.
        apart: (T, P - 3) L (x - mean), the residual of the prior (SIP eq. 30).
        beyond: (T, P - 3) how far each parameter is out of its limits, rad (SIP eq. 19).
        costs: of all of these.
    """

    states: SensorStates
    orientation_residual: Array
    acceleration_residual: Array
    prior_residual: Array
    limit_residual: Array
    costs: Costs


def project(values: Array, valid: Array) -> Array:
    """Values (T, N, ...) without their mean over the sensors that count in each frame; zero for the others.

    The body's translation accelerates all sensors alike, is free, and so takes any common part of their
    residuals away. Leaving that part out is minimising over the translation in closed form.
    """
    shape = (*valid.shape, *(1,) * (values.ndim - 2))
    weights = valid.reshape(shape)
    count = np.maximum(weights.sum(axis=1, keepdims=True), 1.0)
    return weights * (values - (weights * values).sum(axis=1, keepdims=True) / count)


def second_difference(positions: Array, rate: float) -> Array:
    """Accelerations (T, ...) of positions (T, ...) by SIP eq. 14; zero in the first and last frame."""
    result = np.zeros_like(positions)
    result[1:-1] = (positions[2:] - 2.0 * positions[1:-1] + positions[:-2]) * rate**2
    return result


def evaluate(problem: Problem, parameters: Array) -> Evaluation:
    """Residuals and costs at parameters (T, P)."""
    rig, weights = problem.rig, problem.weights
    posed = pose_sensors(coordinates(rig, parameters), problem.body)
    turn = rot.matrix_to_rotvec(posed.orientation @ rot.transpose(problem.orientation))
    pull = project(second_difference(posed.position, problem.rate) - problem.acceleration, problem.valid)
    inner = parameters[:, 3:]
    apart = (inner - rig.mean) @ rig.root.T
    beyond = np.minimum(inner - rig.lower, 0.0) + np.maximum(inner - rig.upper, 0.0)
    sensors = turn.shape[1]
    costs = Costs(
        weights.ori / sensors * np.sum(turn**2, axis=(1, 2)),
        weights.acc / sensors * np.sum(pull**2, axis=(1, 2)),
        weights.anthro * weights.mahal * np.sum(apart**2, axis=1),
        weights.anthro * weights.limits * np.sum(beyond**2, axis=1),
    )
    return Evaluation(posed, turn, pull, apart, beyond, costs)


def frame_system(problem: Problem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Normal equations of the terms that know one frame each: (T, P, P) matrices, (T, P) gradients.

    Gauss-Newton's approximation; half the second and first derivatives of the costs.
    """
    rig, weights = problem.rig, problem.weights
    # e(x + d) = log(exp(J d) R_est R^-1): exact, where SIP eq. 24 takes the inverse Jacobian for one.
    turns = rot.inverse_left_jacobian(evaluation.orientation_residual) @ _rows(
        orientation_jacobian(evaluation.states, problem.body)
    )
    jacobian = _on_rig(rig, turns)
    scaled = weights.ori / turns.shape[1] * np.swapaxes(jacobian, 1, 2)
    matrix = scaled @ jacobian
    gradient = (scaled @ evaluation.orientation_residual.reshape(len(jacobian), -1, 1))[..., 0]
    mahal, limits = weights.anthro * weights.mahal, weights.anthro * weights.limits
    matrix[:, 3:, 3:] += mahal * rig.root.T @ rig.root
    gradient[:, 3:] += mahal * evaluation.prior_residual @ rig.root + limits * evaluation.limit_residual
    inner = np.arange(3, matrix.shape[1])
    matrix[:, inner, inner] += limits * (evaluation.limit_residual != 0.0)
    return matrix, gradient


def sensor_movement(problem: Problem, evaluation: Evaluation) -> Array:
    """Jacobian (T, 3 N, P) of the sensors' positions from the pelvis, metres."""
    return _on_rig(problem.rig, _rows(position_jacobian(evaluation.states, problem.body)))


def _rows(jacobian: Array) -> Array:
    return jacobian.reshape(*jacobian.shape[:3], -1)


def _on_rig(rig: PoseParameterisation, jacobian: Array) -> Array:
    """(T, 3 N, P) of a Jacobian (T, N, 3, 72) by exponential coordinates."""
    frames, sensors = jacobian.shape[:2]
    return (jacobian.reshape(-1, jacobian.shape[-1]) @ rig.basis).reshape(frames, 3 * sensors, -1)
