"""`edgepose evaluate --real`: models on recordings of two real wearers."""

import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from edgepose.cli import cli
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording, read_sensors
from edgepose.inference.model import Model
from edgepose.placements import PLACEMENTS, SITES
from edgepose.rotations import geodesic_angle, rotation_about_axis
from edgepose.skeleton import global_rotations
from edgepose_export.archive.model_card import card
from edgepose_export.evaluation import baselines, real_paths
from edgepose_export.evaluation import real_wearers as real

MODELS = ("birnn", "rnn")


def invoke(*words):
    return CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)


@pytest.fixture(scope="module")
def tables():
    return real.measure_models({name: Model(name) for name in MODELS})


@pytest.fixture(scope="module")
def walker():
    return real.read_walker(real.FOLDER)


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(real.FOLDER, tmp_path / "real")


def part(tables, word):
    (title,) = (title for title in tables if word in title)
    return tables[title]


def test_recordings_are_small_and_licensed():
    assert {path.name for path in real.FOLDER.iterdir()} == {*real.FILES, "LICENSES.md"}
    licences = (real.FOLDER / "LICENSES.md").read_text(encoding="utf-8")
    for name in real.FILES:
        assert (real.FOLDER / name).stat().st_size < 750_000
        assert name in licences
    assert set(read_recording(real.FOLDER / real.FILES[0]).sensors) == set(PLACEMENTS)
    further = read_sensors(real.FOLDER / real.FILES[1], tuple(SITES)).sensors
    assert set(further) == set(SITES) - set(PLACEMENTS)


@pytest.mark.parametrize("name", MODELS)
def test_models_beat_what_needs_no_network(tables, name):
    walking = part(tables, "walking")
    for trivial in real.TRIVIAL:
        assert walking[name]["mean of 5"].mean < walking[trivial]["mean of 5"].mean - 2
    assert walking[name]["thighs"].mean < 12
    assert walking[name]["upper arms"].mean < 20
    assert walking[name]["back"].mean < 6
    assert walking[name]["jitter"].mean < walking["nearest sensor"]["jitter"].mean
    for pose, most in (("start", 3), ("end", 5)):
        assert part(tables, f"N-pose, {pose}")[name]["mean of 5"].mean < most
    for side in ("left", "right"):
        thigh = part(tables, "from vertical")[f"{name}, {side}"]
        assert thigh["standing"].mean < 5
        assert 60 < thigh["sitting"].mean < 100
        assert 75 < thigh["after 20 s"].mean < 95
        assert thigh["up again"].mean < 10
        strides = part(tables, "strides")
        shank = strides["nearest sensor"][f"{side}, Hz"]
        assert strides[name][f"{side}, Hz"].mean == pytest.approx(shank.mean, abs=0.01)


def test_what_needs_no_network_is_right_where_the_wearer_does_nothing(tables):
    for trivial in real.TRIVIAL:
        assert part(tables, "N-pose, start")[trivial]["mean of 5"].mean < 1
        assert part(tables, "from vertical")[f"{trivial}, left"]["standing"].mean < 1
        assert part(tables, "from vertical")[f"{trivial}, left"]["after 20 s"].mean < 30
        assert part(tables, "walking")[trivial]["mean of 5"].mean > 14


def test_numbers_of_frames(tables):
    walking = part(tables, "walking")["birnn"]
    assert [metric.frames for metric in walking.values()] == [720, 720, 720, 720, 717]
    assert part(tables, "from vertical")["rnn, left"]["up again"].frames == 600
    assert 15 <= part(tables, "strides")["rnn"]["left, Hz"].frames <= 18


def test_the_truth_is_the_straight_pose_in_the_hold(walker):
    still = walker.during(real.WALKER.hold)
    for name, truth in walker.truth.items():
        angle = {"left_upper_arm": -np.pi / 2, "right_upper_arm": np.pi / 2}.get(name, 0.0)
        away = geodesic_angle(truth[still], rotation_about_axis("z", angle))
        assert np.degrees(away).mean() < 1.5, name
    # Then thighs swing forward and backward of hanging ones, seen in the direction of walking.
    walk = walker.during((7.0, 10.0))
    for name in ("left_upper_leg", "right_upper_leg"):
        down = -walker.truth[name][walk][:, :, 1]
        forward = np.degrees(np.arctan2(down[:, 2], -down[:, 1]))
        sideways = np.degrees(np.arctan2(down[:, 0], -down[:, 1]))
        assert np.ptp(forward) > 40 > 3 * np.ptp(sideways) / 2, name


