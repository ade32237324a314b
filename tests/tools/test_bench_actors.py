import re
import runpy
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edgepose.placements import BONES
from edgepose.skeleton import UNOBSERVED, global_rotations, local_from_global
from tests.support import processes

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "bench_actors.py"
_TOOL = runpy.run_path(str(TOOL))
errors, without_constants = _TOOL["errors"], _TOOL["without_constants"]


def test_one_turn_of_each_unmeasured_bone_is_taken_out():
    """Of two takes of an actor; what changes from frame to frame and the measured bones stay."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(rng.normal(scale=0.3, size=(len(UNOBSERVED), 3))).as_matrix()
    true, poses = [], []
    for frames in (40, 60):
        pose = Rotation.random(frames * 24, random_state=rng).as_matrix().reshape(frames, 24, 3, 3)
        other = global_rotations(pose)
        other[:, list(UNOBSERVED)] = other[:, list(UNOBSERVED)] @ turns
        true.append(pose)
        poses.append(local_from_global(other))
    assert errors(poses, true).mean(axis=0).min() > 5.0
    assert errors(without_constants(poses, true), true).max() < 1e-4
    noise = Rotation.from_rotvec(rng.normal(scale=0.1, size=(60, 3))).as_matrix()
    other = global_rotations(poses[1])
    other[:, 1] = other[:, 1] @ noise
    got = global_rotations(without_constants([poses[0], local_from_global(other)], true)[1])
    np.testing.assert_allclose(got[:, list(BONES)], global_rotations(true[1])[:, list(BONES)], atol=1e-9)
    left = np.linalg.norm(got[:, 1] - global_rotations(true[1])[:, 1], axis=(1, 2))
    assert 0.05 < left.mean() < 0.5


def test_table_of_a_take(tmp_path):
    walk = ROOT / "tests" / "data" / "mocap" / "07_01.bvh"
    for words in (
        ("-m", "edgepose", "synthesize", walk, "--out", tmp_path),
        (TOOL, "--data", tmp_path, "--model", "rnn", "--part", "cmu-walk-run"),
    ):
        done = processes.run(
            [sys.executable, *map(str, words)], text=True, capture_output=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
    row = done.stdout.splitlines()[-1]
    before, after, frames = re.fullmatch(r"\| `rnn`, cmu-walk-run \| (.*) \| (.*) \| (\d+) \|", row).groups()
    before, after = ([float(value) for value in cell.split(" / ")] for cell in (before, after))
    assert all(0.0 < b < a < 40.0 for a, b in zip(before, after, strict=True))
    assert int(frames) == 30
