"""`edgepose report`, and the angles and steps in it."""

from __future__ import annotations

import base64
import io
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import click
import matplotlib.image
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import edgepose
from edgepose.analysis.joint_angles import ANGLES, LIMBS, joint_angles, walking_bouts
from edgepose.analysis.path import path_of
from edgepose.analysis.report import POINTS, extremes, write_report
from edgepose.cli import cli
from edgepose.convert import Job, convert
from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.pose import PoseFrame, longest_holds, parse_status
from edgepose.rotations import rotvec_to_matrix
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.npz import NpzSink
from edgepose.skeleton import JOINTS, default_body, local_from_global
from edgepose_export.mocap import read_motion

WALK = Path(__file__).parents[3] / "tools" / "data" / "09_12.bvh"
CLIPS = Path(__file__).parents[2] / "data" / "mocap"
SHORT_WALK = CLIPS / "dataset-2_walk_normal_001.bvh"
OTHER = CLIPS / "dataset-2_raise-up-right-hand_normal_001.bvh"


def pose(**turns: tuple[str, object]) -> np.ndarray:
    """A T-pose (1, 24, 3, 3) in which some joints are turned; axes and degrees as scipy takes them."""
    local = np.tile(np.eye(3), (1, 24, 1, 1))
    for joint, (axes, angles) in turns.items():
        local[0, JOINTS.index(joint)] = Rotation.from_euler(axes, angles, degrees=True).as_matrix()
    return local


# --- angles and steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("turns", "name", "degrees"),
    [
        ({}, "trunk lean", 0),
        ({"left_hip": ("x", -40)}, "left hip flexion", 40),
        ({"right_hip": ("x", 15)}, "right hip flexion", -15),
        ({"left_hip": ("z", 20)}, "left hip abduction", 20),
        ({"right_hip": ("z", -20)}, "right hip abduction", 20),
        ({"right_knee": ("x", 110)}, "right knee flexion", 110),
        ({"left_shoulder": ("z", -90)}, "left shoulder elevation", 0),
        ({"right_shoulder": ("z", -60)}, "right shoulder elevation", 150),
        ({"left_collar": ("z", 30)}, "left shoulder elevation", 120),
        ({"left_elbow": ("y", -75)}, "left elbow flexion", 75),
        ({"right_elbow": ("y", 75)}, "right elbow flexion", 75),
        ({"spine1": ("x", 10), "spine2": ("x", 20)}, "trunk flexion", 30),
        ({"spine2": ("z", -12)}, "trunk side bend", 12),
        ({"spine3": ("y", 25)}, "trunk rotation", 25),
        ({"pelvis": ("YX", [70, 35])}, "trunk lean", 35),
    ],
)
def test_known_poses_have_the_angles_of_their_names(turns, name, degrees):
    angles = joint_angles(pose(**turns))
    assert angles[name] == pytest.approx(degrees, abs=1e-6)
    straight = joint_angles(pose())
    changed = {key for key in angles if abs(angles[key][0] - straight[key][0]) > 1e-6}
    also = {"trunk lean"} if name.startswith("trunk") and "rotation" not in name else set()
    assert changed <= {name} | also
    assert len(angles) == 2 * len(LIMBS) + len(ANGLES) - len(LIMBS)


def motion(path: Path) -> tuple[np.ndarray, float]:
    read = read_motion(path)
    return local_from_global(read.rotations), read.rate


def test_steps_of_a_real_walk_and_of_a_mirrored_one():
    local, rate = motion(WALK)
    offsets = default_body().offsets
    (walk,) = walking_bouts(local, offsets, rate)
    assert len(walk.frames) == 29
    assert (walk.left[1:] != walk.left[:-1]).all()
    cadence = 60.0 * rate / np.diff(walk.frames).mean()
    assert 80 < cadence < 140
    mirror = np.diag([-1.0, 1.0, 1.0])
    sides = {"left": "right", "right": "left"}
    swap = [JOINTS.index("_".join(sides.get(word, word) for word in name.split("_"))) for name in JOINTS]
    (other,) = walking_bouts(mirror @ local[:, swap] @ mirror, offsets, rate)
    np.testing.assert_array_equal(other.frames, walk.frames)
    np.testing.assert_array_equal(other.left, ~walk.left)
    # Twice as slow: the same steps, half the cadence.
    (slow,) = walking_bouts(np.repeat(local, 2, axis=0), offsets, 2 * rate)
    assert np.abs(slow.frames / 2 - walk.frames).max() <= 1


