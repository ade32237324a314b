"""Forked commands against commands that are started as a user starts them."""

from __future__ import annotations

import signal
import subprocess
import sys

from tests.support import processes


def both(*words: str, **options: object) -> list[tuple[int, str, str]]:
    """Exit code, output and messages of a new process, and of a forked one."""
    command = [sys.executable, *words]
    return [
        (done.returncode, done.stdout, done.stderr)
        for done in (
            subprocess.run(command, capture_output=True, text=True, check=False, **options),
            processes.run(command, capture_output=True, text=True, **options),
        )
    ]


def test_words_codes_and_streams_are_the_same(tmp_path):
    for words in (("--version",), ("models",), ("no-such-command",), ("convert", "-", "--to", "csv")):
        new, forked = both("-m", "edgepose", *words, input="", cwd=tmp_path)
        assert new == forked


def test_it_can_be_killed():
    command = [sys.executable, "-m", "edgepose", "check", "--file", "-"]
    with processes.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.poll() is None
        process.send_signal(signal.SIGKILL)
        assert process.wait(10) == -signal.SIGKILL
