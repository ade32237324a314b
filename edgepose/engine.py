"""Runs a model archive frame by frame: window, stream or step (DIP 3.4, 5.1.3, 5.1.4).

Every frame that goes in comes out, in order: the first ones seen with the past that there is, the last ones,
at `finish`, with the future that there is.
"""

from __future__ import annotations

from collections import deque
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

    tag: Any
    rotations: Array
    std: Array
    filling: bool


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


class StreamEngine:
    """Each frame once, with carried state; `future` is 0 for a unidirectional network."""

    def __init__(self, module: torch.jit.ScriptModule, past: int, future: int, together: int = 1) -> None:
        """Warms the module up.

        Args:
            module: an archive.
            past: as many first poses are marked as filling.
            future: frames that a pose waits for.
            together: frames that are gathered and run at once, where nobody waits for poses.
        """
        self._module, self._past, self._together = module, past, together
        self._tags: deque[Any] = deque()
        self._frames: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._done = 0
        with torch.inference_mode():
            self._state = module.start(1, future)
            still = (torch.eye(3).expand(6, 3, 3), torch.zeros(6, 3))
            for _ in range(WARM_UP + future):
                self._frames = [still] * together
                self._run()
            self._state = module.start(1, future)

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`; with several frames together, the poses of all of them at once."""
        self._tags.append(tag)
        self._frames.append((_tensor(orientation), _tensor(acceleration)))
        if len(self._frames) < self._together:
            return []
        with torch.inference_mode():
            return self._outputs(*self._run())

    def finish(self) -> list[EngineOutput]:
        """See `Engine.finish`."""
        with torch.inference_mode():
            outputs = self._outputs(*self._run()) if self._frames else []
            return outputs + self._outputs(*self._module.drain(self._state))

    def _run(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses that are due after the gathered frames."""
        frames, self._frames = self._frames, []
        if len(frames) == 1:
            orientation, acceleration = frames[0]
            rotations, std, self._state = self._module.stream(
                orientation[None], acceleration[None], self._state
            )
        else:
            orientations, accelerations = (torch.stack(column)[None] for column in zip(*frames, strict=True))
            rotations, std, self._state = self._module.stream_many(orientations, accelerations, self._state)
        return rotations, std

    def _outputs(self, rotations: torch.Tensor, std: torch.Tensor) -> list[EngineOutput]:
        outputs = []
        for pose, deviation in zip(rotations[0].numpy(), std[0].numpy(), strict=True):
            outputs.append(EngineOutput(self._tags.popleft(), pose, deviation, self._done < self._past))
            self._done += 1
        return outputs


def _tensor(array: Input) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, np.float32))
