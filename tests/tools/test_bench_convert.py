"""The benchmark of `edgepose convert`, with few files."""

import re
import sys
from pathlib import Path

from tests.support import processes

TOOL = Path(__file__).parents[2] / "tools" / "bench_convert.py"


def test_the_broken_file_is_told_and_the_others_are_whole():
    words = ["--files", "4", "--seconds", "2", "--jobs", "2"]
    result = processes.run(
        [sys.executable, str(TOOL), *words], text=True, capture_output=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert [re.sub(r", \d+ MB,|: \d+ s,", ":", line) for line in lines] == [
        f"4 files of {what}: to {to} with --jobs 2: 3 whole, 1 damaged"
        for what, to in (("recording", "npz"), ("poses", "bvh"), ("poses", "npz"))
    ]
