"""Arrays out of pickles, without running what is in them.

Data sets come as pickles, from anyone and from Python 2. Every object in one becomes a stand-in that keeps
its state, and arrays are built from those.
"""

from __future__ import annotations

import io
import pickle
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from edgepose.errors import EdgeposeError, FileFormatError

MOST_STEPS = 5_000_000
"""Instructions of a pickle that are followed; a file of arrays has some hundred. About five seconds."""

MOST_PARTS = 100_000
"""Parts of a tuple, those of the tuples in it counted as often as they are there."""

MOST_ODD_KEYS = 1000
"""Keys of dictionaries and members of sets that are no text; together, in a file."""

MOST_KEY_PARTS = 100
"""Parts of a tuple that is a key: hashing goes through all of them, each time."""


class InertObject:
    """Stands in for an object of any class: keeps what the pickle says about it, does nothing."""

    def __init__(self, *args: Any) -> None:
        """Keep the arguments."""
        self.args = args
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        """Keep the state."""
        self.state = state


class _DType(InertObject):
    """A numpy dtype, as the code and the state that it was written with."""

    def build(self) -> np.dtype:
        code = self.args[0] if self.args else ""
        if not isinstance(code, str) or not re.fullmatch(r"[<>|=]?([iu][1248]|f[248])", code):
            raise ValueError("a dtype that is no number's")
        dtype = np.dtype(code)
        big = isinstance(self.state, tuple) and self.state[1:2] == (">",)
        return dtype.newbyteorder(">") if big else dtype


class _Array(InertObject):
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


