"""Options given twice or without a value, and commands that are mistyped."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (("run", "--model", "rnn", "--csv", "a.csv", "--model", "birnn"), "--model"),
        (("calibrate", "--port", "a", "--port", "b"), "--port"),
        (("convert", "a.csv", "--to", "npz", "--to=csv"), "--to"),
        (("train", "--config", "a", "--config", "a"), "--config"),
        (("bench", "orientation", "--data", "a", "--data", "b"), "--data"),
    ],
)
def test_an_option_twice(command, tmp_path, words, flag):
    result = command(*words, cwd=tmp_path)
    assert result.returncode == 2
    assert f"Error: {flag} is given 2 times, but only once counts" in result.stderr
    assert f"Usage: python -m edgepose {words[0]}" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("convert", "", "--to", "npz"), "IN"),
        (("run", "--file", "a.npz", "--csv", "a.csv", "--csv="), "--csv"),
        (("view", ""), "POSES"),
        (("calibrate", "--file", ""), "--file"),
        (("bench", "orientation", "--data", ""), "--data"),
    ],
)
def test_an_empty_value_is_no_folder(command, tmp_path, words, name):
    result = command(*words, cwd=tmp_path)
    assert result.returncode == 2
    assert f"Error: {name} is empty: give a value, or leave it out\n" in result.stderr


def test_options_that_may_be_repeated(command):
    result = command("run", "--rig", "a.toml", "--rig", "b.toml", "--debug")
    assert "given 2 times" not in result.stderr
    result = command("models", "--help", "--help")
    assert result.returncode == 0


@pytest.mark.parametrize(
    ("word", "says"),
    [("chek", "Did you mean 'check'?"), ("conver", "Did you mean 'convert'?"), ("zzz", "command 'zzz'.\n")],
)
def test_a_mistyped_command(command, word, says):
    result = command(word)
    assert result.returncode == 2
    assert says in result.stderr
