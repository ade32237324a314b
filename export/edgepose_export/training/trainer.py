"""Training of the networks (DIP 3.4): statistics, loss, steps, validation, checkpoints."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from edgepose.errors import EdgeposeError
from edgepose.inference.features import ACCELERATIONS, rotation_to_6d
from edgepose.placements import ROOT
from edgepose.skeleton import PARENTS
from edgepose_export.archive.torchscript import Statistics, new_network
from edgepose_export.networks.normalisation import network_inputs, seen_from_first
from edgepose_export.networks.shape import NetworkShape, smoothed
from edgepose_export.synthesis.augmentation import augment
from edgepose_export.synthesis.body_shapes import draw_shapes
from edgepose_export.synthesis.posture_variation import AFTER, BEFORE, vary_bodies
from edgepose_export.training.checkpoints import (
    CHECKPOINT,
    WEIGHTS_ONLY,
    mean_of,
    read_checkpoint,
    save_checkpoint,
    shape_of,
)
from edgepose_export.training.config import TrainConfig, config_values
from edgepose_export.training.dataset import RESTS, SEATED, Batch, PackedTakes
from edgepose_export.training.description import describe, further_run
from edgepose_export.training.distributed import ALONE, Processes
from edgepose_export.training.losses import likelihood_loss, smoothness_loss
from edgepose_export.training.place import contact_weights, place_accuracy, place_counts, place_loss
from edgepose_export.training.windows import sample_windows, window_starts, windows, windows_with_sitting

__all__ = ["CHECKPOINT", "Trainer", "fit", "mean_of", "read_checkpoint", "save_checkpoint"]


def pose_targets(relative: Tensor, shape: NetworkShape) -> Tensor:
    """Return targets (..., pose outputs), not yet z-scored, of root-relative rotations (..., 24, 3, 3)."""
    joints = list(shape.joints)
    if shape.targets == "global-6d":
        return rotation_to_6d(relative[..., joints, :, :]).flatten(-2)
    parents = relative[..., [PARENTS[j] for j in joints], :, :].transpose(-1, -2)
    return torch.matmul(parents, relative[..., joints, :, :]).flatten(-3)


def network_inputs_of(orientation: Tensor, acceleration: Tensor, shape: NetworkShape) -> Tensor:
    """Return inputs (..., T, inputs) of sequences, not yet z-scored."""
    if shape.normalisation == "sequence":
        orientation, acceleration = seen_from_first(orientation, acceleration)
    return network_inputs(orientation, acceleration, shape.normalisation, shape.acceleration)


def compute_statistics(tape: PackedTakes, shape: NetworkShape, processes: Processes = ALONE) -> Statistics:
    """Return means and standard deviations over the training tapes of all processes (DIP 4.4).

    Local matrices are z-scored entry by entry as in the paper. Global rotations share one standard deviation,
    so that a degree weighs the same at every joint.
    """
    moments = torch.zeros(2, shape.inputs + shape.pose_outputs, dtype=torch.float64)
    # Take by take, because a tape may be larger than the memory.
    for start, end in pairwise(tape.starts.tolist()):
        x = network_inputs_of(tape.orientation[start:end], tape.acceleration[start:end], shape)
        numbers = torch.cat([x, pose_targets(tape.relative[start:end], shape)], dim=-1).double()
        moments += torch.stack([numbers.sum(0), numbers.square().sum(0)])
    count = float(processes.total(tape.starts[-1]))
    mean, square = processes.total(moments) / count
    deviation = ((square - mean.square()).clamp_min(0.0) * (count / (count - 1.0))).sqrt()
    input_mean, target_mean = mean.float().split([shape.inputs, shape.pose_outputs])
    input_std, target_std = deviation.float().split([shape.inputs, shape.pose_outputs])
    target_std = target_std.clamp_min(1e-2)
    if shape.targets == "global-6d":
        target_std = target_std.square().mean().sqrt().expand_as(target_std)
    return Statistics(input_mean.clone(), input_std.clamp_min(1e-3), target_mean.clone(), target_std.clone())


def describe_tape(tape: PackedTakes, processes: Processes = ALONE) -> dict[str, Any]:
    """Return the description of the takes of all processes for an archive's card."""
    takes = list(zip(tape.names, tape.starts.diff().tolist(), strict=True))
    gathered = processes.gathered((tape.licenses, tape.sources, takes))
    return describe(*(chain.from_iterable(lists) for lists in zip(*gathered, strict=True)))


