import numpy as np
import pytest
import torch
from scipy.stats import chi2

from edgepose.skeleton import JOINTS
from edgepose_export.archive.torchscript import describe, script
from edgepose_export.evaluation import uncertainty as rel
from edgepose_export.evaluation.evaluate import Mode, run_with_std
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.dataset import Take

CHECKPOINT = {"step": 7, "data": {}, "config": '{"steps": 7}'}


def drawn(count=40_000, joints=1, seed=0):
    """Deviations of many sizes, and the sizes of turns that scatter as they say."""
    rng = np.random.default_rng(seed)
    deviations = rng.uniform(0.05, 0.5, (count, joints))
    turns = rng.normal(size=(count, joints, 3)) * deviations[..., None] / np.sqrt(3)
    return np.linalg.norm(turns, axis=-1), deviations


def test_right_deviations_are_found_right():
    result = rel.reliability(*drawn())
    np.testing.assert_allclose(result.actual_deg, result.predicted_deg, rtol=0.05)
    assert (np.diff(result.predicted_deg) > 0).all()
    np.testing.assert_allclose(result.within, rel.EXPECTED, atol=0.01)
    assert result.scale == pytest.approx(1.0, abs=0.02)
    assert result.values == 40_000
    np.testing.assert_allclose(rel.EXPECTED, chi2.cdf([3, 12], 3), atol=1e-3)


def test_wrong_deviations_are_found_wrong():
    errors, deviations = drawn()
    result = rel.reliability(3.0 * errors, deviations)
    assert result.scale == pytest.approx(3.0, rel=0.02)
    np.testing.assert_allclose(result.actual_deg, 3.0 * result.predicted_deg, rtol=0.05)
    assert result.within[0] < 0.1
    said = rel.describe(result)
    assert len(said.splitlines()) == rel.BINS + 2
    assert "60.8 % expected" in said
    assert "scale 3.0" in said
    assert "40000 joint errors" in said


def test_scales_mend_each_joint():
    errors, deviations = drawn(joints=3)
    wrong = np.array([0.5, 1.0, 4.0])
    got = rel.scales(errors, deviations / wrong)
    np.testing.assert_allclose(got, wrong, rtol=0.02)
    assert rel.reliability(errors, deviations / wrong * got).scale == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("targets", ["local-matrix", "global-6d"])
def test_errors_are_of_the_rotations_that_the_network_predicts(parts, tiny, wearers, targets):
    """A truth that is the prediction turned in one joint, locally or as seen from the root."""
    shape = NetworkShape("rnn", 8, targets, "predicted")
    module, about = tiny(shape), describe("x", parts(shape)[0], CHECKPOINT, 0, 0)
    orientation, acceleration = (x[0].numpy() for x in wearers(1, 15))
    poses = torch.eye(3).expand(15, 24, 3, 3).numpy()
    take = Take("made up", orientation, acceleration, poses, "free")
    mode = Mode("stream")
    ((truth, std),) = run_with_std(module, [take], mode)
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    truth[:, 1] = truth[:, 1] @ turn  # the left hip; the knee below it turns with it
    errors, deviations = rel.errors_and_deviations(module, about, [take._replace(pose=truth)] * 2, mode)
    assert errors.shape == deviations.shape == (30, 15)
    expected = dict.fromkeys(about["joints"], 0.0) | {"left_hip": 0.3}
    if targets == "global-6d":
        expected["left_knee"] = 0.3
    np.testing.assert_allclose(errors, np.tile(list(expected.values()), (30, 1)), atol=1e-5)
    np.testing.assert_allclose(
        deviations[:15], std[:, [JOINTS.index(name) for name in about["joints"]]], atol=1e-6
    )


def test_archive_holds_the_fitted_factors(shape, parts, tiny, wearers):
    factors = torch.linspace(0.5, 3.0, 24)
    inputs = wearers(1, 6)
    with torch.no_grad():
        plain, fitted = tiny(shape)(*inputs), script(*parts(shape), factors)(*inputs)
    torch.testing.assert_close(fitted[1], plain[1] * factors)
    torch.testing.assert_close(fitted[0], plain[0])
