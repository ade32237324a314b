"""Configs of training runs: their fields, the TOML files that hold them, and what is refused."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.utils.text_files import read_toml
from edgepose_export.archive.torchscript import KINDS
from edgepose_export.networks.normalisation import SCHEMES
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.synthesis.augmentation import Augmentation


@dataclass(frozen=True)
class TrainConfig:
    """One training run; what a config file holds.

    Attributes:
        network: the network's shape.
        augmentation: disturbances of the batches.
        beta: weight of the beta-likelihood (Seitzer et al. 2022); 0 is the paper's Gaussian likelihood, which
            lets entries that never move take all gradient.
        acceleration_loss: whether the network shall give back the input accelerations too (DIP 3.4.2).
        steps: optimiser steps.
        sequences: sequences a step, of all processes together.
        window: frames a sequence.
        streamed: frames of look-ahead with which a BiRNN is trained as it streams; 0 trains it on whole
            sequences, three times as fast.
        joined: sequences may run over the ends of takes: a network that is never reset learns to recover from
            a jump.
        free_share: share of the sequences taken from CMU's takes.
        seated_share: share of the sequences taken from takes with made sitting, where there are any; the
            other shares are of the rest.
        input_dropout: share of the inputs set to zero (DIP: 0.2).
        smoothness: weight of the squared second differences in time of the pose's error, in normalised units:
            what it costs to tremble where the wearer does not.
        learning_rate: of Adam.
        warm_up: steps in which the learning rate rises to its first value.
        schedule: "exponential" (DIP: times 0.96 every 2000 steps) or "cosine" down to zero at the last step.
        averaging: decay of the exponential moving average of the weights; 0 for none.
        patience: stop after so many validations without a better likelihood; 0 never.
        validate_every: steps between validations and checkpoints.
        bf16: matrix products in bfloat16.
        seed: of the weights, batches and disturbances.
    """

    network: NetworkShape = field(default_factory=NetworkShape)
    augmentation: Augmentation = field(default_factory=Augmentation)
    beta: float = 0.0
    acceleration_loss: bool = True
    steps: int = 100_000
    sequences: int = 64
    window: int = 120
    streamed: int = 0
    joined: bool = False
    free_share: float = 0.0
    seated_share: float = 0.0
    input_dropout: float = 0.2
    smoothness: float = 0.0
    learning_rate: float = 1e-3
    warm_up: int = 200
    schedule: str = "exponential"
    averaging: float = 0.0
    patience: int = 10
    validate_every: int = 1000
    bf16: bool = False
    seed: int = 0


def read_config(path: Path) -> TrainConfig:
    """A TOML file with TrainConfig's fields, `[network]` and `[augmentation]` tables.

    With `base = "NAME"` it says only what differs from NAME.toml in the same folder.

    Raises:
        EdgeposeError: no file, not TOML, an unknown field, or a value of a wrong type or out of its range.
    """
    values = _toml(path)
    try:
        if "base" in values:
            name = values.pop("base")
            if not isinstance(name, str):
                raise ValueError(f"base is {name!r}; it takes the name of a config beside this one")
            values = _over(_toml(path.with_name(f"{name}.toml")), values)
        return config_from(values)
    except ValueError as error:
        raise EdgeposeError(f"{path}: {error}") from error


def _toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise EdgeposeError(f"{path}: No such file; give the name of a shipped config or a TOML file")
    return read_toml(path)


def _over(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Values laid over those of a base, tables entry by entry."""
    result = base | values
    for name, table in values.items():
        if isinstance(table, dict) and isinstance(base.get(name), dict):
            result[name] = base[name] | table
    return result


def config_from(values: dict[str, Any]) -> TrainConfig:
    """TrainConfig of plain values; the inverse of `config_values`.

    Raises:
        ValueError: an unknown field, or a value of a wrong type or out of its range; names the field.
    """
    values = dict(values)
    tables: dict[str, Any] = {"network": NetworkShape, "augmentation": Augmentation}
    for name, kind in tables.items():
        table = values.pop(name, {})
        if not isinstance(table, dict):
            raise ValueError(f"{name} is {table!r}; it takes a table [{name}]")
        values[name] = kind(**_checked(table, kind()._asdict(), f" in [{name}]"))
    defaults = {f.name: getattr(TrainConfig, f.name) for f in fields(TrainConfig) if f.name not in tables}
    config = TrainConfig(
        **_checked({k: v for k, v in values.items() if k not in tables}, defaults),
        **{name: values[name] for name in tables},
    )
    if config.network.measured == "passed" and config.network.targets != "global-6d":
        raise ValueError('measured = "passed" needs targets = "global-6d"')
    if config.acceleration_loss and not config.network.acceleration:
        raise ValueError("a network without accelerations cannot give them back: acceleration_loss = false")
    if config.streamed and config.network.kind != "birnn":
        raise ValueError('only kind = "birnn" can be trained as streamed')
    if config.network.smoothing and config.network.kind not in ("birnn", "rnn"):
        raise ValueError('smoothing is for kind = "birnn" and "rnn"')
    if config.network.smoothing and config.network.targets != "global-6d":
        raise ValueError('smoothing needs targets = "global-6d"')
    if config.streamed >= config.window:
        raise ValueError(f"streamed is {config.streamed}; it takes fewer frames than the window has")
    return config


_CHOICES = {
    "kind": tuple(KINDS),
    "normalisation": SCHEMES,
    "targets": ("local-matrix", "global-6d"),
    "measured": ("predicted", "passed"),
    "schedule": ("exponential", "cosine"),
}

_RANGES: dict[str, tuple[float, float]] = {
    "hidden": (1, 8192),
    "steps": (1, 10**9),
    "sequences": (1, 10**6),
    "window": (1, 10**6),
    "streamed": (0, 1000),
    "validate_every": (1, 10**9),
    "seed": (0, 2**62),
    "learning_rate": (1e-12, 10.0),
    "warm_up": (0, 10**9),
    "averaging": (0.0, 1.0),
    "input_dropout": (0.0, 0.99),
    "free_share": (0.0, 1.0),
    "seated_share": (0.0, 1.0),
    "aligned": (0.0, 1.0),
    "mirror": (0.0, 1.0),
    "silent": (0.0, 1.0),
    "smoothing": (0.0, 0.99),
}
"""Least and greatest value of numbers; those of other fields are 0 and 1000."""


def _checked(values: dict[str, Any], defaults: dict[str, Any], where: str = "") -> dict[str, Any]:
    """The same values, if each has its default's type (or is whole) and is in its range."""
    for name, value in values.items():
        if name not in defaults:
            raise ValueError(f"unknown field {name!r}{where}")
        kind = type(defaults[name])
        if type(value) is not kind and not (kind is float and type(value) is int):
            words = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
            raise ValueError(f"{name} is {value!r}; it takes {words[kind]}")
        if kind is str and value not in _CHOICES[name]:
            raise ValueError(f"{name} is {value!r}; it takes {' or '.join(map(repr, _CHOICES[name]))}")
        if kind in (int, float):
            low, high = _RANGES.get(name, (0, 1000))
            if not low <= value <= high:
                raise ValueError(f"{name} is {value!r}; it takes {low:g} to {high:g}")
    return values


def config_values(config: TrainConfig) -> dict[str, Any]:
    """Plain values of a config, as a config file would hold them."""
    return asdict(config) | {
        "network": config.network._asdict(),
        "augmentation": config.augmentation._asdict(),
    }
