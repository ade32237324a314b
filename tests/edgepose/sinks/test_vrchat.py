"""VRChat's OSC trackers, read by another's OSC library as Unity reads positions and Euler angles."""

from __future__ import annotations

import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle
from scipy.spatial.transform import Rotation

from edgepose.pose import PoseFrame
from edgepose.sinks.registry import SINKS
from edgepose.sinks.vrchat import TRACKERS, VrchatSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from tests.support.datagrams import Listener
from tests.support.poses import anything, pose

MIRROR = np.diag([-1.0, 1.0, 1.0])
"""From T, where X is left, to Unity, where it is right."""


def trackers(one: PoseFrame, **options) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Position, metres, and angles, degrees, of each tracker of the only datagram of a pose."""
    with Listener() as receiver:
        host, _, port = receiver.address.partition(":")
        with VrchatSink(host, int(port), **options) as sink:
            sink.write(one)
        receiver.first.wait(30)
    (datagram,) = receiver.datagrams
    assert len(datagram) <= 1472  # one Ethernet frame
    found: dict[str, dict[str, np.ndarray]] = {}
    for message in OscBundle(datagram):
        _, tracking, word, name, what = message.address.split("/")
        assert (tracking, word, len(message.params)) == ("tracking", "trackers", 3)
        assert all(isinstance(value, float) for value in message.params)
        found.setdefault(name, {})[what] = np.array(message.params)
    return {name: (values["position"], values["rotation"]) for name, values in found.items()}


@pytest.mark.parametrize("index", range(3))
def test_positions_and_angles_are_those_of_the_body_in_unitys_frame(index):
    one, body = anything(index), default_body(1.6)
    rotations, positions = forward_kinematics(one.rotations, body.offsets, one.translation)
    found = trackers(one, body=body)
    assert list(found) == list(TRACKERS)
    for name, (place, rotator) in TRACKERS.items():
        position, (x, y, z) = found[name]
        np.testing.assert_allclose(position, MIRROR @ positions[JOINTS.index(place)], atol=1e-5)
        unity = Rotation.from_euler("zxy", [z, x, y], degrees=True)  # about fixed axes, z first
        true = Rotation.from_matrix(MIRROR @ rotations[JOINTS.index(rotator)] @ MIRROR)
        assert (unity * true.inv()).magnitude() < 1e-5


@pytest.mark.parametrize(
    ("turns", "tracker", "angles"),
    [
        ({}, "1", [0, 0, 0]),
        ({"pelvis": ("y", 90)}, "head", [0, -90, 0]),  # a wearer who turns left: Unity counts to the right
        ({"pelvis": ("x", 30)}, "6", [30, 0, 0]),  # bows
        ({"left_shoulder": ("z", -80)}, "7", [0, 0, 80]),  # the left arm is lowered
        ({"right_hip": ("x", -90)}, "5", [-90, 0, 0]),  # the right thigh is lifted
        ({"right_knee": ("x", 90)}, "3", [90, 0, 0]),  # the right shank is behind
    ],
)
def test_known_poses(turns, tracker, angles):
    np.testing.assert_allclose(trackers(pose(**turns))[tracker][1], angles, atol=1e-4)


def test_sides_and_heights_of_a_wearer_who_stands_somewhere():
    found = {name: position for name, (position, _) in trackers(pose(), body=default_body(1.9)).items()}
    taller = trackers(pose(where=np.array([1.0, 0.9, 2.0])))["1"][0]
    assert found["2"][0] < -0.05 < 0.05 < found["3"][0]  # left is at minus x
    assert 0.0 < found["2"][1] < 0.15 < found["4"][1] < found["1"][1] < found["6"][1] < found["head"][1] < 1.9
    assert found["7"][0] < -0.3
    np.testing.assert_allclose(found["1"][[0, 2]], 0.0, atol=1e-6)
    np.testing.assert_allclose(taller, [-1.0, 0.9, 2.0], atol=1e-6)


@pytest.mark.parametrize("count", ["8", "6", "3"])
def test_fewer_trackers(count):
    target = SINKS["vrchat"].parse(f"127.0.0.1:9000,trackers={count}")
    assert (target.host, target.port, target.cast) == ("127.0.0.1", 9000, "")
    assert list(trackers(pose(), trackers=target.option)) == [*map(str, range(1, int(count) + 1)), "head"]
