import json
import pickle
import resource
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from edgepose.errors import EdgeposeError
from edgepose.inference.features import network_input
from edgepose.placements import BONES, ROOT
from edgepose.skeleton import PARENTS, PREDICTED, default_body
from edgepose_export.archive.torchscript import Statistics
from edgepose_export.mocap import read_motion, resample
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape, PoseDecoder, smoothed
from edgepose_export.synthesis.augmentation import Augmentation, augment
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training import trainer as training
from edgepose_export.training.config import TrainConfig, config_from
from edgepose_export.training.dataset import read_take, tape, training_paths
from edgepose_export.training.sources import SOURCES
from edgepose_export.training.trainer import Trainer, read_checkpoint, save_checkpoint
from edgepose_export.training.windows import sample_windows, window_starts, windows

DATA = Path(__file__).parents[1] / "data" / "mocap"
SMALL = TrainConfig(
    network=NetworkShape("rnn", 8, "global-6d", "passed"),
    augmentation=Augmentation(0.5, 4.0, 3.0, 0.1, 0.02),
    beta=0.5,
    steps=12,
    sequences=4,
    window=20,
    shares={"cmu": 0.25},
    input_dropout=0.1,
    averaging=0.9,
    validate_every=4,
)
ABOUT = {"summary": "walks", "licenses": ["free"], "takes": 3, "hours": 0.001}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Recordings on disk: two of Bandai-Namco, one of CMU."""
    folder = tmp_path_factory.mktemp("recordings")
    sources = {
        "dataset-2_walk_normal_001": "dataset-2_walk_normal_001.bvh",
        "dataset-2_raise-up-right-hand_normal_001": "dataset-2_raise-up-right-hand_normal_001.bvh",
        "01_01": "07_01.bvh",
    }
    for name, source in sources.items():
        motion = resample(read_motion(DATA / source))
        imus, source = virtual_imus(motion, default_body()), SOURCES[motion.source]
        arrays = recording_arrays(motion, imus, source.license, source.name)
        np.savez(folder / f"{name}.npz", **arrays)
    return folder


@pytest.fixture(scope="module")
def takes(files):
    return [read_take(path) for path in sorted(files.glob("*.npz"))]


def trainer(takes, config=SMALL):
    return Trainer(config, tape(takes), tape(takes[-1:]), dict(ABOUT))


def fit(one, folder):
    losses, validations = [], []
    training.fit(one, folder, lambda step, loss: losses.append(loss), validations.append)
    return losses, validations


def same(a, b):
    """Two nested states hold the same bits."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


# --- loss and targets ---------------------------------------------------------------------------------------


def test_targets_are_what_the_decoder_turns_into_the_pose(shape, takes):
    together = tape(takes)
    statistics = training.compute_statistics(together, shape)
    targets = training.pose_targets(together.relative, shape)
    mean = (targets - statistics.target_mean) / statistics.target_std
    pose, _ = PoseDecoder(shape, *statistics[2:])(together.orientation, mean, torch.ones_like(mean))
    truth = torch.cat([torch.from_numpy(take.pose) for take in takes])
    chosen = [0, *PREDICTED]
    torch.testing.assert_close(pose[:, chosen], truth[:, chosen], rtol=0, atol=2e-4)


def test_tape(takes):
    together = tape(takes)
    assert together.names == [take.name for take in takes]
    for i, take in enumerate(takes):
        part = slice(int(together.starts[i]), int(together.starts[i + 1]))
        assert torch.equal(together.orientation[part], torch.from_numpy(take.orientation))
        assert torch.equal(together.acceleration[part], torch.from_numpy(take.acceleration))
        # Global rotations as seen from the pelvis: those of the bones with sensors are known.
        seen = together.orientation[part, -1:].mT @ together.orientation[part]
        torch.testing.assert_close(together.relative[part][:, [18, 19, 4, 5, 15, 0]], seen, rtol=0, atol=1e-4)
        for joint in (1, 16):
            local = together.relative[part, PARENTS[joint]].mT @ together.relative[part, joint]
            torch.testing.assert_close(local, torch.from_numpy(take.pose)[:, joint], rtol=0, atol=1e-5)


