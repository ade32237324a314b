"""BVH as other programs write it: axes, units, names, channels, spelling."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgepose.convert import Job, Options, convert
from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.poses.registry import read_poses
from edgepose.pose import PoseFrame
from edgepose.sinks.bvh import BvhSink, depth_first
from edgepose.skeleton import JOINTS, PARENTS, default_body

COUNT = 4
ROTATIONS = Rotation.from_rotvec(0.5 * np.sin(np.arange(COUNT * 72).reshape(-1, 3) / 7.0)).as_matrix()
ROTATIONS = ROTATIONS.reshape(COUNT, 24, 3, 3)
PLACES = np.linspace([0.0, 0.9, 0.0], [0.5, 1.0, 4.0], COUNT)

IDENTITY = np.eye(3)
BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From T to Blender's world: Z up, facing -Y."""


def write_bvh(
    path: Path,
    to_world: NDArray[np.float64] = IDENTITY,
    unit_m: float = 0.01,
    order: str = "ZXY",
    names: Callable[[str], str] = str,
    six: bool = False,
    extra_root: bool = False,
) -> Path:
    """The poses in another program's way; independent of `BvhSink`."""
    offsets = default_body().offsets @ to_world.T / unit_m
    lines = ["HIERARCHY"]
    if extra_root:
        lines += ["ROOT Armature", "{", "OFFSET 0 0 0", "CHANNELS 3 Xrotation Yrotation Zrotation"]
    closing: list[str] = []
    for at, joint in enumerate(depth_first()):
        while closing and int(closing[-1]) != PARENTS[joint]:
            closing.pop()
            lines.append("}")
        closing.append(str(joint))
        root = not at and not extra_root
        places = "Xposition Yposition Zposition " if six or not at else ""
        turns = " ".join(f"{axis}rotation" for axis in order)
        lines += [f"{'ROOT' if root else 'JOINT'} {names(JOINTS[joint])}", "{"]
        lines += ["OFFSET " + " ".join(f"{x:.6f}" for x in offsets[joint])]
        lines += [f"CHANNELS {6 if places else 3} {places}{turns}"]
    lines += ["}"] * (len(closing) + extra_root)
    lines += ["MOTION", f"Frames: {COUNT}", "Frame Time: 0.016667"]
    local = to_world @ ROTATIONS @ to_world.T
    for frame in range(COUNT):
        numbers = [0.0, 0.0, 0.0] if extra_root else []
        for at, joint in enumerate(depth_first()):
            if not at:
                numbers += (to_world @ PLACES[frame] / unit_m).tolist()
            elif six:
                numbers += offsets[joint].tolist()
            numbers += Rotation.from_matrix(local[frame, joint]).as_euler(order, degrees=True).tolist()
        lines.append(" ".join(f"{number:.6f}" for number in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


def check(path: Path, hands: bool = True) -> None:
    poses = read_poses(path)
    joints = 24 if hands else 22
    assert poses.rate == pytest.approx(60.0, rel=1e-4)
    np.testing.assert_allclose(poses.rotations[:, :joints], ROTATIONS[:, :joints], atol=1e-5)
    np.testing.assert_allclose(poses.translation, PLACES, atol=1e-4)


WORLDS = {
    "Y up, facing -Z": np.diag([-1.0, 1.0, -1.0]),
    "Z up, facing Y": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "Z up, facing X": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "Y down, facing Z": np.diag([-1.0, -1.0, 1.0]),
    "X up, facing Y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


@pytest.mark.parametrize("six", [False, True])
@pytest.mark.parametrize(("unit_m", "order"), [(1.0, "ZXY"), (0.01, "XYZ")])
def test_of_blender(tmp_path, unit_m, order, six):
    """Blender's exporter writes Z up, in metres or the unit of its import, perhaps six channels a joint."""
    check(write_bvh(tmp_path / "a.bvh", BLENDER, unit_m, order, six=six))


@pytest.mark.parametrize("world", WORLDS)
def test_any_world(tmp_path, world):
    assert np.linalg.det(WORLDS[world]) == 1.0
    check(write_bvh(tmp_path / "a.bvh", WORLDS[world]))


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_any_order(tmp_path, order):
    check(write_bvh(tmp_path / "a.bvh", order=order, extra_root=True))


@pytest.mark.parametrize("unit_m", [1.0, 0.1, 0.01, 0.001])
def test_clear_units(tmp_path, unit_m):
    check(write_bvh(tmp_path / "a.bvh", unit_m=unit_m))


SHANK_M = float(np.linalg.norm(default_body().offsets[JOINTS.index("left_ankle")]))


@pytest.mark.parametrize(
    ("shank", "says"),
    [
        (SHANK_M / 0.0254, "long, cm and in are possible; give convert --unit m|dm|cm"),
        (16.5, "16.5 long, cm and in are possible; give"),
        (19.0, "19 long, cm and in are possible; give"),
        (0.04, "0.04 long, that is no shank in m, cm, mm, dm or in; give"),
        (1.3, "1.3 long, that is no shank"),
        (7.1, "7.1 long, that is no shank"),
    ],
)
def test_unclear_units(tmp_path, shank, says):
    path = write_bvh(tmp_path / "a.bvh", unit_m=SHANK_M / shank)
    with pytest.raises(EdgeposeError, match=re.escape(says)):
        read_poses(path)


def test_a_unit_that_is_given(tmp_path):
    path = write_bvh(tmp_path / "a.bvh", unit_m=0.0254)
    result = convert(Job(path, tmp_path / "a.npz"), Options(unit="in"))
    assert (result.samples, result.problem) == (COUNT, None)
    check(tmp_path / "a.npz")


@pytest.mark.parametrize("skeleton", BVH_NAMES)
def test_names(tmp_path, skeleton):
    table = dict(zip(JOINTS, BVH_NAMES[skeleton], strict=True))
    check(write_bvh(tmp_path / "a.bvh", names=table.__getitem__))
    check(write_bvh(tmp_path / "b.bvh", names=lambda joint: f"Character1:{table[joint]}".upper()))


def test_names_of_rokoko_with_four_joints_in_the_spine(tmp_path):
    table = dict(zip(JOINTS, BVH_NAMES["rokoko"], strict=True))
    path = write_bvh(tmp_path / "a.bvh", names=table.__getitem__)
    text = path.read_text().replace("Spine3", "Spine4")
    start = text.index("JOINT Spine4")
    between = "JOINT Spine3\n{\nOFFSET 0 0 0\nCHANNELS 0\n"
    # It opens before Spine4, and closes with the last brace of Spine2.
    end = text.index("}\n}\nMOTION")
    path.write_text(f"{text[:start]}{between}{text[start:end]}}}\n{text[end:]}")
    assert "Spine3" in read_bvh(path).names
    check(path)


@pytest.mark.parametrize("skeleton", BVH_NAMES)
def test_names_that_are_written(command, tmp_path, skeleton):
    with BvhSink(tmp_path / "a.bvh", names=skeleton) as sink:
        for i, rotations in enumerate(ROTATIONS):
            sink.write(PoseFrame(i, i / 60.0, rotations, np.zeros(24), PLACES[i]))
    assert sorted(read_bvh(tmp_path / "a.bvh").names) == sorted(BVH_NAMES[skeleton])
    check(tmp_path / "a.bvh")


SPELLINGS = {
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "exponents": lambda text: re.sub(r"-?\d+\.\d{6}", lambda number: f"{float(number[0]):.8e}", text),
    "byte order mark": lambda text: "\ufeff" + text,
    "empty lines": lambda text: text.replace("\n", "\n\n"),
    "no end sites": str,
    "end sites": lambda text: text.replace("}\n}", "End Site\n{\nOFFSET 1 1 1\n}\n}\n}", 1),
    "small letters": str.lower,
    "no blank after the colon": lambda text: text.replace("Time: ", "Time:").replace("Frames: ", "Frames:"),
    "decimal commas": lambda text: re.sub(r"(\d)\.(\d)", r"\1,\2", text),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings(tmp_path, spelling):
    path = write_bvh(tmp_path / "a.bvh")
    path.write_bytes(SPELLINGS[spelling](path.read_text()).encode())
    check(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda text: text.replace("0.016667", "60"),
            "frame time of 60 s is not plausible; .* write 0.016667",
        ),
        (lambda text: text.replace("0.016667", "0"), "frame time of 0 s is not possible"),
        (lambda text: text.replace("left_", "x_").replace("right_", "left_").replace("x_", "right_"), "toes"),
    ],
    ids=["rate", "zero", "left and right exchanged"],
)
def test_refused(tmp_path, change, says):
    path = write_bvh(tmp_path / "a.bvh")
    path.write_text(change(path.read_text()))
    with pytest.raises(EdgeposeError, match=says):
        read_poses(path)


def test_arms_that_hang_in_the_zero_pose_are_refused(tmp_path):
    """An A-pose of 35 degrees: taken for a T-pose, all arms would be off by that."""
    path = write_bvh(tmp_path / "a.bvh")
    head, joint, rest = path.read_text().partition("JOINT left_elbow\n{\nOFFSET ")
    numbers, _, rest = rest.partition("\n")
    length = np.linalg.norm(np.array(numbers.split(), float))
    path.write_text(f"{head}{joint}{0.82 * length:.4f} {-0.57 * length:.4f} 0\n{rest}")
    with pytest.raises(EdgeposeError, match="its left_elbow is not where a T-pose has it; export it with"):
        read_poses(path)


def test_unknown_positions_stay_unknown(tmp_path):
    """The lowest joint is on the ground, and no position comes back."""
    from edgepose.formats.joint_tree import forward

    with BvhSink(tmp_path / "a.bvh", names="unity") as sink:
        for i, rotations in enumerate(ROTATIONS):
            sink.write(PoseFrame(i, i / 60.0, rotations, np.zeros(24)))
    heights = forward(read_bvh(tmp_path / "a.bvh"))[1][..., 1]
    np.testing.assert_allclose(heights.min(axis=1), 0.0, atol=1e-3)  # cm
    assert read_poses(tmp_path / "a.bvh").translation is None
