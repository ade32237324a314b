"""The prior of poses: learning it, keeping it, refusing what is none."""

from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.sip.prior import SIZE, learn_prior, load_prior, save_prior
from edgepose.skeleton import JOINTS

CLIP = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
HELD_OUT = Path(__file__).parents[2] / "data" / "mocap"


def coordinate(joint, axis):
    return 3 * (JOINTS.index(joint) - 1) + "xyz".index(axis)


def test_the_shipped_prior_is_of_people():
    prior = load_prior()
    assert "free for all use" in prior.about
    knee, elbow = coordinate("left_knee", "x"), coordinate("left_elbow", "y")
    assert prior.lower[knee] > np.deg2rad(-25)
    assert np.deg2rad(90) < prior.upper[knee] < np.deg2rad(160)
    assert prior.mean[elbow] < 0.0 < prior.mean[coordinate("right_elbow", "y")]
    thighs = prior.covariance[coordinate("left_hip", "x"), coordinate("left_knee", "x")]
    assert thighs < 0.0  # who lifts a thigh bends the knee


def test_a_prior_is_learnt_and_kept(tmp_path):
    rng = np.random.default_rng(0)
    mixing = 0.1 * rng.normal(size=(72, 72))
    poses = 0.2 + rng.normal(size=(20_000, 72)) @ mixing
    poses[:, -3:] = 0.0  # never moves
    prior = learn_prior(poses, "made up")
    np.testing.assert_allclose(prior.mean[:60], 0.2, atol=0.03)
    expected = (mixing.T @ mixing)[3:, 3:][:60, :60] + np.deg2rad(4.0) ** 2 * np.eye(60)
    np.testing.assert_allclose(prior.covariance[:60, :60], expected, atol=0.06)
    assert (prior.lower < prior.mean).all()
    assert (prior.upper > prior.mean).all()
    save_prior(tmp_path / "prior.npz", prior)
    again = load_prior(tmp_path / "prior.npz")
    assert again.about == "made up"
    for mine, kept in zip(prior[:4], again[:4], strict=True):
        np.testing.assert_allclose(kept, mine, rtol=1e-5, atol=1e-6)


def test_few_poses_are_no_prior():
    with pytest.raises(EdgeposeError, match="100 poses are too few for a prior: give at least 690"):
        learn_prior(np.zeros((100, 72)), "")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(3)}, r"'mean' is not \(69,\) finite angles"),
        ({"mean": np.full(SIZE, np.nan)}, r"'mean' is not \(69,\) finite angles"),
        ({"covariance": -np.eye(SIZE)}, "not positive definite"),
        ({"covariance": np.triu(np.ones((SIZE, SIZE)))}, "contradict themselves"),
        ({"lower": np.full(SIZE, 9.0)}, "contradict themselves"),
        ({"upper": np.array(["x"])}, "not a prior of poses"),
    ],
)
def test_what_is_no_prior_is_told(tmp_path, change, message):
    arrays = dict(zip(("mean", "covariance", "lower", "upper"), load_prior()[:4], strict=True))
    np.savez(tmp_path / "prior.npz", about="", **arrays | change)
    with pytest.raises(EdgeposeError, match=message):
        load_prior(tmp_path / "prior.npz")


def test_no_file_or_another_file(tmp_path):
    with pytest.raises(EdgeposeError, match=r"none\.npz: not a prior of poses"):
        load_prior(tmp_path / "none.npz")
    np.savez(tmp_path / "poses.npz", poses=np.zeros((3, 72)))
    with pytest.raises(EdgeposeError, match=r"poses\.npz: not a prior of poses .* edgepose learn-prior"):
        load_prior(tmp_path / "poses.npz")


def test_learn_prior_reads_motion_and_leaves_held_out_takes_out(command, tmp_path):
    rng = np.random.default_rng(1)
    names = ("mine", "02_01")  # the second is held out by its name
    for name, size in zip(names, (0.1, 2.0), strict=True):
        np.savez(
            tmp_path / f"{name}.npz",
            poses=np.cumsum(0.002 * rng.normal(size=(7200, 72)), axis=0) + size,
            trans=np.zeros((7200, 3)),
            mocap_framerate=60.0,
        )
    (tmp_path / "broken.bvh").write_text("HIERARCHY\n")
    out = tmp_path / "prior.npz"
    result = command("learn-prior", tmp_path, "--out", out, "--about", "mine, free")
    assert result.returncode == 0, result.stderr
    assert "720 poses" in result.stderr
    assert "skipped: " in result.stderr
    assert "broken.bvh" in result.stderr
    prior = load_prior(out)
    assert prior.about == "mine, free"
    assert np.abs(prior.mean[:60] - 0.1).max() < 0.5
