from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose.inference.features import network_input
from edgepose.pipeline.dropout import extrapolate_dropouts
from edgepose.placements import BONES, PLACEMENTS
from edgepose.skeleton import JOINTS, default_body
from edgepose_export.mocap import read_motion, resample
from edgepose_export.synthesis.augmentation import (
    JOINT_MIRROR,
    SENSOR_MIRROR,
    Augmentation,
    augment,
    drop_sensor,
    mirror,
    rotations_of,
)
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import Batch, read_take, tape

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"
FLIP = np.diag([-1.0, 1.0, 1.0])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def batch(sequences=400, frames=3):
    def turns(*shape):
        return (
            torch.tensor(Rotation.random(int(np.prod(shape)), random_state=1).as_matrix())
            .float()
            .reshape(*shape, 3, 3)
        )

    acceleration = torch.randn(sequences, frames, 6, 3, generator=generator(9)) * 3
    place = torch.randn(sequences, frames, 10, generator=generator(5))
    place[..., :7] = (place[..., :7] > 0).float()
    return Batch(turns(sequences, frames, 6), acceleration, turns(sequences, frames, 24), place)


def angles(a, b):
    cosine = ((a.mT @ b).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.arccos(cosine.double().clamp(-1, 1)))


def test_sides_are_exchanged_by_name():
    for names, other in ((PLACEMENTS, SENSOR_MIRROR), (JOINTS, JOINT_MIRROR)):
        for i, name in enumerate(names):
            swapped = name.replace("left", "L").replace("right", "left").replace("L", "right")
            assert names[other[i]] == swapped


def test_mirroring_twice_is_nothing():
    data = batch(5)
    for got, expected in zip(mirror(*mirror(*data)), data, strict=True):
        torch.testing.assert_close(got, expected, rtol=0, atol=0)


def symmetric_body():
    """The default body is not quite the same on both sides; this one is."""
    body = default_body()
    offsets = (body.offsets + body.offsets[JOINT_MIRROR] @ FLIP) / 2
    sensors = (body.sensors + body.sensors[SENSOR_MIRROR] @ FLIP) / 2
    return body._replace(offsets=offsets, sensors=sensors)


def test_mirrored_sensors_are_those_of_the_mirrored_motion(tmp_path):
    motion = resample(read_motion(WALK))
    mirrored = motion._replace(
        rotations=FLIP @ motion.rotations[:, JOINT_MIRROR] @ FLIP, translation=motion.translation @ FLIP
    )
    takes = []
    for i, one in enumerate((motion, mirrored)):
        path = tmp_path / f"{i}.npz"
        np.savez(path, **recording_arrays(one, virtual_imus(one, symmetric_body()), ""))
        packed = tape([read_take(path)])
        takes.append(packed.at(torch.arange(len(packed.relative))))
    tolerances = (1e-5, 2e-3, 1e-5, 1e-4)
    for got, expected, tolerance in zip(mirror(*takes[0]), takes[1], tolerances, strict=True):
        torch.testing.assert_close(got, expected, rtol=0, atol=tolerance, equal_nan=True)


def test_share_of_mirrored_sequences():
    data = batch()
    got = augment(data, Augmentation(mirror=0.3), generator())
    changed = [(a != b).flatten(1).any(1) for a, b in zip(got, data, strict=True)]
    assert torch.equal(changed[0], changed[1])
    assert torch.equal(changed[0], changed[2])
    assert torch.equal(changed[0], changed[3])
    assert 0.2 < changed[0].float().mean() < 0.4
    for a, b in zip(got, mirror(*data), strict=True):
        torch.testing.assert_close(a[changed[0]], b[changed[0]])


def test_rotations_of_against_scipy():
    vectors = torch.randn(20, 3, generator=generator(), dtype=torch.float64)
    expected = Rotation.from_rotvec(vectors.numpy()).as_matrix()
    np.testing.assert_allclose(rotations_of(vectors).numpy(), expected, atol=1e-12)


def test_misalignment_is_one_turn_a_sensor_behind_its_orientation():
    data = batch()
    orientation, acceleration, relative, place = augment(
        data, Augmentation(mirror=0, misalignment_deg=4.0), generator()
    )
    error = data[0].mT @ orientation
    torch.testing.assert_close(error, error[:, :1].expand_as(error), rtol=0, atol=1e-5)
    size = angles(data[0][:, 0], orientation[:, 0])
    assert size.square().mean().sqrt().item() == pytest.approx(4.0 * 3**0.5, rel=0.05)
    torch.testing.assert_close(orientation @ orientation.mT, torch.eye(3).expand_as(orientation))
    assert acceleration is data[1]
    assert relative is data[2]
    assert place is data.place


