"""The script that makes the tables of docs/research/place.md."""

from edgepose.analysis.metrics import Metric
from tools import place_tables

NAMES = ("accuracy", "kinds", "walker", "sitter")


def test_the_page_has_all_tables_and_pictures():
    text = place_tables.PAGE.read_text(encoding="utf-8")
    marked = place_tables.with_tables(text, {name: f"the {name}\n" for name in NAMES})
    for name in NAMES:
        assert f"made by tools/place_tables.py -->\nthe {name}\n<!-- end of table -->" in marked
    for picture in ("paths.png", "real-paths.png"):
        assert f"(../images/{picture})" in text
        assert (place_tables.IMAGES / picture).is_file()


def test_rows_have_a_cell_for_each_column():
    table = {"both": {"7 m": Metric(3.14, 1.0, 9), "10 s": Metric(float("nan"), float("nan"), 0)}}
    ((part, model, name, *cells),) = place_tables.rows_of("tennis", "rnn", table, ["both"])
    assert (part, model, name) == ("tennis", "rnn", "both")
    assert cells == ["-", "-", "-", "3.1", "-", "-", "-", "-", "-", "-"]
    assert place_tables.page_table([["a", "b"], ["1", "2"]]) == "| a | b |\n|---|---|\n| 1 | 2 |\n"