def test_statistics(takes):
    together = tape(takes)
    local = training.compute_statistics(together, NetworkShape("rnn", 8))
    targets = training.pose_targets(together.relative, NetworkShape("rnn", 8))
    assert targets.shape[1] == 135
    torch.testing.assert_close(local.target_mean, targets.mean(0))
    torch.testing.assert_close(local.target_std, targets.std(0).clamp_min(1e-2))
    # In the root's frame a degree weighs the same at every joint.
    common = training.compute_statistics(together, SMALL.network).target_std
    assert common.shape == (60,)
    assert common.unique().numel() == 1
    assert all(torch.isfinite(x).all() and (x > 0).all() for x in (local.input_std, common))


def test_loss_is_the_likelihood():
    generator = torch.Generator().manual_seed(0)
    mean, target = torch.randn(2, 5, 7, generator=generator)
    deviation = 0.1 + torch.rand(5, 7, generator=generator)
    expected = -torch.distributions.Normal(mean, deviation).log_prob(target)
    got = training.likelihood_loss(mean, deviation, target, 0.0)
    torch.testing.assert_close(got, expected.mean() - 0.5 * np.log(2 * np.pi))
    # The weight of the beta-likelihood has no gradient of its own.
    deviation.requires_grad_()
    training.likelihood_loss(mean, deviation, target, 0.5).backward()
    plain = 1 / deviation - (target - mean).square() / deviation**3
    torch.testing.assert_close(deviation.grad, (plain * deviation / 35).detach())


def test_trembling_costs_and_a_steady_error_does_not(takes):
    true = torch.linspace(0, 1, 9)[None, :, None].expand(2, 9, 3)
    steady = true + torch.linspace(0.1, 0.5, 9)[:, None]
    trembling = true + 0.1 * torch.tensor([1.0, -1.0]).repeat(5)[:9, None]
    assert training.smoothness_loss(steady, true) < 1e-12
    torch.testing.assert_close(training.smoothness_loss(trembling, true), torch.tensor(0.4**2))
    smooth = replace(SMALL, smoothness=100.0)

    def trembles(config, takes):
        one = trainer(takes, replace(config, warm_up=0, learning_rate=1e-2))
        for _ in range(60):
            one.train_step()
        x, _ = one.averaged(torch.randn(4, 20, 60, generator=torch.Generator().manual_seed(1)))
        return training.smoothness_loss(x, torch.zeros_like(x))

    assert trembles(smooth, takes) < 0.5 * trembles(SMALL, takes)


def test_accelerations_are_reconstructed_too(takes):
    """The loss of a network that says 0 +- 1 for everything is half the mean square of all its targets."""
    one = trainer(takes, replace(SMALL, beta=0.0))

    def zero(x):
        nothing = torch.zeros(*x.shape[:-1], 60 + 15)
        return nothing, nothing + 1

    batch = windows(one.train_tape, torch.tensor([0]), 20)
    s = one.statistics
    targets = (training.pose_targets(batch[2], SMALL.network) - s.target_mean) / s.target_std
    inputs = network_input(*batch[:2])[..., -15:]
    accelerations = (inputs - s.input_mean[-15:]) / s.input_std[-15:]
    expected = 0.5 * torch.cat([targets, accelerations], -1).square().mean()
    torch.testing.assert_close(one._loss(zero, batch, 0.0), expected)


# --- batches ------------------------------------------------------------------------------------------------


def test_windows_stay_inside_takes(takes):
    together = tape(takes)
    ends = together.starts.tolist()
    for joined in (False, True):
        starts = window_starts(together, 20, joined, shares=["cmu"])
        others, cmu = starts[""], starts["cmu"]
        assert set(cmu.tolist()) <= set(range(ends[0], ends[1]))  # 01_01 comes first
        for start in torch.cat([others, cmu]).tolist():
            inside = any(a <= start and start + 20 <= b for a, b in pairwise(ends))
            assert inside or (joined and start + 20 <= ends[-1])
    assert len(window_starts(together, 20, False)[""]) == sum(len(take.pose) - 19 for take in takes)
    assert len(window_starts(together, 20, True)[""]) == ends[-1] - 19


