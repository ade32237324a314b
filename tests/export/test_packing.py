import json
import os
import resource
from pathlib import Path

import numpy as np
import pytest
import torch

from edgepose.errors import EdgeposeError
from edgepose.skeleton import default_body
from edgepose_export.mocap import read_motion, resample
from edgepose_export.synthesis.virtual_imus import recording_arrays, virtual_imus
from edgepose_export.training.dataset import read_take, tape
from edgepose_export.training.memory_map import FRAME, packed_tape
from edgepose_export.training.sources import SOURCES
from edgepose_export.training.windows import windows

DATA = Path(__file__).parents[1] / "data" / "mocap"


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    for name in ("dataset-2_walk_normal_001", "07_01"):
        motion = resample(read_motion(DATA / f"{name}.bvh"))
        imus, source = virtual_imus(motion, default_body()), SOURCES[motion.source]
        arrays = recording_arrays(motion, imus, source.license, source.name)
        np.savez(folder / f"{name}.npz", **arrays)
    return sorted(folder.glob("*.npz"))


def counted(paths):
    """A progress that notes what is packed."""
    done = []

    def show(items):
        for item in items:
            done.append(item)
            yield item

    return done, show


def alike(a, b):
    return all(
        torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y for x, y in zip(a, b, strict=True)
    )


def test_packed_tape_is_the_tape(paths, tmp_path):
    packed = packed_tape(paths, tmp_path / "tape")
    expected = tape([read_take(path) for path in paths])
    assert alike(packed, expected)
    assert packed.sources == expected.sources == ["cmu", "bandai-namco"]
    starts = torch.tensor([3, 60])
    for got, wanted in zip(windows(packed, starts, 20), windows(expected, starts, 20), strict=True):
        assert torch.equal(got, wanted)
    frames = len(packed.orientation)
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "tape").glob("*.f32")}
    assert sum(sizes.values()) == 1192 * frames
    assert sizes["relative.f32"] == 4 * 24 * 9 * frames


def test_packed_once_while_the_takes_are_the_same(paths, tmp_path):
    folder = tmp_path / "tape"
    first, show = counted(paths)
    packed_tape(paths, folder, show)
    assert first == paths
    again, show = counted(paths)
    assert alike(packed_tape(paths, folder, show), packed_tape(paths, folder))
    assert again == []
    fewer, show = counted(paths)
    assert packed_tape(paths[:1], folder, show).names == [paths[0].stem]
    assert fewer == paths[:1]
    os.utime(paths[0], ns=(1, 1))
    changed, show = counted(paths)
    packed_tape(paths[:1], folder, show)
    assert changed == paths[:1]


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "tape.json").unlink(),
        lambda folder: (folder / "tape.json").write_text("{"),
        lambda folder: (folder / "tape.json").write_text("[]"),
        lambda folder: (folder / "tape.json").write_text(
            json.dumps(json.loads((folder / "tape.json").read_text()) | {"lengths": [1]})
        ),
        lambda folder: os.truncate(folder / "relative.f32", 1000),
        lambda folder: (folder / "acceleration.f32").unlink(),
    ],
)
def test_half_of_a_packed_tape_is_made_anew(paths, tmp_path, damage):
    expected = packed_tape(paths, tmp_path / "a")
    packed_tape(paths, tmp_path / "b")
    damage(tmp_path / "b")
    done, show = counted(paths)
    assert alike(packed_tape(paths, tmp_path / "b", show), expected)
    assert done == paths


def test_training_does_not_change_what_is_packed(paths, tmp_path):
    packed = packed_tape(paths, tmp_path / "tape")
    before = {path.name: path.read_bytes() for path in (tmp_path / "tape").iterdir()}
    packed.orientation[:] = 0.0
    assert {path.name: path.read_bytes() for path in (tmp_path / "tape").iterdir()} == before


def test_full_disk_is_told_and_leaves_nothing_that_looks_whole(paths, tmp_path):
    folder = tmp_path / "tape"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(EdgeposeError, match="cannot pack takes there: File too large"):
            packed_tape(paths, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not (folder / "tape.json").exists()
    assert set(FRAME) == {path.stem for path in folder.iterdir()}
    packed_tape(paths, folder)
