"""Safe reading of arrays from pickles, without running code in them.

Data sets come as untrusted pickles, some of them from Python 2. Every object in a pickle becomes a stand-in
that keeps its state, and arrays are built from the stand-ins.
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
"""Limit on the instructions of a pickle, about five seconds; a file of arrays has some hundred."""

MOST_PARTS = 100_000
"""Limit on the parts of a tuple, counting those of nested tuples each time they occur."""

MOST_ODD_KEYS = 1000
"""Limit on the keys of dictionaries and members of sets in a file that are not text."""

MOST_KEY_PARTS = 100
"""Limit on the parts of a tuple used as a key: hashing visits all of them, each time."""


class InertObject:
    """Stands in for an object of any class: keeps its state in the pickle, and does nothing."""

    def __init__(self, *args: Any) -> None:
        """Keep the arguments."""
        self.args = args
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        """Keep the state."""
        self.state = state


class _DType(InertObject):
    """A numpy dtype, with its pickled code and state."""

    def build(self) -> np.dtype:
        code = self.args[0] if self.args else ""
        if not isinstance(code, str) or not re.fullmatch(r"[<>|=]?([iu][1248]|f[248])", code):
            raise ValueError("a dtype that is not numeric")
        dtype = np.dtype(code)
        big = isinstance(self.state, tuple) and self.state[1:2] == (">",)
        return dtype.newbyteorder(">") if big else dtype


class _Array(InertObject):
    """A numpy array, with its pickled state: version, shape, dtype, column order, bytes."""

    def build(self) -> np.ndarray:
        _, shape, dtype, by_column, data = self.state
        # A string pickled by Python 2 is loaded as latin1 text.
        data = data.encode("latin1") if isinstance(data, str) else data
        if not isinstance(dtype, _DType) or not isinstance(data, (bytes, bytearray)):
            raise ValueError("not an array of numbers")
        return np.frombuffer(data, dtype.build()).reshape(shape, order="F" if by_column else "C")


def _make_array(shape: Any, dtype: Any, by_column: bool, data: Any) -> _Array:
    array = _Array()
    array.state = (1, shape, dtype, by_column, data)
    return array


def _encode(text: Any, encoding: Any) -> bytes:
    """Build bytes as Python 3 pickles them at protocol 2: from latin1 text."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("bytes in an encoding other than latin1")
    if not isinstance(text, str):
        raise pickle.UnpicklingError("bytes made from something other than text")
    return text.encode("latin1")


def _empty_bytes(*count: Any) -> bytes:
    """Build empty bytes as protocol 2 pickles them; an argument could request any number of bytes."""
    if count:
        raise pickle.UnpicklingError("bytes made from something else")
    return b""


class _Tuple(tuple):
    """A tuple that keeps its number of parts, counting those of nested tuples each time they occur.

    A few bytes of a pickle can nest a tuple in itself forty times; hashing or comparing it would never end.
    """

    parts = 0


def _functions(make_set: Callable[..., set[Any]]) -> dict[tuple[str, str], Any]:
    """Return the functions and classes that a pickle may call, by module and name."""
    # They are made for each file, because a pickle can set their attributes.
    functions: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): type("ndarray", (InertObject,), {}),
        ("numpy", "dtype"): type("dtype", (_DType,), {}),
        ("_codecs", "encode"): lambda text, encoding: _encode(text, encoding),
    }
    for core in ("numpy.core", "numpy._core"):
        functions[f"{core}.multiarray", "_reconstruct"] = lambda *_: _Array()
        functions[f"{core}.multiarray", "scalar"] = lambda dtype, data: _make_array((), dtype, False, data)
        functions[f"{core}.numeric", "_frombuffer"] = lambda data, dtype, shape, order: _make_array(
            shape, dtype, order == "F", data
        )
    for module in ("builtins", "__builtin__"):
        functions.update(
            {(module, "object"): object, (module, "set"): make_set, (module, "bytes"): _empty_bytes}
        )
    for module in ("copyreg", "copy_reg"):
        # Protocols 0 and 1 make objects this way; every class that can be named here is a stand-in.
        functions[module, "_reconstructor"] = lambda kind, *_: kind()
    return functions


def _counted(instruction: Callable[[Any], None]) -> Callable[[Any], None]:
    def step(self: _Unpickler) -> None:
        self.steps += 1
        if self.steps > MOST_STEPS:
            raise pickle.UnpicklingError("it is too long")
        instruction(self)

    return step


_PythonUnpickler: Any = pickle._Unpickler


