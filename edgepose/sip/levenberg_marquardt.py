"""Levenberg-Marquardt solvers: SOP for each frame, SIP for all frames of a sequence at once (SIP 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.sip.energy import (
    Evaluation,
    Problem,
    evaluate,
    frame_system,
    project,
    second_difference,
    sensor_movement,
)
from edgepose.sip.kinematics import TURNS
from edgepose.sip.parameterisation import coordinates
from edgepose.skeleton import global_rotations

Array = NDArray[np.float64]

SOP_EVALUATIONS = 15
"""Largest number of cost evaluations of SOP, each of all frames."""

SIP_EVALUATIONS = 30
"""Largest number of cost evaluations of SIP; the paper's timing is of 20."""

ENOUGH = 1e-4
"""Relative decrease of the cost below which the search ends."""

_START, _LEAST, _MOST = 1e-3, 1e-6, 1e3  # damping
_DOWN, _UP = 0.2, 5.0

OnStep = Callable[[int, float], None]
"""Called with the number of cost evaluations so far and the mean cost per frame."""


class Minimum(NamedTuple):
    """Result of a search.

    Attributes:
        parameters: (T, P) of the problem's rig.
        evaluation: residuals at these parameters.
        evaluations: number of cost evaluations.
    """

    parameters: Array
    evaluation: Evaluation
    evaluations: int


def orientation_poser(problem: Problem, on_step: OnStep = lambda count, cost: None) -> Minimum:
    """Run SOP: find human poses that explain the orientations, each frame on its own."""
    problem = problem._replace(weights=problem.weights._replace(acc=0.0))
    parameters = _start(problem)
    current = evaluate(problem, parameters)
    cost = _by_frame(current)
    damping = np.full(len(parameters), _START)
    for count in range(1, SOP_EVALUATIONS + 1):
        matrix, gradient = frame_system(problem, current)
        step = np.linalg.solve(_damped(matrix, damping), -gradient[..., None])[..., 0]
        trial = _wrapped(parameters + step)
        at_trial = evaluate(problem, trial)
        better = _by_frame(at_trial) < cost
        parameters, before = np.where(better[:, None], trial, parameters), cost
        current = at_trial if better.all() else evaluate(problem, parameters)
        cost = _by_frame(current)
        damping = np.clip(damping * np.where(better, _DOWN, _UP), _LEAST, _MOST)
        on_step(count, float(cost.mean()))
        if before.sum() - cost.sum() <= 1e-2 * ENOUGH * before.sum() and better.any():
            break
    return Minimum(parameters, current, count)


def inertial_poser(
    problem: Problem,
    start: Array,
    evaluations: int = SIP_EVALUATIONS,
    on_step: OnStep = lambda count, cost: None,
) -> Minimum:
    """Run SIP: find human poses of all frames that explain the orientations and accelerations.

    Args:
        problem: to solve.
        start: (T, P) parameters, those of `orientation_poser`.
        evaluations: largest number of cost evaluations.
        on_step: called after every evaluation.
    """
    parameters, current = start, evaluate(problem, start)
    cost, damping = current.costs.total, _START
    system = None
    count = 1
    while count < evaluations and damping < _MOST:
        system = system or (*frame_system(problem, current), sensor_movement(problem, current))
        trial = _wrapped(parameters + _joint_step(problem, current, *system, damping))
        at_trial = evaluate(problem, trial)
        count += 1
        gain = cost - at_trial.costs.total
        if gain > 0.0:  # false for NaN
            parameters, current, cost, system = trial, at_trial, at_trial.costs.total, None
            damping = max(damping * _DOWN, _LEAST)
        else:
            damping *= _UP
        on_step(count, cost / len(parameters))
        if 0.0 <= gain <= ENOUGH * cost:
            break
    return Minimum(parameters, current, count)


def _start(problem: Problem) -> Array:
    """Return the mean pose (T, P), rotated so that the sensor nearest to the pelvis is as measured."""
    rig, bones = problem.rig, problem.body.bones
    parameters = np.zeros((len(problem.orientation), rig.basis.shape[1]))
    parameters[:, 3:] = rig.mean
    nearest = int(np.argmin(TURNS[bones].sum(axis=1)))
    mean = rot.rotvec_to_matrix(coordinates(rig, parameters[:1]))
    from_pelvis = global_rotations(mean)[0, bones[nearest]]
    parameters[:, :3] = rot.matrix_to_rotvec(problem.orientation[:, nearest] @ from_pelvis.T)
    return parameters


