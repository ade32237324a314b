"""The measures of `edgepose solve` that docs/solve.md has, on one short take."""

import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "bench_solve.py"


def run(*words):
    result = subprocess.run(
        [sys.executable, *map(str, words)], text=True, capture_output=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_table_of_a_held_out_take(tmp_path):
    run("-m", "edgepose", "synthesize", ROOT / "tools" / "data" / "09_12.bvh", "--out", tmp_path / "whole")
    with np.load(tmp_path / "whole" / "09_12.npz") as file:
        arrays = {key: file[key] for key in ("poses", "trans")}
    np.savez(tmp_path / "09_12.npz", **{key: values[:240] for key, values in arrays.items()})
    (tmp_path / "whole" / "09_12.npz").unlink()
    lines = run(TOOL, "table", "--data", tmp_path, "--part", "cmu-walk-run").splitlines()
    assert lines[0].startswith("cmu-walk-run: 1 takes; prior of CMU")
    errors = {line[:32].strip(): float(line[32:].split()[0]) for line in lines[2:-1]}
    assert errors["SIP"] < errors["SIP-M"]
    assert errors["SIP"] < errors["SOP"]
    assert errors["SIP-110"] < errors["SOP"]
    assert set(errors) >= {"SIP-BW", "SIP-120", "rnn, online", "birnn, online, 5 future frames"}
    assert "240 frames" in lines[-1]
