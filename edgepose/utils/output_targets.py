"""Resolution of output names.

Devices, pipes and standard output are streams, which hold nothing that could be lost. For a symbolic link,
its target is written.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from edgepose.errors import ConfigError, EdgeposeError

_LINKS = 40


class Target(NamedTuple):
    """An output, resolved from its name.

    Attributes:
        name: the user's name of it; "-" is standard output.
        path: the path after resolving links, for a file on a disk.
        stream: it is a device, a pipe or standard output, not a file on a disk.
        exists: it exists already.
    """

    name: str
    path: Path
    stream: bool
    exists: bool


def find_target(name: str | Path, what: str) -> Target:
    """Resolve the name of an output.

    Args:
        name: name of the output.
        what: the output's content, for messages.

    Raises:
        EdgeposeError: it is a folder, a disk or a socket, or its folder does not exist.
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
    """Return the descriptor of an open file that a path names, such as /dev/stdout; None for other paths."""
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
    """Return a value that is equal for two names exactly if they are one output; "-" is standard output."""
    number = 1 if str(name) == "-" else descriptor(Path(name))
    try:
        status = os.fstat(number) if number is not None else Path(name).stat()
        return status.st_dev, status.st_ino
    except OSError:  # does not exist yet
        return os.path.realpath(name)


def part_path(output: str | Path) -> Path:
    """Return the file that grows during a run, for an output that is written at its end.

    `walk.npz` grows as `walk.part.csv`, any other as in `walk.glb.part.csv`.
    """
    path = Path(output)
    return path.with_name(f"{path.stem if path.suffix == '.npz' else path.name}.part.csv")


def check_free(paths: Iterable[Path], hint: str) -> None:
    """Check that none of several files exists.

    Args:
        paths: the files.
        hint: advice for the user if one exists.

    Raises:
        EdgeposeError: some of them exist.
    """
    existing = [path for path in paths if path.exists() and not is_stream(path)]
    if existing:
        rest = f" and {len(existing) - 1} others" if existing[1:] else ""
        raise EdgeposeError(f"{existing[0]}{rest}: already exists; {hint}")


class FileTarget(NamedTuple):
    """File to write, and the values of the options that follow its name after commas."""

    path: str
    options: tuple[tuple[str, str], ...]

    def option(self, key: str) -> str:
        """Return the value of an option."""
        return dict(self.options)[key]


def parse_file(text: str, choices: Mapping[str, Sequence[str]]) -> FileTarget:
    """Parse "FILE[,key=value ...]".

    Args:
        text: name of a file, which may hold commas, and options.
        choices: possible values of each option; the first is the default.

    Raises:
        ConfigError: an unknown key or value, or an option given twice.
    """
    path, options = text, dict[str, str]()
    while True:
        rest, comma, option = path.rpartition(",")
        key, equals, value = option.partition("=")
        if not (comma and equals and key.isidentifier()):  # a comma in the name of a file
            break
        if not value or value not in choices.get(key, ()) or not rest:
            known = ", ".join(f"{name}={'|'.join(filter(None, values))}" for name, values in choices.items())
            raise ConfigError(f"unknown option {option!r} of {rest}: possible are {known}")
        if key in options:
            raise ConfigError(f"{text}: the option {key} is given twice")
        path = rest
        options[key] = value
    return FileTarget(path, tuple((key, options.get(key, values[0])) for key, values in choices.items()))


def is_stream(name: str | Path) -> bool:
    """Whether an output is a device, a pipe or standard output, not a file on a disk."""
    try:
        return find_target(name, "").stream
    except EdgeposeError:
        return False


def is_null(name: str | Path) -> bool:
    """Whether an output is the null device."""
    try:
        return Path(name).samefile(os.devnull)
    except OSError:  # does not exist
        return False


def has_reader(name: str | Path) -> bool:
    """Whether an output is read while it is written, so that a slow reader can delay the writer."""
    number = sys.stdout.fileno() if str(name) == "-" else descriptor(Path(name))
    try:
        if number is not None:
            return not stat.S_ISREG(os.fstat(number).st_mode)
        return is_stream(name) and not is_null(name)
    except OSError:  # reported when it is opened
        return False


def write_error_message(error: OSError, name: str, what: str) -> str:
    """Return the message for the user about a failed write."""
    name = "standard output" if name == "-" else name
    if isinstance(error, BrokenPipeError):
        return f"the program that read the {what} from {name} has ended"
    if error.errno == errno.ENOENT:
        return f"cannot write {what} to {name}: its folder does not exist, create it first"
    if error.errno == errno.ENOSPC:
        return f"cannot write {what} to {name}: the disk is full; rows written before are complete"
    return f"cannot write {what} to {name}: {error.strerror or error}"
