"""A Python that has imported edgepose and its libraries, and forks a process for each command of the tests.

Importing PyTorch takes longer than most tests, and edgepose's own modules longer than most commands. A forked
process has them already. It has its own arguments, folder, environment, standard streams and session.
`test_import_rules.py` proves that modules can be imported in any order.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import pickle
import pkgutil
import runpy
import socket
import sys
import threading
import weakref
from pathlib import Path
from typing import Any

LIBRARIES = (
    *("can", "click", "concurrent.futures.process", "filterpy.kalman", "matplotlib.backends.backend_agg"),
    *("matplotlib.figure", "multiprocessing.pool", "numpy", "scipy.linalg", "scipy.optimize", "scipy.signal"),
    *("scipy.spatial", "serial", "torch"),
)
PACKAGES = ("edgepose", "edgepose_export", "firmware_protocols")


def warm_up() -> None:
    """Import all modules that commands need; a command does not free their objects at its end."""
    for library in LIBRARIES:
        importlib.import_module(library)
    for package in PACKAGES:
        folders = importlib.import_module(package).__path__
        for module in pkgutil.walk_packages(folders, f"{package}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    for finalizer in list(weakref.finalize._registry):
        finalizer.atexit = False
    gc.collect()
    gc.freeze()


def serve(channel: socket.socket) -> dict[str, Any]:
    """Answer each request with the id of a new process; return the request in that process.

    A request is JSON, sent with the descriptors of the standard streams: `words`, `folder`, `environment`,
    `session`, and `first`, a function to call before the program starts, pickled, in hexadecimal digits. The
    process is orphaned at once, and so becomes a child of the nearest reaper.
    """
    while True:
        message, streams, _, _ = socket.recv_fds(channel, 1 << 20, 3)
        if not message:
            os._exit(0)
        read, write = os.pipe()
        parent = os.fork()
        if not parent:
            child = os.fork()
            if child:
                os.write(write, str(child).encode())
                os._exit(0)
            for name, stream in enumerate(streams):
                os.dup2(stream, name)
            for file in (*streams, read, write):
                os.close(file)
            channel.close()
            return dict(json.loads(message))
        os.waitpid(parent, 0)
        channel.send(os.read(read, 100))
        for file in (*streams, read, write):
            os.close(file)


def become(request: dict[str, Any]) -> None:
    """Run what `python WORD ...` runs, a module after -m or a script, and end as Python does.

    Freeing all objects of PyTorch at the end would take longer than most commands, so that is left out.
    """
    try:
        run_program(request)
        code = 0
    except SystemExit as stop:
        if stop.code is not None and not isinstance(stop.code, int):
            raise  # a message
        code = stop.code or 0
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            sys.exit(code)  # Python reports it
    os._exit(code & 0xFF)


def run_program(request: dict[str, Any]) -> None:
    """Run a module or script with the arguments, folder, environment and streams of a request."""
    first = pickle.loads(bytes.fromhex(request["first"])) if request["first"] else None
    if request["session"]:
        os.setsid()
    if first is not None:
        first()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    open_standard_streams()
    words = request["words"]
    if words[0] == "-m":
        sys.argv, sys.path[0] = words[1:], str(Path.cwd())
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv, sys.path[0] = words, str(Path(words[0]).resolve().parent)
        runpy.run_path(words[0], run_name="__main__")


def open_standard_streams() -> None:
    """Open them as the interpreter does when it starts: the old ones remember what they were opened on."""
    encoding = sys.stdout.encoding
    sys.stdin = sys.__stdin__ = _stream(0, encoding=encoding)
    sys.stdout = sys.__stdout__ = _stream(1, "w", encoding=encoding)
    sys.stderr = sys.__stderr__ = _stream(2, "w", 1, encoding=encoding, errors="backslashreplace")


def _stream(file: int, *mode: Any, **text: Any) -> Any:
    try:
        os.fstat(file)
    except OSError:  # closed; Python starts without it
        return None
    return os.fdopen(file, *mode, closefd=False, **text)


if __name__ == "__main__":
    warm_up()
    become(serve(socket.socket(fileno=int(sys.argv[1]))))
