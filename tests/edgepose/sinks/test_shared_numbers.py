"""Numbers of a pose that outputs share."""

import numpy as np

from edgepose.rotations import matrix_to_quat, matrix_to_rotvec, rotvec_to_matrix
from edgepose.sinks.shared_numbers import quats, rotvec_text, rotvecs
from tests.support.poses import anything


def test_they_follow_an_array_that_is_used_again():
    pose = anything(1)
    pose = pose._replace(rotations=pose.rotations.copy())
    for seed in (1, 2, 1):
        vectors = np.random.default_rng(seed).normal(size=(24, 3))
        pose.rotations[:] = rotvec_to_matrix(vectors)
        np.testing.assert_array_equal(quats(pose), matrix_to_quat(pose.rotations))
        np.testing.assert_array_equal(rotvecs(pose), matrix_to_rotvec(pose.rotations))
        assert rotvec_text(pose) == ",".join(f"{x:.6f}" for x in matrix_to_rotvec(pose.rotations).ravel())
        double = pose._replace(rotations=pose.rotations.astype(float))
        np.testing.assert_array_equal(quats(double), matrix_to_quat(pose.rotations))
