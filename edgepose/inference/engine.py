"""Runs a model archive frame by frame: window, stream or step (DIP 3.4, 5.1.3, 5.1.4).

Every frame that goes in comes out, in order: the first ones seen with the past that there is, the last ones,
at `finish`, with the future that there is.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float32]
Input = NDArray[np.floating[Any]]

WARM_UP = 5
"""Frames run through a module before the first real one; TorchScript compiles and specialises during its
first calls.
"""


class EngineOutput(NamedTuple):
    """The pose of one frame.

    Attributes:
        tag: what `push` was given with that frame.
        rotations: (24, 3, 3) local rotations, joint 0 against T.
        std: (24,) standard deviations, radians.
        filling: fewer frames have been seen than the network's past asks for.
    """

    frame: Any
    rotations: Array
    std: Array
    warming_up: bool


class EngineInput(NamedTuple):
    """What goes into an engine: the arguments of `Engine.push`."""

    frame: Any
    orientation: Input
    acceleration: Input


class Engine(Protocol):
    """What `WindowEngine` and `StreamEngine` are."""

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """Takes a frame ((6, 3, 3) R_TB, (6, 3) m/s^2 in T without gravity) and gives the poses that are
        due.
        """

    def finish(self) -> list[EngineOutput]:
        """Gives the poses of the frames that still wait for their future."""


class WindowEngine:
    """For each frame the network runs over `past` frames before it, itself and `future` frames after it."""

    def __init__(self, module: torch.jit.ScriptModule, past: int, future: int) -> None:
        """Warms the module up; past and future are numbers of frames, 0 or more."""
        self._module, self._past, self._future = module, past, future
        self._tags: deque[Any] = deque()
        self._seen = 0
        self._orientation = torch.zeros(1, 0, 6, 3, 3)
        self._acceleration = torch.zeros(1, 0, 6, 3)
        length = past + 1 + future
        with torch.inference_mode():
            for _ in range(WARM_UP):
                module.window(torch.eye(3).expand(1, length, 6, 3, 3), torch.zeros(1, length, 6, 3), past)

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`."""
        length = self._past + 1 + self._future
        self._orientation = torch.cat([self._orientation, _tensor(orientation)[None, None]], dim=1)[
            :, -length:
        ]
        self._acceleration = torch.cat([self._acceleration, _tensor(acceleration)[None, None]], dim=1)[
            :, -length:
        ]
        self._tags.append(tag)
        self._seen += 1
        return [self._oldest(self._future)] if self._seen > self._future else []

    def finish(self) -> list[EngineOutput]:
        """See `Engine.finish`."""
        return [self._oldest(future) for future in range(len(self._tags) - 1, -1, -1)]

    def _oldest(self, future: int) -> EngineOutput:
        """Pose of the oldest frame that has no pose yet, `future` frames behind the newest."""
        length = self._orientation.shape[1]
        index = length - 1 - future
        first = max(0, index - self._past)
        with torch.inference_mode():
            rotations, std = self._module.window(
                self._orientation[:, first:], self._acceleration[:, first:], index - first
            )
        return EngineOutput(self._tags.popleft(), rotations[0].numpy(), std[0].numpy(), index < self._past)


class _StreamState:
    """The stream of one wearer: its state, and what waits for a pose."""

    def __init__(self, state: list[torch.Tensor]) -> None:
        self.state = state
        self.tags: deque[Any] = deque()
        self.done = 0

    def outputs(self, rotations: Array, std: Array, past: int) -> list[EngineOutput]:
        """The next poses of this wearer, (T, 24, 3, 3) and (T, 24)."""
        outputs = []
        for pose, deviation in zip(rotations, std, strict=True):
            outputs.append(EngineOutput(self.tags.popleft(), pose, deviation, self.done < past))
            self.done += 1
        return outputs


