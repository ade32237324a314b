"""Poses at another rate, live."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from edgepose.pipeline.pose_resampler import PoseResampler
from edgepose.pose import PoseFrame

COUNT = 120
TURNS = Rotation.from_rotvec(np.cumsum(np.full((COUNT, 3), [0.02, -0.01, 0.03]), axis=0))


def poses(start_s: float = 1.7e9) -> list[PoseFrame]:
    """Poses at 60 Hz that turn and walk; a contact begins at the 60th."""
    return [
        PoseFrame(
            i,
            start_s + i / 60.0,
            np.tile(TURNS[i].as_matrix(), (24, 1, 1)).astype(np.float32),
            np.zeros(24),
            np.array([0.1 * i, 1.0, -0.2 * i]),
            frozenset({"head"} if i % 2 else ()),
            contacts=np.full(7, float(i >= 60), np.float32),
        )
        for i in range(COUNT)
    ]


def test_half_the_rate_is_every_second_pose():
    resampler = PoseResampler(30.0, 60.0)
    given = poses()
    found = [each for pose in given for each in resampler.add(pose)]
    assert [pose.index for pose in found] == list(range(COUNT // 2))
    assert [pose.time_s for pose in found] == [pose.time_s for pose in given[::2]]
    assert all(pose.rotations is other.rotations for pose, other in zip(found, given[::2], strict=True))


@pytest.mark.parametrize("rate", [7.0, 25.0, 59.94, 100.0, 144.0])
def test_poses_between(rate):
    resampler = PoseResampler(rate, 60.0)
    found = []
    for pose in poses(start_s=40.0):
        new = resampler.add(pose)
        # No pose waits longer than for the first one after it.
        assert all(pose.time_s - 1.001 / 60.0 < each.time_s <= pose.time_s for each in new)
        found += new
    times = np.array([pose.time_s for pose in found])
    assert 0.0 <= times[0] - 40.0 < 1.0 / rate
    assert [pose.index for pose in found] == list(range(len(found)))
    np.testing.assert_allclose(np.diff(times), 1.0 / rate, atol=1e-4)
    assert times[-1] > 40.0 + (COUNT - 1) / 60.0 - 1.0 / rate - 1e-4
    places = (times - 40.0) * 60.0
    wanted = Slerp(np.arange(COUNT), TURNS)(np.clip(places, 0, COUNT - 1)).as_matrix()
    np.testing.assert_allclose([pose.rotations[3] for pose in found], wanted, atol=1e-4)
    np.testing.assert_allclose([pose.translation[0] for pose in found], 0.1 * places, atol=1e-3)
    assert [pose.contacts[0] == 1.0 for pose in found] == [bool(place >= 59.5) for place in places]
    for pose, place in zip(found, places, strict=True):
        if abs(place % 1.0 - 0.5) > 0.01:  # else both are as near
            assert ("head" in pose.held) == (round(place) % 2 == 1)


def test_wearers_on_one_grid_stay_on_it():
    grids = [PoseResampler(30.0, 60.0), PoseResampler(30.0, 60.0)]
    times = [
        {round(each.time_s, 4) for pose in poses()[start:] for each in grid.add(pose)}
        for start, grid in enumerate(grids)
    ]
    assert times[1] == times[0] - {min(times[0])}


def test_a_pause_is_not_filled():
    resampler = PoseResampler(100.0, 60.0)
    given = [pose._replace(time_s=pose.time_s + 90.0 * (pose.index >= 60)) for pose in poses(0.0)]
    found = [each for pose in given for each in resampler.add(pose)]
    assert [pose.index for pose in found] == list(range(len(found)))
    assert 195 < len(found) < 201
    steps = np.diff([pose.time_s for pose in found])
    assert np.sum(steps > 0.011) == 1