def test_poses_are_those_of_a_run(tmp_path, walker):
    path, calibration, out = real.FOLDER / real.FILES[0], tmp_path / "c.json", tmp_path / "poses.npz"
    start, end = real.WALKER.hold
    hold = ("--from", start, "--hold", end - start, "--body-frame", real.WALKER.facing)
    assert invoke("calibrate", "--file", path, *hold, "--out", calibration).exit_code == 0
    run = ("run", "--file", path, "--calibration", calibration, "--model", "rnn", "--npz", out)
    assert invoke(*run).exit_code == 0
    poses = read_poses(out)
    expected = Model("rnn").poses(walker.take.orientation, walker.take.acceleration)
    assert len(poses.rotations) == len(expected) == 1253
    assert np.degrees(geodesic_angle(poses.rotations, expected)).max() < 0.01


def test_bones_follow_their_sensors(walker):
    world = global_rotations(baselines.following(walker.take))
    bones = walker.take.orientation
    for joint, sensor in ((1, 2), (2, 3), (9, 5), (16, 0), (17, 1), (18, 0), (12, 4)):
        np.testing.assert_allclose(world[:, joint], bones[:, sensor], atol=1e-5)


# --- command ------------------------------------------------------------------------------------------------


def test_tables_fit_a_terminal(tables):
    for title, table in tables.items():
        assert max(map(len, real.format_table(title, table).splitlines())) <= 80
    assert max(map(len, real.LEGEND.splitlines())) <= 80


def test_command_prints_all_tables(tables):
    said = invoke("evaluate", "--real", "--model", "rnn")
    assert said.exit_code == 0
    for title, table in tables.items():
        rows = {row: columns for row, columns in table.items() if not row.startswith("birnn")}
        assert f"\n{real.format_table(title, rows)}\n" in said.stdout
    assert f"\n{real.LEGEND}\n" in said.stdout
    assert said.stdout.rstrip().endswith(real_paths.LEGEND)


def test_archives_of_ones_own_need_trust(tmp_path):
    path = tmp_path / "mine.pt"
    shutil.copy(real.FOLDER / "LICENSES.md", path)
    with pytest.raises(EdgeposeError, match=r"mine\.pt"):
        invoke("evaluate", "--real", "--model", path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--real", "--past", 0], "omit --past"),
        (["--real", "--part", "all"], "omit --part"),
        (["--real", "--baselines"], "omit --baselines"),
        ([], "give --data FOLDER, or --real"),
        (["--real", "--data", "no-such-folder"], "does not exist"),
    ],
)
def test_wrong_use(words, message):
    result = invoke("evaluate", *words)
    assert result.exit_code == 2
    assert message in result.output


def fails(folder):
    with pytest.raises(EdgeposeError) as caught:
        invoke("evaluate", "--real", "--model", "rnn", "--data", folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_missing_recordings_are_named(folder):
    (folder / real.FILES[1]).unlink()
    said = fails(folder)
    assert f"{folder}: has no {real.FILES[1]};" in said
    assert "--data" in said


@pytest.mark.parametrize(("file", "sensor"), [(0, "head"), (1, "left_upper_arm"), (2, "pelvis")])
def test_missing_sensors_are_named(folder, file, sensor):
    path = folder / real.FILES[file]
    recording = read_sensors(path, tuple(SITES))
    sensors = {name: data for name, data in recording.sensors.items() if name != sensor}
    write_npz(path, recording._replace(sensors=sensors))
    assert fails(folder).startswith(f"{path}: no samples of {sensor}; ")


def test_recordings_that_end_early_are_named(folder):
    path = folder / real.FILES[2]
    recording = read_recording(path)
    sensors = {
        name: data._replace(time_s=data.time_s[:2000], quat=data.quat[:2000], acc=data.acc[:2000])
        for name, data in recording.sensors.items()
    }
    write_npz(path, recording._replace(sensors=sensors))
    assert fails(folder).startswith(f"{path}: ends at 60.0 s;")


def test_damaged_recordings_are_named(folder):
    path = folder / real.FILES[1]
    path.write_bytes(path.read_bytes()[:50_000])
    assert fails(folder).startswith(f"{path}: not a complete NPZ file")


def test_cards_have_them(tables):
    about = Model("birnn").metadata
    text = card(about | {"real": {title: dict(table) for title, table in tables.items()}})
    assert "## Accuracy on real wearers" not in card(about | {"real": {}})
    section = text.partition("## Accuracy on real wearers")[2].partition("\n## ")[0]
    mean = part(tables, "walking")["birnn"]["mean of 5"]
    assert f" {mean.mean:.1f} ± {mean.std:.1f} |" in section
    assert section.count("### ") == len(tables) == 5
