"""The bridge to ROS 2 of the documentation, without ROS 2."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edgepose.sinks.udp import encode_json
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from tests.support.poses import anything, pose

PAGE = Path(__file__).parents[3] / "docs" / "guide" / "ros2.md"


def bridge() -> dict:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names = {"__name__": "edgepose_tf"}
    exec(compile(code, str(PAGE), "exec"), names)
    return names


def test_frames_of_ros_are_where_the_joints_are():
    transforms = bridge()["transforms"]
    to_ros = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # X forward, Y left, Z up
    for one in (anything(1), anything(2), pose(where=np.zeros(3))):
        turned, places = {"map": Rotation.identity()}, {"map": np.zeros(3)}
        for time_s, parent, joint, offset, rotation in transforms(encode_json(one)):
            assert abs(time_s - one.time_s) < 1e-6
            places[joint] = places[parent] + turned[parent].apply(offset)
            turned[joint] = turned[parent] * Rotation.from_quat(rotation)
        rotations, positions = forward_kinematics(one.rotations, default_body().offsets, one.translation)
        for joint, matrix, position in zip(JOINTS, rotations, positions, strict=True):
            np.testing.assert_allclose(places[joint], to_ros @ position, atol=1e-5)
            np.testing.assert_allclose(turned[joint].as_matrix(), to_ros @ matrix @ to_ros.T, atol=1e-5)
