"""The head for the place: labels that training reads, its loss, its training, its methods in archives."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.inference.archive import load, read_info
from edgepose.inference.features import network_input
from edgepose.inference.quantisation import pack_weights
from edgepose.pose import CONTACTS
from edgepose.skeleton import default_body
from edgepose_export.archive.torchscript import script
from edgepose_export.mocap import read_motion, resample
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.synthesis.augmentation import Augmentation
from edgepose_export.synthesis.contacts import contacts, level_velocity
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.config import TrainConfig, config_from
from edgepose_export.training.dataset import read_take, tape
from edgepose_export.training.place import contact_weights, place_accuracy, place_counts, place_loss
from edgepose_export.training.trainer import Trainer, fit, read_checkpoint

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"
SHAPE = NetworkShape("rnn", 8, "global-6d", "passed", place=True)
CONFIG = TrainConfig(
    network=SHAPE,
    augmentation=Augmentation(0.5),
    steps=12,
    sequences=8,
    window=20,
    input_dropout=0.0,
    learning_rate=0.02,
    validate_every=6,
    place_loss=1.0,
)
ABOUT = {"summary": "walks", "licenses": ["free"], "takes": 1, "hours": 0.001}


@pytest.fixture(scope="module")
def walk():
    return resample(read_motion(WALK))


@pytest.fixture(scope="module")
def arrays(walk):
    return recording_arrays(walk, virtual_imus(walk, default_body()), "free")


def take_of(folder, arrays, **changed):
    """The take that training reads; what is changed to None is left out."""
    path = folder / "take.npz"
    np.savez(path, **{k: v for k, v in (arrays | changed).items() if v is not None})
    return read_take(path)


@pytest.fixture(scope="module")
def take(arrays, tmp_path_factory):
    return take_of(tmp_path_factory.mktemp("walk"), arrays)


def trainer(take, config=CONFIG):
    return Trainer(config, tape([take]), tape([take]), dict(ABOUT))


# --- labels -------------------------------------------------------------------------------------------------


def test_recordings_have_contacts_and_velocity(walk, arrays, take):
    joints = virtual_imus(walk, default_body()).joints
    np.testing.assert_array_equal(arrays["contact"], contacts(joints, 60.0))
    expected = level_velocity(walk.translation, walk.rotations[:, 0], 60.0)
    np.testing.assert_allclose(arrays["velocity"], expected, atol=1e-5)
    assert (arrays["contact"].dtype, arrays["velocity"].dtype) == (np.uint8, np.float32)
    np.testing.assert_array_equal(take.place, np.concatenate([arrays["contact"], arrays["velocity"]], 1))
    assert take.place.dtype == np.float32
    assert np.median(take.place[:, 9]) > 0.5  # forwards


@pytest.mark.parametrize("missing", ["contact", "velocity"])
def test_recordings_of_older_versions_have_unknown_places(arrays, take, tmp_path, missing):
    old = take_of(tmp_path, arrays, **{missing: None})
    assert old.place is None
    together = tape([old, take])
    assert together.place.shape == (2 * len(take.pose), 10)
    assert together.place[: len(take.pose)].isnan().all()
    assert torch.equal(together.place[len(take.pose) :], torch.from_numpy(take.place))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("contact", lambda x: x[:, :6], "contacts are not 0 or 1"),
        ("contact", lambda x: x * 2, "contacts are not 0 or 1"),
        ("contact", lambda x: x.astype(float), "contacts are not 0 or 1"),
        ("contact", lambda x: x[0, 0], "contacts are not 0 or 1"),
        ("contact", lambda x: -x.astype(np.int8), "contacts are not 0 or 1"),
        ("velocity", lambda x: x[1:], "a velocity is not finite, or absurd"),
        ("velocity", lambda x: x * np.nan, "a velocity is not finite, or absurd"),
        ("velocity", lambda x: x.astype(str), "a velocity is not finite, or absurd"),
    ],
)
def test_labels_that_cannot_be(arrays, tmp_path, name, value, message):
    with pytest.raises(EdgeposeError, match=message):
        take_of(tmp_path, arrays, **{name: value(arrays[name])})


def test_labels_that_are_shorter_than_the_poses(arrays, tmp_path):
    short = {name: arrays[name][1:] for name in ("contact", "velocity")}
    with pytest.raises(EdgeposeError, match="differ in length"):
        take_of(tmp_path, arrays, **short)


# --- loss ---------------------------------------------------------------------------------------------------


def test_unknown_frames_do_not_count():
    generator = torch.Generator().manual_seed(0)
    output = torch.randn(2, 8, 10, generator=generator, requires_grad=True)
    target = torch.randn(2, 8, 10, generator=generator)
    target[..., :7] = (target[..., :7] > 0).float()
    weights = torch.arange(1.0, 8.0)
    known = torch.rand(2, 8, generator=generator) > 0.4
    expected = place_loss(output[known], target[known], weights)
    contact = torch.nn.functional.binary_cross_entropy(
        output[known][:, :7].sigmoid(), target[known][:, :7], weight=weights
    )
    error = (output[known][:, 7:] - target[known][:, 7:]).abs()
    huber = torch.where(error < 0.1, 5.0 * error.square(), error - 0.05).mean()
    torch.testing.assert_close(expected, contact + huber)
    some = torch.where(known[..., None], target, torch.nan)
    got = place_loss(output, some, weights)
    torch.testing.assert_close(got, expected)
    got.backward()
    assert output.grad.isfinite().all()
    assert not output.grad[~known].any()
    torch.testing.assert_close(place_counts(output, some), place_counts(output[known], target[known]))
    nothing = place_loss(output, torch.full_like(target, torch.nan), weights)
    assert nothing == 0.0
    assert place_accuracy(place_counts(output, torch.full_like(target, torch.nan))) == {}


def test_a_network_that_only_knows_the_shares_loses_as_much_on_each_contact(take):
    share = torch.tensor([0.6, 0.5, 0.7, 0.3, 0.1, 0.9, 0.2])
    place = torch.zeros(1000, 10)
    place[:, :7] = (torch.arange(1000)[:, None] < 1000 * share).float()
    known = tape([take])._replace(place=torch.cat([place, torch.full((50, 10), torch.nan)]))
    weights = contact_weights(known)
    output = torch.zeros(1000, 10)
    for i in range(7):
        output[:, :7] = torch.logit(share)
        only = torch.zeros(7)
        only[i] = weights[i]
        torch.testing.assert_close(place_loss(output, place, only), torch.tensor(1 / 7))
    never = contact_weights(known._replace(place=torch.zeros(9, 10)))
    assert never.isfinite().all()


def test_accuracy_is_balanced():
    target = torch.zeros(10, 10)
    target[:8, :4] = 1.0
    target[:, 9] = 1.0
    always = torch.zeros(10, 10)
    always[:, :4] = 5.0
    assert place_accuracy(place_counts(always, target)) == {"contact": 0.5, "velocity": 1.0}
    right = torch.where(target[:, :7] > 0, 2.0, -2.0)
    best = place_accuracy(place_counts(torch.cat([right, target[:, 7:]], 1), target))
    assert best == {"contact": 1.0, "velocity": 0.0}
    probabilities = torch.cat([right.sigmoid(), target[:, 7:]], 1)
    assert place_accuracy(place_counts(probabilities, target, threshold=0.5)) == best


# --- training -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "streamed", "bf16", "right"),
    [("rnn", 0, False, 0.5), ("birnn", 0, True, 0.75), ("birnn", 3, False, 0.75)],
)
def test_the_head_is_trained_in_the_same_run(take, tmp_path, kind, streamed, bf16, right):
    config = replace(
        CONFIG,
        network=SHAPE._replace(kind=kind, hidden=16),
        augmentation=Augmentation(0.0),
        streamed=streamed,
        bf16=bf16,
        place_loss=10.0,
        learning_rate=0.03,
        warm_up=0,
        steps=40,
        validate_every=20,
    )
    one, lines = trainer(take, config), []
    before = one.validate()
    fit(one, tmp_path, lambda step, loss: None, lines.append)
    assert [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()] == lines
    assert set(lines[-1]) == {"step", "train", "validation", "contact", "velocity"}
    assert lines[-1]["velocity"] < 0.8 * before["velocity"]
    assert lines[-1]["contact"] > right
    # The pose alone decides which checkpoint is the best.
    assert one.best == min(line["validation"] for line in lines)


def test_the_pose_is_trained_as_without_the_head(take):
    """A head with hardly any weight leaves everything else as it is, to the bit."""
    plain = trainer(take, replace(CONFIG, network=SHAPE._replace(place=False)))
    one = trainer(take, replace(CONFIG, place_loss=1e-30))
    for name, weights in plain.network.state_dict().items():
        one.network.state_dict()[name].copy_(weights)
    one.generator.set_state(plain.generator.get_state())
    for _ in range(2):
        assert one.train_step() == plain.train_step()
    for name, weights in plain.network.state_dict().items():
        torch.testing.assert_close(one.network.state_dict()[name], weights)
    assert set(plain.validate()) == {"validation"}


def test_takes_without_labels_train_the_pose_only(take, tmp_path):
    one = trainer(take._replace(place=None))
    head = one.network.place.weight.clone()
    assert np.isfinite(one.train_step())
    assert torch.equal(one.network.place.weight, head)
    assert set(one.validate()) == {"validation"}


def test_fine_tuning_starts_a_head_that_the_checkpoint_lacks(take, tmp_path):
    first = trainer(take, replace(CONFIG, network=SHAPE._replace(place=False), steps=2, validate_every=2))
    fit(first, tmp_path, lambda step, loss: None, lambda line: None)
    state = read_checkpoint(tmp_path / "best.pt")
    one = trainer(take)
    head = one.network.place.weight.clone()
    one.start_from(state)
    for network in (one.network, one.averaged):
        weights = network.state_dict()
        assert torch.equal(weights["place.weight"], head)
        assert all(torch.equal(weights[name], value) for name, value in state["averaged"].items())
    assert np.isfinite(one.train_step())
    # And back again, without the head.
    back = trainer(take, replace(CONFIG, network=SHAPE._replace(place=False)))
    back.start_from(one.state())
    assert torch.equal(back.network.mean.weight, one.averaged.mean.weight)
    with pytest.raises(EdgeposeError, match="the checkpoint holds"):
        one.load(first.state())  # within a run nothing may change


@pytest.mark.parametrize(
    ("network", "weight", "message"),
    [
        ({"kind": "wavenet"}, 1.0, 'place needs kind = "birnn" or "rnn"'),
        ({"kind": "rnn", "normalisation": "sequence"}, 1.0, "place needs another normalisation"),
        ({"kind": "rnn"}, 0.0, "place needs place_loss"),
    ],
)
def test_configs_that_cannot_be(network, weight, message):
    with pytest.raises(ValueError, match=message):
        config_from({"network": {"place": True, **network}, "place_loss": weight})


# --- archives -----------------------------------------------------------------------------------------------

SHAPES = [
    SHAPE,
    SHAPE._replace(kind="birnn"),
    SHAPE._replace(kind="birnn", smoothing=0.6),
]


@pytest.fixture(params=SHAPES, ids=lambda shape: f"{shape.kind}-{shape.smoothing}")
def shape(request):
    return request.param


def close(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=2e-5)


@torch.no_grad()
def test_archive_computes_what_training_computed(shape, parts, tiny, wearers):
    network, statistics = parts(shape)
    orientation, acceleration = wearers(2, 9)
    module = tiny(shape)
    rotations, std, place = module.forward_place(orientation, acceleration)
    assert place.shape == (2, 9, len(CONTACTS) + 3)
    x = (network_input(orientation, acceleration) - statistics.input_mean) / statistics.input_std
    expected = network(x)[2]
    close(place, torch.cat([expected[..., :7].sigmoid(), expected[..., 7:]], -1))
    assert place[..., :7].std() > 0.02
    for got, wanted in zip((rotations, std), module(orientation, acceleration), strict=True):
        assert torch.equal(got, wanted)
    for index in (0, 4, 8):
        pose = module.window_place(orientation, acceleration, index)
        close(pose[2], module.forward_place(orientation, acceleration)[2][:, index] if shape.kind == "birnn"
              else place[:, index])  # fmt: skip
        for got, wanted in zip(pose[:2], module.window(orientation, acceleration, index), strict=True):
            assert torch.equal(got, wanted)


def streamed(module, inputs, future, many):
    """Outputs of a stream with the place and without it, each joined over time."""
    state, plain = module.start(2, future), module.start(2, future)
    with_place, without = [], []
    step = many or 1
    for t in range(0, inputs[0].shape[1], step):
        part = [x[:, t : t + step] if many else x[:, t] for x in inputs]
        *pose, state = (module.stream_many_place if many else module.stream_place)(*part, state)
        with_place.append(pose)
        *pose, plain = (module.stream_many if many else module.stream)(*part, plain)
        without.append(pose)
    with_place.append(module.drain_place(state))
    without.append(module.drain(plain))
    return [
        [torch.cat(column, dim=1) for column in zip(*rows, strict=True)] for rows in (with_place, without)
    ]


@pytest.mark.parametrize("many", [0, 4])
@torch.no_grad()
def test_a_stream_has_the_place_of_every_frame(shape, tiny, wearers, many):
    module, inputs = tiny(shape), wearers(2, 10)
    future = 3 if shape.kind == "birnn" else 0
    (rotations, std, place), (same_rotations, same_std) = streamed(module, inputs, future, many)
    assert torch.equal(rotations, same_rotations)
    assert torch.equal(std, same_std)
    assert place.shape == (2, 10, 10)
    if shape.kind == "rnn":
        close(place, module.forward_place(*inputs)[2])
    else:
        # A stream of a bidirectional network is that of training, whose last frames have no future.
        whole, _ = streamed(module, inputs, 9, many)
        close(whole[2][:, :1], module.forward_place(*inputs)[2][:, :1])


@torch.no_grad()
def test_a_streamed_bidirectional_network_is_that_of_training(parts, tiny, wearers):
    network, statistics = parts(SHAPES[1])
    inputs = wearers(2, 10)
    x = (network_input(*inputs) - statistics.input_mean) / statistics.input_std
    expected = network(x, 3)[2]
    place = streamed(tiny(SHAPES[1]), inputs, 3, 0)[0][2]
    close(place[:, :7], torch.cat([expected[..., :7].sigmoid(), expected[..., 7:]], -1))


@torch.no_grad()
def test_without_a_head_nothing_changes(shape, parts, wearers):
    network, statistics = parts(shape)
    plain, _ = parts(shape._replace(place=False))
    plain.load_state_dict({k: v for k, v in network.state_dict().items() if not k.startswith("place")})
    inputs = wearers(1, 6)
    module, other = script(network, statistics), script(plain, statistics)
    for got, wanted in zip(module(*inputs), other(*inputs), strict=True):
        assert torch.equal(got, wanted)
    assert not [name for name in dir(other) if name.endswith("_place")]
    assert sum(p.numel() for p in other.buffers()) < sum(p.numel() for p in module.buffers())


def test_metadata_say_what_the_archive_has(write_archive, tmp_path):
    def metadata(shape):
        with zipfile.ZipFile(write_archive(tmp_path / "small.pt", shape)) as archive:
            (name,) = (name for name in archive.namelist() if name.endswith("extra/edgepose.json"))
            return json.loads(archive.read(name))

    expected = {"contacts": list(CONTACTS), "velocity": "level pelvis frame, m/s"}
    assert metadata(SHAPE)["place"] == expected
    assert "place" not in metadata(SHAPE._replace(place=False))
    assert [kind for kind, about in NETWORKS.items() if about.placed] == ["birnn", "rnn"]


@pytest.mark.parametrize("precision", ["fp16", "int8"])
@torch.no_grad()
def test_packed_weights_keep_the_head(parts, wearers, precision):
    module, inputs = script(*parts(SHAPE)), wearers(1, 6)
    before = module.forward_place(*inputs)[2]
    pack_weights(module, precision)
    after = module.forward_place(*inputs)[2]
    assert (after - before).abs().max() < 0.2
    assert not torch.equal(after, before)


def edgepose(*words):
    """Output of a command that has to succeed."""
    done = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_training_export_and_evaluation_report_the_head(arrays, tmp_path):
    recordings, run, path = tmp_path / "recordings", tmp_path / "run", tmp_path / "tiny.pt"
    recordings.mkdir()
    for name in ("01_01", "03_01"):
        np.savez(recordings / f"{name}.npz", **arrays)
    old = {key: value for key, value in arrays.items() if key != "contact"}
    np.savez(recordings / "07_01.npz", **old)
    (tmp_path / "tiny.toml").write_text(
        "steps = 2\nsequences = 4\nwindow = 20\nvalidate_every = 2\nplace_loss = 0.3\n"
        "[network]\nkind = 'rnn'\nhidden = 8\nplace = true\n"
    )
    data = ("--data", recordings)
    said = edgepose("train", "--config", tmp_path / "tiny.toml", *data, "--out", run, "--threads", 1)
    (line,) = (line for line in said.splitlines() if "step 2 of 2" in line)
    log = json.loads((run / "log.jsonl").read_text())
    assert f"contacts {100 * log['contact']:.1f} %, velocity off by {log['velocity']:.2f} m/s," in line
    edgepose("export", run / "checkpoint.pt", "--out", path, "--measure", recordings)
    info = read_info(path)
    assert "place_accuracy" not in info.metadata  # the held-out take has no labels
    card = (tmp_path / "tiny.md").read_text()
    assert "left_ankle, right_ankle, left_foot, right_foot, pelvis, left_wrist, right_wrist; velocity" in card
    assert "### Contacts" not in card
    (recordings / "07_01.npz").unlink()
    edgepose("export", run / "checkpoint.pt", "--out", path, "--measure", recordings, "--overwrite")
    info = read_info(path)
    take = read_take(recordings / "03_01.npz")
    with torch.no_grad():
        whole = load(info, trust=True).forward_place(
            torch.from_numpy(take.orientation)[None], torch.from_numpy(take.acceleration)[None]
        )[2][0]
    expected = place_accuracy(place_counts(whole, torch.from_numpy(take.place), threshold=0.5))
    assert info.metadata["place_accuracy"] == {"validation": pytest.approx(expected, abs=1e-4)}
    row = f"| validation | {100 * expected['contact']:.1f} | {expected['velocity']:.2f} |"
    assert "### Contacts and velocity\n\n" in (tmp_path / "tiny.md").read_text()
    assert row in (tmp_path / "tiny.md").read_text()
    said = edgepose("evaluate", "--model", path, "--trust", *data, "--part", "validation")
    assert said.splitlines()[-1] == (
        f"validation, tiny streamed: contacts of the feet {100 * expected['contact']:.1f} % right, "
        f"velocity off by {expected['velocity']:.2f} m/s"
    )
