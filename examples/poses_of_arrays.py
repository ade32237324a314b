"""Run the network alone on numpy arrays, without files, sensors or calibration."""

import numpy as np

import edgepose

T = 120
orientation = np.tile(np.eye(3), (T, 6, 1, 1))  # bones in the body frame: a T-pose
acceleration = np.zeros((T, 6, 3))  # m/s^2, without gravity
# Lower legs are vertical in a squat, too: without preceding motion the network cannot tell it from standing.
rotations = edgepose.load_model("rnn").poses(orientation, acceleration)
knee = edgepose.JOINTS.index("left_knee")
angle = np.degrees(np.arccos(np.clip((np.trace(rotations[-1, knee]) - 1) / 2, -1, 1)))
print(f"{rotations.shape}, left knee bent by {angle:.1f} deg")
