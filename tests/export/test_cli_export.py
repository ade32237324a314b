import json
import re
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording
from edgepose.inference import archive
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from edgepose_export.archive.torchscript import Statistics, new_network, script
from edgepose_export.training.config import config_from
from edgepose_export.training.dataset import read_take
from edgepose_export.training.sources import HELD_OUT
from edgepose_export.training.trainer import mean_of, read_checkpoint
from tests.support import processes

DATA = Path(__file__).parents[1] / "data" / "mocap"
WALK = DATA / "dataset-2_walk_normal_001.bvh"
CONFIG = """
steps = 6
sequences = 2
window = 20
validate_every = 3
averaging = 0.5
[network]
kind = "birnn"
hidden = 8
targets = "global-6d"
measured = "passed"
"""
# One real take under names of every part of the split.
NAMES = ("01_01", "03_01", "07_01", "02_01", "dataset-2_walk_tired_001")


@pytest.fixture(autouse=True)
def own_settings(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def edgepose(*arguments):
    """Output of a command that has to succeed."""
    result = CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def fails(*arguments):
    """The one line with which a command ends, as `edgepose` prints it."""
    with pytest.raises(EdgeposeError) as caught:
        CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def with_config(train: tuple[object, ...], config: Path) -> list[object]:
    """The words of a training with another config."""
    words = list(train)
    words[words.index("--config") + 1] = config
    return words


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The whole chain, once: recordings, a run of a few steps, an archive with its card."""
    folder = tmp_path_factory.mktemp("chain")
    (folder / "mocap").mkdir()
    for name in NAMES:
        shutil.copy(WALK, folder / "mocap" / f"{name}.bvh")
    (folder / "tiny.toml").write_text(CONFIG)
    recordings, run = folder / "recordings", folder / "run"
    said = [edgepose("synthesize", folder / "mocap", "--out", recordings).output]
    train = ("train", "--config", folder / "tiny.toml", "--data", recordings, "--threads", 1)
    said.append(edgepose(*train, "--out", run).output)
    said.append(
        edgepose(
            "export", run / "best.pt", "--out", folder / "new" / "tiny.pt", "--measure", recordings
        ).output
    )
    return folder, said, train


def test_synthesize(made):
    folder, said, _ = made
    assert "5 of 5 recordings written" in said[0]
    assert sorted(p.stem for p in (folder / "recordings").iterdir()) == sorted(NAMES)
    recording = read_recording(folder / "recordings" / "07_01.npz")
    assert all(len(data.time_s) == 119 for data in recording.sensors.values())


def test_train(made):
    folder, said, _ = made
    assert "training on 1 takes" in said[1]
    assert "step 3 of 6: loss" in said[1]
    assert "step 6 of 6: loss" in said[1]
    state = read_checkpoint(folder / "run" / "checkpoint.pt")
    assert state["step"] == 6
    assert state["data"]["takes"] == 1
    assert "CMU" in state["data"]["licenses"][0]


def test_figures_of_another_model_stand_beside(made, tmp_path):
    folder, _, _ = made
    to = ("export", folder / "run" / "best.pt", "--out", tmp_path / "tiny.pt", "--beside", "rnn")
    edgepose(*to, "--measure", folder / "recordings")
    measures = archive.read_info(tmp_path / "tiny.pt").metadata["measures"]
    assert set(measures) == {"cmu-walk-run", "cmu-02", "bandai-styles"}
    for rows in measures.values():
        other, own = rows["`rnn`, online, step by step"], rows["online, stream (5 future)"]
        assert 0 < other["sip_error_deg"][0] < own["sip_error_deg"][0]
    assert "| `rnn`, online, step by step |" in (tmp_path / "tiny.md").read_text()
    refused = CliRunner().invoke(cli, [str(a) for a in to])
    assert (refused.exit_code, "--beside needs --measure" in refused.output) == (2, True)


def test_metadata(made):
    folder, said, _ = made
    path = folder / "new" / "tiny.pt"
    assert f"wrote {path}" in said[2]
    about = archive.read_info(path).metadata
    assert about["format"] == archive.FORMAT
    assert (about["name"], about["kind"], about["hidden"]) == ("tiny", "birnn", 8)
    assert about["parameters"] == sum(
        x.numel() for x in read_checkpoint(folder / "run" / "best.pt")["averaged"].values()
    )
    assert about["placements"] == list(PLACEMENTS)
    assert (about["rate_hz"], about["past"], about["future"]) == (60.0, 20, 5)
    assert len(about["joints"]) == 10
    assert (about["targets"], about["measured_bones"]) == ("global-6d", "passed")
    training = about["training"]
    assert training["config"]["network"]["hidden"] == 8
    assert training["summary"] == "CMU Graphics Lab Motion Capture Database"
    assert "free for all use" in training["licenses"][0]
    assert (training["takes"], training["steps"]) == (1, read_checkpoint(folder / "run" / "best.pt")["step"])
    assert training["hours"] == pytest.approx(119 / 60 / 3600)
    assert about["torch"] == torch.__version__
    assert about["revision"] is None or len(about["revision"]) == 40
    assert set(about["measures"]) == {"cmu-walk-run", "cmu-02", "bandai-styles"}
    for rows in about["measures"].values():
        assert len(rows) == 9
        for measures in rows.values():
            mean, deviation, frames = measures["sip_error_deg"]
            assert mean > 0
            assert deviation > 0
            assert frames == 119
    # JSON as other languages read it: no NaN.
    with zipfile.ZipFile(path) as file:
        text = file.read("tiny/extra/edgepose.json").decode()
    json.loads(text, parse_constant=lambda name: pytest.fail(name))


def test_a_folder_without_held_out_takes(made, tmp_path):
    """One's own recordings have other names: `train` takes every tenth for validation."""
    folder, _, _ = made
    take = folder / "recordings" / "07_01.npz"
    for name in ("monday", "tuesday"):
        (tmp_path / "own").mkdir(exist_ok=True)
        (tmp_path / "own" / f"{name}.npz").write_bytes(take.read_bytes())
    to = ("export", folder / "run" / "best.pt", "--out", tmp_path / "a.pt")
    said = edgepose(*to, "--measure", tmp_path / "own")
    assert f"has no recordings of {', '.join(HELD_OUT)}; measuring on validation" in said.stderr
    assert set(archive.read_info(tmp_path / "a.pt").metadata["measures"]) == {"validation"}
    assert "### validation" in (tmp_path / "a.md").read_text()
    said = edgepose("evaluate", "--model", "rnn", "--data", tmp_path / "own")
    assert "measuring on validation" in said.stderr
    assert said.stdout.startswith("\nvalidation\n")


def test_a_held_out_part_that_is_missing_is_named(made, tmp_path):
    folder, _, _ = made
    take = folder / "recordings" / "07_01.npz"
    (tmp_path / "07_01.npz").write_bytes(take.read_bytes())
    said = edgepose("evaluate", "--model", "rnn", "--data", tmp_path)
    lacking = ", ".join(part for part in HELD_OUT if part != "cmu-walk-run")
    assert f"has no recordings of {lacking}; measuring on cmu-walk-run" in said.stderr
    assert said.stdout.startswith("\ncmu-walk-run\n")


def test_card(made):
    folder, _, _ = made
    card = (folder / "new" / "tiny.md").read_text(encoding="utf-8")
    about = archive.read_info(folder / "new" / "tiny.pt").metadata
    for text in (
        "# tiny",
        "bidirectional LSTM",
        "5 future frames have arrived (83 ms)",
        "8 units",
        "at 60 Hz",
        ", ".join(PLACEMENTS),
        "free for all use",
        "### cmu-walk-run",
        "### bandai-styles",
        "### Precision of the weights",
        "mean pose",
        "online, window (20, 5)",
        "edgepose synthesize",
        "edgepose train",
        "edgepose export",
    ):
        assert text in card
    assert "Weights: free for any use" in card
    # Only what was run, and nothing of the shipped models.
    assert "edgepose train --config tiny --data RECORDINGS --out RUN\n" in card
    assert f"Runs: tiny ({about['training']['steps']} steps)." in card
    assert "--recipe" not in card
    assert "`cmu-02` is CMU subject 02: bending, punches, sword play, washing" in card
    assert "--out tiny.pt --past 20 --future 5 --measure RECORDINGS\n" in card
    assert "cgspeed" not in card
    mean, deviation, frames = about["measures"]["cmu-02"]["offline, whole take"]["sip_error_deg"]
    row = next(line for line in card.split("### cmu-02")[1].splitlines() if "offline" in line)
    assert row.startswith(f"| offline, whole take | {mean:.2f} ± {deviation:.2f} |")
    assert row.endswith(f"| {frames} |")


def test_models_and_evaluate(made):
    folder, _, _ = made
    path = folder / "new" / "tiny.pt"
    data = ("--data", folder / "recordings")
    assert "trusted: no" in edgepose("models", path).output
    assert "is not known" in fails("evaluate", "--model", path, *data)
    edgepose("models", "--trust", path)
    said = edgepose("evaluate", "--model", path, *data, "--part", "cmu-02", "--baselines").stdout
    part, head, *rows, note = said.strip().splitlines()
    assert part == "cmu-02"
    assert head.startswith("method")
    assert "119 frames" in note
    assert [row.split("  ")[0] for row in rows] == [
        "online, window (20, 5)",
        "online, stream (5 future)",
        "offline, whole take",
        "mean pose",
        "frozen calibration pose",
        "measured bones, others' mean local pose",
        "measured bones, others interpolated",
        "measured bones, others interpolated + mean offsets",
        "8 nearest neighbours of the frame",
    ]
    # The archive's own figures come back.
    mean, deviation, _ = archive.read_info(path).metadata["measures"]["cmu-02"]["offline, whole take"][
        "sip_error_deg"
    ]
    assert f"{mean:.2f} ± {deviation:.2f}" in rows[2]
    said = edgepose(
        "evaluate", "--model", path, *data, "--part", "all", "--online", "window", "--past", 3
    ).stdout
    assert "online, window (3, 5)" in said
    assert "595 frames" in said
    assert "stream" not in said


def test_training_goes_on_and_fine_tunes(made, tmp_path):
    folder, _, train = made
    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    assert "continue that run with --resume" in fails(*train, "--out", run)
    said = edgepose(*train, "--out", run, "--resume", "--steps", 9).output
    assert "continuing at step 6" in said
    assert read_checkpoint(run / "checkpoint.pt")["step"] == 9
    tuned = tmp_path / "tuned"
    edgepose(*train, "--out", tuned, "--init", folder / "run" / "best.pt")
    data = read_checkpoint(tuned / "checkpoint.pt")["data"]
    assert data["earlier"] == [{"run": "tiny", "steps": read_checkpoint(folder / "run" / "best.pt")["step"]}]
    assert data["takes"] == 1  # the same take
    both = CliRunner().invoke(cli, [*map(str, train), "--out", str(run), "--resume", "--init", "x"])
    assert both.exit_code == 2
    assert "no such" in fails(*train, "--out", tmp_path / "none", "--resume").lower()


def test_own_recordings_are_enough_to_fine_tune(made, tmp_path):
    """Files that no part of the split claims: some of them tell when to stop."""
    folder, _, _ = made
    (tmp_path / "mine").mkdir()
    for name in ("morning", "evening"):
        shutil.copy(folder / "recordings" / "01_01.npz", tmp_path / "mine" / f"{name}.npz")
    edgepose(
        "train", "--config", folder / "tiny.toml", "--data", tmp_path / "mine", "--out", tmp_path / "tuned",
        "--init", folder / "run" / "best.pt", "--steps", 2, "--threads", 1,
    )  # fmt: skip
    assert read_checkpoint(tmp_path / "tuned" / "checkpoint.pt")["step"] == 2


def test_unidirectional(made, tmp_path):
    folder, _, _ = made
    config = tmp_path / "rnn.toml"
    config.write_text(CONFIG.replace('"birnn"', '"rnn"').replace("steps = 6", "steps = 1"))
    data = folder / "recordings"
    edgepose("train", "--config", config, "--data", data, "--out", tmp_path / "run", "--threads", 1)
    path = tmp_path / "rnn.pt"
    edgepose("export", tmp_path / "run" / "checkpoint.pt", "--out", path)
    about = archive.read_info(path).metadata
    assert (about["kind"], about["past"], about["future"], about["measures"]) == ("rnn", 0, 0, {})
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    assert "unidirectional" in card
    assert "held-out motion" not in card
    said = edgepose("evaluate", "--model", path, "--trust", "--data", data, "--part", "cmu-02").stdout
    assert "online, step by step" in said
    wrong = CliRunner().invoke(
        cli, ["evaluate", "--model", str(path), "--trust", "--data", str(data), "--future", "2"]
    )
    assert wrong.exit_code == 2
    assert "unidirectional" in wrong.output


def test_evaluate_of_a_kind_that_this_version_does_not_have(made, write_archive, tmp_path):
    """The archive says what it can do: this one is measured as a stream, and has no window."""
    path = write_archive(tmp_path / "other.pt", kind="gru", windowed=False)
    data = ("--trust", "--data", str(made[0] / "recordings"), "--part", "cmu-02")
    words = ["evaluate", "--model", str(path), *data]
    said = CliRunner().invoke(cli, words, catch_exceptions=False)
    assert said.exit_code == 0, said.output
    assert "online, stream (2 future)" in said.stdout
    for flags in (["--past", "3"], ["--online", "window"], ["--heat-map", str(tmp_path / "map.png")]):
        wrong = CliRunner().invoke(cli, [*words, *flags])
        assert wrong.exit_code == 2
        assert "sees a fixed number of frames" in wrong.output


def test_synthesize_options(tmp_path):
    out = tmp_path / "out"
    edgepose(
        "synthesize", WALK, "--out", out, "--rate", 100, "--hold", 2, "--mounting", 1, "--height", 1.9,
        "--jobs", 2,
    )  # fmt: skip
    recording = read_recording(out / f"{WALK.stem}.npz")
    times = recording.sensors["head"].time_s
    np.testing.assert_allclose(np.diff(times), 0.01)
    assert times[-1] > 2 + 1 + 1.9
    still = recording.sensors["left_forearm"].acc[:190]
    np.testing.assert_allclose(still, np.broadcast_to(still[0], still.shape), atol=1e-5)
    assert np.linalg.norm(still[0]) == pytest.approx(9.81, abs=1e-4)


def test_synthesize_rests(tmp_path):
    edgepose("synthesize", WALK, "--out", tmp_path, "--rests", 1)
    take = read_take(tmp_path / f"{WALK.stem}.rests.npz")
    assert 20 * 60 - 1 <= len(take.pose) <= 50 * 60 + 1
    still = np.abs(np.diff(take.orientation, axis=0)).max(axis=(1, 2, 3)) < 0.002
    assert 0.2 < still.mean() < 0.95
    both = ["synthesize", str(WALK), "--out", str(tmp_path), "--rests", "1", "--seated", "1"]
    assert "--seated and --rests make different takes" in CliRunner().invoke(cli, both).output


def test_synthesize_on_an_own_body(tmp_path):
    """A model file of SMPL's layout: another body gives other accelerations and the same orientations."""
    body = default_body(1.5, "female")
    joints = forward_kinematics(np.tile(np.eye(3), (24, 1, 1)), body.offsets)[1]
    np.savez(tmp_path / "model.npz", J=joints)
    edgepose("synthesize", WALK, "--out", tmp_path / "own", "--body", tmp_path / "model.npz")
    edgepose("synthesize", WALK, "--out", tmp_path / "default")
    own, default = (read_take(tmp_path / name / f"{WALK.stem}.npz") for name in ("own", "default"))
    np.testing.assert_array_equal(own.orientation, default.orientation)
    assert 0.1 < np.abs(own.acceleration - default.acceleration).max() < 20.0
    (tmp_path / "model.pkl").write_bytes(b"no pickle")
    assert "model.pkl" in fails("synthesize", WALK, "--out", tmp_path, "--body", tmp_path / "model.pkl")


def test_synthesize_faults(tmp_path):
    folder = tmp_path / "mocap"
    folder.mkdir()
    assert "no motion files" in fails("synthesize", folder, "--out", tmp_path / "out")
    shutil.copy(WALK, folder / "good.bvh")
    (folder / "bad.bvh").write_text("HIERARCHY\n")
    result = CliRunner().invoke(cli, ["synthesize", str(folder), "--out", str(tmp_path / "out")])
    assert "skipped:" in result.output
    assert "bad.bvh" in result.output
    assert "1 of 2 files could not be converted" in str(result.exception)
    assert (tmp_path / "out" / "good.npz").exists()
    shutil.copy(WALK, folder / "good.amc")
    assert "would both become" in fails("synthesize", folder, "--out", tmp_path / "out")


def test_export_faults(made, tmp_path):
    folder, _, _ = made
    best = folder / "run" / "best.pt"
    assert "No such file" in fails("export", tmp_path / "none.pt", "--out", tmp_path / "x.pt")
    assert CliRunner().invoke(cli, ["export", str(best), "--out", str(tmp_path / "x.md")]).exit_code == 2
    (tmp_path / "file").write_text("")
    assert "cannot be written" in fails("export", best, "--out", tmp_path / "file" / "x.pt")


def test_mean_weights_of_checkpoints(made, tmp_path):
    folder, _, train = made
    first, tuned = folder / "run" / "best.pt", tmp_path / "tuned" / "checkpoint.pt"
    edgepose(*train, "--out", tuned.parent, "--init", first, "--steps", 3)
    edgepose("export", tuned, first, "--out", tmp_path / "mean.pt")
    about = archive.read_info(tmp_path / "mean.pt").metadata
    assert (about["training"]["checkpoints"], about["training"]["steps"]) == (2, 3)
    card = (tmp_path / "mean.md").read_text(encoding="utf-8")
    assert "3 steps in the last of 2 training runs, whose weights are averaged." in card
    assert "checkpoint.pt OTHERS --out" in card
    states = [read_checkpoint(path) for path in (tuned, first)]
    weights = mean_of({"tuned": states[0], "first": states[1]})["averaged"]
    for name, mean in weights.items():
        torch.testing.assert_close(mean, (states[0]["averaged"][name] + states[1]["averaged"][name]) / 2)
    network = new_network(config_from(json.loads(states[0]["config"])).network)
    network.load_state_dict(weights)
    expected = script(network, Statistics(**states[0]["statistics"]))
    still = torch.eye(3).expand(1, 9, 6, 3, 3), torch.zeros(1, 9, 6, 3)
    module = archive.load(archive.read_info(tmp_path / "mean.pt"), trust=True)
    for got, wanted in zip(module(*still), expected(*still), strict=True):
        torch.testing.assert_close(got, wanted)
    (tmp_path / "wide.toml").write_text(CONFIG.replace("hidden = 8", "hidden = 9"))
    edgepose(*with_config(train, tmp_path / "wide.toml"), "--out", tmp_path / "other", "--steps", 1)
    refused = fails("export", first, tmp_path / "other" / "checkpoint.pt", "--out", tmp_path / "x.pt")
    assert "other/checkpoint.pt: cannot be averaged with" in refused
    twice = CliRunner().invoke(cli, ["export", str(first), str(first), "--out", str(tmp_path / "x.pt")])
    assert (twice.exit_code, "named twice" in twice.output) == (2, True)


def test_rounded_weights(made, tmp_path):
    folder, _, _ = made
    edgepose("export", folder / "run" / "best.pt", "--out", tmp_path / "short.pt", "--rounded")
    info = archive.read_info(tmp_path / "short.pt")
    assert info.metadata["rounded"]
    assert "weights, rounded to about one part in a hundred." in (
        card := (tmp_path / "short.md").read_text("utf-8")
    )
    assert re.search(r"--out short\.pt --past \d+ --future \d+ --rounded\n", card)
    weights = [
        weight
        for name, weight in archive.load(info, trust=True).named_buffers()
        if name.endswith("weight") and not name.startswith("ends.")
    ]
    assert len(weights) >= 8
    assert all(torch.equal(weight.half().float(), weight) for weight in weights)
    twice = ["export", "x.pt", "--out", "y.pt", "--rounded", "--precision", "int8"]
    refused = CliRunner().invoke(cli, twice)
    assert (refused.exit_code, "does not apply to --precision int8" in refused.output) == (2, True)


def test_means_keep_licences_and_refuse_strangers(made):
    folder, _, _ = made
    first = read_checkpoint(folder / "run" / "best.pt")
    data = first["data"] | {"licenses": ["another"], "hours": 99.0}
    mean = mean_of({"a": first, "b": first | {"data": data}})
    assert mean["data"]["licenses"] == sorted([*first["data"]["licenses"], "another"])
    assert mean["data"]["hours"] == 99.0
    torch.manual_seed(1)
    stranger = new_network(config_from(json.loads(first["config"])).network).state_dict()
    odd = first["statistics"] | {"input_std": first["statistics"]["input_std"] + 1.0}
    for change in ({"averaged": stranger}, {"statistics": odd}):
        with pytest.raises(EdgeposeError, match="b: cannot be averaged with a"):
            mean_of({"a": first, "b": first | change})


def test_errors_are_one_line(made, tmp_path):
    _, _, train = made
    (tmp_path / "bad.toml").write_text("steps = 'many'\n")
    arguments = [*map(str, with_config(train, tmp_path / "bad.toml")), "--out", str(tmp_path / "run")]
    done = processes.run(
        [sys.executable, "-m", "edgepose", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr == f"edgepose: {tmp_path / 'bad.toml'}: steps is 'many'; it must be a whole number\n"
    assert not (tmp_path / "run").exists()


def test_tables_and_figures_of_the_paper(made, tmp_path):
    """Two archives side by side, with pictures, and what their deviations are worth."""
    folder, _, _ = made
    birnn, rnn = folder / "new" / "tiny.pt", tmp_path / "small-rnn.pt"
    config = tmp_path / "rnn.toml"
    config.write_text(CONFIG.replace('"birnn"', '"rnn"').replace("steps = 6", "steps = 1"))
    data = ("--data", folder / "recordings")
    edgepose("train", "--config", config, *data, "--out", tmp_path / "run", "--threads", 1)
    edgepose("export", tmp_path / "run" / "checkpoint.pt", "--out", rnn)
    both = ("evaluate", "--trust", "--model", birnn, "--model", rnn, *data)
    said = edgepose(*both, "--table", 3, "--histogram", tmp_path / "errors.png").stdout
    parts, head, *rows, note = said.strip("\n").splitlines()
    assert parts.split() == ["cmu-walk-run", "cmu-02", "bandai-styles"]
    assert head.count("μ_ang, deg") == head.count("σ_pos, cm") == 3
    assert [line.split("   ")[0] for line in rows] == [
        "tiny, online, window (20, 5)",
        "tiny, online, window (50, 5)",
        "small-rnn, online, step by step",
    ]
    assert "cmu-02 119" in note
    assert (tmp_path / "errors.png").stat().st_size > 5000
    said = edgepose(
        *both, "--part", "cmu-02", "--online", "stream", "--reliability", tmp_path / "deviations.png"
    ).stdout
    assert "cmu-02: tiny, online, stream (5 future)" in said
    assert "cmu-02: small-rnn, online, step by step" in said
    assert said.count("% expected") == 4
    assert (tmp_path / "deviations.png").stat().st_size > 5000


def test_heat_map(made, tmp_path):
    folder, _, _ = made
    words = ("evaluate", "--trust", "--data", folder / "recordings", "--part", "cmu-02")
    path = folder / "new" / "tiny.pt"
    said = edgepose(*words, "--model", path, "--heat-map", tmp_path / "map.png", "--every", 40).stdout
    lines = said.strip().splitlines()
    assert "3 frames" in lines[0]
    assert [line.split()[0] for line in lines[1:9]] == ["200", "100", "50", "20", "10", "5", "1", "0"]
    assert lines[9].split() == ["0", "1", "5", "10", "20", "50", "100", "200"]
    assert (tmp_path / "map.png").stat().st_size > 5000
    for more in (("--model", path), ("--model", "rnn")):
        wrong = CliRunner().invoke(
            cli, [*map(str, words), "--model", str(path), *map(str, more), "--heat-map", "x.png"]
        )
        assert wrong.exit_code == 2
    wrong = CliRunner().invoke(cli, [*map(str, words), "--model", "rnn", "--heat-map", "x.png"])
    assert wrong.exit_code == 2
    assert "rnn is unidirectional" in wrong.output
    wrong = CliRunner().invoke(cli, [*map(str, words), "--table", "3", "--past", "4"])
    assert wrong.exit_code == 2
    assert "pictures are written as" in fails(*words, "--model", path, "--histogram", tmp_path / "x.gif")


def test_deviations_are_fitted_at_export(made):
    """The factors of the validation take stand in the archive's description and in what it predicts."""
    folder, _, _ = made
    about = archive.read_info(folder / "new" / "tiny.pt").metadata
    factors = about["std_scale"]
    assert set(factors) == set(JOINTS)
    fitted = [factors[name] for name in about["joints"]]
    assert all(factor > 0 for factor in fitted)
    assert len(set(fitted)) == 10
    assert factors["left_knee"] == factors["pelvis"] == 1.0
    # The same take stands in every part of the split: on each the deviations are right.
    for numbers in about["deviations"].values():
        assert numbers["values"] == 119 * 10
    card = (folder / "new" / "tiny.md").read_text(encoding="utf-8")
    assert "### Predicted standard deviations" in card
    assert f"| {about['deviations']['cmu-02']['scale']:.2f} | 1190 |" in card


def test_fine_tuning_goes_on_too(made, tmp_path):
    """A run that began from other weights (DIP 3.4.4) resumes like any other."""
    folder, _, train = made
    tuned = tmp_path / "tuned"
    edgepose(*train, "--out", tuned, "--init", folder / "run" / "best.pt", "--steps", 3)
    said = edgepose(*train, "--out", tuned, "--resume").output
    assert "continuing at step 3" in said
    state = read_checkpoint(tuned / "checkpoint.pt")
    assert state["step"] == 6
    assert [run["run"] for run in state["data"]["earlier"]] == ["tiny"]
    edgepose("export", tuned / "checkpoint.pt", "--out", tmp_path / "tuned.pt")
    card = (tmp_path / "tuned.md").read_text(encoding="utf-8")
    assert "edgepose train --config tiny --data RECORDINGS --out RUN --init RUN1/checkpoint.pt\n" in card
    assert "tiny (6 steps)." in card


def test_packed_takes_give_the_same_run(made, tmp_path):
    folder, _, train = made
    edgepose(*train, "--out", tmp_path / "packed", "--cache", tmp_path / "cache")
    one, other = (read_checkpoint(path / "checkpoint.pt") for path in (folder / "run", tmp_path / "packed"))
    for name, weights in one["network"].items():
        torch.testing.assert_close(weights, other["network"][name], rtol=0, atol=1e-6)
    assert one["data"] == other["data"]


# --- what is there already ----------------------------------------------------------------------------------

OLD = b"what was there before\n"

WRITES = {
    "export": ("tiny.pt", lambda folder, out: ("export", folder / "run" / "best.pt", "--out", out)),
    "learn-prior": ("prior.npz", lambda folder, out: ("learn-prior", folder / "amass.npz", "--out", out)),
    "histogram": (
        "a.png",
        lambda folder, out: (
            *("evaluate", "--data", folder / "recordings", "--model", "rnn", "--part", "cmu-02"),
            *("--histogram", out),
        ),
    ),
    "synthesize": (
        WALK.with_suffix(".npz").name,
        lambda folder, out: ("synthesize", WALK, "--out", out.parent),
    ),
}


@pytest.fixture(params=WRITES)
def output(request, made, tmp_path):
    """The name of an output, and the words of the command that writes it."""
    folder, _, _ = made
    if not (folder / "amass.npz").exists():  # two minutes of somebody who hardly moves
        poses = np.random.default_rng(1).normal(scale=0.1, size=(720, 156))
        np.savez(folder / "amass.npz", poses=poses, trans=np.zeros((720, 3)), mocap_framerate=6.0)
    name, words = WRITES[request.param]
    out = tmp_path / "out" / name
    out.parent.mkdir()
    return out, words(folder, out)


def test_nothing_is_overwritten_unasked(output):
    out, words = output
    out.write_bytes(OLD)
    assert "already exists" in fails(*words)
    assert out.read_bytes() == OLD
    edgepose(*words, "--overwrite")
    assert out.read_bytes()[:4] in (b"PK\x03\x04", b"\x89PNG")
    assert {path.name for path in out.parent.iterdir()} <= {out.name, f"{out.stem}.md"}


def test_links_and_devices_are_written_through(output):
    out, words = output
    if out.suffix != ".pt":  # whose card would be elsewhere
        out.symlink_to("/dev/null")
        edgepose(*words)
        assert out.readlink() == Path("/dev/null")
        assert Path("/dev/null").is_char_device()
        out.unlink()
    end = out.parent / f"end{out.suffix}"
    out.symlink_to(end.name)
    edgepose(*words)
    assert out.is_symlink()
    assert end.read_bytes()[:4] in (b"PK\x03\x04", b"\x89PNG")


def test_a_folder_in_the_place_of_an_output(output):
    out, words = output
    out.mkdir()
    result = CliRunner().invoke(cli, [*map(str, words), "--overwrite"])
    assert result.exit_code in (1, 2)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("name", ["export", "learn-prior"])
def test_a_card_or_a_file_of_another_kind_is_kept(name, made, tmp_path):
    folder, _, _ = made
    words = WRITES[name][1]
    if name == "export":
        (tmp_path / "tiny.md").write_bytes(OLD)
        assert "tiny.md already exists" in fails(*words(folder, tmp_path / "tiny.pt"))
        assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["tiny.md"]
    else:
        (tmp_path / "prior.json").write_bytes(OLD)
        assert "another kind" in fails(*words(folder, tmp_path / "prior.json"), "--overwrite")
        assert (tmp_path / "prior.json").read_bytes() == OLD
