"""What the name of an output stands for, and whether something would be lost by writing there.

Devices, pipes and standard output are streams: they are written through, and there is nothing to lose. Of a
link it is the file at its end that is written.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import sys
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import EdgeposeError

ENDINGS = frozenset(
    (
        *(".csv", ".npz", ".bvh", ".json", ".html", ".htm", ".png", ".pdf", ".svg", ".pt", ".md", ".toml"),
        *(".bin", ".raw", ".times", ".asc", ".blf", ".log", ".mf4", ".trc", ".db", ".mvnx", ".pkl"),
        *(".sensors", ".asf", ".amc", ".py"),
    )
)
"""Endings of files that edgepose reads or writes: a file of another kind is not to be written over."""

_LINKS = 40


class Target(NamedTuple):
    """What the name of an output stands for.

    Attributes:
        name: as the user gave it; "-" is standard output.
        path: the file at the end of links, if it is one on a disk.
        stream: it is none, but a device, a pipe or standard output.
        exists: a file is there.
    """

    name: str
    path: Path
    stream: bool
    exists: bool


def find_target(name: str | Path, what: str) -> Target:
    """What a name stands for.

    Args:
        name: of the output.
        what: goes into it, for messages.

    Raises:
        EdgeposeError: a folder, a whole disk, or a file that cannot be because its folder is not there.
    """
    path, text = Path(name), str(name)
    if text == "-" or descriptor(path) is not None:
        return Target(text, path, True, True)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        end = Path(os.path.realpath(path))
        if not end.parent.is_dir():
            raise EdgeposeError(write_error_message(error, text, what)) from error
        return Target(text, end, False, False)
    except OSError as error:
        raise EdgeposeError(write_error_message(error, text, what)) from error
    if stat.S_ISDIR(mode):
        raise EdgeposeError(f"cannot write {what} to {text}: Is a directory; name a file in it")
    if stat.S_ISBLK(mode) or stat.S_ISSOCK(mode):
        kind = "disk" if stat.S_ISBLK(mode) else "socket"
        raise EdgeposeError(f"cannot write {what} to {text}: it is a {kind}; name a file")
    return Target(text, Path(os.path.realpath(path)), not stat.S_ISREG(mode), True)


def descriptor(path: Path) -> int | None:
    """The number of an open file of this process that a name stands for, such as /dev/stdout; else None."""
    for _ in range(_LINKS):
        folder = os.path.realpath(path.parent)
        if re.fullmatch(rf"/proc/{os.getpid()}/(task/\d+/)?fd", folder) and path.name.isdigit():
            return int(path.name)
        try:
            path = path.parent / path.readlink()
        except OSError:
            return None
    return None


def identity(name: str | Path) -> object:
    """What is the same for two names exactly if they stand for one output; "-" is standard output."""
    number = 1 if str(name) == "-" else descriptor(Path(name))
    try:
        own = os.fstat(number) if number is not None else Path(name).stat()
        return own.st_dev, own.st_ino
    except OSError:  # not there yet
        return os.path.realpath(name)


def part_path(npz: str | Path) -> Path:
    """Where the poses for an NPZ file are while a run goes on."""
    return Path(npz).with_name(f"{Path(npz).stem}.part.csv")


def check_output(name: str | Path, what: str, endings: Collection[str], overwrite: bool) -> None:
    """Make sure, before any work is done, that an output costs nothing that was not meant.

    Args:
        name: of the output; "-", devices and pipes are always free.
        what: goes into it, for messages.
        endings: of its kind of files, such as ".csv".
        overwrite: whether a file that is there may be replaced.

    Raises:
        EdgeposeError: a file is there, its name is of another kind, or it cannot be written.
    """
    target = find_target(name, what)
    if target.stream:
        return
    for path in (Path(name), target.path):
        ending = path.suffix.lower()
        if ending in ENDINGS and ending not in endings:
            raise EdgeposeError(
                f"{name}: a name with {ending} is of another kind of file; {what} go into one with "
                f"{' or '.join(endings)}"
            )
    if target.exists and not overwrite:
        raise EdgeposeError(f"{name} is there already; choose another name or give --overwrite")


def check_free(paths: Iterable[Path], hint: str) -> None:
    """Make sure that none of many files is there already.

    Args:
        paths: of the files.
        hint: what to do about it.

    Raises:
        EdgeposeError: some are.
    """
    there = [path for path in paths if path.exists() and not is_stream(path)]
    if there:
        rest = f" and {len(there) - 1} others" if there[1:] else ""
        raise EdgeposeError(f"{there[0]}{rest}: there already; {hint}")


def is_stream(name: str | Path) -> bool:
    """Whether an output is a device, a pipe or standard output: no file on a disk."""
    try:
        return find_target(name, "").stream
    except EdgeposeError:
        return False


def is_null(name: str | Path) -> bool:
    """Whether an output is the device in which everything vanishes."""
    try:
        return Path(name).samefile(os.devnull)
    except OSError:  # not there
        return False


def has_reader(name: str | Path) -> bool:
    """Whether somebody reads an output while it is written, who could hold up what writes it."""
    number = sys.stdout.fileno() if str(name) == "-" else descriptor(Path(name))
    try:
        if number is not None:
            return not stat.S_ISREG(os.fstat(number).st_mode)
        return is_stream(name) and not is_null(name)
    except OSError:  # told where it is opened
        return False


def write_error_message(error: OSError, name: str, what: str) -> str:
    """The line for the user where writing has failed."""
    name = "standard output" if name == "-" else name
    if isinstance(error, BrokenPipeError):
        return f"the program that read the {what} from {name} has ended"
    if error.errno == errno.ENOENT:
        return f"cannot write {what} to {name}: its folder does not exist, create it first"
    if error.errno == errno.ENOSPC:
        return f"cannot write {what} to {name}: the disk is full; rows written before are complete"
    return f"cannot write {what} to {name}: {error.strerror or error}"
