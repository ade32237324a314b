"""Arrays out of pickles, without running what is in them.

Data sets come as pickles, from anyone and from Python 2. Every object in one becomes a stand-in that keeps
its state, and arrays are built from those.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from edgepose.errors import EdgeposeError


class Inert:
    """Stands in for an object of any class: keeps what the pickle says about it, does nothing."""

    def __init__(self, *args: Any) -> None:
        """Keep the arguments."""
        self.args = args
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        """Keep the state."""
        self.state = state


class _DType(Inert):
    """A numpy dtype, as the code and the state that it was written with."""

    def build(self) -> np.dtype:
        code = str(self.args[0]) if self.args else ""
        if not re.fullmatch(r"[<>|=]?([iu][1248]|f[248])", code):
            raise ValueError(f"dtype {code!r}")
        dtype = np.dtype(code)
        big = isinstance(self.state, tuple) and self.state[1:2] == (">",)
        return dtype.newbyteorder(">") if big else dtype


class _Array(Inert):
    """A numpy array, as the state that it was written with: version, shape, dtype, column order, bytes."""

    def build(self) -> np.ndarray:
        _, shape, dtype, by_column, data = self.state
        # A string of Python 2 arrives as text in latin1.
        data = data.encode("latin1") if isinstance(data, str) else data
        if not isinstance(dtype, _DType) or not isinstance(data, (bytes, bytearray)):
            raise ValueError("not an array of numbers")
        return np.frombuffer(data, dtype.build()).reshape(shape, order="F" if by_column else "C")


def _filled(shape: Any, dtype: Any, by_column: bool, data: Any) -> _Array:
    array = _Array()
    array.state = (1, shape, dtype, by_column, data)
    return array


def _encode(text: str, encoding: str) -> bytes:
    """How Python 3 writes bytes at protocol 2: as text in latin1."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes in {encoding!r}")
    return text.encode("latin1")


def _functions() -> dict[tuple[str, str], Any]:
    """What a pickle may call, by module and name, made anew for each file."""
    # A pickle can set attributes of what it names, so it gets classes and functions of its own.
    functions: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): type("ndarray", (Inert,), {}),
        ("numpy", "dtype"): type("dtype", (_DType,), {}),
        ("_codecs", "encode"): lambda text, encoding: _encode(text, encoding),
    }
    for core in ("numpy.core", "numpy._core"):
        functions[f"{core}.multiarray", "_reconstruct"] = lambda *_: _Array()
        functions[f"{core}.multiarray", "scalar"] = lambda dtype, data: _filled((), dtype, False, data)
        functions[f"{core}.numeric", "_frombuffer"] = lambda data, dtype, shape, order: _filled(
            shape, dtype, order == "F", data
        )
    for module in ("builtins", "__builtin__"):
        functions.update({(module, "object"): object, (module, "set"): set, (module, "bytes"): bytes})
    for module in ("copyreg", "copy_reg"):
        # How protocols 0 and 1 make an object; every class that can be named here is a stand-in.
        functions[module, "_reconstructor"] = lambda kind, *_: kind()
    return functions


class _Unpickler(pickle.Unpickler):
    """Builds stand-ins; refuses by name every class and function that arrays do not need."""

    def __init__(self, file: BinaryIO, path: Path, inert: Callable[[str, str], bool], advice: str) -> None:
        super().__init__(file, encoding="latin1")
        self.path, self.inert, self.advice = path, inert, advice
        self.functions = _functions()

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self.functions:
            return self.functions[module, name]
        if self.inert(module, name):
            return type(name, (Inert,), {})
        raise EdgeposeError(f"{self.path}: the file asks for {module}.{name}, {self.advice}")


def read_pickle(
    path: Path, what: str, advice: str, inert: Callable[[str, str], bool] = lambda module, name: False
) -> dict[Any, Any]:
    """The dictionary in a pickle; no code in it is run.

    Args:
        path: file to read.
        what: the file should be, for messages.
        advice: why a class or function that the file asks for is not given, and what to do.
        inert: whether a class, by module and name, is known and becomes an `Inert`.

    Raises:
        EdgeposeError: the file asks for code, is broken, or is no dictionary.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        try:
            content = _Unpickler(file, path, inert, advice).load()
        except (EdgeposeError, OSError):
            raise
        except Exception as error:  # a broken pickle can fail in any way
            reason = str(error).partition("\n")[0]
            raise EdgeposeError(f"{path}: not a readable {what}: {reason}") from error
    if not isinstance(content, dict):
        raise EdgeposeError(f"{path}: {what} holds a dictionary, this one a {type(content).__name__}")
    return content


def numbers(value: Any, name: str, path: Path) -> np.ndarray:
    """Finite numbers of whatever a pickle has under a name: an array, or chumpy's wrapper of one.

    Raises:
        EdgeposeError: it is something else.
    """
    array = array_of(value, name, path)
    if not np.all(np.isfinite(array)):
        raise EdgeposeError(f"{path}: {name} contains NaN or infinity")
    return array


def array_of(value: Any, name: str, path: Path) -> np.ndarray:
    """As `numbers`, with NaN and infinity as they are."""
    if isinstance(value, Inert) and isinstance(value.state, dict):
        value = value.state.get("x")
    try:
        array = value.build() if isinstance(value, _Array) else np.asarray(value)
    except (TypeError, ValueError) as error:
        raise EdgeposeError(f"{path}: {name} is not an array of numbers") from error
    if array.dtype.kind not in "fiu":
        raise EdgeposeError(f"{path}: {name} is not an array of numbers")
    return array
