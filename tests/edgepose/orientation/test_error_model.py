"""Jacobians of the filter's error model, against the motion itself."""

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.orientation import FilterSettings
from edgepose.orientation import error_model as model
from firmware_protocols.sample import STANDARD_G

DT = np.full(14, 0.01)


def integrate(state, gyr, acc):
    """Orientation and velocity after a block, and the orientations in the middle of each sample."""
    quat, bias, velocity, acc_bias, sensitivity = state
    middles = []
    for dt, rate, force in zip(DT, gyr, acc, strict=True):
        turned = np.array(
            rot.integrate_rotvec(tuple(quat), *((rate - sensitivity @ rate - bias) * dt).tolist())
        )
        middle = (quat + turned) / np.linalg.norm(quat + turned)
        velocity = velocity + (rot.quat_rotate(middle, force - acc_bias) - [0, 0, STANDARD_G]) * dt
        quat = turned
        middles.append(middle)
    return quat, velocity, np.array(middles)


@pytest.mark.parametrize("seed", range(5))
def test_transition_is_the_derivative_of_the_motion(seed):
    rng = np.random.default_rng(seed)
    gyr, acc = rng.normal(2.0, 1.0, (14, 3)), rng.normal((2.0, 4.0, 9.0), 1.0, (14, 3))
    mag = rng.normal(0.0, 30.0, (14, 3))
    quat = rng.normal(size=4)
    state = [
        quat / np.linalg.norm(quat),
        rng.normal(size=3) * 0.02,
        rng.normal(size=3),
        rng.normal(size=3) * 0.1,
        rng.normal(size=(3, 3)) * 0.005,
    ]
    end, velocity, middles = integrate(state, gyr, acc)
    grown = model.transition(DT, 2.0 * middles, gyr, acc - state[3], mag)
    np.testing.assert_allclose(state[2] + grown.velocity, velocity, atol=1e-12)
    np.testing.assert_allclose(grown.field, rot.quat_rotate(middles, mag).sum(axis=0), atol=1e-11)
    small = 1e-6
    measured = np.eye(model.SIZE)
    for i in range(model.SIZE):
        part = min(i // 3, 4)
        change = np.zeros(state[part].shape if part else 3)
        change.flat[i - 3 * part] = small
        other = list(state)
        other[part] = (
            rot.quat_multiply(rot.rotvec_to_quat(change), state[0]) if part == 0 else state[part] + change
        )
        other_end, other_velocity, _ = integrate(other, gyr, acc)
        turned = rot.quat_to_rotvec(rot.quat_multiply(other_end, rot.quat_conjugate(end)))
        measured[model.TURN, i] = turned / small
        measured[model.VEL, i] = (other_velocity - velocity) / small
    # In the middle of a block a bias has turned the sensor half as far as at its end: this is nearly so.
    np.testing.assert_allclose(grown.matrix, measured, atol=0.04 * np.abs(measured[:, 3:6]).max())
    exact = grown.matrix.copy()
    exact[model.VEL, model.BIAS] = measured[model.VEL, model.BIAS]
    exact[model.VEL, model.SENSITIVITY] = measured[model.VEL, model.SENSITIVITY]
    np.testing.assert_allclose(exact, measured, atol=1e-3)


def test_noise_grows_with_time_and_with_what_was_lost():
    density = model.noise_density(FilterSettings())
    short, long = (model.process_noise(density, t, 0.0, 0.0) for t in (0.1, 0.2))
    np.testing.assert_allclose(2.0 * short, long)
    lost = model.process_noise(density, 0.1, 0.5, 2.0) - short
    np.testing.assert_allclose(np.diag(lost), [0.25] * 3 + [0] * 3 + [4.0] * 3 + [0] * 12)


def test_turn_is_the_product_with_a_rotation_vector():
    rng = np.random.default_rng(1)
    for size in (0.0, 1e-12, 1e-3, 1.0, 3.0, 7.0):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        vector = size * rng.normal(size=3)
        expected = rot.quat_multiply(quat, rot.rotvec_to_quat(vector))
        np.testing.assert_allclose(rot.integrate_rotvec(tuple(quat), *vector.tolist()), expected, atol=1e-12)
