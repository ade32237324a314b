"""The tables of the documentation that are made from the code."""

import re

import pytest

from firmware_protocols.registry import BUILT_IN, PROTOCOLS
from tools import make_tables

PAGES = [make_tables.ROOT / page for page in make_tables.PAGES]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_are_up_to_date(path):
    text = path.read_text(encoding="utf-8")
    assert "<!-- table" in text
    assert make_tables.with_tables(text) == text, "run: python tools/make_tables.py"


def test_every_protocol_has_a_row_and_a_page():
    rows = make_tables.protocols().splitlines()[2:]
    for row, name in zip(rows, BUILT_IN, strict=True):
        assert f"`{name}`" in row
        assert f" {PROTOCOLS[name].default_bitrate} " in row
        (link,) = re.findall(r"\]\((.*?)\)", row)
        assert (make_tables.ROOT / "docs" / "guide" / link).is_file(), link
