"""Training of the networks (DIP 3.4): loss, batches, steps, checkpoints that can be resumed."""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from edgepose.errors import EdgeposeError
from edgepose.features import ACCELERATIONS, network_input, rotation_to_6d
from edgepose.skeleton import PARENTS
from edgepose_export.archive import Statistics
from edgepose_export.augmentation import Augmentation, augment
from edgepose_export.dataset import Tape
from edgepose_export.networks import NetworkShape, PoseNetwork

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True)
class TrainConfig:
    """One training run; what a config file holds.

    Attributes:
        network: the network's shape.
        augmentation: disturbances of the batches.
        beta: weight of the beta-likelihood (Seitzer et al. 2022); 0 is the paper's Gaussian likelihood, which
            lets entries that never move take all gradient.
        steps: optimiser steps.
        sequences: sequences a step.
        window: frames a sequence.
        joined: sequences may run over the ends of takes: a network that is never reset learns to recover from
            a jump.
        free_share: share of the sequences taken from CMU's takes.
        input_dropout: share of the inputs set to zero (DIP: 0.2).
        learning_rate: of Adam.
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
    steps: int = 100_000
    sequences: int = 64
    window: int = 120
    joined: bool = False
    free_share: float = 0.0
    input_dropout: float = 0.2
    learning_rate: float = 1e-3
    schedule: str = "exponential"
    averaging: float = 0.0
    patience: int = 10
    validate_every: int = 1000
    bf16: bool = False
    seed: int = 0


def read_config(path: Path) -> TrainConfig:
    """A TOML file with TrainConfig's fields, `[network]` and `[augmentation]` tables.

    Raises:
        EdgeposeError: no file, not TOML, an unknown field, or a value of a wrong type or out of its range.
    """
    try:
        return config_from(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise EdgeposeError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise EdgeposeError(f"{path}: {error}") from error


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
    return config


_CHOICES = {
    "kind": ("birnn", "rnn"),
    "targets": ("local-matrix", "global-6d"),
    "measured": ("predicted", "passed"),
    "schedule": ("exponential", "cosine"),
}

_RANGES: dict[str, tuple[float, float]] = {
    "hidden": (1, 8192),
    "steps": (1, 10**9),
    "sequences": (1, 10**6),
    "window": (1, 10**6),
    "validate_every": (1, 10**9),
    "seed": (0, 2**62),
    "learning_rate": (1e-12, 10.0),
    "averaging": (0.0, 1.0),
    "input_dropout": (0.0, 0.99),
    "free_share": (0.0, 1.0),
    "mirror": (0.0, 1.0),
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


# --- targets and loss ---------------------------------------------------------------------------------------


def pose_targets(relative: Tensor, shape: NetworkShape) -> Tensor:
    """Numbers (..., pose outputs) that the network shall give, before z-scoring, of root-relative rotations
    (..., 24, 3, 3).
    """
    joints = list(shape.joints)
    if shape.targets == "global-6d":
        return rotation_to_6d(relative[..., joints, :, :]).flatten(-2)
    parents = relative[..., [PARENTS[j] for j in joints], :, :].transpose(-1, -2)
    return torch.matmul(parents, relative[..., joints, :, :]).flatten(-3)


def statistics_of(tape: Tape, shape: NetworkShape) -> Statistics:
    """Means and deviations over a training tape (DIP 4.4).

    Local matrices are z-scored entry by entry as in the paper. Global rotations get one deviation for all
    entries, so that a degree weighs the same at every joint.
    """
    inputs = network_input(tape.orientation, tape.acceleration)
    targets = pose_targets(tape.relative, shape)
    deviation = targets.std(0).clamp_min(1e-2)
    if shape.targets == "global-6d":
        deviation = deviation.square().mean().sqrt().expand_as(deviation).clone()
    return Statistics(inputs.mean(0), inputs.std(0).clamp_min(1e-3), targets.mean(0), deviation)


def likelihood_loss(mean: Tensor, deviation: Tensor, target: Tensor, beta: float) -> Tensor:
    """Negative Gaussian log-likelihood (DIP eq. 4 and 5), each term weighted by deviation^(2 beta) without
    gradient; a scalar.
    """
    loss = torch.log(deviation) + 0.5 * ((target - mean) / deviation).square()
    if beta:
        loss = loss * deviation.detach() ** (2.0 * beta)
    return loss.mean()


# --- batches ------------------------------------------------------------------------------------------------


def window_starts(tape: Tape, window: int, joined: bool) -> tuple[Tensor, Tensor]:
    """First frames of all windows that a tape holds, those of CMU's takes apart: (others, CMU's)."""
    groups: tuple[list[Tensor], list[Tensor]] = ([], [])
    last = int(tape.starts[-1]) - window
    for i, free in enumerate(tape.free):
        start, end = int(tape.starts[i]), int(tape.starts[i + 1])
        end = min(end - 1, last) if joined else end - window
        if end >= start:
            groups[free].append(torch.arange(start, end + 1))
    empty = torch.zeros(0, dtype=torch.long)
    return torch.cat([empty, *groups[0]]), torch.cat([empty, *groups[1]])


def draw(starts: tuple[Tensor, Tensor], count: int, free_share: float, generator: torch.Generator) -> Tensor:
    """First frames (count,) of random windows with the wanted share of CMU's."""
    other, cmu = starts
    if free_share == 0.0 or len(other) == 0 or len(cmu) == 0:
        pool = torch.cat([other, cmu])
        return pool[torch.randint(len(pool), (count,), generator=generator)]
    free = round(count * free_share)
    return torch.cat(
        [
            cmu[torch.randint(len(cmu), (free,), generator=generator)],
            other[torch.randint(len(other), (count - free,), generator=generator)],
        ]
    )


