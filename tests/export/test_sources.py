"""Sources, actors and parts of takes by their paths, on the paths of the published motion."""

import re
from collections import Counter, defaultdict
from pathlib import Path

import pytest

from edgepose.errors import EdgeposeError
from edgepose_export.training.dataset import measured_parts, parts_of, take_paths, training_paths
from edgepose_export.training.sources import ABOUT, GROUPS, HELD_OUT, SOURCES, VALIDATION, part_of, take_info

PATHS = (Path(__file__).parents[1] / "data" / "mocap" / "paths.txt").read_text().split()
"""All motion files of the sources; of the second dataset of Bandai-Namco, the first of each kind."""

TAKES = [path.rsplit(".", 1)[0] for path in PATHS]


def by(key):
    """Return the parts of the takes for each value of a key."""
    parts = defaultdict(set)
    for take in TAKES:
        if key(take) is not None:
            parts[key(take)].add(part_of(take))
    return parts


def found(pattern):
    """Return a key: the groups of a pattern."""
    return lambda take: (match := re.search(pattern, take)) and match.groups()


def test_parts_of_published_motion():
    assert Counter(map(part_of, TAKES)) == {
        "train": 682,
        "cmu-walk-run": 52,
        "cmu-02": 12,
        "cmu-03": 4,
        "bandai-styles": 19,
        "bandai-not-confident": 10,
        "basketball": 16,
        "basketball-validation": 12,
        "tennis": 2,
        "tennis-validation": 2,
        "boxing": 1,
        "boxing-validation": 1,
        "martial-arts": 4,
        "martial-arts-validation": 4,
        "pushes": 14,
        "walks-validation": 2,
        "jumps-validation": 4,
        "unused": 10,
    }
    assert set(map(part_of, TAKES)) == {*HELD_OUT, *VALIDATION, "train", "unused"}
    assert set(ABOUT) == {*HELD_OUT, *VALIDATION}
    assert set(GROUPS["sports"]) <= set(HELD_OUT)
    assert GROUPS["validation"] == VALIDATION


def test_every_published_take_has_its_source():
    counts = Counter(take_info(take).source.name for take in TAKES)
    assert counts.pop("own") == 4  # t_pose.bvh, in no part
    assert set(counts) == {*SOURCES} - {"amass"}
    assert counts["snu-basketball"] == 96
    assert counts["snu-martial-arts"] == 16
    assert counts["cmu-extra"] == 20


@pytest.mark.parametrize(
    ("take", "source", "actor", "part", "free"),
    [
        ("01_01", "cmu", "cmu 01", "train", True),
        ("06_15.part2", "cmu", "cmu 06", "train", True),
        ("directing_traffic_1.part6", "cmu-extra", "cmu-extra directing_traffic", "train", True),
        ("02_03.part1", "cmu", "cmu 02", "cmu-02", True),
        ("seated/03_01.seated", "cmu", "cmu 03", "cmu-03", True),
        ("107_12", "cmu", "cmu 107", "train", True),
        ("cmu-more/69/69_09_1", "cmu", "cmu 69", "train", True),
        ("cmu-more/60/60_09_scaled", "cmu", "cmu 60", "train", True),
        ("CMU/07/07_01_poses", "amass", "amass CMU/07", "cmu-walk-run", False),
        ("CMU/02/02_01_stageii", "amass", "amass CMU/02", "cmu-02", False),
        ("ACCAD/s007/QkWalk1_poses", "amass", "amass ACCAD/s007", "train", False),
        ("dataset-1_walk_tired_001", "bandai-namco", "bandai-namco dataset-1", "bandai-styles", False),
        ("dataset-2_walk_normal_001", "bandai-namco", "bandai-namco dataset-2", "train", False),
        ("s_008_2_3.part1.seated", "snu-basketball", "snu-basketball 008 3", "basketball", True),
        ("s_009_1_1", "snu-basketball", "snu-basketball 009 1", "train", True),
        ("s_019_1_2", "snu-martial-arts", "snu-martial-arts 019 2", "martial-arts", True),
        ("Samsung/wd2_pose", "snu-woody2", "snu-woody2 Samsung", "train", True),
        ("wd2_pose", "snu-woody2", "snu-woody2", "train", True),
        ("snu/woody2/Physics2/wd2_Take_001", "snu-woody2", "snu-woody2 Physics2", "unused", True),
        ("snu/crouched/wd2_097_V001", "snu-crouched", "snu-crouched", "train", True),
        ("my walk", "own", "own .", "train", False),
        ("anna/walks/01_walk", "own", "own anna/walks", "train", False),
        ("02_01/walk", "own", "own 02_01", "train", False),  # a folder's name says nothing
        ("my_02_01", "own", "own .", "train", False),
    ],
)
def test_what_a_path_says(take, source, actor, part, free):
    info = take_info(take)
    assert (info.source.name, info.actor, info.part, info.source.free) == (source, actor, part, free)
    assert part_of(take) == part


