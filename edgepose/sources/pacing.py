"""Batches of the samples of a file, at once or at its own pace."""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import inf

from edgepose.imu import ImuSample

_SLICE_S = 0.01  # length of a batch


def paced_batches(
    rows: Iterator[ImuSample], realtime: bool, blocking: bool
) -> Iterator[tuple[float, list[ImuSample], float]]:
    """Yield samples in slices of time: the time up to which all are delivered, the samples, the delay.

    In real time, that time runs on with the clock; otherwise it is that of the newest sample. Until a slice
    is due, empty ones are yielded unless `blocking`.
    """
    now_s = end_s = -inf
    batch: list[ImuSample] = []
    offset_s = 0.0

    def late_s() -> float:
        return max(0.0, time.monotonic() + offset_s - end_s) if realtime else 0.0

    for sample in rows:
        if end_s == -inf:
            now_s, end_s = sample.time_s, sample.time_s + _SLICE_S
            offset_s = sample.time_s - time.monotonic()
        while sample.time_s >= end_s:
            if realtime:
                while not blocking and end_s - offset_s > time.monotonic():
                    yield now_s, [], 0.0
                time.sleep(max(0.0, end_s - offset_s - time.monotonic()))
                now_s = end_s
            yield now_s, batch, late_s()
            batch = []
            # Outside real time, a pause in the samples is skipped.
            end_s = end_s + _SLICE_S if realtime else sample.time_s + _SLICE_S
        batch.append(sample)
        now_s = max(now_s, sample.time_s)
    if batch:
        yield now_s, batch, late_s()
