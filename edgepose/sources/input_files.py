"""Expansion of the files, patterns and folders that a user names into the files in them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import is_poses, pose_suffixes
from edgepose.formats.recordings.registry import (
    check_no_part,
    find_format,
    find_whole,
    recording_suffixes,
)
from edgepose.sources.replay import CAN_LOGS, CAPTURES, is_can_log


class InputFile(NamedTuple):
    """A recording, or a file of poses, that a user has named alone or with others.

    Attributes:
        path: file, or folder of a session.
        name: its path without ending, relative to the folder that it was found in.
    """

    path: Path
    name: Path


class Kind(NamedTuple):
    """A kind of files to look for in folders.

    Attributes:
        endings: endings of their names.
        fits: whether a file with such a name is to be taken.
    """

    endings: tuple[str, ...]
    fits: Callable[[Path], bool] = lambda path: True


_RECORDINGS = (".csv", ".npz", *CAPTURES, *CAN_LOGS)


def recordings_and_poses() -> Kind:
    """Return the kind of everything that can be converted."""
    return Kind(tuple(dict.fromkeys([*_RECORDINGS, *recording_suffixes(), *pose_suffixes()])))


def recordings() -> Kind:
    """Return the kind of recordings alone, so that poses which lie beside them are passed over."""
    endings = tuple(dict.fromkeys([*_RECORDINGS, *recording_suffixes()]))
    return Kind(endings, lambda path: path.is_dir() or not is_poses(path))


def expand(inputs: Sequence[Path], outs: Collection[Path], kind: Kind) -> list[InputFile]:
    """Return the files that a user's inputs stand for, each once, with names that are all different.

    Args:
        inputs: files ("-" is standard input), folders that hold them at any depth, and sessions; a name with
            `*`, `?` or `[` that is not a file is a pattern.
        outs: folders to write to, which are not searched.
        kind: what to look for in folders. Files that are named are not judged.

    Raises:
        EdgeposeError: an input is missing or empty, or two files have the same name.
    """
    resolved = {out.resolve() for out in outs}
    files: dict[Path, InputFile] = {}
    for file in (file for source in inputs for file in _expand(source, resolved, kind)):
        other = files.setdefault(file.name, file)
        if other.path != file.path:
            raise EdgeposeError(
                f"{other.path} and {file.path} would both become {file.name}; give them to separate "
                "commands, each with a folder of its own for the results"
            )
    return list(files.values())


def _expand(source: Path, outs: Collection[Path], kind: Kind) -> Iterator[InputFile]:
    """Yield the files that an input stands for."""
    if source.is_dir():
        try:
            found = sorted(_find(source, outs, kind))
        except OSError as error:
            raise EdgeposeError(f"{error.filename}: cannot list it: {error.strerror}") from None
        if not found:
            raise EdgeposeError(
                f"{source}: no recording in this folder; names end in {', '.join(kind.endings)}, or .gz of a "
                "log"
            )
        for path in found:
            # A session folder given by itself keeps its own name.
            relative = Path(source.resolve().name) if path == source else path.relative_to(source)
            # The whole name of a folder: an x-io session has no ending, but there may be dots in its name.
            yield InputFile(path, relative if path.is_dir() else relative.parent / relative.stem)
    elif str(source) == "-":
        if sys.stdin is None:
            raise EdgeposeError("-: there is no standard input; name a file")
        yield InputFile(source, Path("stdin"))
    elif source.exists():
        if not source.is_file():
            raise EdgeposeError(
                f"{source}: not a regular file; give its content as standard input: convert - or --file -, "
                f"with < {source}"
            )
        yield InputFile(source, Path(source.stem))
    elif any(mark in str(source) for mark in "*?["):
        # A pattern that the shell has not expanded: it was quoted, or the shell is that of Windows.
        root = Path(source.anchor or ".")
        pattern = str(source.relative_to(source.anchor) if source.anchor else source)
        matches = sorted(path for path in root.glob(pattern) if not _is_hidden(path) or _is_hidden(source))
        if not matches:
            raise EdgeposeError(f"{source}: no file matches this pattern")
        for path in matches:
            yield from _expand(path, outs, kind)
    else:
        raise EdgeposeError(f"{source}: no such file or folder")


def _find(folder: Path, outs: Collection[Path], kind: Kind) -> Iterator[Path]:
    """Yield the files in a folder, except hidden ones and those in output folders.

    A folder below it that cannot be listed is yielded itself, so that its own job fails, not the others.
    """
    if find_format(folder) is not None:
        yield folder
    else:
        check_no_part(folder)
    for path in folder.iterdir():
        try:
            found = list(_find_at(path, outs, kind))
        except OSError:
            found = [path]
        yield from found


def _find_at(path: Path, outs: Collection[Path], kind: Kind) -> Iterator[Path]:
    """Yield a file if it is of the kind, or the files in a folder."""
    if _is_hidden(path) or find_whole(path) is not None:
        return
    if path.is_dir():
        if not path.is_symlink() and path.resolve() not in outs:
            yield from _find(path, outs, kind)
    # Reading a pipe could block forever.
    elif not path.is_fifo() and (path.suffix.lower() in kind.endings or is_can_log(path)) and kind.fits(path):
        yield path


def _is_hidden(path: Path) -> bool:
    """Return whether a file is a system's own, such as macOS's `._walk.csv` beside `walk.csv`."""
    return path.name.startswith(".") or path.name.lower() == "thumbs.db"
