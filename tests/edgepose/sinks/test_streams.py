"""Poses by the VMC protocol, read by another's OSC library, and as text to viewers over TCP."""

from __future__ import annotations

import select
import socket

import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle
from scipy.spatial.transform import Rotation

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.poses.registry import read_poses
from edgepose.pose import PoseFrame
from edgepose.sinks import vmc
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.tcp import CLIENTS, TcpSink
from edgepose.sinks.vmc import VmcSink
from edgepose.skeleton import (
    JOINTS,
    default_body,
    forward_kinematics,
    global_rotations,
    standing_pelvis_position,
)
from edgepose.utils.sockets import parse_address
from tests.support.poses import anything, pose

# --- VMC ----------------------------------------------------------------------------------------------------


def received(poses: list[PoseFrame], **options) -> list[list[tuple[str, list]]]:
    """Address and arguments of each message of each datagram."""
    datagrams = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        with VmcSink("127.0.0.1", receiver.getsockname()[1], **options) as sink:
            for one in poses:
                sink.write(one)
                for _ in range(2):
                    data = receiver.recv(65536)
                    assert len(data) <= 1472  # one Ethernet frame
                    assert OscBundle.dgram_is_bundle(data)
                    datagrams.append([(message.address, message.params) for message in OscBundle(data)])
    return datagrams


def bones(one: PoseFrame, **options) -> dict[str, tuple[np.ndarray, Rotation]]:
    """Place and rotation of each bone, in Unity's axes; the hips moved along with the root."""
    messages = [message for datagram in received([one], **options) for message in datagram]
    (root,) = [arguments for address, arguments in messages if address == "/VMC/Ext/Root/Pos"]
    assert (root[0], root[2], root[4:]) == ("root", 0.0, [0.0, 0.0, 0.0, 1.0])
    found = {
        arguments[0]: (np.array(arguments[1:4]), Rotation.from_quat(arguments[4:]))
        for address, arguments in messages
        if address == "/VMC/Ext/Bone/Pos"
    }
    assert len(found) == sum(address == "/VMC/Ext/Bone/Pos" for address, _ in messages)
    assert not found["Hips"][0][[0, 2]].any()
    found["Hips"] = (found["Hips"][0] + root[1:4], found["Hips"][1])
    return found


def test_quaternions_of_a_wearer_who_turns_round_keep_their_signs():
    turning = []
    for i in range(40):
        rotations = np.tile(np.eye(3, dtype=np.float32), (24, 1, 1))
        rotations[0] = Rotation.from_euler("y", 20 * i, degrees=True).as_matrix()
        turning.append(anything(i)._replace(rotations=rotations))
    messages = [message for datagram in received(turning) for message in datagram]
    hips = np.array([arguments[4:] for _, arguments in messages if arguments[0] == "Hips"])
    half = np.radians(10.0)
    np.testing.assert_allclose((hips[1:] * hips[:-1]).sum(axis=1), np.cos(half), atol=1e-6)
    np.testing.assert_allclose(hips[30], [0, -np.sin(30 * half), 0, np.cos(30 * half)], atol=1e-6)


def test_what_is_in_the_datagrams():
    datagrams = received([pose(0), pose(90)])
    first, second = datagrams[:2]
    assert [address for address, _ in first[:3]] == ["/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos"]
    assert first[0][1] == [1]
    assert first[1][1] == [0.0]
    assert first[2][1] == ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    assert second[0] == ("/VMC/Ext/T", [0.0])
    assert datagrams[2][1][1] == datagrams[3][0][1] == [1.5]
    names = [
        arguments[0] for datagram in datagrams[:2] for a, arguments in datagram if a.endswith("Bone/Pos")
    ]
    assert names == list(vmc.BONES)
    assert {"Hips", "Spine", "Chest", "Neck", "Head", "LeftUpperArm", "RightLowerLeg"} <= set(names)