def test_no_steps_where_nobody_walks():
    offsets = default_body().offsets
    for clip in (OTHER, SHORT_WALK):  # the other is of two steps
        local, rate = motion(clip)
        assert walking_bouts(local, offsets, rate) == []
    assert walking_bouts(pose(), offsets, 60.0) == []


def test_longest_holds():
    held = np.zeros((9, 6), bool)
    held[2:5, 1] = held[6:8, 1] = held[8:, 4] = True
    held[:, 5] = True
    assert longest_holds(held).tolist() == [0, 3, 0, 0, 1, 9]
    assert longest_holds(np.zeros((0, 6), bool)).tolist() == [0] * 6


# --- the page -----------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Rows of all tables, images, and text of a page in which every tag is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.images: list[np.ndarray] = []
        self.links: list[str] = []
        self.words = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        if tag == "img":
            kind, _, data = found["src"].partition(",")
            assert kind == "data:image/png;base64"
            self.images.append(matplotlib.image.imread(io.BytesIO(base64.b64decode(data))))
            assert found["alt"]
        elif tag != "meta":
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        self.links += [str(found[key]) for key in ("href", "src") if key in found and tag != "img"]

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        self.words += data


def write(path: Path, local: np.ndarray, rate: float) -> None:
    with CsvSink(path) as sink:
        for i, rotations in enumerate(local):
            status = "held head" if 10 <= i < 16 else "filling window" if i < 4 else "ok"
            state = parse_status(status)
            sink.write(PoseFrame(i, 1.7e9 + i / rate, rotations, np.zeros(24), None, *state))


