"""The watch over a rig at the start of a run."""

import pytest

from edgepose.diagnostics.rig_monitor import RigMonitor
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording


@pytest.mark.parametrize(
    ("rigs", "phase", "expected_s"), [(1, 0.0, 8.0), (10, 0.0, 10.0), (20, 0.0, 10.0), (20, 0.02, 10.4)]
)
def test_a_fault_is_reported_once_and_later_if_there_are_many_rigs(wearer, rigs, phase, expected_s):
    """The wearer stands for six seconds, in which equal data mean nothing."""
    recording = read_recording(wearer.recording)
    doubled = recording._replace(
        sensors=recording.sensors | {"head": recording.sensors["pelvis"]}
    )  # the same data twice
    monitor, reported = RigMonitor(phase=phase, rigs=rigs), {}
    start_s = None
    for sample in iter_samples(doubled):
        start_s = sample.time_s if start_s is None else start_s
        for line in monitor.add([sample], sample.time_s):
            assert line not in reported
            reported[line] = sample.time_s - start_s
    assert [line.split(":")[1].strip() for line in reported] == ["head", "pelvis"]
    assert all("same values as" in line for line in reported)
    assert list(reported.values()) == pytest.approx([expected_s] * 2, abs=0.02)