@pytest.mark.parametrize(
    ("turns", "bone", "axis", "direction"),
    [
        # Unity's X is the avatar's right, Y up, Z forward. The arm that was stretched out to its left:
        ({"left_shoulder": ("z", -90)}, "LeftUpperArm", (-1, 0, 0), (0, -1, 0)),  # hangs down
        ({"right_shoulder": ("z", 90)}, "RightUpperArm", (1, 0, 0), (0, -1, 0)),
        ({"left_shoulder": ("y", -90)}, "LeftUpperArm", (-1, 0, 0), (0, 0, 1)),  # points forward
        ({"left_elbow": ("y", -90)}, "LeftLowerArm", (-1, 0, 0), (0, 0, 1)),
        ({"head": ("y", 90)}, "Head", (0, 0, 1), (-1, 0, 0)),  # looks to its left
        ({"neck": ("x", 30)}, "Neck", (0, 1, 0), (0, np.cos(np.pi / 6), 0.5)),  # nods
        ({"left_hip": ("x", -90)}, "LeftUpperLeg", (0, -1, 0), (0, 0, 1)),  # thigh lifted
        ({"right_knee": ("x", 90)}, "RightLowerLeg", (0, -1, 0), (0, 0, -1)),  # heel to the seat
        ({"pelvis": ("y", 90)}, "Hips", (0, 0, 1), (-1, 0, 0)),  # all of it turned to its left
    ],
)
def test_known_poses_turn_bones_the_right_way(turns, bone, axis, direction):
    found = bones(pose(**turns))
    np.testing.assert_allclose(found[bone][1].apply(axis), direction, atol=1e-6)
    for name, (_, rotation) in found.items():
        if name != bone:
            assert rotation.magnitude() < 1e-6


def test_a_lowered_arm_is_a_turn_of_plus_90_degrees_about_z():
    _, rotation = bones(pose(left_shoulder=("z", -90)))["LeftUpperArm"]
    np.testing.assert_allclose(rotation.as_quat(canonical=True), [0, 0, 0.5**0.5, 0.5**0.5], atol=1e-6)


PARENTS = {
    "Spine": "Hips", "Chest": "Spine", "Neck": "Chest", "Head": "Neck",
    **{f"{s}UpperLeg": "Hips" for s in ("Left", "Right")},
    **{f"{s}LowerLeg": f"{s}UpperLeg" for s in ("Left", "Right")},
    **{f"{s}Foot": f"{s}LowerLeg" for s in ("Left", "Right")},
    **{f"{s}Toes": f"{s}Foot" for s in ("Left", "Right")},
    **{f"{s}Shoulder": "Chest" for s in ("Left", "Right")},
    **{f"{s}UpperArm": f"{s}Shoulder" for s in ("Left", "Right")},
    **{f"{s}LowerArm": f"{s}UpperArm" for s in ("Left", "Right")},
    **{f"{s}Hand": f"{s}LowerArm" for s in ("Left", "Right")},
}  # fmt: skip


def test_an_avatar_takes_the_pose_of_the_body():
    """A humanoid that is put together from the messages alone is the mirror image of ours."""
    one, body = anything(3), default_body(1.68)
    one.rotations[JOINTS.index("spine3")] = np.eye(3)
    found = bones(one, body=body)
    world = {"Hips": found["Hips"]}
    for name, parent in PARENTS.items():
        place, rotation = world[parent]
        world[name] = (place + rotation.apply(found[name][0]), rotation * found[name][1])
    assert world.keys() == vmc.BONES.keys()
    rotations, places = forward_kinematics(one.rotations, body.offsets, one.translation)
    mirror = np.diag([-1.0, 1.0, 1.0])
    for name, joint in vmc.BONES.items():
        j = JOINTS.index(joint)
        np.testing.assert_allclose(world[name][0], mirror @ places[j], atol=1e-5)
        np.testing.assert_allclose(world[name][1].as_matrix(), mirror @ rotations[j] @ mirror, atol=1e-5)


def test_head_and_arms_of_an_avatar_without_an_upper_chest_point_the_right_way():
    one = anything(5)
    found = bones(one)
    turn = found["Hips"][1] * found["Spine"][1] * found["Chest"][1] * found["Neck"][1] * found["Head"][1]
    rotations = global_rotations(one.rotations)
    mirror = np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(turn.as_matrix(), mirror @ rotations[15] @ mirror, atol=1e-5)


def test_without_a_place_the_hips_are_above_the_ground():
    place, _ = bones(pose())["Hips"]
    assert place[0] == place[2] == 0.0
    assert 0.8 < place[1] < 1.1


def test_the_root_is_on_the_floor_below_the_wearer():
    """An avatar that keeps the lengths of its own bones walks by it alone."""
    first, _ = received([pose(where=np.array([1.0, 0.75, -2.0]))])
    assert first[2] == ("/VMC/Ext/Root/Pos", ["root", -1.0, 0.0, -2.0, 0.0, 0.0, 0.0, 1.0])
    assert first[3] == ("/VMC/Ext/Bone/Pos", ["Hips", 0.0, 0.75, 0.0, 0.0, 0.0, 0.0, 1.0])


SITTING = {"left_hip": ("x", -90), "right_hip": ("x", -90), "left_knee": ("x", 90), "right_knee": ("x", 90)}


