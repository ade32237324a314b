"""`tools/fuzz_files.py`: a short run, and that it finds what it is for."""

from __future__ import annotations

import json
import random
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support import processes

TOOLS = Path(__file__).parents[2] / "tools"
TOOL = TOOLS / "fuzz_files.py"


@pytest.fixture
def tool(monkeypatch):
    """The modules of the tool."""
    monkeypatch.syspath_prepend(TOOLS)
    import fuzz_files

    return fuzz_files


def test_a_case_of_each_kind_of_file():
    done = processes.run(
        [sys.executable, str(TOOL), "--seed", "7", "--cases", "70"],
        text=True,
        capture_output=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    *_, outcomes, summary = done.stdout.splitlines()
    assert set(re.findall(r"\d+ (\w+)", outcomes)) == {"ok", "refused"}
    assert int(re.match(r"70 cases of (\d+) kinds", summary)[1]) > 55


def ended(tool, code=0, out="", errors="", seconds=0.1, peak=1 << 20):
    return tool.Ended(code, out, errors, seconds, peak)


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({}, "ok"),
        ({"code": 1, "errors": "edgepose: no"}, "refused"),
        ({"code": 2, "errors": "Usage: no"}, "refused"),
        ({"code": 1}, "no message"),
        ({"code": 3, "errors": "x"}, "refused"),
        ({"code": 4, "errors": "x"}, "other exit code"),
        ({"seconds": 11.0}, "hang"),
        ({"peak": 2 << 30}, "over memory"),
        ({"code": 1, "errors": "Traceback (most recent call last):\nKeyError: 1"}, "traceback"),
        ({"code": 1, "errors": "edgepose: unexpected error (KeyError: 1)"}, "unexpected error"),
        ({"errors": "a.py:1: RuntimeWarning: overflow"}, "warning of Python"),
    ],
)
def test_outcomes_of_a_command(tool, tmp_path, change, outcome):
    (tmp_path / "stdout").touch()
    (tmp_path / "out").mkdir()
    assert tool.judge(ended(tool, **change), tmp_path / "out", None)[0] == outcome


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.csv", "t,x\n0,nan\n"), ("a.bvh", "0 -inf 1\n"), ("a.json", '{"a": NaN}'), ("a.npz", "")],
)
def test_outputs_that_are_not_finite(tool, tmp_path, name, content):
    (tmp_path / "stdout").touch()
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / name
    if content:
        path.write_text(content)
    else:
        np.savez(path, x=np.array([np.inf]))
    assert tool.judge(ended(tool), tmp_path / "out", None)[0] == "not finite"


def test_samples_that_are_missing_without_a_word(tool, tmp_path):
    (tmp_path / "stdout").touch()
    (tmp_path / "out").mkdir()
    np.savez(tmp_path / "out" / "a.npz", t=np.arange(3.0), head_quat=np.ones((3, 4)))
    assert tool.judge(ended(tool), tmp_path / "out", 3)[0] == "ok"
    assert tool.judge(ended(tool), tmp_path / "out", 4) == ("silent loss", "3 of 4")
    assert tool.judge(ended(tool, 1, errors="1 bad row"), tmp_path / "out", 4)[0] == "refused"


def test_a_process_that_is_killed_costs_only_its_item(tool):
    import os

    def work(item):
        if item == 3:
            os._exit(9)
        return 2 * item

    answers = dict(tool.supervised(work, list(range(6))))
    assert answers.pop(3) == tool.Lost(9)
    assert answers == {0: 0, 1: 2, 2: 4, 4: 8, 5: 10}


def test_damage_is_the_same_for_the_same_seed(tool, tmp_path):
    results = []
    for _ in range(2):
        path = tmp_path / "a.json"
        path.write_text(json.dumps({"format": "x", "a": list(range(50))}))
        rng = random.Random(4)
        tool.damage_file(rng, path)
        results.append(path.read_bytes())
    assert results[0] == results[1]
    assert results[0] != json.dumps({"format": "x", "a": list(range(50))}).encode()
