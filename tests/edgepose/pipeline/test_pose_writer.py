"""Which poses reach which outputs on a machine that is late."""

import numpy as np
import pytest

from edgepose.pipeline.pose_writer import OLD_S, QUIET_S, PoseWriter
from edgepose.pose import PoseFrame
from edgepose.sinks.base import Sink
from edgepose.sinks.group import SinkGroup


class Shelf(Sink):
    def __init__(self, live):
        self.live, self.frames = live, []

    def write(self, pose):
        self.frames.append(pose.index)

    def close(self):
        """Nothing is open."""


def write(ages, look_ahead_s, sinks):
    """Poses of these ages, a second apart; returns the messages and the number of skipped poses."""
    lines = []
    writer = PoseWriter(SinkGroup(sinks), look_ahead_s, lines.append)
    for i, age_s in enumerate(ages):
        writer.write(PoseFrame(i, float(i), np.eye(3)[None].repeat(24, 0), np.zeros(24)), age_s)
    return lines, writer.skipped


@pytest.mark.parametrize("look_ahead_s", [0.0, 0.5])
def test_live_outputs_skip_old_poses_and_files_keep_them(look_ahead_s):
    live, file = Shelf(True), Shelf(False)
    limit = OLD_S + look_ahead_s
    lines, skipped = write([0.1, limit, limit + 0.1, 9.0, limit - 0.1], look_ahead_s, [live, file])
    assert live.frames == [0, 1, 4]
    assert file.frames == [0, 1, 2, 3, 4]
    assert skipped == 2
    assert lines == [f"poses are {limit + 0.1:.1f} s late; live outputs skip those older than 1 s"]


def test_without_live_outputs_or_without_a_pace_nothing_is_old():
    file, live = Shelf(False), Shelf(True)
    assert write([9.0] * 3, 0.0, [file]) == ([], 0)
    assert write([9.0] * 3, None, [live]) == ([], 0)
    assert file.frames == live.frames == [0, 1, 2]


def test_a_machine_at_its_limit_is_reported_from_time_to_time():
    lines, skipped = write([2.0, 0.5] * int(QUIET_S), 0.0, [Shelf(True)])
    assert skipped == int(QUIET_S)
    assert len(lines) == 2
