"""All recording formats, and functions that read a recording of any format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgepose.errors import FileFormatError
from edgepose.formats.recordings.base import ReadOptions, RecordingFormat
from edgepose.formats.recordings.time_checks import check_times, find_clocks_apart
from edgepose.formats.registered import Reader, all_formats, built_in_format
from edgepose.imu import Recording
from edgepose.placements import LACKING, PLACEMENTS

READERS = {
    "csv": Reader("edgepose.formats.recordings.csv:FORMAT", ".csv"),
    "npz": Reader("edgepose.formats.recordings.npz:FORMAT", ".npz"),
    "mvnx": Reader("edgepose.formats.recordings.mvnx:FORMAT", ".mvnx of Xsens MVN"),
    "dip-imu": Reader("edgepose.formats.recordings.dip_imu:FORMAT", ".pkl of DIP-IMU"),
    "totalcapture": Reader("edgepose.formats.recordings.totalcapture:FORMAT", ".sensors of TotalCapture"),
    "xsens-session": Reader(
        "edgepose.formats.recordings.xsens_session:FORMAT", "a folder of MT Manager or DOT"
    ),
    "xio-session": Reader("edgepose.formats.recordings.xio_session:FORMAT", "a folder of x-io"),
    "packed-session": Reader("edgepose.formats.recordings.packed_session:FORMAT", ".zip of such a folder"),
}
"""All recording formats; modules are imported in this order until one fits a file."""


def read_recording(
    path: Path | str,
    ids: Mapping[int, str] | None = None,
    *,
    salvage: bool = False,
    without: Sequence[str] = (),
) -> Recording:
    """Read a recording of at least the six sensors in any format; an unknown ending, and "-", is CSV.

    A bad row of CSV or NPZ is an error; in other programs' formats it is left out and reported in `damage`.

    Args:
        path: file, or folder of a session.
        ids: placements by serial number, for sessions whose file or folder names contain no placements.
        salvage: leave bad rows of CSV and NPZ out, too.
        without: sensors that the rig lacks and that are not needed.

    Raises:
        FileFormatError: it cannot be read, or is not a recording of all six sensors at one time.
    """
    recording = _read(Path(path), ReadOptions(ids=ids, salvage=salvage))
    missing = [name for name in missing_sensors(recording) if name not in without]
    if missing:
        damage = f" ({recording.damage})" if recording.damage else ""
        lacking = f"; if the rig lacks them: calibrate --without {','.join(missing)}"
        raise FileFormatError(
            f"{path}: no samples of {', '.join(missing)}; a recording needs all six sensors"
            f"{lacking if LACKING.issuperset(missing) else ''}{damage}"
        )
    apart = find_clocks_apart(recording, str(path))
    if apart:
        raise FileFormatError(apart)
    return recording


def salvage_recording(path: Path | str, ids: Mapping[int, str] | None = None) -> Recording:
    """Read the good rows of a recording of any number of sensors; `damage` reports what is wrong with it.

    Args:
        path: file, or folder of a session.
        ids: as in `read_recording`.

    Raises:
        FileFormatError: it cannot be read, or is not a recording.
    """
    recording = _read(Path(path), ReadOptions(salvage=True, ids=ids))
    problems = filter(None, [recording.damage, find_clocks_apart(recording, str(path))])
    return recording._replace(damage="; ".join(problems) or None)


def read_sensors(path: Path | str, names: Sequence[str]) -> Recording:
    """Read the good part of a recording of any of the named sensors.

    Raises:
        FileFormatError: it cannot be read, or is not a recording of such sensors.
    """
    return _read(Path(path), ReadOptions(tuple(names), salvage=True))


def missing_sensors(recording: Recording) -> list[str]:
    """Return the placements without samples."""
    return [name for name in PLACEMENTS if name not in recording.sensors]


def find_format(path: Path) -> RecordingFormat | None:
    """Return the format of a recording by the file's ending or the folder's content; None if unknown.

    "-" is CSV on standard input.
    """
    if str(path) == "-":
        return built_in_format(RecordingFormat, READERS["csv"])
    folder = path.is_dir()
    return next(
        (format for format in all_formats(RecordingFormat, READERS.values()) if format.fits(path, folder)),
        None,
    )


def find_whole(path: Path) -> RecordingFormat | None:
    """Return the format of the recording that a file or folder is one sensor of; None if it is not."""
    return next(
        (
            known
            for known in all_formats(RecordingFormat, READERS.values())
            if known.is_part is not None and known.is_part(path)
        ),
        None,
    )


def check_no_part(path: Path) -> None:
    """Check that a file or folder is not just one sensor of a recording.

    Raises:
        FileFormatError: it is.
    """
    whole = find_whole(path)
    if whole is not None:
        raise FileFormatError(f"{path}: one sensor of {whole.description}; give the folder above it")


def recording_suffixes() -> tuple[str, ...]:
    """Return the endings of recordings that are files."""
    return tuple(
        suffix for format in all_formats(RecordingFormat, READERS.values()) for suffix in format.suffixes
    )


def _read(path: Path, options: ReadOptions) -> Recording:
    try:
        format = find_format(path)
        if format is None:
            if path.is_dir():
                next(path.iterdir(), None)  # raises OSError if it cannot be listed
                raise FileFormatError(
                    f"{path}: unknown kind of file (Is a directory with no recording in it); give the folder "
                    "that holds the files or folders of all sensors"
                )
            format = built_in_format(RecordingFormat, READERS["csv"])
        recording = format.read(path, options)
        if not recording.sensors:
            raise FileFormatError(recording.damage or f"{path}: the recording has no samples")
        if all(all(quantity is None for quantity in data[1:]) for data in recording.sensors.values()):
            raise FileFormatError(
                f"{path}: its sensors have neither orientations nor accelerations that can be read; export "
                "them too"
            )
        check_times(recording, str(path))
        return recording
    except FileFormatError:
        if path.is_file():
            check_no_part(path)  # a better reason, if it is one
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"{path}: cannot read it: {getattr(error, 'strerror', None) or error}"
        ) from None
