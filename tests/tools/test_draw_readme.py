"""The pictures of the README that are drawn without a run."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import pytest

from tests.support import processes

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "new"
    words = [sys.executable, str(ROOT / "tools" / "draw_readme.py"), "--out", str(folder)]
    words += ["--only", "places", "--only", "calibration-poses"]
    done = processes.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_draws_only_what_was_asked_for(pictures):
    assert sorted(file.name for file in pictures.iterdir()) == ["calibration-poses.png", "places.png"]


@pytest.mark.parametrize("name", ["places.png", "calibration-poses.png"])
def test_is_a_png_of_sensible_size(pictures, name):
    data = (pictures / name).read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert 1000 <= width <= 1600
    assert 700 <= height <= 1200
    assert 20_000 < len(data) < 300_000


def test_the_readme_shows_all_pictures():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in ("places.png", "calibration-poses.png", "run.gif"):
        assert f"(docs/images/{name})" in readme
        assert (ROOT / "docs" / "images" / name).stat().st_size < 1_500_000