def test_another_pelvis_turns_with_its_sensor_under_the_same_body():
    data = batch()
    data[2][:, :, 0] = torch.eye(3)
    orientation, acceleration, relative, place = augment(
        data, Augmentation(mirror=0, pelvis_pitch_deg=5.0), generator()
    )
    turn = data[0][:, :, -1].mT @ orientation[:, :, -1]
    torch.testing.assert_close(turn, turn[:, :1].expand_as(turn), rtol=0, atol=1e-5)
    torch.testing.assert_close(turn[..., 0], torch.tensor([1.0, 0, 0]).expand(400, 3, 3), rtol=0, atol=1e-5)
    size = angles(data[0][:, 0, -1], orientation[:, 0, -1])
    assert size.square().mean().sqrt().item() == pytest.approx(5.0, rel=0.1)
    assert torch.equal(orientation[:, :, :-1], data[0][:, :, :-1])
    assert acceleration is data[1]
    assert place is data.place
    before = data.orientation, data.relative
    bodies = (o[:, :, -1:] @ r for o, r in ((orientation, relative), before))
    torch.testing.assert_close(*(body[:, :, 1:] for body in bodies), rtol=0, atol=1e-5)
    assert torch.equal(relative[:, :, 0], data[2][:, :, 0])


def test_heading_turns_all_but_the_pelvis_about_the_vertical():
    data = batch()
    orientation, acceleration, *_ = augment(data, Augmentation(mirror=0, heading_deg=3.0), generator())
    turn = orientation @ data[0].mT
    torch.testing.assert_close(turn[..., 1, :], torch.tensor([0.0, 1, 0]).expand(400, 3, 6, 3))
    torch.testing.assert_close(turn[:, :, -1], torch.eye(3).expand(400, 3, 3, 3))
    torch.testing.assert_close(turn, turn[:, :1].expand_as(turn), rtol=0, atol=1e-5)
    size = angles(orientation, data[0])[:, 0, :-1]
    assert size.square().mean().sqrt().item() == pytest.approx(3.0, rel=0.05)
    torch.testing.assert_close(acceleration, (turn @ data[1][..., None])[..., 0])


def test_a_share_of_the_sequences_stays_aligned():
    data = batch()
    how = Augmentation(mirror=0, misalignment_deg=4.0, heading_deg=3.0, aligned=0.25)
    orientation, acceleration, *_ = augment(data, how, generator())
    untouched = (orientation - data[0]).abs().amax((1, 2, 3, 4)) < 1e-6
    assert 0.18 < untouched.float().mean() < 0.32
    still = (acceleration - data[1]).abs().amax((1, 2, 3)) < 1e-5
    assert torch.equal(still, untouched)


def test_noise_and_scale_of_accelerations():
    data = batch()
    noisy = augment(data, Augmentation(mirror=0, acceleration_noise=0.1), generator())[1] - data[1]
    assert noisy.std().item() == pytest.approx(0.1, rel=0.05)
    assert abs(noisy[:, 1:] * noisy[:, :-1]).mean() < 0.01  # white: new in each frame
    scaled = augment(data, Augmentation(mirror=0, acceleration_scale=0.02), generator())[1] / data[1]
    torch.testing.assert_close(scaled, scaled[:, :1, :, :1].expand_as(scaled))
    assert scaled.std().item() == pytest.approx(0.02, rel=0.1)


def test_nothing_asked_nothing_done_and_the_input_is_never_written():
    data = batch(20)
    kept = [x.clone() for x in data]
    assert all(a is b for a, b in zip(augment(data, Augmentation(mirror=0), generator()), data, strict=True))
    everything = Augmentation(0.5, 4.0, 3.0, 0.1, 0.02, pelvis_pitch_deg=5.0, silent=0.5)
    first, again = (augment(data, everything, generator(3)) for _ in range(2))
    for a, b, original, copy in zip(first, again, data, kept, strict=True):
        assert torch.equal(a, b)
        assert torch.equal(original, copy)
    assert torch.isfinite(network_input(*first[:2])).all()


def test_silent_sensors_are_those_of_a_run():
    motion = resample(read_motion(WALK))
    random = np.random.default_rng(2)
    lean = Rotation.from_rotvec(random.normal(scale=0.5, size=(2, 3))).as_matrix()[:, None, None]
    orientation = torch.tensor(lean @ motion.rotations[:100, BONES]).float()
    acceleration = torch.tensor(random.normal(size=(2, 100, 6, 3))).float()
    first, end = torch.tensor([1, 30]), torch.tensor([60, 400])
    for sensor in range(len(PLACEMENTS)):
        got = drop_sensor(orientation, acceleration, sensor, first, end)
        for i in range(2):
            before, expected = None, []
            for t in range(100):
                held = (np.arange(6) == sensor) & bool(first[i] <= t < end[i])
                frame = extrapolate_dropouts(
                    orientation[i, t].double().numpy(), acceleration[i, t].numpy(), held, before
                )
                before = frame[0]
                expected.append(frame)
            for a, b in zip(got, zip(*expected, strict=True), strict=True):
                np.testing.assert_allclose(a[i].numpy(), np.stack(b), atol=2e-4)
        assert torch.equal(got[0][1, :30], orientation[1, :30])
        assert torch.equal(got[0][0, 60:], orientation[0, 60:])


def test_share_of_sequences_with_a_silent_sensor():
    data = batch(frames=40)
    orientation, acceleration, relative, place = augment(
        data, Augmentation(mirror=0, silent=0.5), generator()
    )
    changed = (acceleration != data[1]).any(-1)
    one = changed.any(1)
    assert 0.35 < one.any(1).float().mean() < 0.5  # of some the silence ends before the sequence begins
    assert (one.sum(1) <= 1).all()
    assert (one.float().mean(0) > 0.04).all()
    assert torch.equal((orientation != data[0]).any(-1).any(-1) | changed, changed)
    assert relative is data[2]
    assert place is data.place
