"""`edgepose evaluate --place`, and the paths of `evaluate --real`."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.inference.archive import find_archive, load, read_info
from edgepose.rotations import rotation_about_axis
from edgepose.skeleton import default_body
from edgepose_export.evaluation.paths import BOTH, ROWS, errors, kind_of, measured, soles, streamed
from edgepose_export.evaluation.real_paths import real_paths, sitter_row, walker_row
from edgepose_export.evaluation.real_wearers import FOLDER
from edgepose_export.mocap import read_motion, resample
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import Take, read_take
from tests.support.documented_keys import documented

WALK = Path(__file__).parents[1] / "data" / "mocap" / "dataset-2_walk_normal_001.bvh"
FRAMES = 721
STRAIGHT = np.tile(np.eye(3, dtype=np.float32), (FRAMES, 24, 1, 1))


def invoke(*words):
    return CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)


def archive(name):
    info = read_info(find_archive(name))
    return load(info), info.metadata


@pytest.fixture(scope="module")
def arrays():
    motion = resample(read_motion(WALK))
    return recording_arrays(motion, virtual_imus(motion, default_body()), "free")


@pytest.fixture(scope="module")
def folder(arrays, tmp_path_factory):
    """A folder with one recording, of a held-out part."""
    path = tmp_path_factory.mktemp("recordings") / "07" / "07_01.npz"
    path.parent.mkdir()
    np.savez(path, **arrays)
    return path.parents[1]


# --- measures -----------------------------------------------------------------------------------------------


def straight_path(speed):
    """12 s along T's Z axis; the feet stand in turn, for half a second each."""
    t = np.arange(FRAMES) / 60.0
    true = np.stack([0 * t, 0.9 + 0 * t, speed * t], axis=1)
    planted = np.stack([(t % 1.0) < 0.5, (t % 1.0) >= 0.5], axis=1)
    feet = np.zeros((FRAMES, 2, 3))
    # While it stands, a foot stays where it is: it goes back relative to the pelvis.
    feet[:, :, 2] = -speed * (t % 0.5)[:, None]
    return true, feet, planted


def test_the_true_path_has_no_error_and_standing_feet_do_not_slide():
    true, feet, planted = straight_path(1.0)
    row = errors(true, true, feet, planted)
    assert all(abs(values).max() < 1e-6 for values in row.values())
    shifted = errors(true + np.array([3.0, -1.0, 2.0]), true, feet, planted)
    assert all(abs(values).max() < 1e-6 for values in shifted.values())


def test_errors_are_those_of_the_path():
    true, feet, planted = straight_path(1.0)
    row = errors(true * [1.0, 1.0, 1.1], true, feet, planted)
    assert row["2 s"] == pytest.approx(20.0)
    assert row["10 s"] == pytest.approx(100.0)
    assert row["1 m"] == pytest.approx(10.0, abs=0.2)
    assert row["7 m"] == pytest.approx(10.0, abs=0.1)
    assert row["slide"] == pytest.approx(10.0, abs=0.1)
    assert abs(row["height"]).max() == 0.0


def test_a_path_that_rises_has_an_error_of_height():
    true, feet, planted = straight_path(1.0)
    row = errors(true + np.linspace(0.0, [0.0, 0.12, 0.0], FRAMES), true, feet, planted)
    assert row["at end"] == pytest.approx([11.0], abs=0.1)
    assert row["height"].mean() == pytest.approx(5.5, abs=0.1)


def test_short_paths_have_no_long_distances():
    true, feet, planted = straight_path(0.2)
    row = errors(true, true, feet, planted)
    assert len(row["3 m"]) == 0 < len(row["1 m"])


def test_soles_of_a_straight_body_are_on_the_ground():
    offsets = default_body().offsets
    expected = offsets[[1, 4, 7]].sum(axis=0)
    expected[1] += offsets[10][1]
    np.testing.assert_allclose(soles(STRAIGHT[:1])[0, 0], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("velocity", "turn", "contact", "kind"),
    [
        ((0.0, 0.0, 0.1), 0.0, 1, "in place"),
        ((0.1, 0.0, 1.0), 0.0, 1, "forwards"),
        ((0.1, 0.0, -1.0), 0.0, 1, "backwards"),
        ((-1.0, 0.0, 0.1), 0.0, 1, "sideways"),
        ((0.1, 0.0, 1.0), 2.0, 1, "turning"),
        ((0.0, 0.0, 3.0), 0.0, 0, "running"),
        ((0.0, 0.0, 0.5), 0.0, 0, "jumping"),
    ],
)
def test_kinds_of_motion(velocity, turn, contact, kind):
    frames = 120
    place = np.tile(np.array([contact] * 4 + [0] * 3 + list(velocity), np.float32), (frames, 1))
    way = np.arange(frames)[:, None] / 60.0 * np.array(velocity)
    pose = STRAIGHT[:frames].copy()
    pose[:, 0] = rotation_about_axis("y", np.linspace(0.0, turn, frames))
    nothing = np.empty((frames, 6, 3), np.float32)
    take = Take("made up", nothing, nothing, pose, "free", place, translation=way)
    assert kind_of(take, slice(0, frames)) == kind


# --- takes and commands -------------------------------------------------------------------------------------


