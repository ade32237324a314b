"""Damaged .npz files: every reader says which file it is."""

import io
import zipfile

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.formats.recordings.registry import read_recording
from edgepose.placements import PLACEMENTS
from edgepose.sip.prior import load_prior
from edgepose_export.mocap import read_motion
from edgepose_export.training.dataset import read_take

READERS = [read_recording, read_poses, read_motion, read_take, load_prior]
# Headers of arrays are Python text: cut short, of odd characters, wrongly indented, of no known keys.
HEADERS = [
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (300, 4",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': \x1c300, 4), }",
    b"  {\n {'descr'",
    b"{'descr': '<f4'}",
    b"\xff\xfe",
]


@pytest.mark.parametrize("content", [b"junk" * 1000, b""])
@pytest.mark.parametrize("reader", READERS)
def test_members_that_are_no_arrays(tmp_path, reader, content):
    """numpy returns their bytes."""
    path = tmp_path / "walk.npz"
    with zipfile.ZipFile(path, "w") as archive:
        sensors = [f"{name}_{quantity}" for name in PLACEMENTS for quantity in ("quat", "acc")]
        for key in ("t", *sensors, "poses", "trans", "mocap_framerate", "mean", "license"):
            archive.writestr(f"{key}.npy", content)
    with pytest.raises(EdgeposeError, match=r"walk\.npz: .*is not an array") as raised:
        reader(path)
    assert len(str(raised.value)) < len(str(path)) + 200


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("reader", READERS)
def test_headers_that_numpy_cannot_parse(tmp_path, reader, header):
    whole = io.BytesIO()
    np.save(whole, np.zeros((300, 4), "<f4"))
    start = whole.getvalue()[:6] + b"\1\0" + (118).to_bytes(2, "little")
    member = start + header.ljust(117)[:117] + b"\n" + bytes(4800)
    path = tmp_path / "walk.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for key in ("t", "head_quat", "head_acc", "poses", "trans", "mocap_framerate", "mean", "license"):
            archive.writestr(f"{key}.npy", member)
    with pytest.raises(EdgeposeError, match=r"walk\.npz"):
        reader(path)
