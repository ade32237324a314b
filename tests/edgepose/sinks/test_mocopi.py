"""mocopi's stream, read as its receivers read it. None of them can be installed, so the reader is here."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.sinks.mocopi import BONES, MocopiSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics, standing_pelvis_position
from tests.support.datagrams import Listener
from tests.support.poses import anything, pose

CONTAINERS = {b"head", b"sndf", b"skdf", b"bons", b"bndt", b"fram", b"btrs", b"btdt"}


def chunks(data: bytes) -> list[tuple[str, object]]:
    """Names and contents of the chunks, which are bytes or further chunks."""
    found, at = [], 0
    while at < len(data):
        size, name = struct.unpack_from("<I4s", data, at)
        content = data[at + 8 : at + 8 + size]
        assert len(content) == size
        found.append((name.decode(), chunks(content) if name in CONTAINERS else content))
        at += 8 + size
    return found


def sent(poses, **options) -> list[dict]:
    with Listener() as receiver:
        host, _, port = receiver.address.partition(":")
        with MocopiSink(host, int(port), **options) as sink:
            for one in poses:
                sink.write(one)
            assert not sink.unsent
        receiver.first.wait(30)
    for datagram in receiver.datagrams:  # the sizes that receivers expect
        assert len(datagram) == (1821 if b"skdf" in datagram else 1591)
    return [dict(chunks(datagram)) for datagram in receiver.datagrams]


def bones(records) -> np.ndarray:
    """Quaternions x, y, z, w and positions (27, 7)."""
    each = [dict(record) for _, record in records]
    assert [struct.unpack("<H", one["bnid"])[0] for one in each] == list(range(27))
    return np.array([struct.unpack("<7f", one["tran"]) for one in each])


def test_the_skeleton_is_the_body_in_its_t_pose():
    body = default_body(1.6)
    first, _ = sent([pose()], body=body)
    assert dict(first["head"]) == {"ftyp": b"sony motion format", "vrsn": b"\x01"}
    assert dict(first["sndf"])["ipad"] == struct.pack("<4H", 127, 0, 0, 1)
    records = dict(first["skdf"])["bons"]
    parents = [struct.unpack("<h", dict(record)["pbid"])[0] for _, record in records]
    assert parents == [-1, *range(10), 7, 11, 12, 13, 7, 15, 16, 17, 0, 19, 20, 21, 0, 23, 24, 25]
    table = bones(records)
    np.testing.assert_array_equal(table[:, :4], np.tile([0, 0, 0, -1], (27, 1)))
    places = np.zeros((27, 3))
    for i, parent in enumerate(parents):
        places[i] = table[i, 4:] + (0 if parent < 0 else places[parent])
    wanted = forward_kinematics(pose().rotations, body.offsets, standing_pelvis_position(body.offsets))[1]
    for place, (name, _, joint) in zip(places, BONES, strict=True):
        if joint:
            np.testing.assert_allclose(place, wanted[JOINTS.index(joint)], atol=1e-6)
        assert place[0] > 0.0 if name.startswith("l_") else True  # left is at plus x


def test_bones_of_a_frame_are_where_the_joints_are():
    poses, body = [anything(i) for i in range(3)], default_body()
    frames = [dict(one["fram"]) for one in sent(poses) if "fram" in one]
    for one, frame in zip(poses, frames, strict=True):
        assert struct.unpack("<I", frame["fnum"]) == (one.index,)
        assert struct.unpack("<d", frame["uttm"]) == (one.time_s,)
        assert abs(struct.unpack("<f", frame["time"])[0] - one.index / 60) < 1e-6
        rotations, positions = forward_kinematics(one.rotations, body.offsets, one.translation)
        table = bones(frame["btrs"])
        turned, places = [], []
        for i, (_, parent, joint) in enumerate(BONES):
            rotation, place = Rotation.from_quat(table[i, :4]), table[i, 4:]
            if parent >= 0:
                place = places[parent] + turned[parent].apply(place)
                rotation = turned[parent] * rotation
            turned.append(rotation)
            places.append(place)
            if joint:
                j = JOINTS.index(joint)
                np.testing.assert_allclose(place, positions[j], atol=1e-5)
                assert (rotation * Rotation.from_matrix(rotations[j]).inv()).magnitude() < 1e-5


def test_the_skeleton_comes_again_every_second_and_signs_do_not_change():
    poses = [pose(i, pelvis=("y", 10.0 * i)) for i in range(75)]
    found = sent(poses, rate=30.0)
    assert [i for i, one in enumerate(found) if "skdf" in one] == [0, 31, 62]
    quats = np.array([bones(dict(one["fram"])["btrs"])[0, :4] for one in found if "fram" in one])
    assert (np.abs(np.diff(quats, axis=0)) < 0.2).all()
    assert quats[0, 3] == -1.0


@pytest.mark.parametrize("host", ["::1", "::ffff:127.0.0.1"])
def test_over_ipv6_the_sender_has_no_address(host):
    with MocopiSink(host, 12351) as sink:
        skeleton, _ = sink.encode(pose())
    assert dict(dict(chunks(skeleton))["sndf"])["ipad"] == bytes(8)
