"""Rig files: TOML files with the settings of one wearer, whose keys are the flags of `edgepose run`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from edgepose.errors import ConfigError, EdgeposeError
from edgepose.sinks.registry import SINKS
from edgepose.sources.protocol_detection import checked_protocol
from edgepose.utils.similar_names import choices
from edgepose.utils.sockets import parse_host_and_port
from edgepose.utils.text_files import read_toml


def read_rig(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the name and the settings of a wearer, by field names of `WearerConfig` and its parts.

    File names in it are relative to the folder of the TOML file.

    Raises:
        ConfigError: the file cannot be read, or a key is unknown or has a value of the wrong type.
    """
    content = read_toml(path)
    name = content.pop("name", path.stem)
    if not isinstance(name, str) or not name.isprintable() or not name.strip():
        raise ConfigError(f"{path}: name must be text in quotes on one line, not {name!r}")
    try:
        return name, {key.replace("-", "_"): _value(key, v, path.parent) for key, v in content.items()}
    except EdgeposeError as error:
        raise ConfigError(f"{path}: {error}") from None


_TEXT, _SWITCH, _WHOLE, _NUMBER = "text in quotes", "true or false", "a whole number", "a number"
_TEXTS = "text in quotes or a list of such texts"

_TYPES: dict[str, Any] = {_SWITCH: (bool,), _WHOLE: (int,), _NUMBER: (int, float)}  # others are text

_FILES = ("file", "sensors", "calibration", *(name for name, output in SINKS.items() if output.suffix))
"""Keys whose values are files, relative to the TOML file; that of `protocol` may be one too."""

_KEYS = {
    "port": _TEXT,
    "baud": _WHOLE,
    "can": _TEXT,
    "bitrate": _WHOLE,
    "fd": _SWITCH,
    "file": _TEXT,
    "realtime": _SWITCH,
    "protocol": _TEXT,
    "sensors": _TEXT,
    "listen": _TEXT,
    "connect": _TEXT,
    "ble": _TEXT,
    "filter": _TEXT,
    "no-mag": _SWITCH,
    "calibration": _TEXT,
    **{name: _SWITCH if output.metavar is None else _TEXTS for name, output in SINKS.items()},
    "rotations": _TEXT,
    "std": _SWITCH,
    "height": _NUMBER,
    "leg-length": _NUMBER,
    "overwrite": _SWITCH,
    "rate": _NUMBER,
    "page-port": _WHOLE,
    "no-place": _SWITCH,
    "no-drift-correction": _SWITCH,
    "control": _TEXT,
}


def _value(key: str, value: object, folder: Path) -> Any:
    """Convert a value of the TOML file to that of the configuration.

    Raises:
        ConfigError: there is no such key, or the value has the wrong type or is invalid.
    """
    if key == "sinks" and isinstance(value, dict) and all(map(_is_text_or_texts, value.values())):
        return value
    what = _KEYS.get(key)
    if what is _TEXTS and isinstance(value, list) and _is_text_or_texts(value):
        return [_value(key, item, folder) for item in value]
    if what is None:
        raise ConfigError(f"unknown key {key!r}; {choices(key, ['name', *_KEYS, 'sinks'], 'keys are')}")
    if type(value) not in _TYPES.get(what, (str,)):  # not isinstance, to which a bool is an int
        raise ConfigError(f"{key} must be {what}, not {value!r}")
    if not isinstance(value, str):
        return float(value) if what == _NUMBER and isinstance(value, int | float) else value
    if not value or "\0" in value:
        raise ConfigError(f"{key} must be text of one character or more, none of them NUL, not {value!r}")
    return _text(key, value, folder)


def _is_text_or_texts(value: object) -> bool:
    return all(isinstance(item, str) for item in (value if isinstance(value, list) else [value]))


def _text(key: str, value: str, folder: Path) -> Any:
    if key in _FILES and value != "-":
        value = str(folder / value)
    if key in ("file", "sensors", "calibration"):
        return Path(value)
    parse: dict[str, Callable[[str], Any]] = {
        "protocol": lambda name: str(folder / name) if name.endswith(".toml") else checked_protocol(name),
        "control": parse_host_and_port,
    }
    if key not in parse:
        return value
    try:
        return parse[key](value)
    except EdgeposeError as error:
        raise ConfigError(f"{key}: {error}") from None
