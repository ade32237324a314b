"""How far the lines of a live source have been read, when threads get no turn."""

from math import inf

import pytest

from edgepose.sources import POLL_S
from edgepose.sources.line_reader import Arrival
from edgepose.sources.live import UNREAD_S, _ReadTime


def arrival(line, time_s, read_s=None):
    return Arrival(line, time_s, b"", time_s if read_s is None else read_s)


def test_the_line_that_was_read_last_counts():
    read = _ReadTime(["a", "b"], 0.0)
    assert read.update([], 0.01) == 0.01  # neither line has started
    assert read.update([arrival("a", 0.02), arrival("b", 0.02)], 0.02) == 0.02
    assert read.update([arrival("a", 0.03)], 0.03) == 0.02
    assert read.update([arrival("a", 0.04), arrival("b", 0.035)], 0.04) == 0.035
    assert read.update([arrival("b", 0.05, -inf)], 0.05) == 0.035  # more is waiting
    assert read.update([arrival("b", 0.05)], 0.05) == 0.04


def test_a_pause_of_the_whole_program_proves_nothing():
    read = _ReadTime(["a"], 0.0)
    assert read.update([arrival("a", 0.01)], 0.01) == 0.01
    assert read.update([], 5.0) == 0.01
    assert read.update([arrival("a", 5.01)], 5.01) == 5.01


def test_a_line_whose_driver_is_stuck_is_not_waited_for():
    read = _ReadTime(["a", "b"], 0.0)
    now_s = read.update([arrival("a", 0.0), arrival("b", 0.0)], 0.0)
    results = []
    while now_s < UNREAD_S + 0.1:
        now_s += 0.5 * POLL_S
        results.append(read.update([arrival("a", now_s)], now_s))
    assert results[0] == results[-20] == 0.0
    assert results[-1] == pytest.approx(now_s)


def test_a_disconnected_line_is_not_waited_for_until_it_is_back():
    read = _ReadTime(["a", "b"], 0.0)
    read.update([arrival("a", 0.1), arrival("b", 0.1)], 0.1)
    assert read.update([arrival("a", 0.2), arrival("b", 0.2, inf)], 0.2) == 0.2
    assert read.update([arrival("a", 0.3)], 0.3) == 0.3
    assert read.update([arrival("a", 0.5), arrival("b", 0.4)], 0.5) == 0.4
