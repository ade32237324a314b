"""Reading of small, untrusted text files, with limits: devices are endless, odd text can stall a parser."""

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
"""Limit on the size of a file; a calibration has some thousand bytes, a sensor map some hundred."""

MOST_TOML_BYTES, MOST_KEY_PARTS = 1 << 18, 100
"""Limits for TOML; the parser's time and memory grow with the square of the number of parts of a key."""


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Read a text file in UTF-8 of at most `most` bytes.

    Raises:
        ConfigError: the file is larger.
        OSError: it cannot be read.
        UnicodeDecodeError: it is not text.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ConfigError(f"{path}: larger than {most >> 10} kB, too large for such a file; check the name")
    return data.decode()


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        ConfigError: it cannot be read, or is not valid TOML.
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
        raise ConfigError(f"{path}: not valid TOML: brackets are nested too deeply") from None
    except ValueError as error:  # also not UTF-8
        # The parser does not name a duplicate key.
        keys = Counter(re.findall(r"^[ \t]*(?:\[[ \t]*)?([\w-]+)[ \t]*[=\]]", text, re.MULTILINE))
        duplicates = [key for key, count in keys.items() if count > 1]
        if duplicates and re.search("twice|overwrite|mutate", str(error)):
            raise ConfigError(f"{path}: {duplicates[0]} is defined twice") from None
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