@pytest.mark.parametrize("turns", [{}, SITTING, {"pelvis": ("x", -90)}], ids=["standing", "sitting", "lying"])
def test_without_a_place_the_lowest_joint_is_on_the_ground(tmp_path, turns):
    """In VMC as in BVH."""
    one = pose(**turns)
    place, _ = bones(one)["Hips"]
    joints = forward_kinematics(one.rotations, default_body().offsets)[1] + place
    assert joints[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    with BvhSink(tmp_path / "a.bvh") as sink:
        sink.write(one)
    np.testing.assert_allclose(read_bvh(tmp_path / "a.bvh").positions[0, 0] / 100.0, place, atol=1e-5)
    assert read_poses(tmp_path / "a.bvh").translation is None


def test_vmc_nobody_listens():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    with VmcSink("127.0.0.1", port) as sink:
        for i in range(10):
            sink.write(pose(i))
        assert 0 < sink.unsent <= 20


# --- TCP ----------------------------------------------------------------------------------------------------

UPRIGHT = standing_pelvis_position(default_body().offsets)


@pytest.fixture
def server():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with TcpSink("127.0.0.1", port) as sink:
        yield sink, port


def read_text(data: bytes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses and places, as TransPose's viewer takes them apart."""
    *whole, rest = data.decode("ascii").split("$")
    assert rest == ""
    result = []
    for text in whole:
        vectors, where = text.split("#")
        result.append((np.array(vectors.split(","), float), np.array(where.split(","), float)))
        assert len(result[-1][0]) == 72
        assert len(result[-1][1]) == 3
    return result


def test_a_viewer_comes_late_and_goes(server):
    sink, port = server
    sink.write(anything(0))
    with socket.create_connection(("127.0.0.1", port)) as viewer:
        poses = [anything(1), pose(2)]
        for one in poses:
            sink.write(one)
        data = b""
        while data.count(b"$") < 2:
            data += viewer.recv(65536)
        for (vectors, where), one in zip(read_text(data), poses, strict=True):
            wanted = Rotation.from_matrix(one.rotations).as_rotvec().ravel()
            np.testing.assert_allclose(vectors, wanted, atol=1e-5)
            # 0 is where TransPose's own wearers begin, standing straight.
            moved = one.translation - UPRIGHT if one.index == 1 else np.zeros(3)
            np.testing.assert_allclose(where, moved, atol=1e-5)
    for i in range(50):
        sink.write(anything(i))
    assert sink.missed == 0
    with socket.create_connection(("127.0.0.1", port)) as viewer:  # and another
        sink.write(pose(3))
        assert len(read_text(viewer.recv(65536))) == 1


def test_a_viewer_that_sleeps_blocks_nobody_and_gets_whole_poses(server):
    sink, port = server
    with (
        socket.socket() as asleep,
        socket.create_connection(("127.0.0.1", port)) as awake,
    ):
        asleep.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        asleep.connect(("127.0.0.1", port))
        seen = b""
        count = 2000
        for i in range(count):
            sink.write(pose(i, where=np.array([i, 0.0, 0.0])))
            while select.select([awake], [], [], 0.0 if i < count - 1 else 1.0)[0]:
                seen += awake.recv(65536)
        assert sink.missed > 1000
        # The one who reads has all of them, or all but a few where this machine was busy.
        numbers = [int(where[0]) for _, where in read_text(seen)]
        assert numbers == sorted(set(numbers))
        assert len(numbers) > 0.9 * count
        # The other has whole ones, once it wakes up.
        late = b""
        while select.select([asleep], [], [], 0.3)[0]:
            late += asleep.recv(65536)
            sink.write(pose(count, where=np.array([count, 0.0, 0.0])))
            if late.endswith(b"$") and f"#{count}," in late.decode():
                break
        numbers = [int(where[0]) for _, where in read_text(late[: late.rindex(b"$") + 1])]
        assert numbers == sorted(numbers)
        assert numbers[-1] == count
        assert len(numbers) < 1000


def test_too_many_viewers(server):
    sink, port = server
    viewers = [socket.create_connection(("127.0.0.1", port)) for _ in range(CLIENTS + 1)]
    for i in range(CLIENTS + 1):
        sink.write(pose(i))
    viewers[-1].settimeout(5)
    assert viewers[-1].recv(65536) == b""
    assert viewers[0].recv(65536).count(b"$") == CLIENTS + 1
    for viewer in viewers:
        viewer.close()


def test_tcp_where_nobody_can_listen(server):
    _, port = server
    with pytest.raises(EdgeposeError, match=rf"cannot listen for viewers at 127.0.0.1 port {port}: .*in use"):
        TcpSink("127.0.0.1", port)
    with pytest.raises(EdgeposeError, match="cannot listen"):
        TcpSink("no-such-host.invalid", 8888)
    assert parse_address("[::1]:8888") == ("::1", 8888)
    with pytest.raises(EdgeposeError, match="not a number"):
        parse_address("127.0.0.1:8888,format=x")
