"""The energy's derivatives against numerical ones, and the joint step against a dense solution."""

import numpy as np
import pytest

from edgepose import rotations as rot
from edgepose.placements import PLACEMENTS, SITES
from edgepose.sip import energy as terms
from edgepose.sip import levenberg_marquardt as minimise
from edgepose.sip.bodies import sensor_points
from edgepose.sip.energy import Problem, Weights
from edgepose.sip.kinematics import orientation_jacobian
from edgepose.sip.network_prior import NetworkPrior
from edgepose.sip.parameterisation import hinge_rig, smpl_rig
from edgepose.sip.prior import load_prior
from edgepose.skeleton import default_body, global_rotations

FRAMES = 6


def problem(names=PLACEMENTS, hinges=False, missing=True, seed=0):
    rng = np.random.default_rng(seed)
    prior, body = load_prior(), sensor_points(default_body(), names)
    rig = hinge_rig(prior) if hinges else smpl_rig(prior, body.bones)
    shape = (FRAMES, len(names))
    valid = np.ones(shape)
    valid[[0, -1]] = 0.0
    if missing:
        valid[3, 1] = 0.0
    return Problem(
        rig,
        body,
        rot.rotvec_to_matrix(0.7 * rng.normal(size=(*shape, 3))),
        3.0 * rng.normal(size=(*shape, 3)),
        valid,
        60.0,
        Weights(),
    ), 0.4 * rng.normal(size=(FRAMES, rig.basis.shape[1]))


def numerical(function, at):
    """Central differences (values, parameters) of a function of parameters (T, P)."""
    step, columns = 1e-5, []
    for i in range(at.size):
        change = np.zeros(at.size)
        change[i] = step
        change = change.reshape(at.shape)
        columns.append((function(at + change).ravel() - function(at - change).ravel()) / (2.0 * step))
    return np.stack(columns, axis=1)


def block_diagonal(blocks):
    frames, rows, columns = blocks.shape
    dense = np.zeros((frames * rows, frames * columns))
    for t, block in enumerate(blocks):
        dense[t * rows : (t + 1) * rows, t * columns : (t + 1) * columns] = block
    return dense


def relative_error(analytic, reference):
    return np.abs(analytic - reference).max() / np.abs(reference).max()


@pytest.mark.parametrize("hinges", [False, True])
def test_orientation_residuals_change_as_their_jacobian_says(hinges):
    this, at = problem(hinges=hinges)
    here = terms.evaluate(this, at)
    turns = rot.inverse_left_jacobian(here.orientation_residual) @ orientation_jacobian(
        here.states, this.body.bones
    ).reshape(FRAMES, -1, 3, 72)
    analytic = block_diagonal((turns @ this.rig.basis).reshape(FRAMES, -1, at.shape[1]))
    assert (
        relative_error(analytic, numerical(lambda x: terms.evaluate(this, x).orientation_residual, at)) < 1e-6
    )


@pytest.mark.parametrize("hinges", [False, True])
def test_sensors_move_as_their_jacobian_says(hinges):
    this, at = problem(hinges=hinges)
    analytic = block_diagonal(terms.sensor_movement(this, terms.evaluate(this, at)))
    reference = numerical(lambda x: terms.evaluate(this, x).states.position, at)
    assert relative_error(analytic, reference) < 1e-6


def expected_by_a_network(seed=1):
    rng = np.random.default_rng(seed)
    local = rot.rotvec_to_matrix(0.4 * rng.normal(size=(FRAMES, 24, 3)))
    joints = np.array([1, 2, 3, 16])
    orientation = global_rotations(local)[:, joints]
    return NetworkPrior(joints, local, orientation, rng.uniform(1.0, 20.0, (FRAMES, len(joints))), None)


@pytest.mark.parametrize("network", [None, expected_by_a_network()])
def test_the_gradient_is_that_of_the_cost(network):
    this, at = problem()
    this = this._replace(network=network)
    at[2, 10:14] = 3.0  # beyond the limits
    here = terms.evaluate(this, at)
    assert here.costs.limits[2] > 0.1
    _, gradient = terms.frame_system(this, here)
    movement = terms.sensor_movement(this, here)
    weight = this.weights.acc / len(PLACEMENTS)
    pull = here.acceleration_residual.copy()
    pull[[0, -1]] = 0.0
    padded = np.pad(pull.reshape(FRAMES, -1), ((1, 1), (0, 0)))
    force = (padded[2:] - 2.0 * padded[1:-1] + padded[:-2]) * 3600.0
    gradient = gradient + weight * np.einsum("trp,tr->tp", movement, force)
    reference = numerical(lambda x: np.array(terms.evaluate(this, x).costs.total), at)
    assert relative_error(2.0 * gradient.ravel(), reference[0]) < 1e-6