def test_short_peaks_are_drawn():
    """One pose in hours, up and down, in the middle and at the end."""
    for count in (1, 2000, 3001, 432_007):
        values = np.sin(np.arange(count) / 1000)
        values[count // 3], values[-1] = 90.0, -90.0
        shown = extremes(values)
        assert (np.diff(shown) > 0).all()
        assert 0 <= shown[0] <= shown[-1] < count
        assert len(shown) <= POINTS
        assert values[shown].max() == values.max()
        assert values[shown].min() == values.min()


def test_page_of_a_walk(command, tmp_path):
    local, rate = motion(WALK)
    name = "walk & <b>.csv"
    write(tmp_path / name, local, rate)
    result = command("report", tmp_path / name)
    assert result.returncode == 0, result.stderr
    page = Page((tmp_path / "walk & <b>.html").read_text(encoding="utf-8"))
    assert result.stdout == f"Wrote {tmp_path / 'walk & <b>.html'}.\n"
    assert name in page.words
    assert "Model, calibration and recording are not in this file." in page.words
    assert page.links == []
    assert [image.shape[1] for image in page.images] == [1600, 990]
    rows = {row[0]: row[1:] for row in page.rows}
    (walk,) = walking_bouts(read_poses(tmp_path / name).rotations, default_body().offsets, rate)
    assert rows["steps"][0].startswith(f"{len(walk.frames)} in ")
    cadence = 60.0 * rate / np.diff(walk.frames).mean()
    assert int(rows["cadence"][0].split()[0]) == pytest.approx(cadence, abs=0.6)
    knee = joint_angles(local)["left knee flexion"]
    low, high, span, mean = map(float, rows["left knee flexion"][:4])
    assert knee.min() - 1 <= low < high <= knee.max() + 1
    assert span == pytest.approx(high - low, abs=1.1)
    assert mean == pytest.approx(knee.mean(), abs=0.6)
    assert {f"{side} {limb}" for side in ("left", "right") for limb in LIMBS} <= rows.keys()
    assert rows["head"][0] == "6"
    assert rows["head"][2] == f"{6 / rate:.2f} s"
    assert rows["pelvis"][0] == "0"
    assert "In 4 poses the window was filling." in page.words


def test_the_path_there_and_back():
    """At 1.2 m/s, with hips that sway by 3 cm in every stride of a second."""
    times = np.arange(0.0, 10.0, 1 / 60.0)
    forward = 1.2 * np.minimum(times, 10.0 - times)
    places = np.stack([0.03 * np.sin(2 * np.pi * times), np.full(600, 0.95), forward], axis=1)
    path = path_of(places, 60.0)
    assert path.distance_m == pytest.approx(12.0, rel=0.03)
    assert path.apart_m == pytest.approx(0.0, abs=0.05)
    assert np.median(path.speed) == pytest.approx(1.2, rel=0.01)
    assert path.speed.max() < 1.3
    still = path_of(np.tile([3.0, 0.95, -2.0], (50, 1)), 60.0)
    assert (still.distance_m, still.apart_m, still.speed.max()) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    swaying = np.stack([0.05 * np.sin(times), np.full(600, 0.95), 0.05 * np.cos(3.0 * times)], axis=1)
    assert path_of(swaying, 60.0).distance_m < 0.15
    assert path_of(places[:1], 60.0).distance_m == 0.0
    assert path_of(places[:2], 60.0).distance_m == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("contacts", [False, True])
def test_page_with_a_path(tmp_path, contacts):
    """Straight to the left at 1.5 m/s, whatever the legs do."""
    local, rate = motion(WALK)
    touching = np.zeros(7, np.float32) if contacts else None
    with CsvSink(tmp_path / "a.csv", translation=True, contacts=contacts) as sink:
        for i, rotations in enumerate(local):
            place = np.array([1.5 * i / rate, 0.9 + 0.1 * (i % 2), 0.0])
            state = frozenset[str](), False, touching
            sink.write(PoseFrame(i, i / rate, rotations, np.zeros(24), place, *state))
    write_report(tmp_path / "a.html", read_poses(tmp_path / "a.csv"), default_body(), "a")
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    rows = {row[0]: row[1:] for row in page.rows}
    seconds = (len(local) - 1) / rate
    assert rows["length"] == rows["from start to end"] == [f"{1.5 * seconds:.1f} m"]
    assert rows["speed of walking"] == rows["highest speed"] == ["1.50 m/s"]
    assert rows["height of the pelvis"] == ["0.90 to 1.00 m"]
    for side in ("left", "right"):
        step_s = float(rows[f"time of a {side} step"][0].split()[0])
        step_m = float(rows[f"length of a {side} step"][0].split()[0])
        assert step_m == pytest.approx(1.5 * step_s, abs=0.015)
    assert [image.shape[1] for image in page.images] == [1600, 990, 990]
    # One line along the middle, from the bottom to the top, where "to the left" points.
    blue = page.images[1][..., 2] - page.images[1][..., 0] > 0.3
    row, column = np.nonzero(blue[60:])
    assert np.ptp(row) > 200
    assert np.ptp(column) < 20


def test_values_that_were_not_measured(tmp_path):
    """Ranges leave them out; the picture shows them on hatching."""
    count = 300
    vectors = np.zeros((count, 24, 3))
    vectors[:, JOINTS.index("left_knee"), 0] = np.radians(np.linspace(0, 30, count))
    vectors[:, JOINTS.index("left_elbow"), 1] = -np.radians(np.linspace(0, 40, count))
    vectors[200:260, JOINTS.index("left_knee"), 0] = np.radians(120)

    def page(name, held):
        with CsvSink(tmp_path / f"{name}.csv") as sink:
            for i, rotations in enumerate(rotvec_to_matrix(vectors)):
                names = frozenset(held if 200 <= i < 260 else ())
                sink.write(PoseFrame(i, i / 60.0, rotations, np.zeros(24), None, names))
        write_report(tmp_path / f"{name}.html", read_poses(tmp_path / f"{name}.csv"), default_body(), name)
        found = Page((tmp_path / f"{name}.html").read_text(encoding="utf-8"))
        return {row[0]: row[1:] for row in found.rows}, found

    rows, whole = page("whole", ())
    assert rows["left knee flexion"][:5] == ["0", "120", "120", rows["left knee flexion"][3], "0 %"]
    rows, partly = page("partly", ("left_lower_leg",))
    assert rows["left knee flexion"][1] == "30"
    assert rows["left hip flexion"][4] == rows["left knee flexion"][4] == "20 %"
    assert rows["right knee flexion"][4] == rows["left elbow flexion"][4] == rows["trunk lean"][4] == "0 %"
    assert "not measured, because a sensor of the angle sent nothing" in partly.words
    # The curves of the knees differ, and so do the labels of figures; those of the elbows do not.
    panels = np.abs(whole.images[1] - partly.images[1]).max(axis=(1, 2))
    height = len(panels) // len(ANGLES)
    assert panels[2 * height : 3 * height].max() > 0.1
    assert panels[4 * height + 30 : 5 * height].max() < 0.01
    assert whole.images[0].shape != partly.images[0].shape or (whole.images[0] != partly.images[0]).any()


def test_a_sensor_that_never_sent(tmp_path):
    with CsvSink(tmp_path / "a.csv") as sink:
        sink.write(
            PoseFrame(0, 0.0, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24), None, frozenset(["pelvis"]))
        )
    write_report(tmp_path / "a.html", read_poses(tmp_path / "a.csv"), default_body(), "a")
    rows = {row[0]: row[1:] for row in Page((tmp_path / "a.html").read_text(encoding="utf-8")).rows}
    assert rows["left elbow flexion"][:5] == ["-", "-", "-", "-", "100 %"]


