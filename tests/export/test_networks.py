import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from edgepose.inference.features import network_input, rotation_to_6d
from edgepose.placements import BONES
from edgepose.skeleton import PREDICTED, UNOBSERVED, global_rotations
from edgepose_export.archive.torchscript import build
from edgepose_export.networks.shape import NetworkShape, PoseDecoder, smoothed
from edgepose_export.synthesis.augmentation import rotations_of

BIRNN = NetworkShape("birnn", 8, "global-6d", "passed")
RNN = BIRNN._replace(kind="rnn")
SMOOTH = 0.6
RESTING = [7, 8, 10, 11, 20, 21, 22, 23]


def close(a, b, atol=2e-5):
    torch.testing.assert_close(a, b, rtol=0, atol=atol)


def run_offline(network, statistics, orientation, acceleration, *future):
    """What training computes, through torch.nn.LSTM, and the decoder."""
    shape, decoder = network.shape, PoseDecoder(network.shape, *statistics[2:])
    x = (network_input(orientation, acceleration) - statistics.input_mean) / statistics.input_std
    mean, deviation = (numbers[..., : shape.pose_outputs] for numbers in network(x, *future))
    orientation = orientation[:, : mean.shape[1]]
    pose = mean * statistics.target_std + statistics.target_mean
    if shape.smoothing:
        pose = smoothed(pose, orientation[:, :, -1], shape.smoothing)
    return decoder.rotations(orientation, pose), decoder.deviations(deviation)


def test_archive_computes_what_training_computed(shape, parts, tiny, wearers):
    inputs = wearers(2, 9)
    with torch.no_grad():
        expected = run_offline(*parts(shape), *inputs)
        rotations, std = tiny(shape)(*inputs)
    close(rotations, expected[0])
    close(std, expected[1])
    assert rotations.shape == (2, 9, 24, 3, 3)
    assert std.shape == (2, 9, 24)


def test_poses_are_rotations_of_the_right_joints(shape, tiny, wearers):
    orientation, acceleration = wearers(1, 6)
    with torch.no_grad():
        rotations, std = tiny(shape)(orientation, acceleration)
    close(rotations @ rotations.mT, torch.eye(3).expand_as(rotations))
    close(torch.linalg.det(rotations), torch.ones(1, 6, 24))
    close(rotations[..., 0, :, :], orientation[..., -1, :, :], atol=0)
    close(rotations[..., RESTING, :, :], torch.eye(3).expand(1, 6, 8, 3, 3), atol=1e-6)
    predicted = list(UNOBSERVED if shape.measured == "passed" else PREDICTED)
    others = sorted(set(range(24)) - set(predicted))
    assert (std[..., predicted] > 0).all()
    assert (std[..., others] == 0).all()
    # Each predicted joint has its own output: none is a copy of another.
    flat = rotations[0, 0, predicted].flatten(1)
    assert torch.cdist(flat, flat).fill_diagonal_(1).min() > 1e-3


def test_passed_bones_equal_the_inputs(tiny, wearers):
    orientation, acceleration = wearers(1, 6)
    for shape in (BIRNN, RNN):
        with torch.no_grad():
            rotations, _ = tiny(shape)(orientation, acceleration)
        world = global_rotations(rotations[0].numpy())
        np.testing.assert_allclose(world[:, list(BONES)], orientation[0].numpy(), atol=3e-6)


@pytest.mark.parametrize("numbers", ["local-matrix", "global-6d"])
def test_deviation_is_in_radians(numbers):
    """Outputs that scatter as a small random turn does give the size of that turn."""
    shape = NetworkShape("rnn", 8, numbers, "predicted")
    decoder = PoseDecoder(shape, torch.zeros(shape.pose_outputs), torch.ones(shape.pose_outputs))
    turns = 0.01 * torch.randn(20000, 3, generator=torch.Generator().manual_seed(0))
    zero = torch.zeros(20000)
    x, y, z = turns.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    matrices = torch.linalg.matrix_exp(skew)
    entries = matrices.flatten(1) if shape.numbers == 9 else matrices[..., :2].mT.flatten(1)
    outputs = torch.cat([entries.std(0).repeat(15), torch.ones(15)])
    mean = torch.cat([entries.mean(0).repeat(15), torch.zeros(15)])
    _, std = decoder(torch.eye(3).expand(6, 3, 3), mean, outputs)
    size = turns.norm(dim=-1).square().mean().sqrt()
    close(std[list(PREDICTED)] / size, torch.ones(15), atol=0.02)


def test_window_is_the_whole_window_at_its_frame(shape, tiny, wearers):
    orientation, acceleration = wearers(2, 7)
    module = tiny(shape)
    with torch.no_grad():
        whole = module(orientation, acceleration)
        for index in range(7):
            for got, expected in zip(module.window(orientation, acceleration, index), whole, strict=True):
                close(got, expected[:, index])