def _by_frame(evaluation: Evaluation) -> Array:
    return np.sum(evaluation.costs, axis=0)


def _damped(matrix: Array, damping: Array | float) -> Array:
    return matrix + np.reshape(damping, (-1, 1, 1)) * np.eye(matrix.shape[-1])


def _wrapped(parameters: Array) -> Array:
    """Limit the pelvis rotation to pi without changing the pose: its coordinates are singular at 2 pi."""
    angle = np.linalg.norm(parameters[:, :3], axis=1, keepdims=True)
    over = angle > np.pi
    parameters[:, :3] *= np.where(over, 1.0 - 2.0 * np.pi / np.where(over, angle, 1.0), 1.0)
    return parameters


def _joint_step(
    problem: Problem, current: Evaluation, matrix: Array, gradient: Array, movement: Array, damping: float
) -> Array:
    """Return the change of all parameters (T, P) that solves the damped normal equations (SIP eq. 31, 32).

    Accelerations couple frames only through the 3 N positions of the sensors. With D the block-diagonal
    matrix of the other terms, G the Jacobian of the acceleration residuals r and w their weight,
    (D + w G^T G) d = -(g + w G^T r) is d = -D^-1 (g + G^T m) with (1 / w + G D^-1 G^T) m = r - G D^-1 g, a
    banded system with 3 N unknowns per frame instead of P.
    """
    frames, rows, _ = movement.shape
    sensors = rows // 3
    across = np.concatenate([np.swapaxes(movement, 1, 2), gradient[..., None]], axis=2)
    solved = np.linalg.solve(_damped(matrix, damping), across)
    spread, moved = movement @ solved[..., :-1], movement @ solved[..., -1:]

    def residual(values: Array) -> Array:
        """Return the acceleration residuals caused by movements (T, 3 N, K) of the sensors."""
        shaped = second_difference(values, problem.rate).reshape(frames, sensors, -1)
        return project(shaped, problem.valid).reshape(values.shape)

    right = current.acceleration_residual.reshape(frames, rows, 1) - residual(moved)
    band = _band(spread, problem.valid, problem.rate, problem.weights.acc / sensors)
    from scipy.linalg import solveh_banded

    dual = solveh_banded(band, right.ravel(), overwrite_ab=True, lower=True, check_finite=False)
    dual = project(dual.reshape(frames, sensors, 3), problem.valid).reshape(frames, rows)
    # The transpose of a second difference that is zero at both ends.
    dual[[0, -1]] = 0.0
    padded = np.pad(dual, ((1, 1), (0, 0)))
    force = (padded[2:] - 2.0 * padded[1:-1] + padded[:-2]) * problem.rate**2
    return -(solved[..., -1] + (solved[..., :-1] @ force[..., None])[..., 0])


def _band(spread: Array, valid: Array, rate: float, weight: float) -> Array:
    """Return 1 / weight + G D^-1 G^T in lower banded storage (9 N, 3 N T) from J D^-1 J^T (T, 3 N, 3 N)."""
    frames, rows, _ = spread.shape
    sensors = rows // 3
    counts = np.maximum(valid.sum(axis=1), 1.0)
    # The symmetric matrix of `project`.
    projection = valid[:, :, None] * (np.eye(sensors) - valid[:, None] / counts[:, None, None])
    projection = np.einsum("tmn,ij->tminj", projection, np.eye(3)).reshape(frames, rows, rows)
    projection[[0, -1]] = 0.0
    spread = spread * rate**4
    diagonal = 4.0 * spread
    diagonal[1:] += spread[:-1]
    diagonal[:-1] += spread[1:]
    next_frame = -2.0 * (spread[1:] + spread[:-1])
    columns = np.zeros((frames, 3 * rows, rows))
    columns[:, :rows] = projection @ diagonal @ projection + np.eye(rows) / weight
    columns[:-1, rows : 2 * rows] = projection[1:] @ next_frame @ projection[:-1]
    columns[:-2, 2 * rows :] = projection[2:] @ spread[1:-1] @ projection[:-2]
    band = np.zeros((3 * rows, frames, rows))
    for column in range(rows):
        band[: 3 * rows - column, :, column] = columns[:, column:, column].T
    return band.reshape(3 * rows, frames * rows)
