"""tools/bench_faults.py: it counts what `run` and `check` say."""

from __future__ import annotations

import sys

from tests.support import processes
from tests.support.processes import ROOT


def test_a_rig_without_faults_is_left_alone():
    clip = ROOT / "tools" / "data" / "09_12.bvh"
    words = [sys.executable, ROOT / "tools" / "bench_faults.py", "--good", clip]
    result = processes.run(words, capture_output=True, text=True, check=True)
    rows = {line[:60].strip(): line[60:].split() for line in result.stdout.splitlines()[1:]}
    assert rows == {"none, a common north": ["1", "0", "0"], "none, no north": ["1", "0", "0"]}