# --- the run ------------------------------------------------------------------------------------------------


class Trainer:
    """A training run: network, averaged weights, optimiser, random generator, step."""

    def __init__(
        self,
        config: TrainConfig,
        train: PackedTakes,
        validation: PackedTakes,
        data: dict[str, Any],
        processes: Processes = ALONE,
    ) -> None:
        """Prepare a run at step 0.

        Args:
            config: settings of the run.
            train: this process's share of the takes to train on.
            validation: this process's share of the takes for validation.
            data: description for the archive's card: that of the takes, see `description.describe`, and, if
                they are known, "run" (name of this run) and "recipe".
            processes: processes that train together.

        Raises:
            EdgeposeError: the sequences cannot be shared equally, or the takes are shorter than the window.
        """
        if config.sequences % processes.size:
            raise EdgeposeError(
                f"sequences is {config.sequences}; {processes.size} processes cannot share it equally"
            )
        torch.manual_seed(config.seed)
        self.config, self.train_tape, self.validation_tape = config, train, validation
        self.data, self.processes = data, processes
        self.shares = {SEATED: config.seated_share, RESTS: config.rests_share}
        # Made takes without a share of their own are used like others.
        kinds = [kind if self.shares.get(kind) else "" for kind in train.made]
        self.starts = window_starts(
            train, config.window, config.joined, lambda take: not kinds[take], config.shares
        )
        self.made_starts = {
            kind: window_starts(
                train, config.window, config.joined, lambda take, kind=kind: kinds[take] == kind
            )
            for kind in self.shares
        }
        self.has_sitting = windows_with_sitting(train, config.window)
        counts = processes.gathered(sum(map(len, self.starts.values())))
        if not all(counts):
            where = f"process {counts.index(0)} has " if processes.size > 1 else ""
            raise EdgeposeError(f"{where}no training take is as long as the window of {config.window} frames")
        if not any(processes.gathered(len(self._validation_starts()))):
            raise EdgeposeError(f"no validation take is as long as the window of {config.window} frames")
        self.statistics = self._placed(compute_statistics(train, config.network, processes))
        self.contact_weights = contact_weights(train, processes).to(processes.device)
        self.network = new_network(config.network).to(processes.device)
        self.averaged = new_network(config.network).to(processes.device)
        self.averaged.load_state_dict(self.network.state_dict())
        self.parallel = processes.wrapped(self.network)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self._seed(0)
        self.step = 0
        self.best = math.inf
        self.worse = 0

    def _seed(self, step: int) -> None:
        """Seed the random numbers of this process from a step on."""
        number = self.config.seed + step * self.processes.size + self.processes.rank
        self.generator = torch.Generator().manual_seed(number + 1)
        if self.processes.rank:
            torch.manual_seed(number)

    def _placed(self, statistics: Statistics) -> Statistics:
        return Statistics(*(numbers.to(self.processes.device) for numbers in statistics))

    def _loss(
        self,
        network: nn.Module,
        batch: Batch,
        dropout: float = 0.0,
        smoothness: float = 0.0,
    ) -> Tensor:
        pose, place = self._losses(network, batch, dropout, smoothness)
        return pose + self.config.place_loss * place_loss(*place, self.contact_weights) if place else pose

    def _losses(
        self, network: nn.Module, batch: Batch, dropout: float = 0.0, smoothness: float = 0.0
    ) -> tuple[Tensor, tuple[Tensor, Tensor] | None]:
        """Return the loss of the pose; and outputs and targets of the head for the place, if there is one."""
        config, s = self.config, self.statistics
        orientation, acceleration, relative, place = (part.to(self.processes.device) for part in batch)
        x = (network_inputs_of(orientation, acceleration, config.network) - s.input_mean) / s.input_std
        target = (pose_targets(relative, config.network) - s.target_mean) / s.target_std
        if config.acceleration_loss:
            target = torch.cat([target, x[..., -ACCELERATIONS:]], dim=-1)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=config.bf16):
            seen = nn.functional.dropout(x, dropout, training=dropout > 0)
            mean, deviation, *head = network(seen, config.streamed) if config.streamed else network(seen)
        target = target[:, : mean.shape[1]]  # when streamed, the last frames have no pose yet
        numbers, pose = target.shape[-1], config.network.pose_outputs
        mean = mean[..., :numbers].float()
        if config.network.smoothing:
            root = orientation[:, : mean.shape[1], ROOT]
            smooth = smoothed(mean[..., :pose] * s.target_std + s.target_mean, root, config.network.smoothing)
            mean = torch.cat([(smooth - s.target_mean) / s.target_std, mean[..., pose:]], dim=-1)
        loss = likelihood_loss(mean, deviation[..., :numbers].float(), target, config.beta)
        if smoothness:
            loss = loss + smoothness * smoothness_loss(mean[..., :pose], target[..., :pose])
        return loss, (head[0].float(), place[:, : mean.shape[1]]) if head else None

    def train_step(self) -> float:
        """Do one optimiser step and return its loss."""
        config = self.config
        rate = config.learning_rate * (
            0.96 ** (self.step / 2000)
            if config.schedule == "exponential"
            else 0.5 * (1.0 + math.cos(math.pi * self.step / config.steps))
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate * min(1.0, (self.step + 1) / (config.warm_up + 1))
        count = config.sequences // self.processes.size
        batch = self._batch(self._drawn_starts(count))
        loss = self._loss(self.parallel, batch, config.input_dropout, config.smoothness)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        # The average starts as a plain mean, so that it soon forgets the random initial weights.
        decay = min(config.averaging, self.step / (self.step + 10.0))
        with torch.no_grad():
            for mean, new in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(new, 1.0 - decay)
        return self.processes.total(loss.detach()).item() / self.processes.size

    def _drawn_starts(self, count: int) -> Tensor:
        """Return the first frames (count,) of random windows, those of made takes last."""
        made, left = [], count
        for kind, share in self.shares.items():
            if len(self.made_starts[kind][""]):
                made.append((self.made_starts[kind], min(round(count * share), left)))
                left -= made[-1][1]
        groups = [(self.starts, left, self.config.shares), *((pool, size, {}) for pool, size in made)]
        return torch.cat([sample_windows(*group, self.generator) for group in groups if group[1]])

    def _batch(self, starts: Tensor) -> Batch:
        """Return augmented windows by their first frames; those with synthetic sitting come last."""
        sizes, sitting = self.config.augmentation, self.has_sitting[starts]
        # The pitch of the pelvis tells sitting from standing, so it must not be disturbed there.
        groups = ((~sitting, sizes), (sitting, sizes._replace(pelvis_pitch_deg=0.0)))
        parts = [
            augment(self._windows(starts[rows]), chosen, self.generator)
            for rows, chosen in groups
            if rows.any()
        ]
        return Batch(*map(torch.cat, zip(*parts, strict=True)))

    def _windows(self, starts: Tensor) -> Batch:
        """Return windows by their first frames, of other bodies if the config asks for them."""
        tape, window, sizes = self.train_tape, self.config.window, self.config.augmentation
        if not (sizes.posture or sizes.stature or sizes.proportions):
            return windows(tape, starts, window)
        index = starts[:, None] + torch.arange(-BEFORE, window + AFTER)
        take = torch.searchsorted(tape.starts, index, right=True)
        index = index.clamp(0, len(tape.relative) - 1)
        shapes = None
        if sizes.stature or sizes.proportions:
            shapes = draw_shapes(len(starts), sizes.stature, sizes.proportions, self.generator)
        return vary_bodies(tape.at(index), take, sizes.posture, shapes, self.generator)

    def _validation_starts(self) -> Tensor:
        window = self.config.window
        return window_starts(self.validation_tape, window, False)[""][:: max(1, window // 2)]

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return measures of the averaged weights on undisturbed validation windows.

        They are the likelihood loss of the pose, "validation", and if possible those of `place_accuracy`.
        """
        starts, total, counts = self._validation_starts(), torch.zeros(2), torch.zeros(6).double()
        for part in starts.split(128) if len(starts) else ():
            batch = windows(self.validation_tape, part, self.config.window)
            loss, place = self._losses(self.averaged, batch)
            total += torch.stack([loss.cpu(), torch.tensor(1.0)]) * len(part)
            if place:
                counts += place_counts(*place).cpu()
        loss, count = self.processes.total(total)
        return {"validation": float(loss / count), **place_accuracy(self.processes.total(counts))}

    def state(self) -> dict[str, Any]:
        """Return all that `load` needs, as tensors and plain values; all processes must call it together."""
        generators = self.processes.gathered((self.generator.get_state(), torch.get_rng_state()))
        return {
            "config": json.dumps(config_values(self.config)),
            "statistics": {name: value.clone() for name, value in self.statistics._asdict().items()},
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": torch.stack([state for state, _ in generators]),
            "torch_generator": torch.stack([state for _, state in generators]),
            "step": self.step,
            "best": self.best,
            "worse": self.worse,
            "data": self.data,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a checkpoint, with the same random numbers if the number of processes is the same.

        Raises:
            EdgeposeError: the checkpoint is of another network, or has no optimiser state.
        """
        if "optimiser" not in state:
            raise EdgeposeError("the checkpoint holds weights only; start a new run from it with --init")
        self._check_shape(state)
        self.statistics = self._placed(Statistics(**state["statistics"]))
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])
        rank, states = self.processes.rank, torch.atleast_2d(state["generator"])
        if len(states) == self.processes.size:
            # Cloned, because torch crashes on a state that is a view of other memory.
            self.generator.set_state(states[rank].clone())
            torch.set_rng_state(torch.atleast_2d(state["torch_generator"])[rank].clone())
        else:
            self._seed(state["step"])
        self.step, self.best, self.worse = state["step"], state["best"], state["worse"]
        self.data = state["data"]

    def start_from(self, state: dict[str, Any]) -> None:
        """Start fine-tuning (DIP 3.4.4) from a checkpoint's averaged weights and statistics.

        Its training data and licences are added to the description of this run's takes, and the run itself to
        the earlier ones.

        Raises:
            EdgeposeError: the checkpoint is of another network; only `smoothing` and `place` may differ. A
                head that it lacks keeps its random weights.
        """
        shape = self.config.network
        self._check_shape(state, smoothing=shape.smoothing, place=shape.place)
        self.statistics = self._placed(Statistics(**state["statistics"]))
        weights = {name: state["averaged"].get(name, own) for name, own in self.network.state_dict().items()}
        self.network.load_state_dict(weights)
        self.averaged.load_state_dict(weights)
        self.data = further_run(state["data"], state["step"], self.data)

    def _check_shape(self, state: dict[str, Any], **other: Any) -> None:
        """Check that the checkpoint's network is that of the config, apart from `other` fields."""
        shape = shape_of(state)
        if shape._replace(**other) != self.config.network:
            raise EdgeposeError(f"the checkpoint holds {shape}, but the config has {self.config.network}")


def fit(
    trainer: Trainer,
    folder: Path,
    on_step: Callable[[int, float], None],
    on_validation: Callable[[dict[str, float]], None],
) -> None:
    """Train until the config's last step, or until early stopping.

    Each validation writes `checkpoint.pt` and a line of `log.jsonl`; the best one so far also `best.pt`.

    Args:
        trainer: the run.
        folder: folder of these files.
        on_step: called with the step and its loss after each step.
        on_validation: called with the line of the log: step, mean training loss, measures of `validate`.

    Raises:
        EdgeposeError: a loss is not finite, or a file cannot be written.
    """
    config, total, count = trainer.config, 0.0, 0
    while trainer.step < config.steps:
        loss = trainer.train_step()
        if not math.isfinite(loss):
            raise EdgeposeError(
                f"the loss is {loss} at step {trainer.step}; "
                "continue from the last checkpoint with a lower learning rate"
            )
        total, count = total + loss, count + 1
        on_step(trainer.step, loss)
        if trainer.step % config.validate_every == 0 or trainer.step == config.steps:
            measures = trainer.validate()
            validation = measures["validation"]
            if not math.isfinite(validation):
                raise EdgeposeError(
                    f"the validation loss is {validation} at step {trainer.step}; "
                    "continue from the last checkpoint with a lower learning rate"
                )
            better = validation < trainer.best
            trainer.best, trainer.worse = (validation, 0) if better else (trainer.best, trainer.worse + 1)
            state = trainer.state()
            line = {"step": trainer.step, "train": total / count, **measures}
            if trainer.processes.rank == 0:
                _write(state, better, line, folder)
            on_validation(line)
            total, count = 0.0, 0
            if config.patience and trainer.worse >= config.patience:
                return


def _write(state: dict[str, Any], better: bool, line: dict[str, float], folder: Path) -> None:
    save_checkpoint(state, folder / CHECKPOINT)
    if better:
        save_checkpoint({k: state[k] for k in WEIGHTS_ONLY}, folder / "best.pt")
    with (folder / "log.jsonl").open("a") as log:
        log.write(json.dumps(line) + "\n")
