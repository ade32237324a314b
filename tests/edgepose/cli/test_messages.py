"""Messages on a terminal of 80 columns: on lines of their own, broken between words."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest

from edgepose.pipeline.network import Network, NetworkConfig
from tests.support.terminals import on_a_terminal

EDGEPOSE = [sys.executable, "-m", "edgepose"]


def test_a_message_replaces_the_status_line(wearer, tmp_path):
    """The head's sensor falls silent after 0.7 s, and is reported a second later."""
    arrays = dict(np.load(wearer.short))
    kept = arrays["t"] < arrays["t"][0] + 0.7
    del arrays["head_gyr"]
    arrays["head_quat"][~kept] = arrays["head_acc"][~kept] = np.nan
    np.savez(tmp_path / "a.npz", **arrays)
    command = [*EDGEPOSE, "run", "--file", tmp_path / "a.npz", "--realtime", "--model", "rnn"]
    _, text = on_a_terminal([*command, "--calibration", wearer.calibration, "--csv", tmp_path / "p.csv"])
    message = rb"head: no data for 1 s; its last values are repeated: check its power and\r\n  connection\r\n"
    assert re.search(rb"\r\d+ poses, [^\r\n]*\x1b\[K\r\x1b\[K" + message, text), text


def test_a_message_replaces_the_progress_bar(wearer, tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nothing")
    (tmp_path / "b.npz").write_bytes(wearer.short.read_bytes())
    command = [*EDGEPOSE, "convert", "a.npz", "b.npz", "--to", "csv", "--out", "o"]
    code, text = on_a_terminal(command, cwd=tmp_path)
    assert code == 1
    assert re.search(rb"Converting [^\n]*\r\x1b\[Ka\.npz: failed: not a", text), text
    assert text.count(b"failed: ") == 1, "a failure is reported once"
    assert len(re.findall(rb"b\.npz +1800 +3\.0  ok\r\n", text)) == 1


def test_long_messages_are_broken_between_words(tmp_path):
    """Names and addresses are not, so that they can be copied."""
    folder = tmp_path / "a-folder-with-a-name-that-is-longer-than-a-line-of-a-terminal-has-columns"
    _, text = on_a_terminal([*EDGEPOSE, "check", "--file", folder / "a.xyz"])
    assert f"{folder}".encode() in text
    lines = text.decode().split("\r\n")
    assert len(lines) > 3
    assert all(len(line) <= 80 or " " not in line.strip() for line in lines), text
    done = on_a_terminal([*EDGEPOSE, "devices", "/dev/none"])
    assert done == (
        1,
        b"Serial ports (edgepose run --port NAME):\r\n  /dev/none  no such port\r\n"
        b"edgepose: cannot listen to /dev/none\r\n",
    )


@pytest.mark.parametrize(
    ("settings", "flags"),
    [
        (NetworkConfig(), ["--model rnn"]),
        (NetworkConfig(online="window"), ["--online stream", "--model rnn"]),
        (NetworkConfig(model="rnn"), []),
        (NetworkConfig(model="rnn", online="window"), []),
    ],
)
def test_a_slow_machine_is_not_told_to_use_what_it_uses(settings, flags):
    assert Network.read(settings, 1).faster == flags
