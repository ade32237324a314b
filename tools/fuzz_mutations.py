"""Random damage to files: bytes, text, arrays, pickles, members of archives, cells of databases."""

from __future__ import annotations

import gzip
import io
import pickle
import random
import shutil
import sqlite3
import struct
import zipfile
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from fuzz_text import damage_text
from numpy.typing import NDArray

EXTREMES = (
    *(b"\x00" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", struct.pack("<f", float("nan"))),
    *(struct.pack("<f", float("inf")), struct.pack("<d", float("nan")), struct.pack("<f", 3e38)),
    *(struct.pack("<d", 1e308), struct.pack("<Q", 1 << 40), b"\x00" * 8, b"\xff" * 8),
)
"""Bytes in the place of others: counts, lengths and numbers at their ends."""

LARGE = 1 << 27
"""Bytes of a member that is small as long as it is packed."""

Numbers = NDArray[Any]

# --- bytes --------------------------------------------------------------------------------------------------


def span(rng: random.Random, size: int, most: int = 64) -> slice:
    """Return a random stretch; a few are long."""
    start = rng.randrange(size)
    length = rng.randint(1, size) if rng.random() < 0.1 else rng.randint(1, most)
    return slice(start, min(size, start + length))


def damage_bytes(rng: random.Random, content: bytes) -> bytes:
    """Return bytes with one random change."""
    if not content:
        return rng.randbytes(rng.randint(1, 100))
    data = bytearray(content)
    part = span(rng, len(data))
    match rng.randrange(9):
        case 0 | 1:
            data[part.start] ^= 1 << rng.randrange(8)
        case 2:
            del data[part.start :]
        case 3:
            del data[part]
        case 4:
            data[part.start : part.start] = data[part]
        case 5:
            data[part.start : part.start] = rng.randbytes(rng.randint(1, 64))
        case 6:
            extreme = rng.choice(EXTREMES)
            data[part.start : part.start + len(extreme)] = extreme
        case 7:
            data[part] = rng.randbytes(part.stop - part.start)
        case _:
            other = span(rng, len(data))
            data[part], data[other] = data[other], data[part]
    return bytes(data)


# --- arrays, pickles ----------------------------------------------------------------------------------------


def damage_array(rng: random.Random, array: Numbers) -> Numbers:
    """Return an array with another value, type or shape."""
    array = np.array(array)
    flat = array.reshape(-1)
    match rng.randrange(8):
        case 0 | 1 | 2 if array.size and array.dtype.kind in "fiu":
            values = (np.nan, np.inf, -np.inf, 1e308, 3e38, 1e7, -1.0, 0.0, 1e-320)
            with np.errstate(all="ignore"):
                flat[span(rng, array.size, 3)] = np.array(rng.choice(values)).astype(array.dtype)
        case 3:
            kinds = ("f2", "f4", "i1", "u8", "c16", "b1", "U4", "S3", "M8[s]", ">f8")
            with np.errstate(all="ignore"):
                return array.astype(rng.choice(kinds))
        case 4:
            return array[: rng.randint(0, len(array))] if array.ndim else array[None]
        case 5:
            return rng.choice((array.T, flat, array[None], np.array(1.0), array[:0], array[..., None]))
        case 6 if array.ndim:
            return np.concatenate([array, array[: rng.randint(0, len(array))]])
        case _ if array.ndim:
            return array[:: rng.choice((-1, 2, 3))]
    return array


def damage_pickle(rng: random.Random, content: bytes) -> bytes:
    """Change an array in a pickle of this tool's own making, or the pickle's bytes."""
    if rng.random() < 0.5:
        return damage_bytes(rng, content)
    document = pickle.loads(content)
    key = rng.choice(list(document))
    odd: tuple[Any, ...] = (None, "x", [], {}, [[1, [2]]], 1 << 70, b"x" * 10, {1, 2}, (1.0, float("nan")))
    if rng.random() < 0.2:
        del document[key]
    elif isinstance(document[key], np.ndarray) and rng.random() < 0.8:
        document[key] = damage_array(rng, document[key])
    else:
        document[key] = rng.choice(odd)
    return pickle.dumps(document, rng.choice((0, 2, 4, 5)))


# --- containers ---------------------------------------------------------------------------------------------


def damage_npy(rng: random.Random, content: bytes) -> bytes:
    """Change an array in an .npy member, or its header."""
    if rng.random() < 0.3:
        head = content[:128].replace(
            *rng.choice(((b"(", b"(9"), (b"<f", b">f"), (b"<f8", b"|O8"), (b"fortran", b"Fortran")))
        )
        return damage_bytes(rng, head) + content[128:] if rng.random() < 0.3 else head + content[128:]
    out = io.BytesIO()
    np.save(out, damage_array(rng, np.load(io.BytesIO(content))))
    return out.getvalue()


def damage_zip(rng: random.Random, content: bytes) -> bytes:
    """Change, remove, rename, repeat or add a member of a zip file, with right checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist() if not name.endswith("/")]
    at = rng.randrange(len(members))
    name, data = members[at]
    kind = rng.randrange(10)
    if kind < 6:
        array = name.endswith(".npy") and kind < 5
        members[at] = name, damage_npy(rng, data) if array else damage(rng, data, name)
    elif kind == 6:
        del members[at]
    elif kind == 7:
        members[at] = (
            rng.choice(("../x.npy", "/tmp/x", "", name[1:], name.upper(), "a\x1b[2J/" + name, "x" * 500)),
            data,
        )
    elif kind == 8:
        members.append((name, rng.choice(members)[1]))
    else:
        members.append(
            (rng.choice(("t.npy", "a.csv", "deep.zip", name)), rng.choice((bytes(LARGE), content, b"")))
        )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in members:
            archive.writestr(name or "x", data)
    return out.getvalue()


def damage_database(rng: random.Random, content: bytes) -> bytes:
    """Change a cell or the layout of an SQLite file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.db"
        path.write_bytes(content)
        with closing(sqlite3.connect(path)) as base:
            columns = [row[1] for row in base.execute("PRAGMA table_info(messages)")]
            value = rng.choice((None, "abc", 1e308, -1, 1 << 40, b"\x00" * 100, float("inf"), "", b""))
            where = "" if rng.random() < 0.1 else f" WHERE rowid = {rng.randint(1, 100)}"
            base.execute(f"UPDATE messages SET {rng.choice(columns)} = ?{where}", (value,))
            if rng.random() < 0.1:
                base.execute(f"ALTER TABLE messages DROP COLUMN {rng.choice(columns)}")
            base.commit()
        return path.read_bytes()


# --- files and folders --------------------------------------------------------------------------------------


def is_text(content: bytes) -> bool:
    """Whether a file is text."""
    head = content[:4096]
    odd = sum(byte > 126 or (byte < 32 and byte not in b"\t\r\n") for byte in head)
    return b"\x00" not in head and odd < 40


def damage(rng: random.Random, content: bytes, name: str) -> bytes:
    """Return the content of a file with one random change; its name tells its kind."""
    inside = rng.random() < 0.8
    if inside and content[:2] == b"PK":
        return damage_zip(rng, content)
    if inside and content[:2] == b"\x1f\x8b":
        return gzip.compress(damage(rng, gzip.decompress(content), name.removesuffix(".gz")), 1)
    if inside and content[:6] == b"SQLite":
        return damage_database(rng, content)
    if inside and name.endswith(".pkl"):
        return damage_pickle(rng, content)
    if inside and is_text(content):
        return damage_text(rng, content)
    return damage_bytes(rng, content)


def damage_file(rng: random.Random, path: Path) -> None:
    """Change a file in its place, once in most cases, up to four times."""
    content = path.read_bytes()
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        try:
            content = damage(rng, content, path.name)
        # What an earlier change made of the file is not always still of its kind.
        except Exception:
            content = damage_bytes(rng, content)
    path.write_bytes(content)


def damage_folder(rng: random.Random, folder: Path) -> None:
    """Change one file below a folder; or remove, rename, repeat or swap files."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path, other = rng.choice(files), rng.choice(files)
    kind = rng.randrange(16)
    if kind > 4:
        damage_file(rng, path)
    elif kind == 0:
        path.unlink()
    elif kind == 1:
        path.rename(
            path.with_name(
                rng.choice(("x.csv", "left_forearm.txt", path.name.upper(), "a\x1b[2J" + path.name))
            )
        )
    elif kind == 2:
        shutil.copy(path, path.with_name("copy of " + path.name))
    elif kind == 3:
        shutil.copy(other, path) if other != path else path.write_bytes(b"")
    else:
        path.unlink()
        path.mkdir()
