"""What is installed where: the project's files say which PyTorch a computer gets."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from edgepose.inference.quantisation import has_fp16_products, is_int8_fast

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ASIMDFHM = 1 << 23


def torch_of(machine: str) -> list[Requirement]:
    """What the project and its constraints ask of torch on a kind of computer."""
    lines = PROJECT["dependencies"] + (ROOT / "constraints.txt").read_text().splitlines()
    found = [Requirement(line) for line in lines if line.startswith("torch")]
    return [r for r in found if r.marker is None or r.marker.evaluate({"platform_machine": machine})]


@pytest.mark.parametrize(
    ("machine", "good", "bad"),
    [("aarch64", "2.9.1", ["2.10.0", "2.13.0"]), ("x86_64", "2.13.0", ["2.14.0", "2.3.1"])],
)
def test_torch(machine, good, bad):
    needed, pinned = torch_of(machine)
    assert good in needed.specifier
    assert str(pinned.specifier) == f"=={good}"
    assert not any(version in needed.specifier for version in bad)


def test_the_set_up_script_knows_the_same_versions():
    text = (ROOT / "tools" / "set-up.sh").read_text()
    arm, others = re.search(r"newest = \((.*)\) if .*aarch64.* else \((.*)\)", text).groups()
    for machine, newest in (("aarch64", arm), ("x86_64", others)):
        needed, _ = torch_of(machine)
        major, minor = map(int, newest.split(","))
        assert f"{major}.{minor}.0" in needed.specifier
        assert f"{major}.{minor + 1}.0" not in needed.specifier


@pytest.mark.parametrize(
    ("machine", "hwcap", "fp16", "int8"),
    [
        ("x86_64", 0, True, True),
        ("AMD64", 0, True, True),
        ("aarch64", 0, False, False),  # Raspberry Pi 4
        ("aarch64", 0x1FFF & ~ASIMDFHM, False, False),  # Raspberry Pi 5
        ("aarch64", ASIMDFHM, True, False),
        ("armv7l", ASIMDFHM, False, False),
        ("riscv64", 0, False, False),
    ],
)
def test_what_a_processor_multiplies(machine, hwcap, fp16, int8):
    assert has_fp16_products(machine, hwcap) == fp16
    assert is_int8_fast(machine) == int8


def test_the_install_page_says_what_is_pinned():
    page = (ROOT / "docs" / "guide" / "install.md").read_text(encoding="utf-8")
    for machine in ("aarch64", "x86_64"):
        _, pinned = torch_of(machine)
        assert f"{str(pinned.specifier)[2:]} is pinned" in page


def test_the_install_page_lists_everything_but_pytorch():
    page = (ROOT / "docs" / "guide" / "install.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^\.venv/bin/pip install (click .*)$", page, re.MULTILINE)
    needed = [Requirement(text) for text in PROJECT["dependencies"]]
    listed = [Requirement(text.strip("'")) for text in re.findall(r"'[^']*'|\S+", line)]
    expected = {(r.name, str(r.marker or "")) for r in needed if r.name != "torch"}
    assert {(r.name, str(r.marker or "")) for r in listed} == expected
