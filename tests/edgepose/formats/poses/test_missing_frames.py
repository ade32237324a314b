"""Files of poses with rounded times and without some of their rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from edgepose.convert import Job, Options, convert, convert_poses
from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import read_bvh
from edgepose.formats.poses.registry import read_poses
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame
from edgepose.sinks.csv import CsvSink

REAL = Path(__file__).parents[3] / "data" / "imu" / "six-sites-3s.npz"
COUNT = 240
TURNS = Rotation.from_rotvec(np.cumsum(np.full((COUNT, 3), [0.02, -0.01, 0.03]), axis=0))


def write(path: Path, frames: range | list[int], digits: int = 9) -> Path:
    """Poses at 60 Hz, all joints turning alike, of which only some frames are written."""
    with CsvSink(path) as sink:
        for i in frames:
            rotations = np.tile(TURNS[i].as_matrix(), (24, 1, 1)).astype(np.float32)
            sink.write(PoseFrame(i, round(i / 60.0, digits), rotations, np.zeros(24), None))
    return path


def frame_time(path: Path) -> tuple[int, float]:
    tree = read_bvh(path)
    return len(tree.rotations), 1.0 / tree.rate


@pytest.mark.parametrize("digits", [9, 3, 2])
def test_rounded_times(tmp_path, digits):
    poses = read_poses(write(tmp_path / "a.csv", range(COUNT), digits))
    assert poses.rate == pytest.approx(60.0, rel=1e-3)
    convert_poses(tmp_path / "a.csv", tmp_path / "a.bvh")
    count, seconds = frame_time(tmp_path / "a.bvh")
    assert count == COUNT
    assert seconds == pytest.approx(1.0 / 60.0, rel=1e-3)


def test_a_pause_does_not_count(tmp_path):
    with CsvSink(tmp_path / "a.csv") as sink:
        for i in range(COUNT):
            sink.write(
                PoseFrame(
                    i,
                    i / 60.0 + 100.0 * (i > 100),
                    np.tile(np.eye(3, dtype=np.float32), (24, 1, 1)),
                    np.zeros(24),
                )
            )
    assert read_poses(tmp_path / "a.csv").rate == 60.0


def test_every_second_row(tmp_path):
    write(tmp_path / "a.csv", range(0, COUNT, 2))
    assert read_poses(tmp_path / "a.csv").rate == 30.0
    _, _, damage = convert_poses(tmp_path / "a.csv", tmp_path / "a.bvh")
    assert damage is None
    assert frame_time(tmp_path / "a.bvh") == (COUNT // 2, pytest.approx(1.0 / 30.0))
    convert_poses(tmp_path / "a.csv", tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["mocap_framerate"] == 30.0


@pytest.mark.parametrize("ending", ["bvh", "npz"])
def test_lost_rows(tmp_path, ending):
    kept = [i for i in range(COUNT) if i % 7 and not 100 < i < 110] + [COUNT]
    kept = [i for i in kept if i < COUNT]
    write(tmp_path / "a.csv", kept)
    count, seconds, damage = convert_poses(tmp_path / "a.csv", tmp_path / f"a.{ending}")
    missing = kept[-1] - kept[0] + 1 - len(kept)
    assert (count, damage) == (
        len(kept),
        f"{tmp_path / 'a.csv'}: {missing} frames are missing between its poses; they are interpolated",
    )
    poses = read_poses(tmp_path / f"a.{ending}")
    assert len(poses.frames) == len(kept) + missing
    assert poses.rate == 60.0
    wanted = Slerp(kept, TURNS[kept])(np.arange(kept[0], kept[-1] + 1))
    np.testing.assert_allclose(poses.rotations[:, 5], wanted.as_matrix(), atol=1e-4)
    assert seconds == pytest.approx((kept[-1] - kept[0]) / 60.0)
    if ending == "npz":
        assert [held == frozenset(PLACEMENTS) for held in poses.held] == [
            i not in kept for i in range(kept[0], kept[-1] + 1)
        ]


def test_the_place_in_lost_rows(tmp_path):
    with CsvSink(tmp_path / "a.csv", translation=True, contacts=True) as sink:
        for i in (0, 1, 2, 4, 8):
            place = np.array([0.1 * i, 1.0, -0.2 * i]), frozenset[str](), False, np.full(7, i / 8, np.float32)
            sink.write(PoseFrame(i, i / 60.0, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24), *place))
    _, _, damage = convert_poses(tmp_path / "a.csv", tmp_path / "a.npz")
    assert damage.endswith("4 frames are missing between its poses; they are interpolated")
    poses = read_poses(tmp_path / "a.npz")
    steps = np.arange(9)
    np.testing.assert_allclose(
        poses.translation, np.stack([0.1 * steps, 0 * steps + 1, -0.2 * steps], 1), atol=1e-6
    )
    np.testing.assert_allclose(poses.contacts, np.tile(steps[:, None] / 8, 7), atol=1e-6)


def test_numbers_far_apart(tmp_path):
    write(tmp_path / "a.csv", [0, 1, 2, 200])
    with pytest.raises(EdgeposeError, match="197 frames are missing between its 4 poses"):
        convert_poses(tmp_path / "a.csv", tmp_path / "a.bvh")


def test_quotes_around_the_names_of_columns(tmp_path):
    """As R writes them: `convert` takes it for poses, too, and not for a recording."""
    path = write(tmp_path / "a.csv", range(COUNT))
    header, rest = path.read_text().split("\n", 1)
    path.write_text(",".join(f'"{name}"' for name in header.split(",")) + "\n" + rest)
    result = convert(Job(path, tmp_path / "b.npz"))
    assert (result.problem, result.samples) == (None, COUNT)


@pytest.mark.parametrize(("step", "rate"), [(1, 24.0), (1, 90.0), (2, 30.0), (2, 60.0)])
def test_another_rate(tmp_path, step, rate):
    """Of a file in which rows are missing, too; if only every second row was kept, 30 Hz are its own."""
    kept = [i for i in range(0, COUNT, step) if i not in (40, 42, 44)]
    write(tmp_path / "a.csv", kept)
    for to in ("csv", "bvh"):
        result = convert(Job(tmp_path / "a.csv", tmp_path / f"b.{to}"), Options(rate=rate))
        missing = COUNT // step - len(kept)
        assert f"{missing} frames are missing between its poses; they are interpolated" in result.problem
        poses = read_poses(tmp_path / f"b.{to}")
        seconds = kept[-1] / 60.0
        assert len(poses.frames) == result.samples == int(seconds * rate + 1e-6) + 1
        assert poses.rate == rate
        places = 60.0 / rate * np.arange(len(poses.frames))
        wanted = Slerp(kept, TURNS[kept])(places).as_matrix()
        np.testing.assert_allclose(poses.rotations[:, 5], wanted, atol=1e-4)
    assert read_poses(tmp_path / "b.csv").held[0] == frozenset()


@pytest.mark.parametrize("rate", [7.0, 30.0, 100.0])
def test_another_rate_about_a_pause(tmp_path, rate):
    """All sensors were silent for long, so frame numbers go on; no pose is made up in between."""
    with CsvSink(tmp_path / "a.csv") as sink:
        for i in range(COUNT):
            time_s = i / 60.0 + (90.0 if i >= 31 else 0.0)
            sink.write(PoseFrame(i, time_s, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24)))
    result = convert(Job(tmp_path / "a.csv", tmp_path / "b.csv"), Options(rate=rate))
    assert result.problem is None
    times = read_poses(tmp_path / "b.csv").time_s
    wanted = [np.arange(int(30 / 60 * rate + 1e-6) + 1) / rate]
    wanted += [90.0 + 31 / 60 + np.arange(int((COUNT - 32) / 60 * rate + 1e-6) + 1) / rate]
    np.testing.assert_allclose(times, np.concatenate(wanted), atol=2e-6)


def test_a_recording_has_no_rate_of_poses(tmp_path):
    result = convert(Job(REAL, tmp_path / "a.csv"), Options(rate=30.0))
    assert result.problem.endswith("--rate is for poses, not for recordings; leave it out")
