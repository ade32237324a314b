"""All formats of recordings, and the functions that read a recording of any of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import ReadOptions, RecordingFormat
from edgepose.formats.registered import all_formats, built_in_format
from edgepose.imu import Recording
from edgepose.placements import PLACEMENTS

READERS = {
    "csv": "edgepose.formats.recordings.csv:FORMAT",
    "npz": "edgepose.formats.recordings.npz:FORMAT",
    "mvnx": "edgepose.formats.recordings.mvnx:FORMAT",
    "dip-imu": "edgepose.formats.recordings.dip_imu:FORMAT",
    "totalcapture": "edgepose.formats.recordings.totalcapture:FORMAT",
    "xsens-session": "edgepose.formats.recordings.xsens_session:FORMAT",
    "xio-session": "edgepose.formats.recordings.xio_session:FORMAT",
    "packed-session": "edgepose.formats.recordings.packed_session:FORMAT",
}
"""Where each `RecordingFormat` is; modules are imported in this order until one fits a file."""


def read_recording(path: Path | str, ids: Mapping[int, str] | None = None) -> Recording:
    """Recording of all six sensors, of any format; a file of an unknown ending, and "-", is CSV.

    A bad row of CSV or NPZ is an error; of other programs' formats it is left out, and `damage` says so.

    Args:
        path: file, or folder of a session.
        ids: placements by serial number, for sessions whose names have no placements in them.

    Raises:
        FileFormatError: it cannot be read, or is anything else than a recording of all six sensors.
    """
    recording = _read(Path(path), ReadOptions(ids=ids))
    missing = missing_sensors(recording)
    if missing:
        damage = f" ({recording.damage})" if recording.damage else ""
        raise FileFormatError(
            f"{path}: no samples of {', '.join(missing)}; a recording needs all six sensors{damage}"
        )
    return recording


def salvage_recording(path: Path | str, ids: Mapping[int, str] | None = None) -> Recording:
    """What is good in a recording, of any number of sensors; `damage` tells of bad rows that are left out.

    Args:
        path: file, or folder of a session.
        ids: as of `read_recording`.

    Raises:
        FileFormatError: it cannot be read, or is no recording at all.
    """
    return _read(Path(path), ReadOptions(salvage=True, ids=ids))


def read_sensors(path: Path | str, names: Sequence[str]) -> Recording:
    """Recording of any of the named sensors, as `read_recording` reads those of the six placements.

    Only CSV and NPZ hold other sensors than the six.

    Raises:
        FileFormatError: it cannot be read, or is anything else than a recording of such sensors.
    """
    return _read(Path(path), ReadOptions(tuple(names)))


def missing_sensors(recording: Recording) -> list[str]:
    """Placements of which there is no sample."""
    return [name for name in PLACEMENTS if name not in recording.sensors]


def find_format(path: Path) -> RecordingFormat | None:
    """The format of a recording by the file's ending, or by what is in a folder; None if it is of none.

    "-" is CSV on standard input.
    """
    if str(path) == "-":
        return built_in_format(RecordingFormat, READERS["csv"])
    folder = path.is_dir()
    return next(
        (known for known in all_formats(RecordingFormat, READERS.values()) if known.fits(path, folder)), None
    )


def recording_suffixes() -> tuple[str, ...]:
    """Endings of recordings that are files."""
    return tuple(
        suffix for known in all_formats(RecordingFormat, READERS.values()) for suffix in known.suffixes
    )


def _read(path: Path, options: ReadOptions) -> Recording:
    try:
        known = find_format(path)
        if known is None:
            if path.is_dir():
                raise FileFormatError(
                    f"{path}: unknown kind of file (Is a directory with no recording in it); give the folder "
                    "that holds the files or folders of all sensors"
                )
            known = built_in_format(RecordingFormat, READERS["csv"])
        return known.read(path, options)
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"{path}: cannot read it: {getattr(error, 'strerror', None) or error}"
        ) from None
