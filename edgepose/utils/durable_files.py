"""Atomic writing of files: a file is either complete or as it was before.

A new file has a temporary name in the same folder until it is complete, and is then renamed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from edgepose.errors import EdgeposeError
from edgepose.utils.output_streams import copy_to_stream
from edgepose.utils.output_targets import Target, find_target, write_error_message


def replace_file(name: str | Path, write: Callable[[Path], None], what: str, *, overwrite: bool) -> None:
    """Write a file under a temporary name and rename it: it is either complete or as it was before.

    Args:
        name: the file; a device or pipe gets a copy of the complete file.
        write: writes a file of the given temporary name, which has the same ending.
        what: the file's content, for messages.
        overwrite: replace an existing file.

    Raises:
        EdgeposeError: the file cannot be written.
    """
    target = find_target(name, what)
    if target.stream:
        with TemporaryDirectory() as folder:
            part = Path(folder) / f"output{Path(name).suffix}"
            with _errors_name_target(part, target, what):
                write(part)
            copy_to_stream(part, target.name, what)
        return
    part = temporary_name(target)
    with _errors_name_target(part, target, what):
        os.close(new_file(part, target))
        try:
            write(part)
            with part.open("rb+") as file:
                os.fsync(file.fileno())
            put_in_place(part, target.path, overwrite)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def write_whole(name: str | Path, content: str | bytes | memoryview, what: str, *, overwrite: bool) -> None:
    """Write a file with some content, text in UTF-8; see `replace_file`."""
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content

    def write(part: Path) -> None:
        part.write_bytes(data)

    replace_file(name, write, what, overwrite=overwrite)


def reason(error: EdgeposeError) -> str:
    """Return the system's reason why a file could not be written, without the file's name."""
    cause = error.__cause__
    return cause.strerror or str(cause) if isinstance(cause, OSError) else str(error)


@contextmanager
def _errors_name_target(part: Path, target: Target, what: str) -> Iterator[None]:
    """Replace the temporary name in errors by the user's name of the file."""
    try:
        yield
    except OSError as error:
        raise EdgeposeError(write_error_message(error, target.name, what)) from error
    except EdgeposeError as error:  # from a sink, which was given the temporary name
        raise EdgeposeError(str(error).replace(str(part), target.name)) from error


def temporary_name(target: Target) -> Path:
    """Return a unique name in the folder of a file.

    Its ending is that of the user's name, not of a link's target, because writers depend on it.
    """
    return target.path.with_name(f".{secrets.token_hex(8)}{Path(target.name).suffix}")


def new_file(part: Path, target: Target) -> int:
    """Create a file with permissions and owner of the file that it will replace; return its descriptor.

    Raises:
        OSError: it cannot be created.
    """
    if target.exists and not os.access(target.path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    number = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
    if target.exists and hasattr(os, "fchown"):
        existing = target.path.lstat()
        if stat.S_ISREG(existing.st_mode):
            with contextlib.suppress(OSError):  # only root can change the owner
                os.fchown(number, existing.st_uid, existing.st_gid)
            with contextlib.suppress(OSError):
                os.fchmod(number, stat.S_IMODE(existing.st_mode))
    return number


def put_in_place(part: Path, path: Path, overwrite: bool) -> None:
    """Rename a file from its temporary to its final name, atomically and durably.

    Raises:
        EdgeposeError: another file has that name and must not be replaced.
        OSError: the file cannot be renamed.
    """
    if overwrite:
        part.replace(path)
    else:
        try:
            os.link(part, path)
        except FileExistsError:
            raise EdgeposeError(f"{path} already exists: another program has just created it") from None
        except OSError:  # a file system without hard links, such as that of SD cards
            if path.exists():
                raise EdgeposeError(f"{path} already exists: another program has just created it") from None
            part.replace(path)
        else:
            part.unlink()
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write a folder's names to the disk; a file without a name after a power cut would be lost."""
    with contextlib.suppress(OSError):  # not possible, nor needed, on Windows
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def make_folder(folder: Path) -> None:
    """Make a folder to write to, and those above it, where they do not exist.

    Raises:
        EdgeposeError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise EdgeposeError(f"cannot make the folder {folder}: {reason}; choose another folder") from None
