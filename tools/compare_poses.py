"""Prints the largest angle between the poses of two files, over all joints and frames, degrees."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from edgepose.formats.poses.registry import read_poses
from edgepose.rotations import matrix_to_rotvec

if __name__ == "__main__":
    one, other = (read_poses(Path(name)).rotations for name in sys.argv[1:3])
    if one.shape != other.shape:
        sys.exit(f"the files differ in length: {len(one)} and {len(other)} poses")
    angles = np.linalg.norm(matrix_to_rotvec(np.swapaxes(one, -1, -2) @ other), axis=-1)
    print(f"{len(one)} poses, at most {np.degrees(angles.max()):.6f} deg apart")
