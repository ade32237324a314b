"""The tables of the documentation that are made from the code."""

import re

import pytest

from edgepose.inference.archive import bundled_archives
from firmware_protocols.registry import BUILT_IN, PROTOCOLS
from tools import make_tables

PAGES = [make_tables.ROOT / page for page in make_tables.PAGES]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_are_up_to_date(path):
    text = path.read_text(encoding="utf-8")
    assert "<!-- table" in text
    assert make_tables.with_tables(text) == text, "run: python tools/make_tables.py"


def test_tables_of_measures_have_all_models_and_their_numbers():
    tables = {}
    for path in PAGES:
        tables |= {match[2]: match[0] for match in make_tables._BLOCK.finditer(path.read_text("utf-8"))}
    assert set(tables) == {*make_tables.TABLES, *make_tables.MEASURED}
    for name in make_tables.MEASURED:
        for model in [f"| `{path.stem}`" for path in bundled_archives()] + ["| nearest sensor"]:
            (row, *_) = [line for line in tables[name].splitlines() if line.startswith(model)]
            assert re.search(r"\| \d+\.\d ± \d+\.\d \|", row), "run: python tools/make_tables.py --measure"


def test_every_protocol_has_a_row_and_a_page():
    rows = make_tables.protocols().splitlines()[2:]
    for row, name in zip(rows, BUILT_IN, strict=True):
        assert f"`{name}`" in row
        assert f" {PROTOCOLS[name].default_bitrate or '-'} " in row
        (link,) = re.findall(r"\]\((.*?)\)", row)
        assert (make_tables.ROOT / "docs" / "guide" / link).is_file(), link
