"""Values of TOML files, checked against the type that a key has."""

from __future__ import annotations

from typing import Any

from edgepose.errors import ConfigError

TEXT, SWITCH, WHOLE, NUMBER = "text in quotes", "true or false", "a whole number", "a number"
TEXTS = "text in quotes or a list of such texts"

_TYPES: dict[str, tuple[type, ...]] = {SWITCH: (bool,), WHOLE: (int,), NUMBER: (int, float)}  # others: text


def checked_value(key: str, value: object, what: str) -> Any:
    """Return the value of a key, numbers as float.

    Args:
        key: name of the key, for messages.
        value: value in the file.
        what: `TEXT`, `SWITCH`, `WHOLE`, `NUMBER` or `TEXTS`.

    Raises:
        ConfigError: the value has another type, is a text that is empty or has NUL characters, or a number
            too large for a float.
    """
    for item in value if what == TEXTS and isinstance(value, list) else [value]:
        if type(item) not in _TYPES.get(what, (str,)):  # not isinstance, to which a bool is an int
            raise ConfigError(f"{key} must be {what}, not {value!r}")
        if item == "":
            raise ConfigError(f"{key} is empty: give a value, or leave it out")
        if isinstance(item, str) and "\0" in item:
            raise ConfigError(f"{key} must be text without NUL characters, not {item!r}")
    try:
        return float(value) if what == NUMBER and isinstance(value, int | float) else value
    except OverflowError:
        raise ConfigError(f"{key} is too large for a number") from None


def texts_by_name(key: str, value: object) -> dict[str, Any]:
    """Return a table whose values are texts or lists of texts.

    Raises:
        ConfigError: it is something else.
    """
    if not isinstance(value, dict):
        raise ConfigError(f"{key} must be a table of names and texts, not {value!r}")
    return {name: checked_value(f"{key}.{name}", item, TEXTS) for name, item in value.items()}