def _encode(text: Any, encoding: Any) -> bytes:
    """How Python 3 writes bytes at protocol 2: as text in latin1."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("bytes in another encoding than latin1")
    if not isinstance(text, str):
        raise pickle.UnpicklingError("bytes of something else than text")
    return text.encode("latin1")


def _no_bytes(*count: Any) -> bytes:
    """How protocol 2 writes bytes where there are none; an argument could ask for any number of them."""
    if count:
        raise pickle.UnpicklingError("bytes made of something else")
    return b""


class _Tuple(tuple):
    """A tuple that knows of how many parts it is, as those of the tuples in it count anew each time.

    A few bytes of a pickle can put a tuple into itself forty times; to hash or compare it would never end.
    """

    parts = 0


def _functions(make_set: Callable[..., set[Any]]) -> dict[tuple[str, str], Any]:
    """What a pickle may call, by module and name, made anew for each file."""
    # A pickle can set attributes of what it names, so it gets classes and functions of its own.
    functions: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): type("ndarray", (InertObject,), {}),
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
        functions.update(
            {(module, "object"): object, (module, "set"): make_set, (module, "bytes"): _no_bytes}
        )
    for module in ("copyreg", "copy_reg"):
        # How protocols 0 and 1 make an object; every class that can be named here is a stand-in.
        functions[module, "_reconstructor"] = lambda kind, *_: kind()
    return functions


def _counted(follow: Callable[[Any], None]) -> Callable[[Any], None]:
    def step(self: _Unpickler) -> None:
        self.steps += 1
        if self.steps > MOST_STEPS:
            raise pickle.UnpicklingError("it is too long")
        follow(self)

    return step


_PythonUnpickler: Any = pickle._Unpickler


class _Unpickler(_PythonUnpickler):
    """Builds stand-ins; refuses by name every class and function that arrays do not need.

    The one in Python rather than that in C, which a few bytes keep busy for ever, or make take all memory:
    this one can be told where to end.
    """

    def __init__(self, content: bytes, path: Path, inert: Callable[[str, str], bool], advice: str) -> None:
        super().__init__(io.BytesIO(content), encoding="latin1")
        self.path, self.inert, self.advice = path, inert, advice
        self.functions = _functions(self._set)
        self.steps = 0
        self.odd_keys = 0

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in self.functions:
            return self.functions[module, name]
        if self.inert(module, name):
            return type(name, (InertObject,), {})
        raise FileFormatError(f"{self.path}: the file asks for {module}.{name}, {self.advice}")

    def _tuple_of(self, items: list[Any]) -> _Tuple:
        made = _Tuple(items)
        made.parts = 1 + sum(item.parts if isinstance(item, _Tuple) else 1 for item in items)
        if made.parts > MOST_PARTS:
            raise pickle.UnpicklingError("a tuple of too many parts")
        return made

    def _check_keys(self, keys: Sequence[Any]) -> None:
        for key in keys:
            # Anybody can choose numbers that meet in one place of a dictionary; text is safe from that.
            self.odd_keys += not isinstance(key, str | bytes)
            if self.odd_keys > MOST_ODD_KEYS or (isinstance(key, _Tuple) and key.parts > MOST_KEY_PARTS):
                raise pickle.UnpicklingError("too many keys, or too long ones, that are no text")

    def _set(self, items: Any = ()) -> set[Any]:
        """A set of a list; what is no list could be of any length."""
        if not isinstance(items, list | tuple):
            raise pickle.UnpicklingError("a set of something else than a list")
        self.steps += len(items)
        self._check_keys(items)
        return set(items)

    def load_tuple(self) -> None:
        items = self.pop_mark()
        self.append(self._tuple_of(items))

    def _load_tuple_of_last(self, count: int) -> None:
        self.stack[-count:] = [self._tuple_of(self.stack[-count:])]

    def load_tuple1(self) -> None:
        self._load_tuple_of_last(1)

    def load_tuple2(self) -> None:
        self._load_tuple_of_last(2)

    def load_tuple3(self) -> None:
        self._load_tuple_of_last(3)

    def load_setitem(self) -> None:
        self._check_keys(self.stack[-2:-1])
        super().load_setitem()

    def load_setitems(self) -> None:
        self._check_keys(self.stack[::2])
        super().load_setitems()

    def load_dict(self) -> None:
        self._check_keys(self.stack[::2])
        super().load_dict()

    def load_additems(self) -> None:
        self._check_keys(self.stack)
        super().load_additems()

    def load_frozenset(self) -> None:
        self._check_keys(self.stack)
        super().load_frozenset()

    def load_bytearray8(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))

    _OWN = (
        *((pickle.TUPLE, load_tuple), (pickle.TUPLE1, load_tuple1), (pickle.TUPLE2, load_tuple2)),
        *((pickle.TUPLE3, load_tuple3), (pickle.SETITEM, load_setitem), (pickle.SETITEMS, load_setitems)),
        *((pickle.DICT, load_dict), (pickle.ADDITEMS, load_additems), (pickle.FROZENSET, load_frozenset)),
        (pickle.BYTEARRAY8, load_bytearray8),
    )
    dispatch: ClassVar = {
        code: _counted(follow)
        for code, follow in (_PythonUnpickler.dispatch | {code[0]: follow for code, follow in _OWN}).items()
    }


def read_pickle(
    path: Path, what: str, advice: str, inert: Callable[[str, str], bool] = lambda module, name: False
) -> dict[Any, Any]:
    """The dictionary in a pickle; no code in it is run.

    Args:
        path: file to read.
        what: the file should be, for messages.
        advice: why a class or function that the file asks for is not given, and what to do.
        inert: whether a class, by module and name, is known and becomes an `InertObject`.

    Raises:
        FileFormatError: the file asks for code, is broken, or is no dictionary.
        OSError: it cannot be read.
    """
    data = path.read_bytes()
    try:
        content = _Unpickler(data, path, inert, advice).load()
    except EdgeposeError:
        raise
    except Exception as error:  # a broken pickle can fail in any way
        cut_off = isinstance(error, (EOFError, IndexError, struct.error))
        reason = "it is cut off or damaged; copy it again" if cut_off else str(error).partition("\n")[0]
        raise FileFormatError(f"{path}: not a readable {what}: {reason or type(error).__name__}") from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path}: {what} holds a dictionary, this one a {type(content).__name__}")
    return content


def numbers(value: Any, name: str, path: Path) -> np.ndarray:
    """Finite numbers of whatever a pickle has under a name: an array, or chumpy's wrapper of one.

    Raises:
        FileFormatError: it is something else.
    """
    array = array_of(value, name, path)
    if not np.all(np.isfinite(array)):
        raise FileFormatError(f"{path}: {name} contains NaN or infinity")
    return array


def _bounded(value: Any) -> Any:
    """A value that numpy can make an array of without end: a list may hold itself many times."""
    waiting, parts = [value], 0
    while waiting:
        own = waiting.pop()
        if isinstance(own, (list, tuple)):
            parts += len(own)
            if parts > MOST_STEPS:
                raise ValueError("a list of too many parts")
            waiting += own
    return value


def array_of(value: Any, name: str, path: Path) -> np.ndarray:
    """As `numbers`, with NaN and infinity as they are."""
    if isinstance(value, InertObject) and isinstance(value.state, dict):
        value = value.state.get("x")
    try:
        array = value.build() if isinstance(value, _Array) else np.asarray(_bounded(value))
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: {name} is not an array of numbers") from error
    if array.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: {name} is not an array of numbers")
    return array
