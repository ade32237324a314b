import runpy
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.colors import to_rgb

from edgepose.analysis.figures import PREDICTION, REFERENCE, project, skeleton_strip
from edgepose.errors import EdgeposeError
from edgepose.pose import PoseFrame
from edgepose.rotations import rotation_about_axis
from edgepose.sinks.csv import CsvSink
from edgepose.skeleton import forward_kinematics

TOOL = Path(__file__).parents[3] / "tools" / "draw_poses.py"

# A plausible grown-up: offsets of the middle and the left side, metres.
OFFSETS = np.zeros((24, 3))
for joint, place in {
    1: (0.07, -0.09, 0), 3: (0, 0.11, -0.02), 4: (0.035, -0.39, 0), 6: (0, 0.135, 0.02),
    7: (-0.015, -0.40, -0.04), 9: (0, 0.055, 0), 10: (0.03, -0.06, 0.125), 12: (0, 0.21, -0.035),
    13: (0.08, 0.115, -0.02), 15: (0, 0.09, 0.05), 16: (0.10, 0.04, -0.02), 18: (0.26, -0.01, -0.02),
    20: (0.25, 0.01, 0), 22: (0.085, -0.01, -0.01),
}.items():  # fmt: skip
    OFFSETS[joint] = place
for left in (1, 4, 7, 10, 13, 16, 18, 20, 22):
    OFFSETS[left + 1] = OFFSETS[left] * [-1, 1, 1]


def n_pose() -> np.ndarray:
    pose = np.tile(np.eye(3), (24, 1, 1))
    pose[16], pose[17] = rotation_about_axis("z", -1.3), rotation_about_axis("z", 1.3)
    return pose


def left_arm_up() -> np.ndarray:
    pose = n_pose()
    pose[16] = rotation_about_axis("z", 1.3)
    return pose


def where(image: np.ndarray, colour: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of one colour, the legend left out."""
    rows, columns = np.nonzero(np.abs(image[..., :3] - to_rgb(colour)).max(axis=-1) < 0.02)
    return rows[rows > 100], columns[rows > 100]


def test_left_is_at_the_viewers_right():
    _, joints = forward_kinematics(left_arm_up(), OFFSETS)
    points, _ = project(joints)
    assert points[22, 0] > points[23, 0]
    assert points[22, 1] > points[15, 1] > points[23, 1]
    _, depths = project([[0, 0, 1], [0, 0, -1]])
    assert depths[0] > depths[1]  # What is before the figure is nearer to the viewer.


def test_picture_is_not_mirrored(tmp_path):
    path = tmp_path / "strip.png"
    skeleton_strip(path, left_arm_up()[None], [0.0], OFFSETS)
    image = matplotlib.image.imread(path)
    assert image.shape[1] == 1600
    (left_rows, left_columns), (right_rows, right_columns) = (
        where(image, PREDICTION[s]) for s in ("left", "right")
    )
    assert len(left_rows) > 1000
    assert len(right_rows) > 1000
    assert left_columns.mean() > right_columns.mean()
    assert left_rows.min() < right_rows.min()  # The raised arm reaches higher.


def test_reference_stands_below(tmp_path):
    path = tmp_path / "strip.png"
    poses = np.stack([n_pose(), left_arm_up(), np.tile(np.eye(3), (24, 1, 1))])
    skeleton_strip(path, poses, [0.0, 0.5, 1.0], OFFSETS, reference=poses, title="PoseSequence")
    image = matplotlib.image.imread(path)
    rows, columns = where(image, PREDICTION["trunk"])
    reference_rows, reference_columns = where(image, REFERENCE["trunk"])
    # Smoothed letters of the title and legend hold a few pixels of any grey.
    assert np.percentile(reference_rows, 1) > rows.max()
    assert abs(columns.mean() - reference_columns.mean()) < 3
    assert len(set(columns)) < columns.max() - columns.min()  # Figures stand apart.


def test_what_cannot_be_drawn(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="same instants"):
        skeleton_strip(tmp_path / "a.png", n_pose()[None], [0.0, 1.0], OFFSETS)
    with pytest.raises(EdgeposeError, match="cannot write the picture"):
        skeleton_strip(tmp_path / "no" / "a.png", n_pose()[None], [0.0], OFFSETS)
    with pytest.raises(EdgeposeError, match="cannot write the picture"):
        skeleton_strip(tmp_path / "a.xyz", n_pose()[None], [0.0], OFFSETS)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(EdgeposeError, match=r"pip install 'edgepose\[plot\]'"):
        skeleton_strip(tmp_path / "a.png", n_pose()[None], [0.0], OFFSETS)


def test_tool(tmp_path):
    main = runpy.run_path(str(TOOL))["main"]
    source = tmp_path / "poses.csv"
    with CsvSink(source) as sink:
        for i in range(60):
            sink.write(PoseFrame(i, 1.7e9 + i / 60, left_arm_up(), np.zeros(24)))
    out = tmp_path / "strip.png"
    result = CliRunner().invoke(
        main, [str(source), "--times", "0,0.5", "--reference", str(source), "--out", str(out)]
    )
    assert result.exit_code == 0, result.output
    assert matplotlib.image.imread(out).shape[1] == 1600
    result = CliRunner().invoke(main, [str(source), "--count", "4", "--out", str(out)])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(main, [str(source), "--times", "99", "--out", str(out)])
    assert result.exit_code == 1
    assert "has no pose at" in result.output
    result = CliRunner().invoke(main, [str(source), "--times", "a", "--out", str(out)])
    assert result.exit_code == 2
