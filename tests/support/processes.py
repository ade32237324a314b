"""Programs that tests start and end."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import inspect
import json
import os
import pickle
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SIMULATOR = ROOT / "tools" / "simulate.py"

_PR_SET_CHILD_SUBREAPER = 36
_OWN_PYTHON = ("LANG", "LC_", "LD_", "MKL_", "OMP_", "PYTHON")
"""Variables that a Python reads when it starts, or the libraries when they are imported."""


class Popen(subprocess.Popen):
    """`subprocess.Popen`, but modules and scripts are forked from a warm Python, see `warm_python`.

    Started as always: `-c` and `-X`, other variables of the interpreter, a `preexec_fn` that pickle refuses.
    """

    def _execute_child(self, *arguments: Any) -> None:
        given = dict(zip(_PARAMETERS, arguments, strict=True))
        words = [os.fspath(word) for word in given["args"]] if isinstance(given["args"], list | tuple) else []
        environment = dict(os.environ if given["env"] is None else given["env"])
        if not _can_be_forked(words, given, environment):
            super()._execute_child(*arguments)
            return
        streams = (given["p2cread"], given["c2pwrite"], given["errwrite"])
        self.pid = _fork(
            {
                "words": words[1:],
                "folder": str(Path(given["cwd"] or ".").absolute()),
                "environment": environment,
                "session": given["start_new_session"],
                "first": _pickled(given["preexec_fn"]),
            },
            [name if stream == -1 else stream for name, stream in enumerate(streams)],
        )
        self._child_created = True
        self._close_pipe_fds(*(given[name] for name in _PIPES))


_PARAMETERS = list(inspect.signature(subprocess.Popen._execute_child).parameters)[1:]
_PIPES = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
_forking = threading.Lock()


def _can_be_forked(words: list[str], given: Mapping[str, Any], environment: Mapping[str, str]) -> bool:
    def own(variables: Mapping[str, str]) -> dict[str, str]:
        return {name: text for name, text in variables.items() if name.startswith(_OWN_PYTHON)}

    return (
        sys.platform == "linux"
        and _can_adopt()
        and words[:1] == [sys.executable]
        and (words[1:2] == ["-m"] or words[1].endswith(".py"))
        and own(environment) == own(os.environ)
        and _pickled(given["preexec_fn"]) is not None
        and not given["pass_fds"]
    )


@cache
def _can_adopt() -> bool:
    """Whether orphans become children of this process, so that their exit codes are known; not under qemu."""
    reaper = ctypes.CDLL(None).prctl
    adopted = reaper(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) == 0
    reaper(_PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)
    return bool(adopted)


def _pickled(function: Callable[[], None] | None) -> str | None:
    """A function in hexadecimal digits, "" for none; None if it cannot be pickled."""
    try:
        return "" if function is None else pickle.dumps(function).hex()
    except (pickle.PicklingError, AttributeError):
        return None


@cache
def _warm_python() -> socket.socket:
    """The line to the Python that forks; it ends with this process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-m", "tests.support.warm_python", str(theirs.fileno())]
    process = subprocess.Popen(command, pass_fds=[theirs.fileno()], cwd=ROOT, stdin=subprocess.DEVNULL)
    theirs.close()

    @atexit.register
    def end() -> None:
        ours.close()
        process.wait()

    return ours


def _fork(request: Mapping[str, Any], streams: list[int]) -> int:
    """Id of a new process, which is a child of this one."""
    with _forking:
        channel = _warm_python()
        reaper = ctypes.CDLL(None).prctl
        reaper(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        try:
            socket.send_fds(channel, [json.dumps(request).encode()], streams)
            return int(channel.recv(100))
        finally:
            reaper(_PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


def run(
    command: list[object],
    *,
    input: str | bytes | None = None,
    capture_output: bool = False,
    timeout: float = 120.0,
    check: bool = False,
    **options: Any,
) -> subprocess.CompletedProcess[Any]:
    """As `subprocess.run`, with the `Popen` of this module."""
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    if input is not None:
        options["stdin"] = subprocess.PIPE
    with Popen(list(map(str, command)), **options) as process:
        try:
            out, errors = process.communicate(input, timeout)
        except BaseException:
            process.kill()
            raise
    done = subprocess.CompletedProcess(command, process.returncode, out, errors)
    if check:
        done.check_returncode()
    return done


def start(*words: object, **options: object) -> subprocess.Popen[str]:
    """The command line with these words; its messages can be read."""
    command = [sys.executable, "-m", "edgepose", *map(str, words)]
    return Popen(command, text=True, **{"stderr": subprocess.PIPE} | options)


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and messages of a process that ends by itself."""
    try:
        _, errors = process.communicate(timeout=120)
    finally:
        process.kill()  # one that hangs would take the ports of other tests
    assert "Traceback" not in errors
    return process.returncode, errors


@contextlib.contextmanager
def simulated(recording: Path, *flags: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Simulated sensors, and their port or bus; killing them unplugs it."""
    command = [sys.executable, str(SIMULATOR), str(recording), *map(str, flags)]
    process = Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            yield process, process.stdout.readline().split()[1]
        finally:
            process.kill()
