"""Compilers for the tests of the C header and the example firmware; feeding in pieces."""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

import firmware_protocols

HEADER = Path(firmware_protocols.__file__).parent / "c"
WARNINGS = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-I", str(HEADER)]


class Compiler:
    """Compiles sources to a program, and fails the test on any warning."""

    def __init__(self, variable, default):
        self.command = shlex.split(os.environ.get(variable, default))
        if shutil.which(self.command[0]) is None:
            pytest.fail(f"{self.command[0]!r} is not installed: set {variable}, or install gcc or clang")

    def __call__(self, output, *arguments):
        words = [*self.command, *WARNINGS, *map(str, arguments), "-o", str(output)]
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return output


@pytest.fixture(scope="session")
def cc():
    return Compiler("CC", "cc")


@pytest.fixture(scope="session")
def cxx():
    return Compiler("CXX", "c++")


@pytest.fixture(scope="session")
def in_pieces():
    """Feeds a stream whole and in pieces of these sizes, and gives its samples and counters if they agree."""

    def feed(make, data, sizes):
        whole, pieces = make(), make()
        expected = whole.feed(data)
        got, at = [], 0
        for size in [*sizes, len(data)]:
            got += pieces.feed(data[at : at + size])
            at += size
        assert got == expected
        assert pieces.counters == whole.counters
        return got, whole.counters

    return feed