class StreamEngine:
    """Each frame once, with carried state; `future` is 0 for a unidirectional network."""

    def __init__(
        self, module: torch.jit.ScriptModule, past: int, future: int, frames_per_step: int = 1
    ) -> None:
        """Warms the module up.

        Args:
            module: an archive.
            past: as many first poses are marked as filling.
            future: frames that a pose waits for.
            frames_per_step: frames that are gathered and run at once, where nobody waits for poses.
        """
        self._module, self._past, self._together = module, past, frames_per_step
        self._frames: list[tuple[torch.Tensor, torch.Tensor]] = []
        with torch.inference_mode():
            self._row = _StreamState(module.start(1, future))
            still = (torch.eye(3).expand(6, 3, 3), torch.zeros(6, 3))
            for _ in range(WARM_UP + future):
                self._frames = [still] * frames_per_step
                self._run()
            self._row = _StreamState(module.start(1, future))

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`; with several frames together, the poses of all of them at once."""
        self._row.tags.append(tag)
        self._frames.append((_tensor(orientation), _tensor(acceleration)))
        if len(self._frames) < self._together:
            return []
        with torch.inference_mode():
            return self._outputs(*self._run())

    def finish(self) -> list[EngineOutput]:
        """See `Engine.finish`."""
        with torch.inference_mode():
            outputs = self._outputs(*self._run()) if self._frames else []
            return outputs + self._outputs(*self._module.drain(self._row.state))

    def _run(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses that are due after the gathered frames."""
        frames, self._frames = self._frames, []
        if len(frames) == 1:
            orientation, acceleration = frames[0]
            rotations, std, self._row.state = self._module.stream(
                orientation[None], acceleration[None], self._row.state
            )
        else:
            orientations, accelerations = (torch.stack(column)[None] for column in zip(*frames, strict=True))
            rotations, std, self._row.state = self._module.stream_many(
                orientations, accelerations, self._row.state
            )
        return rotations, std

    def _outputs(self, rotations: torch.Tensor, std: torch.Tensor) -> list[EngineOutput]:
        return self._row.outputs(rotations[0].numpy(), std[0].numpy(), self._past)


class MultiWearerEngine:
    """`StreamEngine` for any number of wearers: those that have a frame take their step together.

    Each wearer has a state of its own and gets the poses that it would get alone, whenever the others begin,
    pause or end. A step is one pass of the network for all whose states have one shape; only those of which
    too few frames have come for their first pose have another.
    """

    def __init__(
        self,
        module: torch.jit.ScriptModule,
        past: int,
        future: int,
        wearers: int,
        isolate_wearers: bool = False,
    ) -> None:
        """Warms the module up.

        Args:
            module: an archive.
            past: as many first poses of each wearer are marked as filling.
            future: frames that a pose waits for.
            wearers: how many there are; they are called 0, 1, 2 and so on.
            isolate_wearers: run the network once for each wearer, where batching would change results.
        """
        self._module, self._past, self._apart = module, past, isolate_wearers
        with torch.inference_mode():
            # Which tensors of a state have a row for each wearer; the others are the same for all.
            self._has_rows = [
                one.shape != two.shape
                for one, two in zip(module.start(1, future), module.start(2, future), strict=True)
            ]
            still = EngineInput(None, np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3)))
            for count in {1, wearers}:
                self._rows = [_StreamState(module.start(1, future)) for _ in range(count)]
                for _ in range(WARM_UP + future):
                    self.push(dict.fromkeys(range(count), still))
            self._rows = [_StreamState(module.start(1, future)) for _ in range(wearers)]

    def push(self, bodies: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Takes the next frame of some wearers and gives the poses that are due, by wearer."""
        groups: defaultdict[Any, list[int]] = defaultdict(list)
        for wearer, body in bodies.items():
            row = self._rows[wearer]
            row.tags.append(body.frame)
            shapes = tuple(tensor.shape for tensor in row.state)
            groups[(wearer, *shapes) if self._apart else shapes].append(wearer)
        outputs = {}
        with torch.inference_mode():
            for wearers in groups.values():
                outputs.update(self._step(wearers, bodies))
        return outputs

    def finish(self, wearer: int) -> list[EngineOutput]:
        """Gives the poses of a wearer's frames that still wait for their future."""
        row = self._rows[wearer]
        with torch.inference_mode():
            rotations, std = self._module.drain(row.state)
        return row.outputs(rotations[0].numpy(), std[0].numpy(), self._past)

    def _step(self, wearers: list[int], bodies: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Poses after one pass for wearers whose states have one shape."""
        rows = [self._rows[wearer] for wearer in wearers]
        orientation = _tensor(np.array([bodies[wearer].orientation for wearer in wearers]))
        acceleration = _tensor(np.array([bodies[wearer].acceleration for wearer in wearers]))
        state = [
            torch.cat(column) if has_rows else column[0]
            for column, has_rows in zip(
                zip(*(row.state for row in rows), strict=True), self._has_rows, strict=True
            )
        ]
        rotations, std, state = self._module.stream(orientation, acceleration, state)
        columns = [
            tensor.split(1) if has_rows else [tensor] * len(rows)
            for tensor, has_rows in zip(state, self._has_rows, strict=True)
        ]
        poses, deviations, outputs = rotations.numpy(), std.numpy(), {}
        for i, (wearer, row) in enumerate(zip(wearers, rows, strict=True)):
            row.state = [column[i] for column in columns]
            outputs[wearer] = row.outputs(poses[i], deviations[i], self._past)
        return outputs


def _tensor(array: Input) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, np.float32))
