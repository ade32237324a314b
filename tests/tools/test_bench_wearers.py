"""The benchmark of many wearers, on two of them for a second."""

import sys
from pathlib import Path

import pytest

from tests.support import processes

TOOL = Path(__file__).parents[2] / "tools" / "bench_wearers.py"


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """The cells of the table's rows, and the picture."""
    picture = tmp_path_factory.mktemp("wearers") / "wearers.png"
    words = ["--model", "rnn", "--seconds", "1", "--draw", picture, "2"]
    result = processes.run(
        [sys.executable, TOOL, *words], text=True, capture_output=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in result.stdout.splitlines()]
    return cells, picture


def test_a_row_says_what_wearers_cost(rows):
    (head, line, *own), _ = rows
    assert head == [
        "model",
        "wearers",
        "network us",
        "all us",
        "core",
        "p50 ms",
        "p99 ms",
        "late",
        "lost",
        "holds",
    ]
    assert len(line) == len(head)
    row, most = own
    assert row[:2] == ["rnn", "2"]
    network_us, all_us, p50_ms, p99_ms = (
        float(row[head.index(name)]) for name in ("network us", "all us", "p50 ms", "p99 ms")
    )
    assert 0.0 < network_us < all_us
    assert 0.0 < p50_ms <= p99_ms
    assert most == [f"rnn: holds for up to {2 if row[-1] == 'yes' else 0} wearers"]


def test_the_curve_is_drawn(rows):
    assert rows[1].read_bytes().startswith(b"\x89PNG")
