"""The shipped networks follow a wearer who turns."""

from pathlib import Path

import numpy as np
import pytest

from edgepose.analysis.metrics import joint_angle_error
from edgepose.inference import archive
from edgepose.rotations import rotation_about_axis
from edgepose.skeleton import default_body
from edgepose_export.evaluation.evaluate import modes_of, run_archive
from edgepose_export.mocap import read_motion, resample
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import RATE, read_take

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"


def walking_on_the_spot(folder, deg_s):
    """A take of 4 s: steps to and fro while the whole wearer turns at a steady rate."""
    motion = resample(read_motion(WALK))
    there = np.arange(len(motion.rotations))
    frames = np.resize(np.concatenate([there, there[-2:0:-1]]), 240)
    turn = rotation_about_axis("y", np.radians(deg_s) / RATE * np.arange(240))
    translation = motion.translation[frames] * [0.0, 1.0, 0.0]
    motion = motion._replace(rotations=turn[:, None] @ motion.rotations[frames], translation=translation)
    path = folder / f"{deg_s}.npz"
    np.savez(path, **recording_arrays(motion, virtual_imus(motion, default_body()), ""))
    return read_take(path)


@pytest.mark.parametrize("name", ["birnn", "rnn"])
def test_turns_do_not_leave_the_body_behind(name, tmp_path):
    info = archive.read_info(archive.find_archive(name))
    (mode,) = (mode for mode in modes_of(info.metadata) if mode.name == "stream")
    takes = [walking_on_the_spot(tmp_path, deg_s) for deg_s in (0, 180, -180)]
    poses = run_archive(archive.load(info), takes, mode)
    straight, *turning = (
        joint_angle_error(pose, take.pose)[60:].mean() for pose, take in zip(poses, takes, strict=True)
    )
    assert max(turning) < straight + 2.5  # a body that stays behind by a tenth of a second: 5 and more