def stream(module, orientation, acceleration, future):
    state = module.start(len(orientation), future)
    poses, counts = [], []
    for t in range(orientation.shape[1]):
        *pose, state = module.stream(orientation[:, t], acceleration[:, t], state)
        counts.append(pose[0].shape[1])
        poses.append(pose)
    poses.append(module.drain(state))
    return [torch.cat(column, dim=1) for column in zip(*poses, strict=True)], counts


def test_rnn_stream_is_offline(tiny, wearers):
    orientation, acceleration = wearers(2, 12)
    for shape in (RNN, RNN._replace(smoothing=SMOOTH), NetworkShape("rnn", 8, "local-matrix", "predicted")):
        module = tiny(shape)
        with torch.no_grad():
            got, counts = stream(module, orientation, acceleration, 0)
            expected = module(orientation, acceleration)
        assert counts == [1] * 12
        for a, b in zip(got, expected, strict=True):
            close(a, b)


def test_rnn_has_no_future(tiny):
    with pytest.raises(torch.jit.Error, match="no future frames"):
        tiny(RNN).start(1, 1)


def lstm_direction(lstm, suffix):
    """One direction of a bidirectional nn.LSTM as an nn.LSTM of its own."""
    single = nn.LSTM(lstm.input_size, lstm.hidden_size, batch_first=True)
    names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    single.load_state_dict({name: getattr(lstm, name + suffix) for name in names})
    return single


def latency_controlled(network, statistics, orientation, acceleration, future):
    """Definition: forward layers carried over the past, backward layers over [t, t + future] from zero.

    Layer 2's forward input at frame s is layer 1's output as it was when frame s was the present one.
    """
    f1, b1 = lstm_direction(network.lstm1, ""), lstm_direction(network.lstm1, "_reverse")
    f2, b2 = lstm_direction(network.lstm2, ""), lstm_direction(network.lstm2, "_reverse")
    x = (network_input(orientation, acceleration) - statistics.input_mean) / statistics.input_std
    x = torch.relu(network.dense(x))
    forward1 = f1(x)[0]
    outputs, carried = [], None
    for t in range(x.shape[1]):
        ahead = slice(t, t + future + 1)
        backward1 = b1(x[:, ahead].flip(1))[0].flip(1)
        layer1 = torch.cat([forward1[:, ahead], backward1], dim=-1)
        forward2, carried = f2(layer1[:, :1], carried)
        backward2 = b2(layer1.flip(1))[0].flip(1)[:, :1]
        outputs.append(torch.cat([forward2, backward2], dim=-1))
    hidden = torch.cat(outputs, dim=1)
    size = network.shape.pose_outputs
    deviation = nn.functional.softplus(network.deviation(hidden)) + 0.02
    pose = network.mean(hidden)[..., :size] * statistics.target_std + statistics.target_mean
    if network.shape.smoothing:
        pose = low_pass(pose, orientation[:, :, -1], network.shape.smoothing)
    decoder = PoseDecoder(network.shape, *statistics[2:])
    return decoder.rotations(orientation, pose), decoder.deviations(deviation[..., :size])


def low_pass(pose, root, smoothing):
    """Definition: columns of rotations, seen from the root made level, through two stages, each a weighted
    mean of its input and its own last output; corrected for their beginning at zero.
    """
    turn = torch.atan2(root[..., 0, 2] - root[..., 2, 0], root[..., 0, 0] + root[..., 2, 2])
    about = torch.stack([torch.zeros_like(turn), -turn, torch.zeros_like(turn)], dim=-1).flatten(0, 1)
    level = torch.tensor(Rotation.from_rotvec(about.numpy()).as_matrix()).float().unflatten(0, turn.shape)
    root = level @ root
    columns = torch.einsum("btij,btnj->btni", root, pose.unflatten(-1, (-1, 3)))
    first = second = torch.zeros_like(columns[:, 0])
    outputs, one, two = [], 0.0, 0.0  # the last two tell the weight
    for t in range(pose.shape[1]):
        first = smoothing * first + (1 - smoothing) * columns[:, t]
        second = smoothing * second + (1 - smoothing) * first
        one = smoothing * one + (1 - smoothing)
        two = smoothing * two + (1 - smoothing) * one
        outputs.append(torch.einsum("bij,bni->bnj", root[:, t], second / two).flatten(1))
    return torch.stack(outputs, dim=1)


@pytest.mark.parametrize("smoothing", [0.0, SMOOTH])
@pytest.mark.parametrize(("frames", "future"), [(12, 3), (12, 0), (5, 5), (3, 8), (1, 2)])
def test_birnn_stream_against_its_definition(parts, tiny, wearers, frames, future, smoothing):
    inputs, shape = wearers(2, frames), BIRNN._replace(smoothing=smoothing)
    with torch.no_grad():
        got, counts = stream(tiny(shape), *inputs, future)
        expected = latency_controlled(*parts(shape), *inputs, future)
        whole = tiny(shape)(*inputs)
    # Priming: nothing comes out until `future` frames wait; drain gives the rest.
    assert counts == [0] * min(future, frames) + [1] * max(0, frames - future)
    for a, b in zip(got, expected, strict=True):
        close(a, b)
    if frames == 12:
        assert (got[0] - whole[0]).abs().max() > 1e-3  # another function than the whole sequence's


