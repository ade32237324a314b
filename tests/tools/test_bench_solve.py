"""The measures of `edgepose solve` that docs/guide/solve.md has, on one short take."""

import pickle
import sys
from pathlib import Path

import numpy as np

from edgepose.placements import BONES
from edgepose.rotations import rotvec_to_matrix
from edgepose.skeleton import global_rotations
from tests.support import processes

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "bench_solve.py"


def run(*words):
    result = processes.run(
        [sys.executable, *map(str, words)], text=True, capture_output=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


SOURCE = ("--zero", "source")  # as that of the prior


def test_table_of_a_held_out_take(tmp_path):
    run(
        "-m",
        "edgepose",
        "synthesize",
        ROOT / "tools" / "data" / "09_12.bvh",
        *SOURCE,
        "--out",
        tmp_path / "whole",
    )
    with np.load(tmp_path / "whole" / "09_12.npz") as file:
        arrays = {key: file[key] for key in ("poses", "trans")}
    np.savez(tmp_path / "09_12.npz", **{key: values[:240] for key, values in arrays.items()})
    (tmp_path / "whole" / "09_12.npz").unlink()
    lines = run(TOOL, "table", "--data", tmp_path, "--part", "cmu-walk-run").splitlines()
    assert lines[0].startswith("prior of CMU")
    assert lines[1] == "1 takes"
    errors = {line[:32].strip(): float(line[32:].split()[0]) for line in lines[3:-1]}
    assert errors["SIP"] < errors["SIP-M"]
    assert errors["SIP"] < errors["SOP"]
    assert errors["SIP, prior birnn"] < errors["birnn, online, 5 future frames"]
    assert errors["SIP-110"] < errors["SOP"]
    assert set(errors) >= {"SIP-BW", "SIP-120", "rnn, online", "birnn, online, 5 future frames"}
    assert "240 frames" in lines[-1]


def test_table_of_published_takes(tmp_path):
    rng = np.random.default_rng(0)
    gt = 0.1 * np.sin(np.arange(40)[:, None] / 9.0 + rng.normal(size=72))
    bones = global_rotations(rotvec_to_matrix(gt.reshape(-1, 24, 3)))[:, list(BONES)]
    orientation = np.tile(np.eye(3), (40, 17, 1, 1))
    orientation[:, [7, 8, 11, 12, 0, 2]] = bones
    content = {"imu_ori": orientation, "imu_acc": np.zeros((40, 17, 3)), "gt": gt}
    (tmp_path / "01.pkl").write_bytes(pickle.dumps(content))
    lines = run(TOOL, "table", "--published", tmp_path).splitlines()
    assert lines[1] == "1 takes"
    assert {line.split("  ")[0] for line in lines[3:-1]} >= {"SOP", "SIP", "rnn, online"}
    assert "40 frames" in lines[-1]
