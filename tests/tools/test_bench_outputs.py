"""All outputs at once at 1000 poses a second, some of whose receivers are dead."""

import re
import sys
from pathlib import Path

from tests.support import processes

TOOL = Path(__file__).parents[2] / "tools" / "bench_outputs.py"


def test_nothing_is_lost_and_dead_receivers_cost_no_other():
    words = ["--rate", "1000", "--seconds", "0.05", "--dead"]
    result = processes.run(
        [sys.executable, str(TOOL), *words], text=True, capture_output=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    found = dict(re.findall(r"\| (\w+) \| \d+ \| (\d+ of \d+) \|", result.stdout))
    names = ("udp", "osc", "vrchat", "mocopi", "tcp", "csv", "npz", "bvh")
    assert found == {name: "100 of 100" if name == "osc" else "50 of 50" for name in names}
