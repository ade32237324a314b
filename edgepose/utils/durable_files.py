"""Files that are whole or as they were before.

A new file has another name, in the same folder, until it is whole; then it takes its place at once.
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
    """Have a file written under another name and put in its place at once: it is whole or as it was before.

    Args:
        name: of the file; what is no file on a disk gets a copy.
        write: writes the file of that name, whose ending is the same.
        what: is in it, for messages.
        overwrite: whether it may take the place of a file.

    Raises:
        EdgeposeError: it cannot be written.
    """
    target = find_target(name, what)
    if target.stream:
        with TemporaryDirectory() as folder:
            part = Path(folder) / f"output{Path(name).suffix}"
            with _named(part, target, what):
                write(part)
            copy_to_stream(part, target.name, what)
        return
    part = other_name(target)
    with _named(part, target, what):
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
    """Write a file of a content, text in UTF-8; see `replace_file`."""
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content

    def write(part: Path) -> None:
        part.write_bytes(data)

    replace_file(name, write, what, overwrite=overwrite)


def reason(error: EdgeposeError) -> str:
    """What the system says of a file that could not be written, without its name."""
    cause = error.__cause__
    return cause.strerror or str(cause) if isinstance(cause, OSError) else str(error)


@contextmanager
def _named(part: Path, target: Target, what: str) -> Iterator[None]:
    """Errors name the file as the user knows it."""
    try:
        yield
    except OSError as error:
        raise EdgeposeError(write_error_message(error, target.name, what)) from error
    except EdgeposeError as error:  # of a sink, which knows the file by its other name
        raise EdgeposeError(str(error).replace(str(part), target.name)) from error


def other_name(target: Target) -> Path:
    """A name in the folder of a file that nobody else has.

    Its ending is that of the user's name, not of what a link leads to: writers look at it.
    """
    return target.path.with_name(f".{secrets.token_hex(8)}{Path(target.name).suffix}")


def new_file(part: Path, target: Target) -> int:
    """Open a new file, which has the permissions and the owner of the one whose place it will take.

    Raises:
        OSError: it cannot be made.
    """
    if target.exists and not os.access(target.path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    number = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
    if target.exists and hasattr(os, "fchown"):
        there = target.path.lstat()
        if stat.S_ISREG(there.st_mode):
            with contextlib.suppress(OSError):  # only root can give a file to somebody else
                os.fchown(number, there.st_uid, there.st_gid)
            with contextlib.suppress(OSError):
                os.fchmod(number, stat.S_IMODE(there.st_mode))
    return number


def put_in_place(part: Path, path: Path, overwrite: bool) -> None:
    """Give a file its own name, at once and for good.

    Raises:
        EdgeposeError: another file has it and is not to be replaced.
        OSError: it cannot be renamed.
    """
    if overwrite:
        part.replace(path)
    else:
        try:
            os.link(part, path)
        except FileExistsError:
            raise EdgeposeError(f"{path} is there already, made by another program meanwhile") from None
        except OSError:  # a file system without hard links, such as that of SD cards
            if path.exists():
                raise EdgeposeError(f"{path} is there already, made by another program meanwhile") from None
            part.replace(path)
        else:
            part.unlink()
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder last; a file that has no name after a power cut is lost."""
    with contextlib.suppress(OSError):  # Windows cannot, and need not.
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
