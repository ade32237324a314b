"""A wearer whom several test files follow: a recording made of a motion-capture clip, and its calibration."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from tests.support import processes
from tests.support.recordings import part

CLIP = Path(__file__).parents[2] / "tools" / "data" / "09_12.bvh"


class Wearer(NamedTuple):
    """12 s at 100 Hz (6 s of standing, 6 s of motion), and the 3 s about the start of the motion."""

    recording: Path
    calibration: Path
    short: Path


def edgepose(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "edgepose", *map(str, words)]
    return processes.run(command, text=True, capture_output=True, timeout=120, check=False, **options)


@pytest.fixture(scope="session")
def command():
    """Runs the command line to its end: words in, completed process out."""
    return edgepose


@pytest.fixture(scope="session")
def wearer(tmp_path_factory: pytest.TempPathFactory) -> Wearer:
    folder = tmp_path_factory.mktemp("wearer")
    result = edgepose(
        "synthesize", CLIP, "--out", folder / "whole", "--hold", 6, "--mounting", 7, "--rate", 100
    )
    assert result.returncode == 0, result.stderr
    whole = read_recording(folder / "whole" / "09_12.npz")
    files = Wearer(folder / "walk.npz", folder / "calibration.json", folder / "short.npz")
    write_npz(files.recording, part(whole, 0.0, 12.0))
    write_npz(files.short, part(whole, 5.5, 8.5))
    result = edgepose(
        *("calibrate", "--file", files.recording, "--body-frame", "heading:0"),
        *("--from", 1, "--hold", 3, "--out", files.calibration),
    )
    assert result.returncode == 0, result.stderr
    assert np.load(files.short)["t"].size == 300
    return files