def windows(tape: Tape, starts: Tensor, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """Orientations, accelerations and true rotations of windows, each (len(starts), length, ...)."""
    index = starts[:, None] + torch.arange(length)
    return tape.orientation[index], tape.acceleration[index], tape.relative[index]


# --- the run ------------------------------------------------------------------------------------------------


class Trainer:
    """State of one run: network, averaged weights, optimiser, generator, step."""

    def __init__(self, config: TrainConfig, train: Tape, validation: Tape, data: dict[str, Any]) -> None:
        """Starts a run at step 0.

        Args:
            config: of the run.
            train: takes to train on.
            validation: takes that tell when to stop.
            data: what the training takes are, for the archive's card: summary, takes, hours, licenses.
        """
        torch.manual_seed(config.seed)
        self.config, self.train_tape, self.validation_tape = config, train, validation
        self.data = data
        self.statistics = statistics_of(train, config.network)
        self.network = PoseNetwork(config.network)
        self.averaged = PoseNetwork(config.network)
        self.averaged.load_state_dict(self.network.state_dict())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.generator = torch.Generator().manual_seed(config.seed + 1)
        self.starts = window_starts(train, config.window, config.joined)
        for part, starts in (
            ("training", self.starts),
            ("validation", window_starts(validation, config.window, False)),
        ):
            if not any(map(len, starts)):
                raise EdgeposeError(f"no {part} take is as long as the window of {config.window} frames")
        self.step = 0
        self.best = math.inf
        self.worse = 0

    def _loss(self, network: nn.Module, batch: tuple[Tensor, Tensor, Tensor], dropout: float) -> Tensor:
        orientation, acceleration, relative = batch
        s = self.statistics
        x = (network_input(orientation, acceleration) - s.input_mean) / s.input_std
        target = torch.cat(
            [
                (pose_targets(relative, self.config.network) - s.target_mean) / s.target_std,
                x[..., -ACCELERATIONS:],
            ],
            dim=-1,
        )
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.bf16):
            mean, deviation = network(nn.functional.dropout(x, dropout, training=dropout > 0))
        return likelihood_loss(mean.float(), deviation.float(), target, self.config.beta)

    def train_step(self) -> float:
        """One optimiser step; gives its loss."""
        config = self.config
        rate = config.learning_rate * (
            0.96 ** (self.step / 2000)
            if config.schedule == "exponential"
            else 0.5 * (1.0 + math.cos(math.pi * self.step / config.steps))
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate * min(1.0, (self.step + 1) / 200)
        starts = draw(self.starts, config.sequences, config.free_share, self.generator)
        batch = augment(windows(self.train_tape, starts, config.window), config.augmentation, self.generator)
        loss = self._loss(self.network, batch, config.input_dropout)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        # The average starts as the plain mean, so that it forgets the random first weights soon.
        decay = min(config.averaging, self.step / (self.step + 10.0))
        with torch.no_grad():
            for mean, new in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(new, 1.0 - decay)
        return loss.item()

    @torch.no_grad()
    def validate(self) -> float:
        """Loss of the averaged weights on undisturbed validation windows."""
        config = self.config
        pools = window_starts(self.validation_tape, config.window, False)
        starts = torch.cat(pools)[:: max(1, config.window // 2)]
        losses = [
            self._loss(self.averaged, windows(self.validation_tape, part, config.window), 0.0) * len(part)
            for part in starts.split(128)
        ]
        return float(torch.stack(losses).sum() / len(starts))

    def state(self) -> dict[str, Any]:
        """Everything that `load` needs, as tensors and plain values."""
        return {
            "config": json.dumps(config_values(self.config)),
            "statistics": {name: value.clone() for name, value in self.statistics._asdict().items()},
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "torch_generator": torch.get_rng_state(),
            "step": self.step,
            "best": self.best,
            "worse": self.worse,
            "data": self.data,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Goes on where a checkpoint stopped.

        Raises:
            EdgeposeError: the checkpoint is of another network, or holds weights only.
        """
        if "optimiser" not in state:
            raise EdgeposeError("the checkpoint holds weights only; begin a new run from it with --init")
        self._check_shape(state)
        self.statistics = Statistics(**state["statistics"])
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        torch.set_rng_state(state["torch_generator"])
        self.step, self.best, self.worse = state["step"], state["best"], state["worse"]
        self.data = state["data"]

    def start_from(self, state: dict[str, Any]) -> None:
        """Fine-tuning (DIP 3.4.4): takes a checkpoint's averaged weights and statistics.

        What it was trained on, and under which licences, is noted together with this run's takes.

        Raises:
            EdgeposeError: the checkpoint is of another network.
        """
        self._check_shape(state)
        self.statistics = Statistics(**state["statistics"])
        self.network.load_state_dict(state["averaged"])
        self.averaged.load_state_dict(state["averaged"])
        before = state["data"]
        self.data = {
            "summary": f"{before['summary']}, then {self.data['summary']}",
            "licenses": sorted({*before["licenses"], *self.data["licenses"]}),
            "takes": before["takes"] + self.data["takes"],
            "hours": before["hours"] + self.data["hours"],
        }

    def _check_shape(self, state: dict[str, Any]) -> None:
        shape = config_from(json.loads(state["config"])).network
        if shape != self.config.network:
            raise EdgeposeError(f"the checkpoint holds {shape}, the config asks for {self.config.network}")


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes a checkpoint so that a crash leaves the old one or the new one, never half of one.

    Raises:
        EdgeposeError: it cannot be written (disk full).
    """
    partial = path.with_suffix(".partial")
    content = io.BytesIO()
    torch.save(state, content)
    try:
        with partial.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise EdgeposeError(f"{path}: cannot be written: {error.strerror or error}") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's state, read without running pickled code.

    Raises:
        EdgeposeError: missing or not a checkpoint.
    """
    try:
        state = torch.load(path, weights_only=True)
    except OSError as error:
        raise EdgeposeError(f"{path}: {error.strerror or error}") from error
    except Exception as error:
        raise EdgeposeError(f"{path}: not a checkpoint of edgepose train ({type(error).__name__})") from error
    if not isinstance(state, dict) or not set(_WEIGHTS_ONLY) <= set(state):
        raise EdgeposeError(f"{path}: not a checkpoint of edgepose train (entries are missing)")
    try:
        network = PoseNetwork(config_from(json.loads(state["config"])).network)
        network.load_state_dict(state["averaged"])
        Statistics(**state["statistics"])
    except (TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise EdgeposeError(f"{path}: not a checkpoint that this edgepose reads ({reason})") from error
    return state


_WEIGHTS_ONLY = ("config", "statistics", "averaged", "step", "data")
"""Entries of `best.pt`: what `export` and fine-tuning need."""


def fit(
    trainer: Trainer,
    folder: Path,
    on_step: Callable[[int, float], None],
    on_validation: Callable[[int, float, float], None],
) -> None:
    """Trains to the config's end, writing `checkpoint.pt` and, at the best validation loss, `best.pt` and a
    line of `log.jsonl`.
    """
    config, total, count = trainer.config, 0.0, 0
    while trainer.step < config.steps:
        loss = trainer.train_step()
        if not math.isfinite(loss):
            raise EdgeposeError(
                f"the loss is {loss} at step {trainer.step}; "
                "go on from the last checkpoint with a lower learning rate"
            )
        total, count = total + loss, count + 1
        on_step(trainer.step, loss)
        if trainer.step % config.validate_every == 0 or trainer.step == config.steps:
            validation = trainer.validate()
            if not math.isfinite(validation):
                raise EdgeposeError(
                    f"the validation loss is {validation} at step {trainer.step}; "
                    "go on from the last checkpoint with a lower learning rate"
                )
            better = validation < trainer.best
            trainer.best, trainer.worse = (validation, 0) if better else (trainer.best, trainer.worse + 1)
            state = trainer.state()
            save_checkpoint(state, folder / CHECKPOINT)
            if better:
                save_checkpoint({k: state[k] for k in _WEIGHTS_ONLY}, folder / "best.pt")
            with (folder / "log.jsonl").open("a") as log:
                log.write(
                    json.dumps({"step": trainer.step, "train": total / count, "validation": validation})
                    + "\n"
                )
            on_validation(trainer.step, total / count, validation)
            total, count = 0.0, 0
            if config.patience and trainer.worse >= config.patience:
                return