@pytest.mark.parametrize(
    ("shares", "counts"),
    [
        ({"cmu": 0.25}, {"": 30, "cmu": 10}),
        ({"cmu": 0.5, "bandai": 0.5}, {"cmu": 20, "bandai": 20}),
        ({"cmu": 0.1, "bandai": 0.1, "snu": 0.5}, {"cmu": 20, "bandai": 20}),  # no take of snu
        ({"snu": 1.0}, {"": 40}),
        ({"cmu": 0.0, "bandai-namco": 0.0}, {"cmu": 20, "bandai-namco": 20}),
        ({}, {"": 40}),
    ],
)
def test_shares_of_sources(takes, shares, counts):
    starts = window_starts(tape(takes), 20, False, shares=shares)
    drawn = sample_windows(starts, 40, shares, torch.Generator().manual_seed(0)).tolist()
    assert len(drawn) == 40
    found = {name: len([start for start in drawn if start in group]) for name, group in starts.items()}
    assert {name: count for name, count in found.items() if count} == counts


def test_share_of_made_sitting(takes):
    made = [takes[0]._replace(name=f"{takes[0].name}.seated"), *takes[1:]]
    config = replace(SMALL, sequences=8, seated_share=0.25, shares={})
    one = Trainer(config, tape(made), tape(takes), ABOUT)
    end = len(made[0].pose)
    assert (one.starts[""] >= end).all()
    assert len(one.made_starts[".seated"][""]) == end - 19
    # A run that does not ask for them takes them like others.
    plain = Trainer(SMALL, tape(made), tape(takes), ABOUT)
    assert (torch.cat(list(plain.starts.values())) < end).any()
    assert one.train_step() != plain.train_step()


def test_shares_of_made_takes(takes):
    """Each kind of made takes has its own share, whether or not there are takes of the other."""
    sitting, resting = (takes[0]._replace(name=f"take.{kind}") for kind in ("seated", "rests"))
    config = replace(SMALL, sequences=16, seated_share=0.25, rests_share=0.5)
    end = len(sitting.pose)
    for made, expected in (([sitting, resting], (4, 8)), ([sitting], (4,)), ([resting], (8,))):
        one = Trainer(config, tape([*made, *takes]), tape(takes), ABOUT)
        drawn = one._drawn_starts(16)
        assert len(drawn) == 16
        for i, count in enumerate(expected):
            assert ((drawn >= i * end) & (drawn < (i + 1) * end)).sum() == count
        assert (drawn >= len(made) * end).sum() == 16 - sum(expected)
    whole = replace(config, seated_share=0.5, sequences=3)
    one = Trainer(whole, tape([sitting, resting, *takes]), tape(takes), ABOUT)
    assert len(one._drawn_starts(3)) == 3


@pytest.mark.parametrize("joined", [False, True])
def test_windows_with_made_sitting_keep_their_pelvis(takes, monkeypatch, joined):
    """Its pitch is what tells sitting from standing."""
    made = [takes[0], takes[1]._replace(name=f"{takes[1].name}.seated"), *takes[2:]]
    how = Augmentation(mirror=0.0, pelvis_pitch_deg=40.0)
    config = replace(SMALL, sequences=64, seated_share=0.5, shares={}, joined=joined, augmentation=how)
    one = Trainer(config, tape(made), tape(takes), ABOUT)
    first, length = len(made[0].pose), len(made[1].pose)
    sitting = [
        start for start in range(len(one.has_sitting)) if first - config.window < start < first + length
    ]
    assert one.has_sitting.nonzero().flatten().tolist() == sitting
    batches = []

    def recorded(batch, how, generator):
        result = augment(batch, how, generator)
        batches.append((len(batch[0]), (batch[2], result[2])))
        return result

    monkeypatch.setattr(training, "augment", recorded)
    one.train_step()
    (plain, turned), (seated, kept) = batches
    assert plain + seated == 64
    assert seated >= 32 if joined else seated == 32
    assert torch.equal(*kept)
    assert ((turned[0] - turned[1]).abs().amax((1, 2, 3, 4)) > 1e-3).all()


