"""Sessions that are packed in a .zip file: the folder of a session, or what is in it."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import ReadOptions, RecordingFormat
from edgepose.imu import Recording
from edgepose.utils.safe_npz import BROKEN

MAX_BYTES = 2_000_000_000
"""Most bytes that are unpacked."""

MAX_FILES = 10_000

_CHUNK = 1 << 20


def read_zip(path: Path, options: ReadOptions) -> Recording:
    """Unpack a session into a temporary folder and read it there.

    Raises:
        FileFormatError: it is no whole .zip file, too large, or holds no session.
    """
    with TemporaryDirectory(prefix="edgepose-") as temporary:
        folder = Path(temporary) / "session"
        try:
            with zipfile.ZipFile(path) as packed:
                _unpack(path, packed, folder)
        except BROKEN as error:
            raise FileFormatError(f"{path}: not a whole .zip file that can be read ({error})") from None
        session = _session(folder)
        if session is None:
            raise FileFormatError(f"{path}: no session of sensors is packed in it; unpack it to see what is")
        known, place = session
        try:
            recording = known.read(place, options)
        except FileFormatError as error:
            raise FileFormatError(str(error).replace(str(place), str(path))) from None
        damage = recording.damage and recording.damage.replace(str(place), str(path))
        return recording._replace(damage=damage)


def _unpack(path: Path, packed: zipfile.ZipFile, folder: Path) -> None:
    """Write the regular files below the folder, never outside of it."""
    left = MAX_BYTES
    if len(packed.infolist()) > MAX_FILES:
        raise FileFormatError(f"{path}: more than {MAX_FILES} files are packed in it")
    for info in packed.infolist():
        place = PurePosixPath(info.filename.replace("\\", "/"))
        if info.is_dir() or stat.S_ISLNK(info.external_attr >> 16):
            continue
        if place.is_absolute() or ".." in place.parts or ":" in info.filename or not place.parts:
            raise FileFormatError(f"{path}: {info.filename!r} would be unpacked outside of its folder")
        target = folder / place
        target.parent.mkdir(parents=True, exist_ok=True)
        with packed.open(info) as source, target.open("xb") as file:
            while chunk := source.read(min(_CHUNK, left + 1)):
                left -= len(chunk)
                if left < 0:
                    raise FileFormatError(f"{path}: more than {MAX_BYTES} bytes are packed in it")
                file.write(chunk)


def _session(folder: Path) -> tuple[RecordingFormat, Path] | None:
    """The format of a session in a folder, and where it is: in the folder, or alone in one below it."""
    from edgepose.formats.recordings.registry import find_format

    known = find_format(folder)
    if known is not None:
        return known, folder
    below = [path for path in folder.iterdir() if path.is_dir() and path.name != "__MACOSX"]
    return _session(below[0]) if len(below) == 1 else None


FORMAT = RecordingFormat((".zip",), read_zip)
