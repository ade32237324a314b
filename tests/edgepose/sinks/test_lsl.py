"""A stream of the Lab Streaming Layer, found and received with its own library."""

from __future__ import annotations

import os

import numpy as np
import pytest

from edgepose.errors import ConfigError
from edgepose.rotations import matrix_to_quat
from edgepose.sinks.lsl import LslSink
from edgepose.sinks.registry import SINKS
from edgepose.skeleton import JOINTS
from tests.support.poses import anything

NAME = f"edgepose test {os.getpid()}"

pylsl = pytest.importorskip("pylsl", exc_type=(ImportError, RuntimeError))


def received(name: str, sink: LslSink, poses: list) -> tuple[list[list[float]], list[float], object]:
    (found,) = pylsl.resolve_byprop("name", name, timeout=30)
    inlet = pylsl.StreamInlet(found)
    inlet.open_stream(30)
    for one in poses:
        sink.write(one)
    samples, times = inlet.pull_chunk(30.0, len(poses))
    info = inlet.info(30)
    inlet.close_stream()
    return samples, times, info


def test_poses_arrive_with_names_units_and_the_times_of_their_measurement():
    poses = [anything(i)._replace(contacts=np.full(7, i / 4, np.float32)) for i in range(3)]
    poses[1] = poses[1]._replace(held=frozenset({"right_forearm", "pelvis"}), warming_up=True)
    now_s = [1.7e9 + 1.0]
    with LslSink(f"{NAME}.1", 60.0, True, True, clock=lambda: now_s[0], model="rnn") as sink:
        opened_s = pylsl.local_clock()
        samples, times, info = received(f"{NAME}.1", sink, poses)
    labels, types, units = info.get_channel_labels(), info.get_channel_types(), info.get_channel_units()
    assert (info.type(), info.nominal_srate(), len(labels)) == ("MoCap", 60.0, 96 + 3 + 7 + 2)
    assert labels[:5] == ["pelvis_w", "pelvis_x", "pelvis_y", "pelvis_z", "left_hip_w"]
    assert types[:4] == ["OrientationA", "OrientationB", "OrientationC", "OrientationD"]
    assert list(zip(labels, types, units, strict=True))[96:100] == [
        *((f"trans_{axis}", f"Position{axis.upper()}", "meters") for axis in "xyz"),
        ("contact_left_ankle", "Confidence", "normalized"),
    ]
    assert info.desc().child("acquisition").child_value("model") == "rnn"
    table = np.array(samples)
    for one, row in zip(poses, table, strict=True):
        quats, wanted = row[:96].reshape(24, 4), matrix_to_quat(one.rotations)
        np.testing.assert_allclose(np.abs((quats * wanted).sum(axis=1)), 1.0, atol=1e-6)
        np.testing.assert_allclose(row[96:99], one.translation, atol=1e-6)
        np.testing.assert_allclose(row[99:106], one.contacts)
    assert table[:, 106:].tolist() == [[0, 0], [0b100010, 1], [0, 0]]
    np.testing.assert_allclose(np.diff(times), 1 / 60, atol=1e-6)
    assert opened_s - 1.0 - 0.5 < times[0] <= opened_s - 1.0  # measured a second before


def test_a_recording_begins_now_and_names_its_streams():
    poses = [anything(i) for i in range(2)]
    with LslSink(f"{NAME}.2") as sink, LslSink(f"{NAME}.3") as other:
        before_s = pylsl.local_clock()
        samples, times, info = received(f"{NAME}.2", sink, poses)
        assert len(received(f"{NAME}.3", other, poses)[0]) == 2
    assert before_s <= times[0] <= pylsl.local_clock()
    assert len(samples[0]) == info.channel_count() == 4 * len(JOINTS) + 2
    sink.close()  # again


@pytest.mark.parametrize("name", ["", " ", "a\nb", "\x1b[2J", "x" * 101])
def test_names_that_are_none(name):
    with pytest.raises(ConfigError, match="is no name of a stream"):
        SINKS["lsl"].parse(name)
