"""Offline orientation: a smoother in which later measurements correct earlier orientations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgepose import rotations as rot
from edgepose.orientation import error_model as model
from edgepose.orientation.filter import OrientationFilter, Step
from edgepose.orientation.settings import FilterSettings
from edgepose.orientation.types import OrientationResult

Array = NDArray[np.float64]


def smooth(
    time_s: ArrayLike,
    gyr: ArrayLike,
    acc: ArrayLike,
    mag: ArrayLike | None = None,
    settings: FilterSettings | None = None,
) -> OrientationResult:
    """Estimate all orientations of one sensor's recording, in the final frame of `OrientationFilter`.

    The filter runs once; then the remaining errors are propagated back from each correction to the one before
    (Rauch, Tung and Striebel 1965, on the error state) and interpolated in between. Memory use is 40 MB for
    each quarter of an hour.

    Args:
        time_s: (N,) times of the measurements, s.
        gyr: (N, 3) rates, sensor frame, rad/s.
        acc: (N, 3) specific force, sensor frame, m/s^2.
        mag: (N, 3) magnetic field, sensor frame; rows of NaN where it was not measured.
        settings: of the filter.

    Raises:
        ValueError: the shapes do not match.
    """
    steps: list[Step] = []
    forward = OrientationFilter(settings)
    forward.on_step = steps.append
    result = forward.update(time_s, gyr, acc, mag)
    if not steps:
        return result
    left, sigma = _errors_left(steps)
    quat = rot.quat_multiply(rot.rotvec_to_quat(_by_row(steps, left, len(result.quat))), result.quat)
    quat = rot.quat_multiply(rot.quat_about_z(_later_frame_rotation(steps, len(result.quat))), quat)
    # A step's values hold for the block before it; the rows after the last step have that step's values.
    of_row = np.searchsorted([step.row for step in steps], np.arange(len(quat)))
    of_row = np.minimum(of_row, len(steps) - 1)
    bias = np.array([step.bias for step in steps]) + left[:, model.BIAS]
    return result._replace(
        quat=quat / np.linalg.norm(quat, axis=1, keepdims=True), bias=bias[of_row], bias_sigma=sigma[of_row]
    )


def _errors_left(steps: list[Step]) -> tuple[Array, Array]:
    """Return the errors (K, 21) that each step left, and the bias's sigma (K, 3) without them."""
    left = np.zeros((len(steps), model.SIZE))
    covariance = steps[-1].covariance
    sigma = np.empty((len(steps), 3))
    sigma[-1] = np.sqrt(np.diag(covariance)[model.BIAS])
    for i in range(len(steps) - 2, -1, -1):
        step, following = steps[i], steps[i + 1]
        if following.matrix is None:
            covariance = step.covariance
        else:
            gain = np.linalg.solve(following.predicted, following.matrix @ step.covariance).T
            left[i] = gain @ (following.error + left[i + 1])
            covariance = step.covariance + gain @ (covariance - following.predicted) @ gain.T
        sigma[i] = np.sqrt(np.maximum(np.diag(covariance)[model.BIAS], 0.0))
    return left, sigma


def _by_row(steps: list[Step], left: Array, count: int) -> Array:
    """Return rotation errors (N, 3) of the filter's orientations: linear within blocks, jumps at steps."""
    result = np.zeros((count, 3))
    for i, step in enumerate(steps):
        end = left[i, model.TURN]
        if step.matrix is not None:
            before = steps[i - 1].row
            share = np.arange(1, step.row - before + 1)[:, None] / (step.row - before)
            start = left[i - 1, model.TURN]
            result[before + 1 : step.row + 1] = start + share * (step.error[model.TURN] + end - start)
        result[step.row] = end
    return result


def _later_frame_rotation(steps: list[Step], count: int) -> Array:
    """Return the angles (N,) by which the inertial frame was rotated after each row, rad."""
    turned = np.zeros(count)
    for step in steps:
        turned[: step.row] += step.turned
    return turned
