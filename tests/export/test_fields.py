"""The networks without recurrence: feed-forward and WaveNet."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from edgepose.inference import archive as archives
from edgepose.inference.engine import StreamEngine
from edgepose_export.archive.model_card import card
from edgepose_export.archive.torchscript import build, describe, new_network, save, script
from edgepose_export.evaluation import evaluate as evaluation
from edgepose_export.evaluation.evaluate import Mode
from edgepose_export.networks.normalisation import network_inputs
from edgepose_export.networks.receptive_field import DILATIONS, KERNEL, field_archive, padded
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.dataset import Take

SHAPES = [
    NetworkShape(name, 8, "local-matrix") for name, kind in NETWORKS.items() if kind.archive is field_archive
]
CHECKPOINT = {
    "step": 7,
    "data": {"summary": "m", "licenses": ["m"], "takes": 1, "hours": 1.0},
    "config": "{}",
}


@pytest.fixture(scope="module", params=SHAPES, ids=lambda shape: shape.kind)
def shape(request):
    return request.param


@pytest.fixture(scope="module")
def made(shape, parts):
    """Network, statistics, scripted module."""
    network, statistics = parts(shape)
    return network, statistics, script(network, statistics)


def close(a, b, atol=2e-5):
    torch.testing.assert_close(a, b, rtol=0, atol=atol)


def streamed(module, orientation, acceleration, future):
    state, poses = module.start(len(orientation), future), []
    for t in range(orientation.shape[1]):
        *pose, state = module.stream(orientation[:, t], acceleration[:, t], state)
        poses.append(pose)
        assert pose[0].shape[1] == (t >= future)
    poses.append(module.drain(state))
    return [torch.cat(column, dim=1) for column in zip(*poses, strict=True)]


def test_paper_sizes():
    network = new_network(NetworkShape("feed-forward"))
    assert (network.past, network.future) == (20, 5)
    assert network.first.weight.shape == (256, 60, 26)
    assert [layer.out_features for layer in network.others] == [512, 512, 256, 256]
    network = new_network(NetworkShape("wavenet"))
    assert (network.past, network.future) == ((KERNEL - 1) * sum(DILATIONS), 0)


def test_whole_window_and_stream_are_one(made, wearers):
    network, _, module = made
    inputs = wearers(2, 80)
    with torch.no_grad():
        whole = module(*inputs)
        for got, expected in zip(streamed(module, *inputs, network.future), whole, strict=True):
            close(got, expected)
        for index in (0, 3, 70, 79):
            for got, expected in zip(module.window(*inputs, index), whole, strict=True):
                close(got, expected[:, index])
        # A window that holds the field is enough.
        first, last = 70 - network.past, 71 + network.future
        cut = [x[:, first:last] for x in inputs]
        close(module.window(*cut, network.past)[0], whole[0][:, 70])
    close(whole[0] @ whole[0].mT, torch.eye(3).expand_as(whole[0]))


def test_field_is_what_counts(made):
    """A pose depends on the frames of its field and on no other."""
    network, _, _ = made
    x = torch.randn(1, 90, 60, generator=torch.Generator().manual_seed(1), requires_grad=True)
    mean, deviation = network(x)
    (mean[:, 70].sum() + deviation[:, 70].sum()).backward()
    counts = x.grad.abs().sum((0, 2)) > 0
    assert counts.nonzero().flatten().tolist() == list(range(70 - network.past, 71 + network.future))


def test_less_future_is_the_last_frame_again(made, wearers):
    _, _, module = made
    inputs = wearers(1, 30)
    with torch.no_grad():
        got = streamed(module, *inputs, 2)[0]
        for t in (0, 10, 26):
            close(got[:, t], module.window(*(x[:, : t + 3] for x in inputs), t)[0])
        close(got[:, -1], module(*inputs)[0][:, -1])


def test_padding():
    x = torch.arange(6.0).view(1, 3, 2)
    assert padded(x, 2, 1)[0].tolist() == [[0, 1], [0, 1], [0, 1], [2, 3], [4, 5], [4, 5]]


def test_feed_forward_is_dense_layers_over_the_field(parts, wearers):
    network, statistics = parts(SHAPES[0])
    inputs = wearers(1, 26)
    x = (network_inputs(*inputs, "root", True) - statistics.input_mean) / statistics.input_std
    with torch.no_grad():
        first = torch.nn.Linear(26 * 60, 4)
        first.weight.copy_(network.first.weight.transpose(1, 2).flatten(1))
        first.bias.copy_(network.first.bias)
        hidden = torch.relu(first(x.flatten(1)))
        for layer in network.others:
            hidden = torch.relu(layer(hidden))
        close(network(x)[0][:, 20], network.heads.mean(hidden))


def test_archive_on_disk(made, shape, tmp_path, wearers):
    network, _, module = made
    about = describe("small", network, CHECKPOINT, 99, 99)
    save(module, tmp_path / "small.pt", about)
    info = archives.read_info(tmp_path / "small.pt")
    assert (info.metadata["past"], info.metadata["future"]) == (network.past, network.future)
    assert f"{network.past} past" in card(info.metadata)
    loaded = archives.load(info, trust=True)
    orientation, acceleration = (x[0].numpy() for x in wearers(1, 40))
    engine = StreamEngine(loaded, 0, network.future)
    rows = zip(orientation, acceleration, strict=True)
    outputs = [engine.push(t, *row) for t, row in enumerate(rows)] + [engine.finish()]
    run = np.array([one.rotations for some in outputs for one in some])
    turns = Rotation.random(40 * 24, random_state=1).as_matrix().reshape(40, 24, 3, 3)
    take = Take("made up", orientation, acceleration, turns.astype(np.float32), "free")
    modes = evaluation.modes_of(info.metadata)
    assert modes == [Mode("stream", 0, network.future), Mode("offline")]
    for mode in modes:
        np.testing.assert_allclose(evaluation.run_archive(loaded, [take], mode)[0], run, atol=3e-5)


@pytest.mark.parametrize("scheme", ["heading", "sequence"])
@pytest.mark.parametrize("kind", ["birnn", "rnn", "feed-forward", "wavenet"])
def test_normalisations_of_appendix_c(parts, wearers, kind, scheme):
    """A wearer who faces elsewhere gets the same pose; in each way of running."""
    network, statistics = parts(NetworkShape(kind, 8, normalisation=scheme))
    module = script(network, statistics)
    future = 2 if kind in ("birnn", "feed-forward") else 0
    orientation, acceleration = wearers(1, 12)
    turn = torch.tensor(Rotation.from_euler("y", 1.1).as_matrix()).float()
    turned = turn @ orientation, (turn @ acceleration.unsqueeze(-1)).squeeze(-1)
    with torch.no_grad():
        for run in (
            lambda o, a: module(o, a)[0],
            lambda o, a: module.window(o, a, 7)[0],
            lambda o, a: streamed(module, o, a, future)[0],
        ):
            here, there = run(orientation, acceleration), run(*turned)
            close(there[..., 1:, :, :], here[..., 1:, :, :], atol=1e-4)
            close(there[..., 0, :, :], turn @ here[..., 0, :, :], atol=1e-5)
        whole = module(orientation, acceleration)[0]
        close(whole[..., 0, :, :], orientation[..., -1, :, :], atol=1e-5)
        if kind == "rnn":
            close(streamed(module, orientation, acceleration, 0)[0], whole)
        plain = build(network, statistics)(orientation, acceleration)[0]
        close(plain, whole)


@pytest.mark.parametrize("kind", ["birnn", "feed-forward"])
def test_without_accelerations(parts, wearers, kind):
    network, statistics = parts(NetworkShape(kind, 8, acceleration=False))
    module = script(network, statistics)
    orientation, acceleration = wearers(1, 12)
    with torch.no_grad():
        close(module(orientation, acceleration)[0], module(orientation, 0 * acceleration)[0], atol=0)
    assert "accelerations of" not in card(describe("x", network, CHECKPOINT, 20, 5))
