"""Jobs in processes of their own; the commands' tests hold the rest of `run_jobs`."""

import os

import pytest

from edgepose.errors import EdgeposeError
from edgepose.utils.jobs import run_in_order, run_jobs


def test_results_in_order():
    assert list(run_in_order(abs, [-3, 2, -1], 2)) == [3, 2, 1]


def test_a_killed_process_is_reported():
    reason = "process was killed, perhaps for lack of memory; use fewer --jobs"
    with pytest.raises(EdgeposeError, match=f"^a {reason}$"):
        list(run_in_order(os._exit, [1, 1], 2))
    results = run_jobs(os._exit, [1, 1], 2, lambda job, reason: (job, reason))
    assert list(results) == [(1, f"its {reason}")] * 2
