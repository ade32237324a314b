"""Completion in the shell, as docs/guide/install.md sets it up."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs" / "guide" / "install.md"
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"


def completions(line: str) -> list[str]:
    """What bash offers at the end of a line, by the line of the documentation for its start-up file."""
    (setup,) = re.findall(r"^\| bash \|.*\| `(eval .*?)` \|", DOCS.read_text(), re.MULTILINE)
    words = line.split(" ")
    script = f"""{setup}
        COMP_WORDS=({" ".join(words[:-1])} "{words[-1]}")
        COMP_CWORD={len(words) - 1}
        complete -p edgepose | grep -q _edgepose_completion && _edgepose_completion edgepose
        printf '%s\\n' "${{COMPREPLY[@]}}" """
    result = subprocess.run(
        ["bash", "-c", script], env={**os.environ, "PATH": PATH}, text=True, capture_output=True, check=True
    )
    return result.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("edgepose re", {"record", "report"}),
        ("edgepose convert --to ", {"csv", "npz", "bvh", "glb", "sto", "mot"}),
        ("edgepose run --o", {"--online", "--osc", "--overwrite"}),
        ("edgepose synth", {"synthesize"}),
    ],
)
def test_bash_completes(line, offered):
    assert shutil.which("edgepose", path=PATH)
    assert set(completions(line)) == offered
