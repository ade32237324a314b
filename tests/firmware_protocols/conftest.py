"""Compilers for the tests of the C header and the example firmware."""

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
