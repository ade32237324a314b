"""tools/bench_step_calibration.py: the row of the real walker, as in the documentation."""

from __future__ import annotations

import sys

from tests.support import processes
from tests.support.processes import ROOT


def test_the_real_walker_is_the_documented_one():
    words = [sys.executable, ROOT / "tools" / "bench_step_calibration.py"]
    result = processes.run(words, capture_output=True, text=True, check=True)
    row = result.stdout.splitlines()[-1]
    assert row.startswith("| real walker | 1 | 0 | ")
    assert row in (ROOT / "docs" / "guide" / "calibration.md").read_text()