def test_windows_of_other_bodies(takes):
    """Accelerations and velocities are of another size, poses as before."""
    how = Augmentation(mirror=0.0, stature=0.1)
    one = Trainer(replace(SMALL, augmentation=how), tape(takes), tape(takes), ABOUT)
    starts = one.starts[""][:30]
    plain, batch = windows(one.train_tape, starts, one.config.window), one._batch(starts)
    order = torch.argsort(one.has_sitting[starts].int(), stable=True)
    factor = batch.acceleration / plain.acceleration[order]
    torch.testing.assert_close(factor, factor[:, :1, :1, :1].expand_as(factor), rtol=1e-3, atol=1e-3)
    assert 0.05 < factor[:, 0, 0, 0].std() < 0.15
    assert torch.equal(batch.relative, plain.relative[order])
    torch.testing.assert_close(
        batch.place[..., 7:], factor[:, :1, 0, :1] * plain.place[order][..., 7:], equal_nan=True
    )


def test_windows_in_other_postures(takes):
    """Sensors of the pelvis stay, those of other bones go with them, also where takes and the tape end."""
    how = Augmentation(mirror=0.0, posture=1.0)
    one = Trainer(replace(SMALL, joined=True, augmentation=how), tape(takes), tape(takes), ABOUT)
    length, starts = one.config.window, torch.cat(list(one.starts.values())).sort().values
    assert starts[0] == 0
    assert starts.max() == one.train_tape.starts[-1] - length
    plain = windows(one.train_tape, starts, length)
    orientation, acceleration, relative, _ = one._windows(starts)
    assert torch.equal(orientation[:, :, ROOT], plain[0][:, :, ROOT])
    bones = orientation[:, :, ROOT:] @ relative[:, :, list(BONES[:ROOT])]
    torch.testing.assert_close(orientation[:, :, :ROOT], bones)
    assert ((relative - plain[2]).abs().amax((1, 2, 3, 4)) > 1e-3).all()
    assert acceleration.shape == plain[1].shape
    # Postures sway by 0.7 Hz at most: a seam would be felt as 1000 m/s^2.
    assert 0.1 < (acceleration - plain[1]).norm(dim=-1).max() < 30.0


def test_takes_that_are_too_short(takes):
    with pytest.raises(EdgeposeError, match="no training take is as long as the window of 500"):
        trainer(takes, replace(SMALL, window=500))
    with pytest.raises(EdgeposeError, match="no validation take is as long as the window of 50"):
        Trainer(replace(SMALL, window=50), tape(takes), tape(takes[:1]), ABOUT)


def test_own_recordings_without_a_validation_part(files, tmp_path):
    train, validation = training_paths(files)
    assert [path.stem for path in validation] == ["01_01"]
    assert len(train) == 2
    (tmp_path / "a.npz").write_bytes((files / "01_01.npz").read_bytes())
    with pytest.raises(EdgeposeError, match="one recording is not enough"):
        training_paths(tmp_path)
    (tmp_path / "03_01.npz").write_bytes((files / "01_01.npz").read_bytes())
    train, validation = training_paths(tmp_path)
    assert [[path.stem for path in part] for part in (train, validation)] == [["a"], ["03_01"]]


def test_recordings_that_are_all_held_out(tmp_path):
    """The message says that names decide, and to which parts the recordings belong."""
    with pytest.raises(EdgeposeError, match="no recordings; make them with edgepose synthesize"):
        training_paths(tmp_path)
    for name in ("07_01", "08_02", "03_01"):
        (tmp_path / f"{name}.npz").touch()
    message = (
        r"no recording of the part 'train': the names .*sources\.toml.* cmu-03 \(1\), cmu-walk-run \(2\)"
    )
    with pytest.raises(EdgeposeError, match=message):
        training_paths(tmp_path)


