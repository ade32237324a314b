import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose import rotations as rot
from edgepose.inference import features
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import PARENTS, global_rotations


def rotations(*shape, seed=1):
    count = int(np.prod(shape))
    return Rotation.random(count, random_state=seed).as_matrix().reshape(*shape, 3, 3)


def sensors(frames=5, seed=1):
    return rotations(frames, 6, seed=seed), np.random.default_rng(seed).normal(size=(frames, 6, 3))


def inputs(orientation, acceleration):
    return features.network_input(torch.tensor(orientation), torch.tensor(acceleration)).numpy()


def test_inputs_are_equations_9_and_10():
    orientation, acceleration = sensors()
    x = inputs(orientation, acceleration)
    assert x.shape == (5, features.INPUTS)
    for t in range(5):
        root = Rotation.from_matrix(orientation[t, 5]).inv()
        expected = [(root * Rotation.from_matrix(orientation[t, s])).as_matrix().ravel() for s in range(5)]
        expected += [root.apply(acceleration[t, s] - acceleration[t, 5]) for s in range(5)]
        np.testing.assert_allclose(x[t], np.concatenate(expected), atol=1e-12)
    assert PLACEMENTS[5] == "pelvis"
    assert features.ACCELERATIONS == 5 * 3


def test_leading_dimensions_are_free():
    orientation, acceleration = sensors(6)
    whole = inputs(orientation, acceleration)
    shaped = inputs(orientation.reshape(2, 3, 6, 3, 3), acceleration.reshape(2, 3, 6, 3))
    np.testing.assert_array_equal(shaped, whole.reshape(2, 3, 60))
    np.testing.assert_array_equal(inputs(orientation[0], acceleration[0]), whole[0])


def test_a_common_turn_or_push_changes_nothing():
    orientation, acceleration = sensors()
    turn = Rotation.from_euler("y", 75, degrees=True).as_matrix()
    turned = inputs(turn @ orientation, acceleration @ turn.T)
    np.testing.assert_allclose(turned, inputs(orientation, acceleration), atol=1e-12)
    pushed = inputs(orientation, acceleration + np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(pushed, inputs(orientation, acceleration), atol=1e-12)


def test_6d_there_and_back():
    r = torch.tensor(rotations(50))
    torch.testing.assert_close(features.rotation_from_6d(features.rotation_to_6d(r)), r)


def test_6d_of_any_numbers_is_a_rotation():
    x = torch.randn(50, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    r = features.rotation_from_6d(x)
    torch.testing.assert_close(r @ r.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(50, dtype=torch.float64))
    # The first column keeps its direction, the second its side of it.
    torch.testing.assert_close(r[..., 0], x[:, :3] / x[:, :3].norm(dim=-1, keepdim=True))
    assert ((r[..., 1] * x[:, 3:]).sum(-1) > 0).all()


def test_nearest_rotation_is_the_numpy_one_and_the_nearest():
    m = rotations(50) + np.random.default_rng(2).normal(scale=0.4, size=(50, 3, 3))
    m[0] = -np.eye(3)  # determinant -1
    m[1] = np.diag([1.0, 1.0, -0.2])
    got = features.nearest_rotation(torch.tensor(m)).numpy()
    np.testing.assert_allclose(got[1:], rot.nearest_rotation(m)[1:], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(got), 1.0)
    others = rotations(2000, seed=9)
    best = np.linalg.norm(m[:, None] - others, axis=(-2, -1)).min(axis=1)
    assert (np.linalg.norm(m - got, axis=(-2, -1)) <= best + 1e-9).all()


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
def test_local_rotations_undo_forward_kinematics(lead):
    local = rotations(*lead, 24) if lead else rotations(24)
    root = local[..., 0, :, :]
    world = global_rotations(local)
    relative = np.swapaxes(root, -1, -2)[..., None, :, :] @ world
    got = features.local_rotations(torch.tensor(relative), torch.tensor(root), torch.tensor(PARENTS[1:]))
    np.testing.assert_allclose(got.numpy(), local, atol=1e-12)
