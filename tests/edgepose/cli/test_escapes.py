"""What others named reaches a terminal as text only."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from edgepose.cli.terminal.messages import say
from edgepose.formats.recordings.csv import csv_header
from edgepose.formats.recordings.raw_capture import times_header
from tests.support.terminals import on_a_terminal

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e"


OWN = re.compile(rb"\x1b\[(K|\?25[hl]|\?1049[hl]|[HJ]|\d*m)")
"""What the program itself draws with: the rest of a line, the cursor, colours."""


@pytest.mark.parametrize(
    "words",
    [
        ("report", ESCAPES + ".csv"),
        ("run", "--file", ESCAPES + ".npz", "--calibration", "c.json", "--csv", "-"),
        ("run", "--file", "REC", "--calibration", ESCAPES + ".json", "--csv", "-"),
        ("run", "--file", "REC", "--calibration", "CAL", "--csv", ESCAPES + "/a.csv"),
        ("run", "--file", "REC", "--calibration", "CAL", "--model", ESCAPES, "--csv", "-"),
        ("run", "--rig", "rig.toml"),
        ("run", "--rig", "name.toml"),
        ("check", "--port", ESCAPES),
        ("check", "--file", ESCAPES + ".csv"),
        ("calibrate", "--file", ESCAPES + ".csv", "--out", "o.json"),
        ("record", ESCAPES + ".csv", "--port", ESCAPES),
        ("convert", ESCAPES + ".csv", "--to", "npz", "--out", "o"),
        ("convert", "folder", "--to", "npz", "--out", "o"),
        ("record", "-", "--file", ESCAPES.replace("/", "") + ".npz"),
        ("calibrate", "--file", ESCAPES + ".npz", "--body-frame", "heading:0", "--from", 1, "--out", "-"),
        ("--debug", "run", "--file", ESCAPES + ".csv", "--calibration", "CAL", "--csv", "-"),
        ("solve", ESCAPES + ".npz", "--calibration", "CAL", "--csv", "-"),
        ("models", ESCAPES),
        ("view", ESCAPES + ".csv"),
        ("synthesize", "CLIP", "--out", "o", "--body", "body.pkl"),
        (ESCAPES,),
    ],
    ids=lambda words: " ".join(str(word) for word in words if ESCAPES not in str(word)),
)
def test_escape_sequences_of_others_do_not_reach_a_terminal(wearer, tmp_path, words):
    (tmp_path / "rig.toml").write_text(
        'file = "\\u001b]0;owned\\u0007.npz"\ncalibration = "c"\ncsv = "\\u001b[2J"'
    )
    (tmp_path / "name.toml").write_text('"\\u001b[2J" = 1\n')
    (tmp_path / "body.pkl").write_bytes(b"c\x1b]0;owned\x07\n\x1b[2J\n.")
    (tmp_path / "folder").mkdir()
    (tmp_path / f"{ESCAPES}.npz").write_bytes(wearer.recording.read_bytes())
    (tmp_path / "folder" / f"{ESCAPES}.csv").write_text("nothing\n")
    clip = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
    stands_for = {"REC": wearer.short, "CAL": wearer.calibration, "CLIP": clip}
    words = [stands_for.get(word, word) for word in words]
    _, text = on_a_terminal([sys.executable, "-m", "edgepose", *words], cwd=tmp_path)
    assert text
    assert (b"Traceback" in text) == ("--debug" in words)
    rest = OWN.sub(b"", text)
    assert b"\x1b" not in rest
    assert b"\x07" not in rest
    assert "\x9b" not in rest.decode(errors="replace")
    if words[0] != "record":  # whose output is data
        assert "\u202e" not in rest.decode(errors="replace")


def test_names_that_are_no_text(command, wearer, tmp_path):
    """A file of another system: its name is shown as far as it goes, in pages and files, too."""
    odd = os.fsdecode(b"na\xefme")
    shortened = tmp_path / f"{odd}.npz"
    shortened.write_bytes(wearer.recording.read_bytes())
    calibration = tmp_path / "c.json"
    flags = ("--body-frame", "heading:0", "--from", 1)
    result = command("calibrate", "--file", shortened, *flags, "--out", calibration)
    assert result.returncode == 0, result.stderr
    poses = tmp_path / f"{odd}.csv"
    result = command(
        "run", "--file", shortened, "--calibration", calibration, "--model", "rnn", "--csv", poses
    )
    assert result.returncode == 0, result.stderr
    result = command("report", poses)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / f"{odd}.html").read_bytes().endswith(b"</html>\n")


def test_control_characters_in_the_first_lines_of_a_recording():
    assert csv_header({"no\x1b[2Jte": "a\tb\x9bc\nd"}).splitlines()[0] == "# no?[2Jte: a b?c d"
    assert times_header({"\x07": "\x1b"}).splitlines()[0] == "# ?: ?"


def test_a_message_that_quotes_a_file_is_cut(capsys):
    say("edgepose: bad\n" + "x" * 1_000_000)
    first, second = capsys.readouterr().err.splitlines()
    assert first == "edgepose: bad"
    assert second.startswith("xxx")
    assert second.endswith("x ...")
    assert len(second) < 5000