@pytest.mark.parametrize("names", [PLACEMENTS, ("left_forearm", "left_lower_leg", "pelvis"), tuple(SITES)])
def test_the_banded_step_is_that_of_the_dense_normal_equations(names):
    this, at = problem(names)
    here = terms.evaluate(this, at)
    matrix, gradient = terms.frame_system(this, here)
    movement = terms.sensor_movement(this, here)
    pulls = numerical(lambda x: terms.evaluate(this, x).acceleration_residual, at)
    weight = this.weights.acc / len(names)
    dense = block_diagonal(matrix) + weight * pulls.T @ pulls + 1e-3 * np.eye(at.size)
    right = gradient.ravel() + weight * pulls.T @ here.acceleration_residual.ravel()
    step = minimise._joint_step(this, here, matrix, gradient, movement, 1e-3)
    assert relative_error(step.ravel(), -np.linalg.solve(dense, right)) < 1e-5


def test_the_translation_takes_a_common_acceleration_away():
    this, at = problem()
    pushed = this._replace(acceleration=this.acceleration + np.array([3.0, -2.0, 5.0]))
    np.testing.assert_allclose(
        terms.evaluate(this, at).acceleration_residual,
        terms.evaluate(pushed, at).acceleration_residual,
        atol=1e-12,
    )
    one = this._replace(acceleration=this.acceleration.copy())
    one.acceleration[2, 0] += 6.0
    change = terms.evaluate(this, at).acceleration_residual - terms.evaluate(one, at).acceleration_residual
    np.testing.assert_allclose(change[2, 0], 5.0)  # five sixths, the rest is the translation's
    np.testing.assert_allclose(change[2, 1:], -1.0)


def test_unseen_joints_have_what_the_prior_expects():
    """Leaving joints out that no sensor sees gives the least Mahalanobis distance that any values have."""
    prior = load_prior()
    rig = smpl_rig(prior, [18, 19, 4, 5, 15, 0])
    rng = np.random.default_rng(2)
    parameters = np.concatenate([np.zeros((1, 3)), rig.mean + 0.2 * rng.normal(size=(1, len(rig.mean)))], 1)
    from edgepose.sip.parameterisation import coordinates

    whole = coordinates(rig, parameters).reshape(72)[3:]
    inverse = np.linalg.inv(prior.covariance)
    distance = (whole - prior.mean) @ inverse @ (whole - prior.mean)
    assert distance == pytest.approx(np.sum((rig.root @ (parameters[0, 3:] - rig.mean)) ** 2), rel=1e-6)
    slope = inverse @ (whole - prior.mean)
    unseen = np.repeat(~np.isin(np.arange(1, 24), [1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19]), 3)
    np.testing.assert_allclose(slope[unseen], 0.0, atol=1e-6 * np.abs(slope).max())


def test_rigs_have_the_numbers_of_the_paper():
    prior = load_prior()
    everywhere = smpl_rig(prior, range(24))
    assert everywhere.basis.shape == (72, 72)  # 75 with the translation
    assert hinge_rig(prior).basis.shape == (72, 28)  # 31 with the translation


def test_derivatives_of_rotations():
    rng = np.random.default_rng(3)
    vectors = rng.normal(size=(200, 3)) * rng.choice([1e-9, 1e-5, 1e-3, 0.1, 1.0, 1.7], size=(200, 1))
    change = 1e-7 * rng.normal(size=vectors.shape)
    turned = rot.matrix_to_rotvec(
        rot.rotvec_to_matrix(vectors + change) @ rot.rotvec_to_matrix(vectors).swapaxes(-1, -2)
    )
    expected = (rot.left_jacobian(vectors) @ change[..., None])[..., 0]
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    identity = rot.left_jacobian(vectors) @ rot.inverse_left_jacobian(vectors)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)