def changed(files, path, **arrays):
    with np.load(files / "01_01.npz") as data:
        np.savez(path, **({name: data[name] for name in data.files} | arrays))
    return path


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mocap_framerate": np.array(100.0)}, "--rate 60"),
        ({"head_quat": np.tile([0.5, 0.5, 0.5, 0.5], (30, 1))}, "not aligned with the bones"),
        ({"poses": np.zeros((29, 72))}, "differ in length"),
        ({"poses": np.zeros((30, 156))}, "not a recording with true poses"),
        ({"license": np.array(None)}, "not a recording with true poses"),
        ({"head_acc": np.full((30, 3), np.nan)}, "an acceleration is not finite, or absurd"),
        ({"poses": np.full((30, 72), np.inf)}, "a pose is not finite, or absurd"),
        ({"head_quat": np.zeros((30, 4))}, "a quaternion is not of unit length"),
    ],
)
def test_recordings_that_cannot_be_trained_on(files, tmp_path, arrays, message):
    with pytest.raises(EdgeposeError, match=message):
        read_take(changed(files, tmp_path / "x.npz", **arrays))


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x05\x06" + bytes(18)])
def test_files_that_are_no_recordings(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(EdgeposeError, match="make it with edgepose synthesize"):
        read_take(tmp_path / "x.npz")


# --- runs ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["birnn", "rnn"])
def test_loss_falls(takes, tmp_path, kind):
    shape = SMALL.network._replace(kind=kind)
    config = replace(SMALL, network=shape, beta=0.0, steps=60, learning_rate=0.03, validate_every=30)
    one = trainer(takes, config)
    before = one.validate()["validation"]
    losses, validations = fit(one, tmp_path)
    assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 0.1
    assert one.validate()["validation"] < before - 0.1
    assert [line["step"] for line in validations] == [30, 60]
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert log == validations
    assert set(log[0]) == {"step", "train", "validation"}


@pytest.mark.parametrize("schedule", ["exponential", "cosine"])
@pytest.mark.parametrize("bf16", [False, True])
def test_resumed_run_is_the_uninterrupted_one(takes, tmp_path, bf16, schedule):
    config = replace(SMALL, bf16=bf16, schedule=schedule)
    whole = trainer(takes, config)
    fit(whole, tmp_path)
    first = trainer(takes, config)
    for _ in range(8):
        first.train_step()
    save_checkpoint(first.state(), tmp_path / "half.pt")
    torch.rand(3)  # other use of the random numbers in between
    second = trainer(takes, config)
    second.load(read_checkpoint(tmp_path / "half.pt"))
    assert second.step == 8
    fit(second, tmp_path)
    a, b = whole.state(), second.state()
    for key in ("network", "averaged", "optimiser", "generator", "step", "statistics", "data"):
        assert same(a[key], b[key]), key
    assert not same(a["network"], first.state()["network"])


def test_checkpoints(takes, tmp_path):
    one = trainer(takes)
    fit(one, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["best.pt", "checkpoint.pt", "log.jsonl"]
    state = one.state()
    assert same(read_checkpoint(tmp_path / "checkpoint.pt"), state)
    best = read_checkpoint(tmp_path / "best.pt")
    assert set(best) == {"config", "statistics", "averaged", "step", "data"}
    assert config_from(json.loads(best["config"])) == SMALL
    with pytest.raises(EdgeposeError, match=r"weights only.*--init"):
        trainer(takes).load(best)


def test_average_of_the_weights(takes):
    one = trainer(takes, replace(SMALL, averaging=0.9))
    mean = one.network.dense.weight.detach().clone()
    for step in range(1, 4):
        one.train_step()
        decay = min(0.9, step / (step + 10))
        mean = decay * mean + (1 - decay) * one.network.dense.weight.detach()
    torch.testing.assert_close(one.averaged.dense.weight.detach(), mean)
    plain = trainer(takes, replace(SMALL, averaging=0.0))
    plain.train_step()
    assert same(dict(plain.averaged.state_dict()), dict(plain.network.state_dict()))


def test_full_disk_leaves_the_old_checkpoint(takes, tmp_path):
    one = trainer(takes)
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(one.state(), path)
    old = path.read_bytes()
    one.train_step()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(old) // 2, limits[1]))
    try:
        with pytest.raises(EdgeposeError, match=r"checkpoint\.pt: cannot be written: File too large"):
            save_checkpoint(one.state(), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_no_progress_ends_the_run(takes, tmp_path):
    config = replace(SMALL, learning_rate=1e-12, averaging=0.0, patience=2, validate_every=1, steps=50)
    one = trainer(takes, config)
    one.best = -1e9
    _, validations = fit(one, tmp_path)
    assert len(validations) == 2
    assert not (tmp_path / "best.pt").exists()


@pytest.mark.parametrize("where", ["training", "validation"])
def test_nan_ends_the_run_and_is_not_saved(takes, tmp_path, where):
    one = trainer(takes)
    broken = one.train_tape if where == "training" else one.validation_tape
    broken.acceleration[:] = float("nan")
    with pytest.raises(EdgeposeError, match=r"loss is nan at step.*lower learning rate"):
        fit(one, tmp_path)
    assert not list(tmp_path.iterdir())


def test_fine_tuning_starts_from_the_average(takes, tmp_path):
    first = trainer(takes)
    fit(first, tmp_path)
    state = read_checkpoint(tmp_path / "best.pt")
    own = {"summary": "my walks", "licenses": ["mine"], "takes": 1, "hours": 0.5}
    tuned = Trainer(replace(SMALL, seed=4), tape(takes), tape(takes[-1:]), own)
    tuned.start_from(state)
    assert tuned.step == 0
    assert same(dict(tuned.network.state_dict()), state["averaged"])
    assert same(dict(tuned.averaged.state_dict()), state["averaged"])
    assert same(tuned.statistics._asdict(), state["statistics"])
    assert tuned.data["summary"] == "walks, then my walks"
    assert tuned.data["licenses"] == ["free", "mine"]
    assert (tuned.data["takes"], tuned.data["hours"]) == (4, 0.501)
    assert np.isfinite(tuned.train_step())
    smoother = trainer(takes, replace(SMALL, network=SMALL.network._replace(smoothing=0.5)))
    smoother.start_from(state)  # what is behind the weights may change, but not within a run
    assert same(dict(smoother.network.state_dict()), state["averaged"])
    with pytest.raises(EdgeposeError, match=r"the checkpoint holds.*smoothing=0\.0"):
        smoother.load(first.state())
    other = trainer(takes, replace(SMALL, network=SMALL.network._replace(kind="birnn")))
    for start in (other.start_from, other.load):
        with pytest.raises(EdgeposeError, match="the checkpoint holds"):
            start(first.state())


# --- checkpoints of strangers -------------------------------------------------------------------------------


class Writer:
    """Pickles to a call that writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "run")


@pytest.mark.parametrize("form", ["torch", "pickle"])
def test_code_in_a_checkpoint_is_not_run(takes, tmp_path, form):
    target, path = tmp_path / "written", tmp_path / "evil.pt"
    state = trainer(takes).state() | {"step": Writer(target)}
    if form == "torch":
        torch.save(state, path)
    else:
        path.write_bytes(pickle.dumps(state))
    with pytest.raises(EdgeposeError, match="not a checkpoint of edgepose train"):
        read_checkpoint(path)
    assert not target.exists()
    torch.load(path, weights_only=False) if form == "torch" else pickle.loads(path.read_bytes())
    assert target.exists()


def test_files_that_are_no_checkpoints(takes, tmp_path):
    path = tmp_path / "x.pt"
    with pytest.raises(EdgeposeError, match=r"x\.pt: No such file"):
        read_checkpoint(path)
    path.write_bytes(b"nothing")
    with pytest.raises(EdgeposeError, match="not a checkpoint of edgepose train"):
        read_checkpoint(path)
    good = trainer(takes).state()
    for change, message in (
        ({"config": None}, "not a checkpoint that"),
        ({"config": '{"steps": "many"}'}, "steps is 'many'"),
        ({"config": "{"}, "not a checkpoint that"),
        ({"averaged": {}}, "not a checkpoint that"),
        ({"averaged": good["averaged"] | {"mean.weight": torch.ones(2)}}, "not a checkpoint that"),
        ({"statistics": {}}, "not a checkpoint that"),
    ):
        torch.save(good | change, path)
        with pytest.raises(EdgeposeError, match=message) as caught:
            read_checkpoint(path)
        assert "\n" not in str(caught.value)
    torch.save({k: v for k, v in good.items() if k != "data"}, path)
    with pytest.raises(EdgeposeError, match="entries are missing"):
        read_checkpoint(path)
    assert Statistics(**good["statistics"]).input_mean.shape == (60,)


@pytest.mark.parametrize(
    ("kind", "normalisation", "acceleration", "inputs"),
    [
        *((kind, "root", True, 60) for kind in NETWORKS if not NETWORKS[kind].streamed),
        ("rnn", "heading", True, 72),
        ("rnn", "sequence", True, 72),
        ("rnn", "root", False, 45),
    ],
)
def test_every_network_learns(takes, tmp_path, kind, normalisation, acceleration, inputs):
    shape = NetworkShape(kind, 8, normalisation=normalisation, acceleration=acceleration)
    config = replace(SMALL, network=shape, beta=0.0, acceleration_loss=acceleration)
    one = trainer(takes, replace(config, steps=50, warm_up=0, learning_rate=0.03, validate_every=50))
    assert one.statistics.input_mean.shape == (inputs,)
    losses, _ = fit(one, tmp_path)
    assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 0.1
    state = read_checkpoint(tmp_path / "checkpoint.pt")
    assert same(state["averaged"], dict(one.averaged.state_dict()))


def test_a_birnn_learns_as_it_streams(takes, tmp_path):
    config = replace(SMALL, network=SMALL.network._replace(kind="birnn"), streamed=5, steps=50)
    one = trainer(takes, replace(config, warm_up=0, learning_rate=0.03, validate_every=50))
    losses, _ = fit(one, tmp_path)
    assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 0.1


def test_loss_without_accelerations_is_the_poses_alone(takes):
    both, alone = (trainer(takes, replace(SMALL, beta=0.0, acceleration_loss=loss)) for loss in (True, False))
    outputs = SMALL.network.pose_outputs

    def zero(x):
        nothing = torch.zeros(*x.shape[:-1], outputs + 15)
        return nothing, nothing + 1

    batch = windows(both.train_tape, torch.tensor([0]), 20)
    s = both.statistics
    targets = (training.pose_targets(batch[2], SMALL.network) - s.target_mean) / s.target_std
    torch.testing.assert_close(alone._loss(zero, batch, 0.0), 0.5 * targets.square().mean())
    assert both._loss(zero, batch, 0.0) != alone._loss(zero, batch, 0.0)


def test_loss_is_of_what_the_low_pass_gives(takes):
    shape = SMALL.network._replace(smoothing=0.5)
    one = trainer(takes, replace(SMALL, network=shape, beta=0.0, acceleration_loss=False))

    def zero(x):
        nothing = torch.zeros(*x.shape[:-1], shape.pose_outputs + 15)
        return nothing, nothing + 1

    batch = windows(one.train_tape, torch.tensor([0]), 20)
    s = one.statistics
    steady = s.target_mean.expand(1, 20, -1)  # to the root, so it moves as the root does
    smooth = smoothed(steady, batch[0][:, :, ROOT], 0.5)
    assert (smooth - steady).abs().max() > 1e-3
    errors = (training.pose_targets(batch[2], shape) - smooth) / s.target_std
    torch.testing.assert_close(one._loss(zero, batch, 0.0), 0.5 * errors.square().mean())


def test_warm_up_and_decay(takes):
    """DIP 4.1: times 0.96 in 2000 steps; the paper has no warm-up."""
    one = trainer(takes, replace(SMALL, warm_up=0, learning_rate=1e-3))
    for step, expected in ((0, 1e-3), (2000, 0.96e-3), (6000, 1e-3 * 0.96**3)):
        one.step = step
        one.train_step()
        assert one.optimiser.param_groups[0]["lr"] == pytest.approx(expected)
    slow = trainer(takes, replace(SMALL, warm_up=9, learning_rate=1e-3))
    slow.train_step()
    assert slow.optimiser.param_groups[0]["lr"] == pytest.approx(1e-4)
