"""Random damage to text: numbers, lines, columns, headers, separators, values of JSON and TOML, encodings."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from itertools import pairwise

NUMBERS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e400", "-0", "0", "1e-320", "1e7", "1e20", "-1", "1_0"),
    *(
        "",
        "x",
        "9" * 400,
        "0x10",
        "1e",
        "--1",
        "99999999999999999999",
        "2147483648",
        "1,5",
        "\N{ARABIC-INDIC DIGIT ONE}",
    ),
)
"""Texts in the place of a number."""

WORDS = (
    *("0xFFFFFFFF", "true", "null", '""', "[]", "{}", '"x"', "-1", "1e400", "NaN", "[[[[1]]]]", '{"a": 1}'),
    *("1979-05-27", "[" * 3000 + "]" * 3000, '"' + "a" * 5000 + '"', '"\\u001b[2J"', "9" * 5000, "0.5"),
)
"""Values in the place of one of JSON or TOML."""

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
CELL = re.compile(r"[^,;\t\n ]+")
VALUE = re.compile(r'(?<=[:=\[,])\s*("[^"\n]*"|[-+\w.]+)')


def replace_match(rng: random.Random, text: str, pattern: re.Pattern[str], words: tuple[str, ...]) -> str:
    """Return a text with a random match of a pattern replaced by one of several words."""
    matches = list(pattern.finditer(text))
    if not matches:
        return text + rng.choice(words)
    found = rng.choice(matches)
    return text[: found.start()] + rng.choice(words) + text[found.end() :]


def damage_number(rng: random.Random, text: str) -> str:
    """Replace a number."""
    return replace_match(rng, text, NUMBER, NUMBERS)


def damage_lines(rng: random.Random, text: str) -> str:
    """Remove, repeat, swap, cut or join lines, or repeat all of them."""
    lines = text.splitlines(keepends=True) or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(7):
        case 0:
            del lines[at]
        case 1:
            lines[at:at] = lines[min(at, other) : max(at, other) + 1]
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            lines[at] = lines[at][: rng.randint(0, len(lines[at]))]
        case 4:
            lines[at] = lines[at].rstrip("\r\n")
        case 5:
            lines *= rng.randint(2, 5)
        case _:
            lines[at] = rng.choice(
                ("\n", "#\n", "x" * 200_000 + "\n", "\x00\n", "\x1b[2J\n", lines[at].strip() * 50)
            )
    return "".join(lines)


def damage_columns(rng: random.Random, text: str) -> str:
    """Swap, remove or repeat a column, in all lines or in one."""
    separator = max(",;\t ", key=text.count)
    lines = [line.split(separator) for line in text.split("\n")]
    width = max(map(len, lines))
    at, other = rng.randrange(width), rng.randrange(width)
    chosen = lines if rng.random() < 0.6 else [rng.choice(lines)]
    kind = rng.randrange(3)
    for cells in chosen:
        if max(at, other) >= len(cells):
            continue
        if kind == 0:
            cells[at], cells[other] = cells[other], cells[at]
        elif kind == 1:
            del cells[at]
        else:
            cells.insert(at, cells[other])
    return "\n".join(separator.join(cells) for cells in lines)


def damage_header(rng: random.Random, text: str) -> str:
    """Change a word in the first lines."""
    lines = text.split("\n")
    at = rng.randrange(min(len(lines), 4))
    lines[at] = replace_match(
        rng, lines[at], CELL, ("", "x", "time", "nan", "#", "left_forearm_t", "1e9", "é\x1b[31m")
    )
    return "\n".join(lines)


def damage_separators(rng: random.Random, text: str) -> str:
    """Write a table as other programs and countries do."""
    before, after = rng.choice(
        ((",", ";"), (",", "\t"), ("\t", ","), (".", ","), ("\n", "\r"), ("\n", "\r\n"), ("\n", ""))
    )
    if rng.random() < 0.2:
        text = text.replace(".", ",") if before == "\t" else text.replace(",", ";").replace(".", ",")
    return text.replace(before, after)


def damage_value(rng: random.Random, text: str) -> str:
    """Replace a value of JSON or TOML by one of another type."""
    return replace_match(rng, text, VALUE, WORDS)


def damage_document(rng: random.Random, text: str) -> str:
    """Remove, repeat or replace a member anywhere in a JSON document; other text loses a line."""
    try:
        document = json.loads(text)
    except ValueError:
        return damage_lines(rng, text)
    owner, keys = document, []
    while isinstance(owner, dict | list) and owner:
        keys.append((owner, rng.choice(list(owner) if isinstance(owner, dict) else range(len(owner)))))
        owner = owner[keys[-1][1]]
    if not keys:
        return text
    owner, key = rng.choice(keys)
    if rng.random() < 0.4:
        del owner[key]
    else:
        owner[key] = rng.choice(
            (None, True, -1, 1e300, "x", [], {}, [1, 2, 3], {"a": 1}, "\x1b[2J", document["format"])
        )
    return json.dumps(document)


def damage_markup(rng: random.Random, text: str) -> str:
    """Insert markup: entities, nested elements, comments that do not end."""
    entities = (f'<!ENTITY {new} "' + f"&{old};" * 10 + '">' for old, new in pairwise("bcdefghij"))
    bomb = '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb">' + "".join(entities)
    piece = rng.choice(
        (bomb + "]>", "&i;", "<a>" * 2000, "<!--", "<![CDATA[", "</frames>", "&#0;", "<frame/>")
    )
    at = 0 if piece.startswith("<!D") else rng.randrange(len(text) + 1)
    return text[:at] + piece + text[at:]


TEXT: tuple[Callable[[random.Random, str], str], ...] = (
    *(damage_number, damage_number, damage_number, damage_lines, damage_lines, damage_columns),
    *(damage_header, damage_separators, damage_value, damage_value, damage_document, damage_markup),
)


def damage_encoding(rng: random.Random, content: bytes) -> bytes:
    """Write a text in another encoding, or with bytes that are in none."""
    text = content.decode(errors="replace")
    encodings = ("utf-16", "utf-16-be", "utf-8-sig", "utf-32", "cp1252")
    if rng.random() < 0.5:
        return text.encode(rng.choice(encodings), errors="replace")
    at = rng.randrange(len(content) + 1)
    return (
        content[:at]
        + rng.choice((b"\x00", b"\xff", b"\xc3", b"\xef\xbb\xbf", b"\x1a", b"\xed\xa0\x80"))
        + content[at:]
    )


def damage_text(rng: random.Random, content: bytes) -> bytes:
    """Return a text with one random change."""
    if rng.random() < 0.06:
        return damage_encoding(rng, content)
    change = rng.choice(TEXT)
    return change(rng, content.decode(errors="surrogateescape")).encode(errors="surrogateescape")
