"""Weights packed as fp16 or int8 numbers, in the archive and chosen by a run."""

import json
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.analysis.metrics import joint_angle_error
from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.inference import archive
from edgepose.inference.engine import StreamEngine
from edgepose.inference.quantisation import pack_weights, quantise_weights
from edgepose.skeleton import UNOBSERVED
from edgepose_export.archive.torchscript import save, script
from edgepose_export.evaluation.evaluate import Mode, run_archive, takes_of
from edgepose_export.evaluation.quantisation import compare, round_weights
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.training.dataset import take_paths

BIRNN = NetworkShape("birnn", 32, "global-6d", "passed", "tilt")
RNN = BIRNN._replace(kind="rnn")
FAR = {"fp16": 0.05, "int8": 3.0}
"""Largest mean angle from f32, degrees: these networks are random and more sensitive than trained ones."""


@pytest.fixture(params=["fp16", "int8"])
def precision(request):
    return request.param


@pytest.mark.parametrize("shape", [BIRNN, RNN], ids=lambda shape: shape.kind)
def test_packed_weights_give_nearly_the_same_poses(parts, wearers, shape, precision):
    inputs = wearers(2, 12)
    whole, packed = script(*parts(shape)), script(*parts(shape))
    pack_weights(packed, precision)
    future = 2 if shape.kind == "birnn" else 0
    with torch.no_grad():
        for run in (
            lambda module: module(*inputs)[0][0],
            lambda module: module.window(*inputs, 6)[0],
            lambda module: streamed(module, *inputs, future),
        ):
            expected, got = run(whole).numpy(), run(packed).numpy()
            away = joint_angle_error(got, expected, UNOBSERVED).mean()
            assert 0.0 < away < FAR[precision]


def streamed(module, orientation, acceleration, future):
    """Poses of the first wearer."""
    state, poses = module.start(2, future), []
    for t in range(orientation.shape[1]):
        rotations, _, state = module.stream(orientation[:, t], acceleration[:, t], state)
        poses.append(rotations)
    poses.append(module.drain(state)[0])
    return torch.cat(poses, 1)[0]


def test_weights_are_packed_once(parts):
    module = script(*parts(RNN))
    pack_weights(module, "f32")
    with pytest.raises(EdgeposeError, match="unknown precision"):
        pack_weights(module, "int4")
    pack_weights(module, "int8")
    pack_weights(module, "int8")
    with pytest.raises(EdgeposeError, match="packed already"):
        pack_weights(module, "fp16")


def test_packed_archive(tmp_path, parts, wearers, write_archive):
    """An archive saved in int8 is smaller and runs as it was; a run cannot ask for another precision."""
    small, large = tmp_path / "small.pt", write_archive(tmp_path / "large.pt", BIRNN)
    module = script(*parts(BIRNN))
    pack_weights(module, "int8")
    save(module, small, archive.read_info(large).metadata | {"precision": "int8"})
    assert small.stat().st_size < 0.8 * large.stat().st_size
    info = archive.read_info(small)
    loaded = archive.load(info, trust=True)
    with torch.no_grad():
        for a, b in zip(loaded(*wearers(1, 6)), module(*wearers(1, 6)), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert quantise_weights(loaded, info) == quantise_weights(loaded, info, "int8") == "int8"
    with pytest.raises(EdgeposeError, match="its weights are int8; export it again for fp16"):
        quantise_weights(loaded, info, "fp16")


def test_choice_of_a_run(tmp_path, write_archive):
    info = archive.read_info(write_archive(tmp_path / "small.pt", RNN))
    said = []
    assert quantise_weights(archive.load(info, trust=True), info, "f32", said.append) == "f32"
    assert quantise_weights(archive.load(info, trust=True), info, "int8", said.append) == "int8"
    module = archive.load(info, trust=True)
    chosen = quantise_weights(module, info, "auto", said.append)
    # fp16 products are FBGEMM's; where torch has none, the run says so and goes on.
    has_fp16 = "fbgemm" in torch.backends.quantized.supported_engines
    assert chosen == ("fp16" if has_fp16 else "f32")
    assert len(said) == (not has_fp16)
    output = StreamEngine(module, 0, 0).push("tag", np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3)))
    assert np.isfinite(output[0].rotations).all()


def test_networks_that_have_f32_only(tmp_path, write_archive):
    info = archive.read_info(
        write_archive(tmp_path / "field.pt", NetworkShape("feed-forward", 8, "global-6d", "passed"))
    )
    said = []
    assert quantise_weights(archive.load(info, trust=True), info, "auto", said.append) == "f32"
    assert len(said) == 1
    assert "without recurrence" in said[0]
    with pytest.raises(EdgeposeError, match="use --precision f32"):
        quantise_weights(archive.load(info, trust=True), info, "int8")