class _Unpickler(_PythonUnpickler):
    """Builds stand-ins; refuses all classes and functions that arrays do not need.

    It is based on the unpickler in Python, because it can be limited: a few bytes can make the one in C run
    forever or take all memory.
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

    def _make_tuple(self, items: list[Any]) -> _Tuple:
        made = _Tuple(items)
        made.parts = 1 + sum(item.parts if isinstance(item, _Tuple) else 1 for item in items)
        if made.parts > MOST_PARTS:
            raise pickle.UnpicklingError("a tuple of too many parts")
        return made

    def _check_keys(self, keys: Sequence[Any]) -> None:
        for key in keys:
            # Numbers can be chosen so that all their hashes collide; hashes of text are randomised.
            self.odd_keys += not isinstance(key, str | bytes)
            if self.odd_keys > MOST_ODD_KEYS or (isinstance(key, _Tuple) and key.parts > MOST_KEY_PARTS):
                raise pickle.UnpicklingError("too many keys, or too long ones, that are not text")

    def _set(self, items: Any = ()) -> set[Any]:
        """Build a set from a list; other iterables could have any length."""
        if not isinstance(items, list | tuple):
            raise pickle.UnpicklingError("a set made from something other than a list")
        self.steps += len(items)
        self._check_keys(items)
        return set(items)

    def load_tuple(self) -> None:
        items = self.pop_mark()
        self.append(self._make_tuple(items))

    def _load_tuple_of_last(self, count: int) -> None:
        self.stack[-count:] = [self._make_tuple(self.stack[-count:])]

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

    _OVERRIDES = (
        *((pickle.TUPLE, load_tuple), (pickle.TUPLE1, load_tuple1), (pickle.TUPLE2, load_tuple2)),
        *((pickle.TUPLE3, load_tuple3), (pickle.SETITEM, load_setitem), (pickle.SETITEMS, load_setitems)),
        *((pickle.DICT, load_dict), (pickle.ADDITEMS, load_additems), (pickle.FROZENSET, load_frozenset)),
        (pickle.BYTEARRAY8, load_bytearray8),
    )
    dispatch: ClassVar = {
        code: _counted(instruction)
        for code, instruction in (
            _PythonUnpickler.dispatch | {code[0]: instruction for code, instruction in _OVERRIDES}
        ).items()
    }


def read_pickle(
    path: Path, what: str, advice: str, inert: Callable[[str, str], bool] = lambda module, name: False
) -> dict[Any, Any]:
    """Read the dictionary in a pickle, without running any code in it.

    Args:
        path: file to read.
        what: the expected kind of file, for messages.
        advice: why a class or function named in the file is refused, and what to do, for messages.
        inert: whether a class, by module and name, is known and becomes an `InertObject`.

    Raises:
        FileFormatError: the file asks for code, is damaged, or does not hold a dictionary.
        OSError: it cannot be read.
    """
    data = path.read_bytes()
    try:
        content = _Unpickler(data, path, inert, advice).load()
    except EdgeposeError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        cut_off = isinstance(error, (EOFError, IndexError, struct.error))
        reason = "it is cut off or damaged; copy it again" if cut_off else str(error).partition("\n")[0]
        raise FileFormatError(f"{path}: not a readable {what}: {reason or type(error).__name__}") from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{path}: {what} holds a dictionary, this one a {type(content).__name__}")
    return content


def numbers(value: Any, name: str, path: Path) -> np.ndarray:
    """Return a value of a pickle as an array of finite numbers; it may be in chumpy's wrapper.

    Raises:
        FileFormatError: the value is something else.
    """
    array = array_of(value, name, path)
    if not np.all(np.isfinite(array)):
        raise FileFormatError(f"{path}: {name} contains NaN or infinity")
    return array


def _bounded(value: Any) -> Any:
    """Return a value after checking its number of parts: a list may hold itself many times."""
    waiting, parts = [value], 0
    while waiting:
        item = waiting.pop()
        if isinstance(item, (list, tuple)):
            parts += len(item)
            if parts > MOST_STEPS:
                raise ValueError("a list of too many parts")
            waiting += item
    return value


def array_of(value: Any, name: str, path: Path) -> np.ndarray:
    """Return a value like `numbers`, but with NaN and infinity allowed."""
    if isinstance(value, InertObject) and isinstance(value.state, dict):
        value = value.state.get("x")
    try:
        array = value.build() if isinstance(value, _Array) else np.asarray(_bounded(value))
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: {name} is not an array of numbers") from error
    if array.dtype.kind not in "fiu":
        raise FileFormatError(f"{path}: {name} is not an array of numbers")
    return array
