"""The script that writes the tables of the pages about speed."""

import re

from tools import refresh_benchmarks

WAY = {"model": "rnn", "mode": "stream", "precision": "fp16", "us": 250.0, "p50_us": 1.0, "p99_us": 2.0}
MODEL = {
    "name": "rnn",
    "start": {"torch": {"imports_s": 1.0, "load_s": 0.25, "memory_mb": None}},
    "steps_us": {"decode": 61.4},
    "full_speed": {"p50_ms": 1.0, "p99_ms": 2.0, "max_ms": 3.0, "frames": 9, "per_s": 1100.0},
    "live": {"us": 2000.0, "waits": 2.4, "p50_ms": 1.5, "p99_ms": 2.5, "poses": 300},
    "ways": [WAY | {"max_us": 3.0, "times": 2.5}],
}
REPORT = {
    "machine": {"processor": "a board", "python": "3.11", "torch": "2.3"},
    "models": [MODEL],
    "sizes": [MODEL | {"name": "rnn-512", "ways": [WAY | {"model": "rnn-512", "max_us": 3.0, "times": 5.0}]}],
    "wearers": ["| model | wearers |", "|---|---|", "| rnn | 8 |", "rnn: holds for up to 8 wearers"],
}


def test_the_pages_have_all_tables():
    tables = refresh_benchmarks.page_tables(REPORT)
    pages = [page.read_text(encoding="utf-8") for page in refresh_benchmarks.PAGES]
    named = {name for page in pages for _, name, _ in refresh_benchmarks._BLOCK.findall(page)}
    assert named == set(tables)
    for page in pages:
        written = refresh_benchmarks.with_tables(page, tables)
        assert refresh_benchmarks.with_tables(written, tables) == written
        assert re.sub(r"[^#]*", "", written) == re.sub(r"[^#]*", "", page)  # no section is lost
    assert refresh_benchmarks.PICTURE.is_file()


def test_tables_hold_what_was_measured():
    tables = refresh_benchmarks.page_tables(REPORT)
    assert tables["steps"] == "| us a frame | rnn |\n|---|---|\n| decode | 61 |\n"
    assert "| rnn-512 | stream | fp16 | 250 | 1 | 2 | 3 | 4000 | 1.5 % | 5.0 |\n" in tables["networks"]
    assert "| rnn | 2000 | 12.0 % | 2.40 | 1.50 | 2.50 |\n" in tables["live"]
    assert tables["wearers"].endswith("| rnn | 8 |\n")