def test_no_session_subject_or_style_has_two_parts():
    sessions = by(found(r"/s_(\d{3})_\d+_\d+$"))
    assert len(sessions) == 6 + 5
    subjects = by(found(r"cmu-(?:bvh|amc|more)/(?:[\w-]+/)?(\d\d)_\d\d[^/]*$"))
    assert len(subjects) == 8 + 7 + 2
    styles = by(found(r"dataset-\d_[^/]*_([a-z-]+)_\d+$"))
    assert len(styles) == 19
    for parts in (sessions, subjects, styles):
        assert {len(found) for found in parts.values()} == {1}
    assert by(found(r"(Push)")) == {("Push",): {"pushes"}}


@pytest.mark.parametrize("copy", ["standing/{}", "{}.part3", "{}.part2.seated", "a/b/{}.seated"])
def test_pieces_and_versions_stay_together(copy):
    for take in TAKES:
        assert part_of(copy.format(take)) == part_of(take)
        assert part_of(copy.format(take.rsplit("/")[-1])) == part_of(take)


def touched(folder, *names):
    for name in names:
        (folder / f"{name}.npz").parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.npz").touch()


def test_parts_of_a_folder(tmp_path):
    touched(tmp_path, *TAKES, *(f"standing/{take}.part1" for take in TAKES))
    parts = {part: take_paths(tmp_path, part) for part in ("train", *HELD_OUT, *VALIDATION)}
    assert sum(map(len, parts.values())) == 2 * (len(TAKES) - 10) == len(set().union(*parts.values()))
    train, validation = training_paths(tmp_path)
    assert train == parts["train"]
    assert validation == take_paths(tmp_path, "validation")
    assert set(validation) == set().union(*(parts[part] for part in VALIDATION))
    assert set(take_paths(tmp_path, "sports")) == set().union(*(parts[part] for part in GROUPS["sports"]))
    assert len(take_paths(tmp_path, "all")) == 2 * len(TAKES)
    assert measured_parts(tmp_path) == ([*HELD_OUT, "sports"], [])


def test_unknown_part(tmp_path):
    touched(tmp_path, "01_01")
    with pytest.raises(EdgeposeError, match="tenis: no such part; did you mean 'tennis'"):
        take_paths(tmp_path, "tenis")
    with pytest.raises(EdgeposeError, match=r"no recording of the part 'sports': .* belong to train \(1\)"):
        take_paths(tmp_path, "sports")


def test_own_takes_are_divided_by_motion(tmp_path):
    names = [f"{who}/walk{number:02}" for who in ("anna", "ben") for number in range(10)]
    touched(tmp_path, *names, *(f"{name}.part2" for name in names), *(f"seated/{n}.seated" for n in names))
    train, validation = training_paths(tmp_path)
    assert {path.name.split(".")[0] for path in validation} == {"walk00"}
    assert len(validation) == 6
    assert len(train) == len(parts_of(tmp_path)) - 6


def test_one_motion_in_pieces(tmp_path):
    touched(tmp_path, "walk.part1")
    with pytest.raises(EdgeposeError, match="one recording is not enough"):
        training_paths(tmp_path)
    touched(tmp_path, "walk.part2")
    train, validation = training_paths(tmp_path)
    assert [path.name for path in (*validation, *train)] == ["walk.part1.npz", "walk.part2.npz"]