@pytest.mark.parametrize("smoothing", [0.0, SMOOTH])
@pytest.mark.parametrize("future", [1, 5])
def test_a_stream_gives_what_streamed_training_computed(parts, tiny, wearers, future, smoothing):
    inputs, shape = wearers(3, 14), BIRNN._replace(smoothing=smoothing)
    with torch.no_grad():
        expected = run_offline(*parts(shape), *inputs, future)
        got, _ = stream(tiny(shape), *inputs, future)
    assert expected[0].shape == (3, 14 - future, 24, 3, 3)
    for a, b in zip(got, expected, strict=True):
        close(a[:, : 14 - future], b)


def test_smoothing_is_a_two_pole_low_pass_of_rotations_seen_from_a_level_pelvis(wearers):
    """Against its definition, frame by frame."""
    root = wearers(2, 20)[0][:, :, -1]
    pose = torch.randn(2, 20, BIRNN.pose_outputs, generator=torch.Generator().manual_seed(0))
    close(smoothed(pose, root, SMOOTH), low_pass(pose, root, SMOOTH))


def test_smoothing_keeps_a_bone_at_rest_under_a_pelvis_that_shakes():
    """And lets a body turn as one, however fast."""
    bone = torch.tensor(Rotation.random(10, random_state=1).as_matrix()).float()
    shakes = 0.3 * torch.randn(1, 40, 3, generator=torch.Generator().manual_seed(2))
    shakes[..., 1] = 0.0
    turn = torch.zeros(1, 40, 3)
    turn[..., 1] = torch.arange(40) * 0.2  # 11 deg a frame
    root = rotations_of(turn) @ rotations_of(shakes)
    pose = rotation_to_6d(root.mT.unsqueeze(2) @ rotations_of(turn).unsqueeze(2) @ bone).flatten(-2)
    close(smoothed(pose, root, 0.9), pose)
    steady = pose[:, :1].expand_as(pose)
    close(smoothed(steady, rotations_of(turn), 0.9), steady)


def test_wearers_of_a_batch_do_not_meet(shape, tiny, wearers):
    inputs = wearers(2, 6)
    module = tiny(shape)
    future = 2 if shape.kind == "birnn" else 0
    with torch.no_grad():
        whole, window, streamed = (
            module(*inputs),
            module.window(*inputs, 4),
            stream(module, *inputs, future)[0],
        )
        for i in range(2):
            one = [x[i : i + 1] for x in inputs]
            alone = module(*one), module.window(*one, 4), stream(module, *one, future)[0]
            for together, single in zip((whole, window, streamed), alone, strict=True):
                for a, b in zip(together, single, strict=True):
                    close(a[i : i + 1], b)


def test_plain_module_and_scripted_module_agree(shape, parts, tiny, wearers):
    inputs = wearers(1, 5)
    plain = build(*parts(shape))
    with torch.no_grad():
        for a, b in zip(plain(*inputs), tiny(shape)(*inputs), strict=True):
            close(a, b)


PROGRAM = """
import sys, torch
module = torch.jit.load(sys.argv[1])
inputs = torch.load(sys.argv[2])
o, a, future = inputs["o"], inputs["a"], inputs["future"]
state, poses = module.start(1, future), []
for t in range(o.shape[1]):
    rotations, std, state = module.stream(o[:, t], a[:, t], state)
    poses.append(rotations)
poses.append(module.drain(state)[0])
torch.save([module(o, a)[0], module.window(o, a, 3)[0], torch.cat(poses, 1)], sys.argv[3])
assert not [name for name in sys.modules if name.startswith("edgepose")]
"""


@pytest.mark.parametrize("kind", ["birnn", "rnn"])
def test_saved_archive_runs_with_torch_alone(tmp_path, tiny, wearers, write_archive, kind):
    shape = BIRNN._replace(kind=kind)
    path = write_archive(tmp_path / "small.pt", shape)
    orientation, acceleration = wearers(1, 6)
    future = 2 if kind == "birnn" else 0
    torch.save({"o": orientation, "a": acceleration, "future": future}, tmp_path / "inputs.pt")
    done = subprocess.run(
        [sys.executable, "-I", "-c", PROGRAM, path, tmp_path / "inputs.pt", tmp_path / "out.pt"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    module = tiny(shape)
    with torch.no_grad():
        expected = [
            module(orientation, acceleration)[0],
            module.window(orientation, acceleration, 3)[0],
            stream(module, orientation, acceleration, future)[0][0],
        ]
    for got, want in zip(torch.load(tmp_path / "out.pt"), expected, strict=True):
        close(got, want)
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith("extra/edgepose.json")]
        about = json.loads(archive.read(names[0]))
    assert about["kind"] == kind
    assert about["joints"] == [
        "left_hip", "right_hip", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar",
        "left_shoulder", "right_shoulder",
    ]  # fmt: skip
