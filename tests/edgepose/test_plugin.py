"""The example plug-in, installed as a user installs it: a wire format and an output of another package."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.sinks.base import SinkContext
from edgepose.skeleton import default_body

PLUGIN = Path(__file__).parents[2] / "examples" / "plugin"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The environment of a Python that has the plug-in."""
    folder = tmp_path_factory.mktemp("site")
    source = tmp_path_factory.mktemp("source")
    for path in PLUGIN.iterdir():  # a build leaves files beside its source
        if path.is_file():
            (source / path.name).write_bytes(path.read_bytes())
    flags = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    subprocess.run([sys.executable, "-m", "pip", "install", *flags, "--target", folder, source], check=True)
    path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path}


def edgepose(environment, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "edgepose", *map(str, words)]
    return subprocess.run(command, text=True, capture_output=True, check=False, env=environment)


def test_its_format_and_its_output(installed, wearer, tmp_path):
    recording = read_recording(wearer.short)
    lines = []
    for row in range(len(recording.sensors["head"].time_s)):
        for i, name in enumerate(PLACEMENTS):
            own = recording.sensors[name]
            numbers = [*own.quat[row], *own.acc[row]]
            lines.append(f"E,{i},{int(1e6 * own.time_s[row])}," + ",".join(f"{x:.6f}" for x in numbers))
    lines.insert(60, "E,0,noise")
    capture = tmp_path / "a.bin"
    capture.write_text("\n".join(lines) + "\n")
    run = [
        *("run", "--file", capture, "--protocol", "example-lines", "--model", "rnn"),
        *("--calibration", wearer.calibration, "--sink", f"example-count={tmp_path / 'count.txt'}"),
    ]
    result = edgepose(installed, *run)
    assert result.returncode == 1
    assert "1 bad" in result.stderr
    assert f"{capture}: 1 corrupted packets left out" in result.stderr
    assert (tmp_path / "count.txt").read_text() == "180\n"
    (tmp_path / "count.txt").write_text("old")
    result = edgepose(installed, *run)
    assert result.returncode == 1
    assert "count.txt already exists" in result.stderr
    assert (tmp_path / "count.txt").read_text() == "old"
    capture.write_text("\n".join(line for line in lines if "noise" not in line) + "\n")
    result = edgepose(installed, *run, "--overwrite")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "count.txt").read_text() == "180\n"
    result = edgepose(installed, "check", "--file", capture, "--protocol", "example-lines")
    assert "6 of 6" in result.stdout or "sensors fine" in result.stdout


def test_its_output_by_itself(tmp_path, monkeypatch):
    """A second `close` does nothing; nothing is written without poses or after a failure."""
    monkeypatch.syspath_prepend(str(PLUGIN))
    plugin = importlib.import_module("edgepose_example_plugin")
    context = SinkContext(default_body())
    pose = PoseFrame(0, 0.0, np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)), np.zeros(24))
    path = tmp_path / "count.txt"
    with plugin.open_count(str(path), context):
        pass
    assert not path.exists()
    sink = plugin.open_count(str(path), context)
    sink.write(pose)
    sink.discard()
    sink.close()
    assert not path.exists()
    with plugin.open_count(str(path), context) as sink:
        sink.write(pose)
    assert path.read_text() == "1\n"
    path.unlink()
    sink.close()
    assert not path.exists()
    with pytest.raises(EdgeposeError, match="its folder does not exist"):
        plugin.open_count(str(tmp_path / "nowhere" / "count.txt"), context)


def test_without_it(command, wearer, tmp_path):
    flags = ("--file", wearer.short, "--calibration", wearer.calibration)
    result = command("run", *flags, "--sink", "example-count=x")
    assert result.returncode == 1
    assert "unknown output 'example-count'" in result.stderr
    result = command("run", *flags, "--sink", "example-count")
    assert result.returncode == 2
    assert "is not NAME=TARGET" in result.stderr
    result = command("check", "--file", "x.bin", "--protocol", "example-lines")
    assert result.returncode == 2
    assert "unknown protocol 'example-lines'" in result.stderr
