"""`edgepose synthesize` on skeletons of other programs: T-poses, mappings, faults, the picture to check."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.rotations import rotvec_to_matrix
from edgepose.skeleton import default_body, forward_kinematics
from edgepose_export.mocap import read_motion, resample
from tests.support.skeletons import FAMILIES, write_bvh

DATA = Path(__file__).parents[1] / "data" / "mocap"
T_POSE = np.tile(np.eye(3), (1, 24, 1, 1))
ORIGIN = np.array([[0.0, 0.95, 0.0]])
FAMILY = FAMILIES["lafan"]


def edgepose(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def walk():
    motion = read_motion(DATA / "07_01.bvh")
    return motion._replace(rotations=motion.rotations[::2], translation=motion.translation[::2], rate=60.0)


def test_good_takes_are_kept_and_each_fault_costs_its_file(tmp_path, walk):
    folder, out = tmp_path / "mocap", tmp_path / "out"
    (folder / "sub").mkdir(parents=True)
    write_bvh(folder / "good.bvh", FAMILY, walk.rotations, walk.translation)
    write_bvh(folder / "sub" / "random axes.bvh", FAMILY, walk.rotations, walk.translation, seed=3)
    write_bvh(folder / "sub" / "t_pose.bvh", FAMILY, T_POSE, ORIGIN, seed=3)
    write_bvh(folder / "one.bvh", FAMILY, walk.rotations[:1], walk.translation[:1])
    still = walk.rotations[:1].repeat(5, axis=0)
    write_bvh(folder / "still.bvh", FAMILY, still, walk.translation[:1].repeat(5, axis=0))
    text = (folder / "good.bvh").read_text()
    (folder / "slow.bvh").write_text(text.replace("Frame Time: 0.0166667", "Frame Time: 1"))
    (folder / "dog.bvh").write_text(text.replace("Hand", "FrontPaw").replace("Foot", "HindPaw"))
    jumping = walk.translation.copy()
    jumping[15:] += [3.0, 0.0, 0.0]
    write_bvh(folder / "jumps.bvh", FAMILY, walk.rotations, jumping)
    result = edgepose("synthesize", folder, "--out", out)
    skipped = [line for line in result.output.splitlines() if line.startswith("skipped:")]
    for name, reason in {
        "one": "too short: 1 frame at 60 Hz",
        "still": "no motion: all 5 frames are the same",
        "slow": "a frame rate of 1 Hz is not that of motion capture",
        "dog": "unknown skeleton: no joint for left_foot, left_hand, right_foot, right_hand; joints not ",
        "jumps": "no part between two jumps is as long as a second",
    }.items():
        assert [line for line in skipped if f"{name}.bvh: {reason}" in line], (name, skipped)
    assert len(skipped) == 5
    assert "2 of 7 recordings written" in result.output  # the T-pose is no take
    assert result.exit_code == 1
    assert isinstance(result.exception, EdgeposeError)
    assert sorted(path.name for path in out.rglob("*.npz")) == ["good.npz", "random axes.npz"]


def test_t_pose_and_mapping_files(tmp_path, walk):
    take, stand = tmp_path / "take.bvh", tmp_path / "stand.bvh"
    for path, rotations, translation in ((take, walk.rotations, walk.translation), (stand, T_POSE, ORIGIN)):
        write_bvh(path, FAMILY, rotations, translation, seed=3)
        path.write_text(path.read_text().replace("JOINT Head", "JOINT Bone7"))
    (tmp_path / "map.toml").write_text('head = "Bone7"\nneck = "Neck"\nunit = "cm"\n')
    refused = edgepose("synthesize", take, "--out", tmp_path / "a")
    assert "no T-pose" in refused.output
    flags = ("--t-pose", stand, "--mapping", tmp_path / "map.toml")
    done = edgepose("synthesize", take, "--out", tmp_path / "a", *flags)
    assert done.exit_code == 0, done.output
    with np.load(tmp_path / "a" / "take.npz") as made:
        poses = rotvec_to_matrix(made["poses"].reshape(-1, 24, 3))
        np.testing.assert_allclose(poses[0, 0], walk.rotations[0, 0], atol=1e-3)
        assert str(made["source"]) == "own"
    (tmp_path / "map.toml").write_text('tail = "Bone7"\n')
    wrong = edgepose("synthesize", take, "--out", tmp_path / "b", "--mapping", tmp_path / "map.toml")
    assert "unknown key 'tail'" in str(wrong.exception)


def test_feet_stand_still_on_a_body_of_another_size(tmp_path, walk):
    """The way is scaled to the legs, so that a stance foot slides on no body."""
    takes = {}
    for height in (1.5, 1.9):
        out = tmp_path / str(height)
        done = edgepose("synthesize", DATA / "07_01.bvh", "--out", out, "--height", height)
        assert done.exit_code == 0, done.output
        with np.load(out / "07_01.npz") as made:
            local = rotvec_to_matrix(made["poses"].reshape(-1, 24, 3))
            takes[height] = forward_kinematics(local, default_body(height).offsets, made["trans"])[1]
    way = {height: np.ptp(joints[:, 0], axis=0).max() for height, joints in takes.items()}
    legs = {height: default_body(height).leg_length_m for height in takes}
    assert way[1.5] / way[1.9] == pytest.approx(legs[1.5] / legs[1.9], rel=1e-3)
    source = resample(read_motion(DATA / "07_01.bvh"))
    assert way[1.5] / np.ptp(source.translation, axis=0).max() == pytest.approx(
        legs[1.5] / source.leg_length, rel=1e-3
    )
    slides = [
        np.linalg.norm(np.diff(joints[:, (7, 8)], axis=0)[..., [0, 2]], axis=-1).min(axis=1).mean() * 60
        for joints in takes.values()
    ]
    assert max(slides) < 0.2  # m/s; the walker moves at 1.3


def test_a_picture_of_each_skeleton(tmp_path, walk):
    folder = tmp_path / "mocap"
    folder.mkdir()
    for name in ("07_01.bvh", "07_01.amc", "07.asf", "dataset-2_walk_normal_001.bvh"):
        shutil.copy(DATA / name, folder / name)
    shutil.copy(DATA / "07_01.bvh", folder / "07_02.bvh")
    (folder / "dog.bvh").write_text((folder / "07_01.bvh").read_text().replace("Foot", "Paw"))
    picture = tmp_path / "check.png"
    result = edgepose("synthesize", folder, "--check", picture)
    assert result.exit_code == 0, result.output
    assert "3 skeletons drawn" in result.output  # one of both files of CMU's in BVH
    assert "not drawn:" in result.output
    assert "dog.bvh: unknown skeleton" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    before = picture.read_bytes()
    assert "exists" in str(edgepose("synthesize", folder, "--check", picture).exception)
    assert picture.read_bytes() == before
    assert "pictures are written as" in str(edgepose("synthesize", folder, "--check", "a.txt").exception)
    (folder / "only").mkdir()
    shutil.move(folder / "dog.bvh", folder / "only")
    nothing = edgepose("synthesize", folder / "only", "--check", tmp_path / "b.png")
    assert "no skeleton to draw" in str(nothing.exception)
    needs = edgepose("synthesize", folder)
    assert needs.exit_code == 2
    assert "Missing option '--out'" in needs.output