def test_page_names_where_poses_come_from(tmp_path):
    about = {"model": "rnn", "calibration": "ca<li>b.json", "source": "walk.npz", "date": "2026-01-02 10:00"}
    with NpzSink(tmp_path / "a.npz", about=about | {"edgepose": "0.0.9"}) as sink:
        for i in range(3):
            sink.write(PoseFrame(i, i / 60.0, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24)))
    convert(Job(tmp_path / "a.npz", tmp_path / "b.npz"))  # keeps it
    write_report(tmp_path / "b.html", read_poses(tmp_path / "b.npz"), default_body(), "b.npz")
    rows = {row[0]: row[1:] for row in Page((tmp_path / "b.html").read_text(encoding="utf-8")).rows}
    assert rows["poses"] == ["b.npz"]
    assert rows["model"] == ["rnn"]
    assert rows["calibration"] == ["ca<li>b.json"]
    assert rows["recording or port"] == ["walk.npz"]
    assert rows["made"] == ["2026-01-02 10:00"]
    assert rows["made with"] == ["edgepose 0.0.9"]
    assert rows["report made with"] == [f"edgepose {edgepose.__version__}"]


def test_page_of_a_single_pose_to_another_file(command, tmp_path):
    write(tmp_path / "a.csv", pose(), 60.0)
    result = command("report", tmp_path / "a.csv", "--out", tmp_path / "b.html", "--height", "1.6")
    assert result.returncode == 0, result.stderr
    page = Page((tmp_path / "b.html").read_text(encoding="utf-8"))
    assert "No walking was found." in page.words
    assert re.search(r"1 poses, 0\.0 s", page.words)


def test_page_of_a_bvh_file(command, tmp_path):
    local, rate = motion(WALK)
    with BvhSink(tmp_path / "a.bvh", rate) as sink:
        for i, rotations in enumerate(local):
            sink.write(PoseFrame(i, i / rate, rotations, np.zeros(24)))
    result = command("report", tmp_path / "a.bvh")
    assert result.returncode == 0, result.stderr
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    (walk,) = walking_bouts(local, default_body().offsets, rate)
    steps = {row[0]: row[1:] for row in page.rows}["steps"][0]
    assert steps.startswith(f"{len(walk.frames)} in ")


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("nothing.csv", 1, "cannot read poses from nothing.csv"),
        ("a.csv --out no/a.html", 1, "its folder does not exist"),
        ("a.csv --out a.csv", 2, "--out would overwrite a.csv"),
        ("a.csv --height 17", 2, "17.0 is not in the range 0.8<=x<=2.5 metres"),
        ("a.csv --leg-length 1.4", 1, "leg length 1.4 m does not fit a height of 1.75 m"),
    ],
)
def test_wrong_use(command, tmp_path, words, code, says):
    write(tmp_path / "a.csv", pose(), 60.0)
    result = command("report", *words.split(), cwd=tmp_path)
    assert result.returncode == code
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_without_matplotlib(monkeypatch, tmp_path):
    write(tmp_path / "a.csv", pose(), 60.0)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(EdgeposeError, match=r"pip install 'edgepose\[plot\]'"):
        write_report(tmp_path / "a.html", read_poses(tmp_path / "a.csv"), default_body(), "a")


def test_documented_commands_are_understood():
    docs = (Path(__file__).parents[3] / "docs" / "guide" / "report.md").read_text()
    documented = re.findall(r"^edgepose report (.*)$", docs, re.MULTILINE)
    assert len(documented) >= 2
    for words in documented:
        cli.get_command(click.Context(cli), "report").make_context("report", words.split())
    for name in ANGLES:  # each has its place in the table
        what = name.removeprefix("trunk ")
        assert re.search(rf"^\| [a-z ,]*{what.split()[-1]}", docs, re.MULTILINE)
