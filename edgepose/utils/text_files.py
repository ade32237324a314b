"""Small text files of anyone, read with limits: a device has no end, and odd text keeps a parser busy."""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from edgepose.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MOST_BYTES = 1 << 20
"""A calibration has some thousand bytes, a map of sensors some hundred."""

MOST_TOML_BYTES, MOST_KEY_PARTS = 1 << 18, 100
"""A key of many parts takes the parser the square of them in time and memory."""


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """A text file in UTF-8 of so many bytes at most.

    Raises:
        ConfigError: it is larger.
        OSError: it cannot be read.
        UnicodeDecodeError: it is no text.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ConfigError(f"{path}: larger than {most >> 10} kB, as no such file is; is it another one?")
    return data.decode()


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file.

    Raises:
        ConfigError: it cannot be read, or is none.
    """
    text = ""
    try:
        text = read_text(path, MOST_TOML_BYTES)
        if any(line.count(".") > MOST_KEY_PARTS for line in text.splitlines()):
            raise ValueError(f"a key has more than {MOST_KEY_PARTS} parts")
        return tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot read it: {error.strerror}") from None
    except RecursionError:
        raise ConfigError(f"{path}: not valid TOML: brackets within brackets without end") from None
    except ValueError as error:  # also not UTF-8
        # The parser does not name what is there twice.
        keys = Counter(re.findall(r"^[ \t]*(?:\[[ \t]*)?([\w-]+)[ \t]*[=\]]", text, re.MULTILINE))
        twice = [key for key, count in keys.items() if count > 1]
        if twice and re.search("twice|overwrite|mutate", str(error)):
            raise ConfigError(f"{path}: {twice[0]} is there twice") from None
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
