"""Binary glTF 2.0: a skinned figure with the skeleton and the motion of a body.

Poses come in blocks and go to the disk at once, because an hour of them takes 90 MB: their number gives the
layout of the file.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.bone_mesh import bone_mesh
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.pose import PoseSequence
from edgepose.rotations import matrix_to_quat, quat_continuous
from edgepose.skeleton import (
    JOINTS,
    PARENTS,
    forward_kinematics,
    grounded_pelvis_position,
    standing_pelvis_position,
)

Array = NDArray[np.float64]

_COMPONENTS = {np.dtype("u1"): 5121, np.dtype("<f4"): 5126}
_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_LARGEST = 1 << 32  # bytes, because lengths in the file have 32 bits
_VERTICES = 34962  # target of a view with attributes of vertices
_COLOUR = [0.25, 0.5, 0.8, 1.0]


class _Accessors:
    """The arrays of the binary part, one after the other.

    Attributes:
        accessors: their descriptions in the JSON part.
        views: their places, in the JSON part.
        starts: the same as offsets in the binary part, bytes.
        size: of the binary part, bytes.
    """

    def __init__(self) -> None:
        """Start without arrays."""
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.starts: list[int] = []
        self.size = 0

    def add(self, shape: tuple[int, ...], dtype: str = "<f4", vertices: bool = False, **more: Any) -> int:
        """Reserve the room of an array, whose rows take multiples of four bytes; return its index."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": size}
        self.views.append({**view, "target": _VERTICES} if vertices else view)
        accessor = {"componentType": _COMPONENTS[np.dtype(dtype)], "type": _TYPES[shape[1:]]}
        self.accessors.append({"bufferView": len(self.views) - 1, "count": shape[0], **accessor, **more})
        self.starts.append(self.size)
        self.size += size
        return len(self.starts) - 1


def write_glb(
    path: Path,
    blocks: Iterable[PoseSequence],
    count: int,
    rate: float,
    offsets: Array,
    names: str = "smpl",
    about: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write poses, keeping only a part of them in memory.

    Args:
        path: file to write.
        blocks: the poses, in order.
        count: total number of poses.
        rate: frames per second.
        offsets: (24, 3) of the wearer's body, metres.
        names: of the joints, a key of `BVH_NAMES`.
        about: see `PoseSequence`.

    Raises:
        EdgeposeError: the file would have more than 4 GB.
        OSError: the file cannot be written.
    """
    figure = _figure(offsets)
    times = (np.arange(count) / rate).astype("<f4")
    arrays = _Accessors()
    corners = figure["POSITION"]
    bounds = {"min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist()}
    for name, values in figure.items():
        more = bounds if values is corners else {}
        arrays.add(values.shape, values.dtype.str, name != "inverseBindMatrices", **more)
    time = arrays.add(times.shape, min=[float(times[0])], max=[float(times[-1])])
    position = arrays.add((count, 3))
    rotations = [arrays.add((count, 4)) for _ in JOINTS]
    document = _document(arrays, list(figure), offsets, names, about)
    document["animations"] = [_animation(time, position, rotations)]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + arrays.size
    if total >= _LARGEST:
        raise EdgeposeError(f"{path}: {count} poses do not fit into a GLB file, which has at most 4 GB")
    with path.open("wb") as file:
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", arrays.size, b"BIN\0"))
        for values in (*figure.values(), times):
            file.write(values.tobytes())
        start = total - arrays.size
        places = [start + arrays.starts[index] for index in (position, *rotations)]
        _write_motion(file, blocks, places, offsets)


def _write_motion(file: BinaryIO, blocks: Iterable[PoseSequence], places: list[int], offsets: Array) -> None:
    """Write positions and rotations; `places` are where they begin in the file, the position first."""
    done = 0
    before = np.zeros((1, len(JOINTS), 4))
    for block in blocks:
        known = block.translation
        positions = grounded_pelvis_position(block.rotations, offsets) if known is None else known
        # The signs of following quaternions agree, because some programs interpolate them by components.
        quats = quat_continuous(np.concatenate([before, matrix_to_quat(block.rotations)]))[1:]
        before = quats[-1:]
        xyzw = np.roll(quats, -1, axis=-1).astype("<f4")
        file.seek(places[0] + 12 * done)
        file.write(positions.astype("<f4").tobytes())
        for joint, place in enumerate(places[1:]):
            file.seek(place + 16 * done)
            file.write(xyzw[:, joint].tobytes())
        done += len(quats)


def _figure(offsets: Array) -> dict[str, NDArray[Any]]:
    """Return the arrays of the mesh and its skin, in the T-pose on the ground."""
    mesh = bone_mesh(offsets)
    pelvis = standing_pelvis_position(offsets)
    joints, weights = (np.zeros((len(mesh.joints), 4), dtype) for dtype in ("u1", "<f4"))
    joints[:, 0] = mesh.joints
    weights[:, 0] = 1.0
    rest = np.broadcast_to(np.eye(3), (len(JOINTS), 3, 3))
    inverse = np.tile(np.eye(4), (len(JOINTS), 1, 1))
    inverse[:, 3, :3] = -(forward_kinematics(rest, offsets, pelvis)[1])  # columns are stored one by one
    return {
        "POSITION": mesh.positions + pelvis.astype("<f4"),
        "NORMAL": mesh.normals,
        "JOINTS_0": joints,
        "WEIGHTS_0": weights,
        "inverseBindMatrices": inverse.astype("<f4"),
    }


def _document(
    arrays: _Accessors, figure: list[str], offsets: Array, names: str, about: Mapping[str, str]
) -> dict[str, Any]:
    """Return the JSON part without the animation; `figure` are the names of the first arrays."""
    nodes: list[dict[str, Any]] = []
    for joint, name in enumerate(BVH_NAMES[names]):
        place = offsets[joint] if joint else standing_pelvis_position(offsets)
        children = [child for child, parent in enumerate(PARENTS) if parent == joint]
        nodes.append(
            {"name": name, "translation": place.tolist()} | ({"children": children} if children else {})
        )
    nodes.append({"name": "figure", "mesh": 0, "skin": 0})
    material = {"baseColorFactor": _COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.8}
    attributes = {name: figure.index(name) for name in figure[:-1]}
    return {
        "asset": {"version": "2.0", "generator": "edgepose", "extras": dict(about)},
        "scene": 0,
        "scenes": [{"nodes": [0, len(JOINTS)]}],
        "nodes": nodes,
        "materials": [{"name": "figure", "pbrMetallicRoughness": material}],
        "meshes": [{"name": "figure", "primitives": [{"attributes": attributes, "material": 0}]}],
        "skins": [
            {"joints": list(range(len(JOINTS))), "inverseBindMatrices": len(figure) - 1, "skeleton": 0}
        ],
        "buffers": [{"byteLength": arrays.size}],
        "bufferViews": arrays.views,
        "accessors": arrays.accessors,
    }


def _animation(time: int, position: int, rotations: list[int]) -> dict[str, Any]:
    """Return the animation, given the indices of the arrays of times, positions and rotations."""
    outputs = [position, *rotations]
    targets = [{"node": 0, "path": "translation"}]
    targets += [{"node": joint, "path": "rotation"} for joint in range(len(JOINTS))]
    return {
        "name": "motion",
        "samplers": [{"input": time, "output": output, "interpolation": "LINEAR"} for output in outputs],
        "channels": [{"sampler": i, "target": target} for i, target in enumerate(targets)],
    }
