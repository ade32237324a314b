"""Binary glTF, read by the rules of its specification and by trimesh.

Blender 5.0.1, three.js r187 and Khronos' validator took the file of this test, see docs/reference/outputs.md.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.poses.registry import read_poses
from edgepose.pose import PoseFrame
from edgepose.sinks.glb import GlbSink
from edgepose.skeleton import JOINTS, default_body, forward_kinematics, standing_pelvis_position

COUNT = 620  # more than a block
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5121: np.uint8, 5126: np.float32}


def motion() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    vectors = np.cumsum(rng.normal(0.0, 0.05, (COUNT, 24, 3)), axis=0)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(COUNT, 24, 3, 3)
    return rotations, np.cumsum(rng.normal(0.0, 0.01, (COUNT, 3)), axis=0)


def read(path: Path) -> tuple[dict, list[np.ndarray]]:
    """The JSON part and the arrays of a file."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + length])
    binary, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, binary, length % 4) == (b"BIN\0", document["buffers"][0]["byteLength"], 0)
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * WIDTHS[accessor["type"]]
        start = 28 + length + view["byteOffset"]
        numbers = np.frombuffer(data, TYPES[accessor["componentType"]], count, start)
        arrays.append(numbers.reshape(accessor["count"], -1))
    return document, arrays


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "walk.glb"
    rotations, places = motion()
    with GlbSink(path, 50.0, default_body(1.6), "unity", True, {"model": "rnn"}) as sink:
        sink.start()
        for i, local in enumerate(rotations):
            sink.write(PoseFrame(i, i / 50.0, local, np.zeros(24, np.float32), places[i]))
        assert (path.parent / "walk.glb.part.csv").exists()
        assert not path.exists()
    assert [each.name for each in path.parent.iterdir()] == ["walk.glb"]
    return path


def test_joints_and_skin_follow_the_poses(walk):
    document, arrays = read(walk)
    nodes = document["nodes"]
    assert [node["name"] for node in nodes[:24]] == list(BVH_NAMES["unity"])
    animation = document["animations"][0]
    local = np.tile(np.eye(4), (COUNT, 24, 1, 1))
    local[:, :, :3, 3] = [node["translation"] for node in nodes[:24]]
    for channel in animation["channels"]:
        sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
        values = arrays[sampler["output"]]
        np.testing.assert_allclose(arrays[sampler["input"]][:, 0], np.arange(COUNT) / 50.0, atol=1e-6)
        if target["path"] == "translation":
            local[:, target["node"], :3, 3] = values
        else:
            assert np.sum(values[1:] * values[:-1], axis=1).min() > 0.9  # of either sign
            local[:, target["node"], :3, :3] = Rotation.from_quat(values).as_matrix()
    world = np.empty_like(local)
    order = [(0, None)]
    for node, parent in order:
        world[:, node] = local[:, node] if parent is None else world[:, parent] @ local[:, node]
        order += [(child, node) for child in nodes[node].get("children", ())]
    rotations, places = motion()
    joints = forward_kinematics(rotations, default_body(1.6).offsets, places)[1]
    np.testing.assert_allclose(world[:, :, :3, 3], joints, atol=1e-4)

    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    inverse = arrays[document["skins"][0]["inverseBindMatrices"]].reshape(24, 4, 4).transpose(0, 2, 1)
    corners, moved_by = arrays[attributes["POSITION"]], arrays[attributes["JOINTS_0"]][:, 0]
    # Every bone's solid begins at its joint.
    starts = np.concatenate([corners, np.ones((len(corners), 1))], axis=1)[::24]
    skinned = np.einsum("tnij,nj->tni", world[:, moved_by[::24]] @ inverse[moved_by[::24]], starts)
    np.testing.assert_allclose(skinned[..., :3], joints[:, moved_by[::24]], atol=1e-4)
    assert (arrays[attributes["WEIGHTS_0"]] == [1, 0, 0, 0]).all()


def test_trimesh_shows_a_body_in_a_t_pose(walk):
    scene = trimesh.load(walk)
    height = standing_pelvis_position(default_body(1.6).offsets)[1]
    assert 1.4 < scene.extents[1] < 1.7
    assert scene.bounds[0][1] == pytest.approx(0.0, abs=0.05)
    (solid,) = scene.geometry.values()
    assert 0.001 < solid.volume < 0.02  # negative if the faces looked inwards
    at = scene.graph.get("Hips")[0][:3, 3]
    np.testing.assert_allclose(at, [0.0, height, 0.0], atol=1e-6)


def test_nothing_is_lost(tmp_path):
    """An existing file stays until there are poses; a run that is cut off leaves a CSV file."""
    path = tmp_path / "a.glb"
    path.write_bytes(b"old")
    with GlbSink(path) as sink:
        sink.start()
    assert path.read_bytes() == b"old"
    sink = GlbSink(path)
    sink.write(PoseFrame(0, 0.0, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24, np.float32)))
    with pytest.raises(EdgeposeError, match=r"a\.glb\.part\.csv already exists, .* --to glb --out saved"):
        GlbSink(path)
    assert len(read_poses(tmp_path / "a.glb.part.csv").frames) == 1
    sink.close()
    document, arrays = read(path)
    assert arrays[document["animations"][0]["samplers"][0]["output"]][0, 1] > 0.8  # stands on the ground
    assert len(JOINTS) == len(document["skins"][0]["joints"])
