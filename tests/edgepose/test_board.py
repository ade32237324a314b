"""The files of examples/board: what systemd and udev read, and the command that they start."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from edgepose.cli.commands.run import run
from edgepose.sources.hid_receiver import RULE

BOARD = Path(__file__).parents[2] / "examples" / "board"
UNIT, RULES = BOARD / "edgepose.service", BOARD / "60-edgepose.rules"
MATCHES = {"ACTION", "SUBSYSTEM", "DRIVER", "ATTRS{idVendor}", "ATTRS{idProduct}", "ATTRS{serial}"}
SETTINGS = {"SYMLINK", "GROUP", "MODE", "ATTR{latency_timer}"}


def test_systemd_takes_the_unit(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    text = UNIT.read_text()
    assert "/opt/edgepose/.venv/bin/edgepose" in text
    # Of the command only the program's name must exist.
    (tmp_path / UNIT.name).write_text(text.replace("/opt/edgepose/.venv/bin/edgepose", sys.executable))
    command = ["systemd-analyze", "verify", str(tmp_path / UNIT.name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert [line for line in done.stderr.splitlines() if UNIT.name in line] == []
    assert done.returncode == 0, done.stderr


def test_the_unit_starts_a_command_that_exists():
    (line,) = re.findall(r"^ExecStart=\S+/edgepose run (.*)$", UNIT.read_text(), re.M)
    context = run.make_context("run", line.split(), resilient_parsing=True)
    assert context.params["model"] == "rnn"


def test_every_rule_is_a_list_of_matches_and_settings():
    rules = [line for line in RULES.read_text().splitlines() if line and not line.startswith("#")]
    assert len(rules) == 3
    assert RULE in rules
    for rule in rules:
        parts = [re.fullmatch(r'([A-Z]+(?:\{\w+\})?)(==|\+?=)"([^"]+)"', part) for part in rule.split(", ")]
        assert all(parts), rule
        kinds = [(match[1] in MATCHES, match[1] in SETTINGS, match[2] == "==") for match in parts]
        assert set(kinds) == {(True, False, True), (False, True, False)}, rule
