"""Configs of training runs: fields, TOML files, and checks of the values."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError
from edgepose.utils.similar_names import choices
from edgepose.utils.text_files import read_toml
from edgepose_export.networks.normalisation import SCHEMES
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape
from edgepose_export.synthesis.augmentation import Augmentation
from edgepose_export.training.sources import OWN, SOURCES

CONFIGS = Path(__file__).parent / "configs"
"""Folder with the configs of the shipped models."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run, as in a config file.

    Attributes:
        network: shape of the network.
        augmentation: disturbances of the batches.
        beta: parameter of the beta-likelihood (Seitzer et al. 2022); 0 is the paper's Gaussian likelihood, in
            which entries that never move dominate the gradient.
        acceleration_loss: whether the network also reconstructs the input accelerations (DIP 3.4.2).
        steps: number of optimiser steps.
        sequences: sequences per step, of all processes together.
        window: frames per sequence.
        streamed: frames of look-ahead if a BiRNN is trained as it streams; 0 trains it on whole sequences,
            which is three times as fast.
        joined: whether sequences may cross the ends of takes, so that a network that is never reset learns to
            recover from a jump.
        shares: share of the sequences taken from each of some sources, by name (`sources.toml`) or by its
            part before a dash (`snu`); sequences of other sources are taken in proportion to their frames.
        seated_share: share of the sequences taken from takes with synthetic sitting, if there are any.
        rests_share: share of the sequences taken from takes with synthetic rests, if there are any; `shares`
            refers to the sequences of neither kind.
        input_dropout: share of the inputs set to zero (DIP: 0.2).
        smoothness: jitter penalty: weight of the squared second differences in time of the pose error, in
            normalised units.
        place_loss: weight of the loss of contacts and velocity, if the network has a head for them.
        learning_rate: learning rate of Adam.
        warm_up: steps over which the learning rate rises to its initial value.
        schedule: "exponential" (DIP: times 0.96 every 2000 steps) or "cosine" down to zero at the last step.
        averaging: decay of the exponential moving average of the weights; 0 for no averaging.
        patience: number of validations without a better likelihood after which training stops; 0 for never.
        validate_every: steps between validations, at which checkpoints are written, too.
        bf16: whether matrix products are computed in bfloat16.
        seed: seed of weights, batches and disturbances.
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
    shares: dict[str, float] = field(default_factory=dict)
    seated_share: float = 0.0
    rests_share: float = 0.0
    input_dropout: float = 0.2
    smoothness: float = 0.0
    place_loss: float = 0.0
    learning_rate: float = 1e-3
    warm_up: int = 200
    schedule: str = "exponential"
    averaging: float = 0.0
    patience: int = 10
    validate_every: int = 1000
    bf16: bool = False
    seed: int = 0


def read_config(path: Path, settings: dict[str, Any] | None = None) -> TrainConfig:
    """Read a TOML file with TrainConfig's fields and the tables `[network]`, `[augmentation]` and `[shares]`.

    A file with `base = "NAME"` contains only what differs from NAME.toml in the same folder. `settings`
    override values of the file.

    Raises:
        EdgeposeError: the file is missing or not TOML, or has an unknown field, a value of a wrong type, or a
            value out of range.
    """
    values = _toml(path)
    try:
        if "base" in values:
            name = values.pop("base")
            if not isinstance(name, str):
                raise ValueError(f"base is {name!r}; it must be the name of a config in the same folder")
            values = _merged(_toml(path.with_name(f"{name}.toml")), values)
        return config_from(_merged(values, settings or {}))
    except ValueError as error:
        raise EdgeposeError(f"{path}: {error}") from error


def _toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise EdgeposeError(f"{path}: No such file; give the name of a shipped config or a TOML file")
    return read_toml(path)


