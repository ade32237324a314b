"""Sessions in .zip files, whole, broken and hostile."""

from __future__ import annotations

import shutil
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings import packed_session
from edgepose.formats.recordings.registry import find_format, read_recording
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS
from tests.edgepose.formats.recordings.test_xio_session import write_recording as write_session

HEAD = "// Update Rate: 100.0Hz\n"
NAMES = "PacketCounter,Acc_X,Acc_Y,Acc_Z,Quat_q0,Quat_q1,Quat_q2,Quat_q3\n"
ROWS = [f"{i},0.0,0.0,9.81,1.0,0.0,0.0,0.0\n" for i in range(50)]


def pack(path: Path, prefix: str = "", rows: list[str] = ROWS) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in PLACEMENTS:
            packed.writestr(f"{prefix}{name}.txt", HEAD + NAMES + "".join(rows))
        packed.writestr("__MACOSX/._nothing", b"x")
    return path


@pytest.mark.parametrize("prefix", ["", "walk/", "a/b/c/"])
def test_a_session(tmp_path, prefix):
    recording = read_recording(pack(tmp_path / "walk.zip", prefix))
    assert recording.damage is None
    assert list(recording.sensors) == list(PLACEMENTS)
    np.testing.assert_allclose(recording.sensors["head"].time_s, np.arange(50) / 100.0)


def test_messages_name_the_packed_file(tmp_path):
    path = pack(tmp_path / "walk.zip", "walk/", [*ROWS, "x\n"])
    damage = read_recording(path).damage
    assert f"{path}/head.txt: 1 bad rows left out, the first: row 53 has 1 columns and not 8" in damage
    path = pack(tmp_path / "walk.zip", "walk/", [])
    with pytest.raises(EdgeposeError, match=str(path)):
        read_recording(path)


@pytest.mark.parametrize("name", ["../head.txt", "/tmp/head.txt", "C:\\head.txt", "a/../../head.txt"])
def test_nothing_is_written_outside(tmp_path, name):
    path = pack(tmp_path / "walk.zip")
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr(zipfile.ZipInfo(name), b"x")
    with pytest.raises(EdgeposeError, match="outside of its folder"):
        read_recording(path)


def test_links_are_left_out(tmp_path):
    path = pack(tmp_path / "walk.zip")
    link = zipfile.ZipInfo("readme.txt")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr(link, b"/etc/passwd")
    assert read_recording(path).damage is None


def test_what_is_not_a_session(tmp_path, monkeypatch):
    path = pack(tmp_path / "walk.zip")
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(EdgeposeError, match=r"not a whole \.zip file"):
        read_recording(path)
    damaged = bytearray(whole)
    damaged[60:80] = bytes(20)
    path.write_bytes(damaged)
    with pytest.raises(EdgeposeError, match=r"not a whole \.zip file"):
        read_recording(path)
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("holiday.jpg", b"x")
    with pytest.raises(EdgeposeError, match="no session of sensors is packed in it"):
        read_recording(path)
    monkeypatch.setattr(packed_session, "MAX_BYTES", 3000)
    path.write_bytes(whole)
    with pytest.raises(EdgeposeError, match="more than 3000 bytes are packed in it"):
        read_recording(path)
    assert find_format(path) is packed_session.FORMAT


@pytest.mark.parametrize("packing", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_damage_in_each_way_of_packing(tmp_path, packing):
    path = tmp_path / "walk.zip"
    with zipfile.ZipFile(pack(tmp_path / "plain.zip")) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            new.writestr(entry.filename, old.read(entry), compress_type=packing)
        longest = max(new.infolist(), key=lambda entry: entry.file_size)
    content = bytearray(path.read_bytes())
    start = longest.header_offset + 30 + len(longest.filename) + 20
    content[start : start + 40] = bytes(255 - byte for byte in content[start : start + 40])
    path.write_bytes(content)
    with pytest.raises(EdgeposeError, match="read"):
        read_recording(path)


def write_recording(path: Path, recording: Recording) -> Path:
    write_session(path / "walk", recording)
    packed = shutil.make_archive(str(path), "zip", path)
    shutil.rmtree(path)
    return Path(packed)