def test_comparison_of_precisions(tmp_path, parts, make_takes):
    """Errors and distances are those of the packed archive's own poses."""
    data = make_takes(tmp_path)
    assert len(take_paths(data, "all")) == 1
    rows = compare(lambda: script(*parts(RNN)), data, ["all"], Mode("stream"))["all"]
    assert list(rows) == ["f32", "fp16", "int8"]
    assert rows["f32"]["away"]["sip_error_deg"][0] < 1e-2
    (take,) = takes_of(data, "all")
    packed = script(*parts(RNN))
    pack_weights(packed, "int8")
    whole, poses = (run_archive(m, [take], Mode("stream"))[0] for m in (script(*parts(RNN)), packed))
    for reference, key in ((take.pose, "errors"), (whole, "away")):
        expected = joint_angle_error(poses, reference, UNOBSERVED).mean()
        assert rows["int8"][key]["joint_angle_error_10_deg"][0] == pytest.approx(expected, rel=1e-3)
    json.dumps(rows)


def test_precision_of_a_run(tmp_path, write_archive, make_takes):
    path = write_archive(tmp_path / "small.pt", BIRNN)
    (recording,) = take_paths(make_takes(tmp_path, "--hold", 3), "all")
    calibration = tmp_path / "calibration.json"
    words = ("--file", recording, "--body-frame", "heading:0", "--from", 0, "--hold", 2)
    edgepose("calibrate", *words, "--out", calibration)
    poses = {}
    for name in ("f32", "int8"):
        out = tmp_path / f"{name}.npz"
        words = ("--file", recording, "--calibration", calibration, "--model", path, "--trust", "--npz", out)
        said = edgepose("run", *words, "--precision", name).stderr
        assert f"(birnn, stream) in {name};" in said
        poses[name] = read_poses(out).rotations
    away = joint_angle_error(poses["int8"], poses["f32"], UNOBSERVED)
    assert 0.0 < away.mean() < FAR["int8"]


def edgepose(*words):
    result = CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture
def make_takes():
    """One real take in a folder."""
    walk = Path(__file__).parents[2] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"

    def make(folder, *options):
        (folder / "mocap").mkdir()
        shutil.copy(walk, folder / "mocap" / "walk.bvh")
        edgepose("synthesize", folder / "mocap", "--out", folder / "takes", *options)
        return folder / "takes"

    return make


def test_rounded_weights_are_exact_in_fp16_and_compress(parts):
    network, _ = parts(RNN._replace(hidden=128))[:2]
    with torch.no_grad():
        network.mean.bias.zero_()
    before = {name: weight.clone() for name, weight in network.named_parameters()}
    round_weights(network)
    for name, weight in network.named_parameters():
        assert torch.equal(weight.half().float(), weight)
        typical = before[name].square().mean().sqrt()
        assert (weight - before[name]).square().mean().sqrt() <= 0.013 * typical
        assert (weight - before[name]).abs().max() <= 2**0.5 / 64 * typical + 1e-9
    again = {name: weight.clone() for name, weight in network.named_parameters()}
    round_weights(network)
    assert all(torch.equal(weight, again[name]) for name, weight in network.named_parameters())

    def size(weights):
        return len(
            zlib.compress(torch.cat([w.detach().flatten() for w in weights.values()]).numpy().tobytes())
        )

    assert size(again) < 0.45 * size(before)


@pytest.fixture
def raspberry(monkeypatch):
    """As on a processor whose first fp16 product would end the process."""
    monkeypatch.setattr("edgepose.inference.quantisation.platform.machine", lambda: "aarch64")
    monkeypatch.setattr("edgepose.inference.quantisation._hwcap", lambda: 0)


def test_without_products_of_fp16_auto_is_f32(tmp_path, write_archive, raspberry):
    info = archive.read_info(write_archive(tmp_path / "a.pt", RNN))
    told = []
    assert quantise_weights(archive.load(info, trust=True), info, "auto", told.append) == "f32"
    assert told == []
    with pytest.raises(EdgeposeError, match=r"a\.pt: this processor cannot multiply fp16 .*--precision f32"):
        quantise_weights(archive.load(info, trust=True), info, "fp16", told.append)
    assert quantise_weights(archive.load(info, trust=True), info, "int8", told.append) == "int8"
    assert told == ["warning: int8 is many times slower than f32 on aarch64; use --precision f32"]


def test_without_products_of_fp16_an_archive_of_them_is_refused(tmp_path, write_archive, raspberry):
    info = archive.read_info(write_archive(tmp_path / "a.pt", RNN, precision="fp16"))
    with pytest.raises(EdgeposeError, match=r"cannot multiply fp16 numbers.*export it again in f32"):
        quantise_weights(archive.load(info, trust=True), info)