def _merged(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a base, overridden by others; tables but `[shares]` are merged entry by entry."""
    result = base | values
    for name, table in values.items():
        if name != "shares" and isinstance(table, dict) and isinstance(base.get(name), dict):
            result[name] = base[name] | table
    return result


def config_from(values: dict[str, Any]) -> TrainConfig:
    """Return the TrainConfig with some plain values; the inverse of `config_values`.

    Raises:
        ValueError: a field is unknown, or its value has the wrong type or is out of range; names the field.
    """
    values = dict(values)
    shares = _shares(values.pop("shares", {}), values.pop("free_share", 0.0))
    tables: dict[str, Any] = {"network": NetworkShape, "augmentation": Augmentation}
    for name, kind in tables.items():
        table = values.pop(name, {})
        if not isinstance(table, dict):
            raise ValueError(f"{name} is {table!r}; it must be a table [{name}]")
        values[name] = kind(**_checked(table, kind()._asdict(), f" in [{name}]"))
    defaults = {f.name: f.default for f in fields(TrainConfig) if f.default is not MISSING}
    config = TrainConfig(
        **_checked({k: v for k, v in values.items() if k not in tables}, defaults),
        **{name: values[name] for name in tables},
        shares=shares,
    )
    if config.network.measured == "passed" and config.network.targets != "global-6d":
        raise ValueError('measured = "passed" needs targets = "global-6d"')
    if config.acceleration_loss and not config.network.acceleration:
        raise ValueError(
            "a network without accelerations cannot reconstruct them: set acceleration_loss = false"
        )
    if config.seated_share + config.rests_share > 1.0:
        raise ValueError(
            f"seated_share and rests_share are {config.seated_share:g} and {config.rests_share:g}; "
            "their sum must not exceed 1"
        )
    kind = NETWORKS[config.network.kind]
    if config.streamed and not kind.streamed:
        raise ValueError(f"streamed needs {_kinds('streamed')}")
    if config.network.smoothing and not kind.smoothed:
        raise ValueError(f"smoothing needs {_kinds('smoothed')}")
    if config.network.smoothing and config.network.targets != "global-6d":
        raise ValueError('smoothing needs targets = "global-6d"')
    if config.network.place and not kind.placed:
        raise ValueError(f"place needs {_kinds('placed')}")
    if config.network.place and config.network.normalisation == "sequence":
        raise ValueError('place needs another normalisation than "sequence"')
    if config.network.place and not config.place_loss:
        raise ValueError("place needs place_loss: without it, nothing trains the head")
    if config.streamed >= config.window:
        raise ValueError(
            f"streamed is {config.streamed}; it must be less than window, which is {config.window}"
        )
    return config


def _shares(table: Any, free_share: Any) -> dict[str, float]:
    """Return the checked table `[shares]`; `free_share` is what CMU's share was called in older configs."""
    if not isinstance(table, dict):
        raise ValueError(f"shares is {table!r}; it must be a table [shares]")
    table = table or ({"cmu": free_share} if free_share else {})
    names = {*SOURCES, *(name.split("-")[0] for name in SOURCES), OWN}
    for name in table:
        if name not in names:
            raise ValueError(f"unknown source {name!r} in [shares]; {choices(name, sorted(names))}")
    shares = _checked(table, dict.fromkeys(table, 0.0), high=1.0)
    if sum(shares.values()) > 1.0 + 1e-9:
        raise ValueError(f"the shares in [shares] sum up to {sum(shares.values()):g}; at most 1 is possible")
    return {name: float(share) for name, share in shares.items()}


def _kinds(ability: str) -> str:
    """Return the kinds of networks with an ability, for messages."""
    names = [f'"{name}"' for name, kind in NETWORKS.items() if getattr(kind, ability)]
    return f"kind = {' or '.join(names)}"


CHOICES: dict[str, tuple[str, ...]] = {
    "kind": tuple(NETWORKS),
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
    "seated_share": (0.0, 1.0),
    "rests_share": (0.0, 1.0),
    "aligned": (0.0, 1.0),
    "mirror": (0.0, 1.0),
    "stature": (0.0, 1.0),
    "proportions": (0.0, 5.0),
    "straight_arms": (0.0, 2.0),
    "silent": (0.0, 1.0),
    "smoothing": (0.0, 0.99),
}
"""Least and greatest values of numbers; those of all other fields are 0 and 1000."""


def _checked(
    values: dict[str, Any], defaults: dict[str, Any], where: str = "", high: float = 1000
) -> dict[str, Any]:
    """Return the values if each is in range and has the type of its default (or is whole, for a float)."""
    for name, value in values.items():
        if name not in defaults:
            raise ValueError(f"unknown field {name!r}{where}")
        kind = type(defaults[name])
        if type(value) is not kind and not (kind is float and type(value) is int):
            words = {bool: "true or false", int: "a whole number", float: "a number", str: "a string"}
            raise ValueError(f"{name} is {value!r}; it must be {words[kind]}")
        if kind is str and value not in CHOICES[name]:
            raise ValueError(f"{name} is {value!r}; it must be {' or '.join(map(repr, CHOICES[name]))}")
        if kind in (int, float):
            least, most = _RANGES.get(name, (0, high))
            if not least <= value <= most:
                raise ValueError(f"{name} is {value!r}; it must be from {least:g} to {most:g}")
    return values


def config_values(config: TrainConfig) -> dict[str, Any]:
    """Return the plain values of a config, as in a config file."""
    return asdict(config) | {
        "network": config.network._asdict(),
        "augmentation": config.augmentation._asdict(),
    }
