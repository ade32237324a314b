"""Pose CSV as spreadsheets, pandas and R write it."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from edgepose.convert import Job, convert
from edgepose.errors import FileFormatError
from edgepose.formats.poses.registry import is_poses, read_poses, salvage_poses
from edgepose.pose import PoseFrame
from edgepose.rotations import rotvec_to_matrix
from edgepose.sinks.csv import CsvSink

COUNT = 30
VECTORS = 0.6 * np.sin(np.arange(COUNT * 72).reshape(COUNT, 24, 3) / 9.0)


@pytest.fixture
def lines(tmp_path) -> list[str]:
    """A file of `COUNT` poses as `run` writes it."""
    path = tmp_path / "whole.csv"
    with CsvSink(path) as sink:
        for i, vectors in enumerate(VECTORS):
            held = frozenset(["head"] if i == 4 else [])
            sink.write(PoseFrame(i, 40.0 + i / 60.0, rotvec_to_matrix(vectors), np.zeros(24), None, held))
    return path.read_text().splitlines()


def semicolons(lines: list[str]) -> str:
    return "\r\n".join(line.replace(",", ";").replace(".", ",") for line in lines)


def without(lines: list[str], name: str) -> list[str]:
    at = lines[0].split(",").index(name)
    return [",".join(cell for i, cell in enumerate(line.split(",")) if i != at) for line in lines]


WAYS = {
    "Excel, German": lambda lines: ("\ufeff" + semicolons(lines)).encode(),
    "Excel, UTF-16": lambda lines: "\r\n".join(line.replace(",", "\t") for line in lines).encode("utf-16"),
    "tabs": lambda lines: "\n".join(line.replace(",", "\t") for line in lines).encode(),
    "separator named": lambda lines: ("sep=,\r\n" + "\r\n".join(lines)).encode(),
    "separator named, German": lambda lines: ("sep=;\r\n" + semicolons(lines)).encode(),
    "R": lambda lines: "\n".join(
        [",".join(f'"{name}"' for name in lines[0].split(",")), *lines[1:]]
    ).encode(),
    "R with row names": lambda lines: "\n".join(
        [
            ",".join(f'"{name}"' for name in ["", *lines[0].split(",")]),
            *(f'"{i}",{line}' for i, line in enumerate(lines[1:], start=1)),
        ]
    ).encode(),
    "pandas with index": lambda lines: "\n".join(
        [f",{lines[0]}", *(f"{i},{line}" for i, line in enumerate(lines[1:]))]
    ).encode(),
    "all quoted": lambda lines: "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in lines
    ).encode(),
    "empty rows and columns": lambda lines: "\n".join(
        [line + ",," for line in lines[:9]] + ["," * 80] * 3 + lines[9:] + [","]
    ).encode(),
    "other order of columns": lambda lines: "\n".join(
        ",".join([*line.split(",")[:3], *line.split(",")[12:], *line.split(",")[3:12]]) for line in lines
    ).encode(),
    "17 digits": lambda lines: "\n".join(
        [lines[0]]
        + [
            ",".join([*line.split(",")[:3], *(f"{float(x):.17e}" for x in line.split(",")[3:])])
            for line in lines[1:]
        ]
    ).encode(),
}


@pytest.mark.parametrize("way", WAYS)
def test_the_same_poses_come_back(tmp_path, lines, way):
    path = tmp_path / "a.csv"
    path.write_bytes(WAYS[way](lines))
    assert is_poses(path)
    result = convert(Job(path, tmp_path / "a.npz"))
    assert (result.samples, result.problem) == (COUNT, None)
    poses = read_poses(tmp_path / "a.npz")
    np.testing.assert_allclose(poses.rotations, rotvec_to_matrix(VECTORS), atol=2e-6)
    np.testing.assert_allclose(poses.time_s, 40.0 + np.arange(COUNT) / 60.0, atol=1e-6)
    assert poses.status[4] == "held head"


def test_without_status(tmp_path, lines):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(without(lines, "status")) + "\n")
    assert is_poses(path)
    assert read_poses(path).status == ["ok"] * COUNT


def cells(lines: list[str], column: int, change) -> list[str]:
    rows = [line.split(",") for line in lines]
    for row in rows[1:]:
        row[column] = change(row[column])
    return [",".join(row) for row in rows]


def in_degrees(lines: list[str]) -> list[str]:
    for column in range(3, 75):
        lines = cells(lines, column, lambda cell: str(np.degrees(float(cell))))
    return lines


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (in_degrees, "row 2 has an angle of pelvis beyond a whole turn; angles must be in radians"),
        (lambda lines: without(lines, "neck_y"), "not a file of poses: the names of its columns must be"),
        (lambda lines: without(lines, "time_s"), "starts with 'frame,status,.*, not with 'frame,time_s"),
        (
            lambda lines: [line.replace(".", ",") for line in lines],
            "row 2 has 148 cells for 75 columns: its numbers have decimal commas, and commas separate",
        ),
        (lambda lines: cells(lines, 1, lambda _: ""), "30 bad rows .* row 2 has a cell that is not a number"),
    ],
    ids=["degrees", "joint missing", "time missing", "commas twice", "times empty"],
)
def test_refused(tmp_path, lines, change, says):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(change(lines)) + "\n")
    with pytest.raises(FileFormatError, match=says):
        salvage_poses(path)


def test_a_workbook_is_named(tmp_path):
    path = tmp_path / "a.xlsx"
    with zipfile.ZipFile(path, "w") as book:
        book.writestr("[Content_Types].xml", "<Types/>")
    with pytest.raises(
        FileFormatError, match=r"a\.xlsx is not a file of poses: a workbook or .*; save the sheet"
    ):
        salvage_poses(path)


@pytest.mark.parametrize(
    ("change", "frames", "says"),
    [
        (lambda lines: lines + lines[1:], COUNT, "30 bad rows .* row 32 has frame 0 after frame 29"),
        (lambda lines: [lines[0], *lines[:0:-1]], 1, "row 3 has frame 28 after frame 29; sort the rows"),
        (
            lambda lines: cells(lines, 1, lambda _: "1.7e+09"),
            1,
            r"row 3 has time 1.7e\+09 s as the row before; write times with more digits",
        ),
    ],
    ids=["two takes", "newest first", "times without digits"],
)  # fmt: skip
def test_only_in_part(tmp_path, lines, change, frames, says):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(change(lines)) + "\n")
    poses, problem = salvage_poses(path)
    assert len(poses.frames) == frames
    assert re.search(says, problem)


def test_text_files_are_converted(tmp_path: Path, lines):
    path = tmp_path / "a.txt"
    path.write_bytes(WAYS["Excel, UTF-16"](lines))
    assert convert(Job(path, tmp_path / "a.bvh")).samples == COUNT
