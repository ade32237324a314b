"""A custom output: prints the height of the right wrist above the pelvis for each pose.

python examples/own_sink.py walk.npz calib.json
"""

import sys

import numpy as np

import edgepose
from edgepose.skeleton import default_body, forward_kinematics


class WristHeight(edgepose.Sink):
    """Prints a number for each pose."""

    def __init__(self) -> None:
        self._offsets = default_body().offsets
        self._wrist = edgepose.JOINTS.index("right_wrist")

    def write(self, pose: edgepose.PoseFrame) -> None:
        _, joints = forward_kinematics(np.asarray(pose.rotations, float)[None], self._offsets)
        print(f"{pose.time_s:.3f} {joints[0, self._wrist, 1] - joints[0, 0, 1]:+.3f} m")

    def close(self) -> None:
        pass


recording, calibration = sys.argv[1:3]
pipeline = edgepose.Pipeline(edgepose.load_calibration(calibration), model="rnn")
with edgepose.open_source(file=recording) as source, WristHeight() as sink:
    for pose in pipeline.poses(source):
        sink.write(pose)