def test_a_walk_is_followed(folder):
    module, metadata = archive("birnn")
    take = read_take(folder / "07" / "07_01.npz", folder)
    (path,) = measured(module, metadata, [take])
    assert set(path.estimates) == set(ROWS)
    way = np.linalg.norm(take.translation[-1] - take.translation[0])
    error = path.estimates[BOTH] - path.true
    assert np.linalg.norm(error[-1] - error[0]) < 0.12 * way
    assert path.errors[BOTH]["1 m"].mean() < 20.0


def test_poses_are_those_of_a_run(folder):
    module, metadata = archive("rnn")
    take = read_take(folder / "07" / "07_01.npz", folder)
    poses, place = streamed(module, take, metadata["future"])
    assert len(poses) == len(place) == len(take.pose)
    whole = module(torch.from_numpy(take.orientation)[None], torch.from_numpy(take.acceleration)[None])[0]
    np.testing.assert_allclose(poses, whole[0].numpy(), atol=1e-4)


def test_the_command_shows_rows_kinds_and_a_picture(folder, tmp_path):
    picture = tmp_path / "paths.png"
    result = invoke("evaluate", "--data", folder, "--model", "rnn", "--place", "--paths", picture)
    assert result.exit_code == 0, result.output
    assert "cmu-walk-run, rnn: errors of the path" in result.output
    tables = result.output[result.output.index("cmu-walk-run, rnn") : result.output.index("wrote")]
    assert all(len(line) <= 80 for line in tables.splitlines())
    for row in (*ROWS, "truth", "count"):
        assert re.search(rf"^{row} +[\d-]", result.output, re.MULTILINE), row
    assert picture.stat().st_size > 10_000


def test_json_has_the_tables(folder, arrays):
    found = []
    for words in ([], ["--place"]):
        result = invoke("evaluate", "--data", folder, "--model", "rnn", *words, "--json")
        assert result.exit_code == 0, result.output
        found.append(json.loads(result.stdout))
        assert set(found[-1]) == {"command", *documented("evaluate")}
    poses, place = found
    (table,) = poses["tables"]
    assert (table["kind"], table["title"]) == ("poses", "cmu-walk-run")
    assert table["rows"]["offline, whole take"]["sip_error_deg"]["frames"] == len(arrays["poses"])
    assert 2.0 < table["rows"]["offline, whole take"]["sip_error_deg"]["mean"] < 20.0
    (contacts,) = poses["contacts"]
    assert (contacts["part"], contacts["model"]) == ("cmu-walk-run", "rnn")
    assert 0.5 < contacts["contact"] <= 1.0
    assert [table["kind"] for table in place["tables"]] == ["place", "place by motion"]
    rows = place["tables"][0]["rows"]
    assert rows["no heads"]["1 m"]["mean"] > 0.0
    assert rows["no heads"]["10 s"]["mean"] is None  # a way that is too short


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--place", "--table", "3"], "--place has tables and a picture of its own"),
        (["--place", "--online", "stream"], "--place has tables and a picture of its own"),
        (["--place", "--past", "20"], "--place has tables and a picture of its own"),
        (["--paths", "paths.png"], "--paths belongs to --place or --real"),
    ],
)
def test_flags_that_contradict_each_other(folder, words, problem):
    result = invoke("evaluate", "--data", folder, *words)
    assert result.exit_code == 2
    assert problem in " ".join(result.output.split())


def test_recordings_without_contacts_are_refused(arrays, tmp_path):
    old = {name: value for name, value in arrays.items() if name not in ("contact", "velocity")}
    np.savez(tmp_path / "07_01.npz", **old)
    with pytest.raises(EdgeposeError, match="no recording of cmu-walk-run has contacts; make them again"):
        invoke("evaluate", "--data", tmp_path, "--model", "rnn", "--place")


@pytest.mark.parametrize(
    ("trans", "problem"),
    [(np.zeros((3, 3)), "differ in length"), (np.full((9, 3), np.nan), "not finite")],
)
def test_positions_that_cannot_be_are_refused(arrays, tmp_path, trans, problem):
    frames = len(arrays["poses"])
    wrong = np.resize(trans, (frames, 3)) if len(trans) == 9 else trans
    np.savez(tmp_path / "07_01.npz", **(arrays | {"trans": wrong}))
    with pytest.raises(EdgeposeError, match=problem):
        read_take(tmp_path / "07_01.npz")


# --- real wearers -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real():
    return real_paths({name: archive(name) for name in ("birnn", "rnn")}, FOLDER)


@pytest.mark.parametrize("name", ["birnn", "rnn"])
def test_the_walker_comes_back(real, name):
    row = walker_row(real[name][0])
    assert row["difference, %"] < 5.0
    assert row["height, cm"] < 4.0
    assert row["apart, m"] < 0.5
    assert 4.5 < row["out, m"] < 6.0


def test_the_sitter_sits_with_feet_on_the_floor(real):
    row = sitter_row(real["birnn"][1])
    assert 0.35 < row["lowered, m"] < 0.5
    assert abs(row["risen, cm"]) < 3.0
    assert row["feet, cm"] < 3.0
    late = sitter_row(real["rnn"][1])  # is unsure about a wearer who has just sat down
    assert 0.35 < late["standing, m"] - late["after 20 s, m"] < 0.5
    assert abs(late["risen, cm"]) < 3.0
