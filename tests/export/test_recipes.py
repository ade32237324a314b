"""`edgepose train --recipe`: from raw motion to an archive and its card, also after a crash."""

import json
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.inference import archive
from edgepose_export.cli.recipe import wanted_takes
from edgepose_export.training.recipes import RECIPES, read_recipe, recipe_path
from edgepose_export.training.sources import SOURCES
from edgepose_export.training.trainer import read_checkpoint
from tests.support import processes

WALK = Path(__file__).parents[1] / "data" / "mocap" / "07_01.bvh"

RECIPE = """
sources = ["cmu", "snu-tennis"]

[[recordings]]
folder = "plain"

[[recordings]]
folder = "standing"
train = true
every = 2
options = { hold = 1.0 }

[[stage]]
name = "first"
config = "small.toml"

[[stage]]
name = "second"
config = "small.toml"
settings = { steps = 4, learning_rate = 1e-4 }

[export]
average = ["second", "first"]
rounded = true
"""
CONFIG = """
steps = 60
sequences = 4
window = 20
validate_every = 2
averaging = 0.5
[network]
kind = "rnn"
hidden = 8
targets = "global-6d"
measured = "passed"
"""


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    """Three takes with a copy in another format's folder, a stranger's take, and a recipe."""
    folder = tmp_path_factory.mktemp("kitchen")
    for name in ("cmu/01/01_01", "cmu/01/01_02", "cmu/03/03_01", "cmu/07/07_01", "again/01_01", "anna/walk"):
        (folder / "mocap" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(WALK, folder / "mocap" / f"{name}.bvh")
    (folder / "tiny.toml").write_text(RECIPE)
    (folder / "small.toml").write_text(CONFIG)
    return folder


def words(kitchen, out):
    return ["train", "--recipe", kitchen / "tiny.toml", kitchen / "mocap", "--out", out, "--threads", 1]


def called(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)


def fails(*arguments):
    with pytest.raises(EdgeposeError) as caught:
        called(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def made(kitchen):
    """A whole run, and what it said."""
    result = called(*words(kitchen, kitchen / "run"))
    assert result.exit_code == 0
    return kitchen / "run", result.stderr


def test_from_motion_to_archive(made):
    run, said = made
    assert "motion: cmu (4 files)" in said
    assert "recipe tiny uses snu-tennis, none found below" in said
    assert "recipe tiny does not use own (1 files)" in said
    assert "stage 1 of 2, first: step 60 of 60" in said
    assert "min of all stages" in said
    assert "stage 2 of 2, second: step 4 of 4" in said
    names = sorted(
        path.relative_to(run / "recordings").as_posix() for path in (run / "recordings").rglob("*.npz")
    )
    assert len(names) == 5
    assert names[-1].startswith("standing/")
    info = archive.read_info(run / "tiny.pt")
    training = info.metadata["training"]
    assert (training["takes"], training["steps"], training["checkpoints"]) == (3, 4, 2)
    assert training["earlier"] == [{"run": "first", "steps": 60}]
    assert training["free"] == {"cmu": True}
    assert info.metadata["rounded"]
    assert list(info.metadata["measures"]) == ["cmu-walk-run"]
    assert read_checkpoint(run / "stages" / "second" / "checkpoint.pt")["step"] == 4


def test_card_says_what_was_run(made):
    run, _ = made
    card = (run / "tiny.md").read_text(encoding="utf-8")
    assert "- Weights: free for any use" in card
    assert "```\nedgepose train --recipe tiny MOCAP... --out RUN\n```" in card
    assert "Runs: first (60 steps), second (4 steps)." in card
    assert read_recipe(run.parent / "tiny.toml").sha256[:16] in card


def test_card_of_a_stage_exported_by_hand(made, tmp_path):
    run, _ = made
    called("export", run / "stages" / "first" / "checkpoint.pt", "--out", tmp_path / "mine.pt")
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "Its stages second were not run." in card
    assert "edgepose export RUN/stages/first/checkpoint.pt --out mine.pt\n" in card


def test_finished_run_is_kept(kitchen, made):
    run, _ = made
    before = (run / "tiny.pt").read_bytes()
    assert "tiny.pt is complete" in called(*words(kitchen, run)).stderr
    assert (run / "tiny.pt").read_bytes() == before


def test_killed_runs_go_on(kitchen, made, tmp_path):
    """A run that is killed twice, and called again each time, ends with the weights of one that is not.

    A take that cannot be read costs itself, and is told at the end.
    """
    out = tmp_path / "run"
    shutil.copytree(kitchen, tmp_path / "mine", ignore=lambda folder, names: {"run"} & {*names})
    (tmp_path / "mine" / "mocap" / "cmu" / "01" / "01_04.bvh").write_text("nothing")
    command = [sys.executable, "-m", "edgepose", *words(tmp_path / "mine", out)]

    def killed_after(file):
        with processes.Popen([str(word) for word in command], stderr=-3, stdout=-3) as process:
            while not file() and process.poll() is None:
                time.sleep(0.01)
            process.send_signal(signal.SIGKILL)
            assert process.wait(60) == -signal.SIGKILL

    journal = out / "recordings" / "plain" / ".synthesized"
    killed_after(lambda: journal.exists() and len(journal.read_text().split("\n")) > 1)
    first = next((out / "recordings" / "plain").rglob("*.npz"))
    written = first.stat().st_mtime_ns
    assert "first" not in json.loads((out / "run.json").read_text())["done"]
    killed_after((out / "stages" / "first" / "checkpoint.pt").exists)
    assert "export" not in json.loads((out / "run.json").read_text())["done"]
    assert "tiny.pt was made without 1 motion files" in fails(*command[3:])
    assert first.stat().st_mtime_ns == written
    assert "export" in json.loads((out / "run.json").read_text())["done"]
    for stage in ("first", "second"):
        whole, parts = (
            read_checkpoint(run / "stages" / stage / "checkpoint.pt")["averaged"] for run in (made[0], out)
        )
        torch.testing.assert_close(whole, parts, rtol=0, atol=1e-6)


def test_changed_recipe_or_motion_is_refused(kitchen, made, tmp_path):
    run, _ = made
    for name in ("tiny.toml", "small.toml"):
        shutil.copy(kitchen / name, tmp_path / name)
    changed = ["train", "--recipe", tmp_path / "tiny.toml", kitchen / "mocap", "--out", run]
    assert called(*changed).exit_code == 0  # the same recipe elsewhere
    assert "was begun with other folders of motion" in fails(
        *changed[:3], kitchen / "mocap" / "cmu", *changed[4:]
    )
    (tmp_path / "small.toml").write_text(CONFIG.replace("hidden = 8", "hidden = 9"))
    assert "was begun with another recipe, or version of it" in fails(*changed)
    assert "holds files, but no run of a recipe" in fails(*changed[:-1], tmp_path)


# --- reading ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["birnn", "rnn", "birnn-nc", "rnn-nc"])
def test_shipped_recipes(name):
    recipe = read_recipe(recipe_path(name))
    assert recipe.name == name
    bound = [source for source in recipe.sources if source not in SOURCES or not SOURCES[source].free]
    assert bool(bound) == name.endswith("-nc")
    assert all(stage.config.network.kind == name.removesuffix("-nc") for stage in recipe.stages)
    assert {path.stem for path in RECIPES.glob("*.toml")} == {"birnn", "rnn", "birnn-nc", "rnn-nc"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('sources = ["cmu", "snu-tennis"]', 'sources = ["cmv"]', "unknown source 'cmv' in sources"),
        ('sources = ["cmu", "snu-tennis"]', "", "sources is missing"),
        ("hold = 1.0", "hald = 1.0", "recordings standing: No such option"),
        ("hold = 1.0", "hold = -1.0", "recordings standing: Invalid value for '--hold'"),
        ("every = 2", "every = 0", "every is 0"),
        ("every = 2", "evry = 2", "unknown entry 'evry'"),
        ("train = true", 'takes = "("', "takes is no regular expression"),
        ('folder = "standing"', 'folder = "../x"', "it must be a plain name"),
        ('folder = "standing"', 'folder = "plain"', "no two of the same folder"),
        ('name = "second"', 'name = "first"', "no two of the same name"),
        ('config = "small.toml"', 'config = "none.toml"', "No such file"),
        ("steps = 4,", "stups = 4,", "unknown field 'stups'"),
        ('"second", "first"]', '"third"]', "average must list stages"),
        ("rounded = true", "round = true", "export: No such option"),
    ],
)
def test_broken_recipe(kitchen, tmp_path, old, new, message):
    assert old in RECIPE
    (tmp_path / "tiny.toml").write_text(RECIPE.replace(old, new))
    shutil.copy(kitchen / "small.toml", tmp_path / "small.toml")
    said = fails("train", "--recipe", tmp_path / "tiny.toml", kitchen / "mocap", "--out", tmp_path / "run")
    assert message in said
    assert not (tmp_path / "run").exists()


def test_unknown_recipe_and_motion(kitchen, tmp_path):
    assert "rbnn: no such recipe; did you mean 'rnn'" in fails(
        "train", "--recipe", "rbnn", kitchen / "mocap", "--out", tmp_path / "run"
    )
    (tmp_path / "mocap").mkdir()
    said = fails("train", "--recipe", "rnn", tmp_path / "mocap", "--out", tmp_path / "run")
    assert "no motion of the sources that recipe rnn uses" in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give --recipe to make a model"),
        (("--recipe", "rnn", "--config", "rnn"), "give --recipe to make a model"),
        (("--recipe", "rnn"), "--recipe needs folders with motion"),
        (("--recipe", "rnn", ".", "--resume"), "--recipe decides all but --out and --threads"),
        (("--config", "rnn"), "--config needs --data"),
        (("--config", "rnn", "--data", ".", "."), "--config needs --data, and no folders with motion"),
    ],
)
def test_options_that_do_not_go_together(tmp_path, options, message):
    result = called("train", *options, "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())


def test_takes_of_a_recipe(tmp_path):
    """A take is used once, T-poses are not, and parts decide what made motion is made of."""
    names = (
        "amc/07/07_01.amc",
        "bvh/07/07_01.bvh",
        "snu/basketball/t_pose.bvh",
        "s_008_1_1.bvh",
        "s_009_1_1.bvh",
    )
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    recipe = read_recipe(recipe_path("birnn"))
    takes = wanted_takes(recipe, (tmp_path,))
    assert {path.relative_to(tmp_path).as_posix() for path in takes} == {names[1], *names[3:]}
    plain, standing = recipe.recordings[:2]
    assert len(plain.chosen(takes)) == 3
    assert [path.name for path in standing.chosen(takes)] == ["s_009_1_1.bvh"]
