"""Engines that run a model archive frame by frame: windowed, streaming or batched (DIP 3.4, 5.1.3, 5.1.4).

There is one pose for every frame, in order. The first frames are processed with the past available so far,
the last ones, at `finish`, with the future that is left.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.errors import ModelError

Array = NDArray[np.float32]
Input = NDArray[np.floating[Any]]

WARM_UP = 5
"""Frames run through a module before the first real one: TorchScript compiles in its first calls."""


class EngineOutput(NamedTuple):
    """The pose of one frame.

    Attributes:
        frame: the `tag` passed to `push` with that frame.
        rotations: (24, 3, 3) local rotations, joint 0 relative to T.
        std: (24,) standard deviations, radians.
        warming_up: fewer frames have been seen than the network's past needs.
        place: (10,) probabilities of the contacts `edgepose.pose.CONTACTS`, then the velocity of the pelvis
            in its level frame, m/s; None if the archive does not estimate them.
    """

    frame: Any
    rotations: Array
    std: Array
    warming_up: bool
    place: Array | None = None


def check_finite(output: EngineOutput) -> None:
    """Raise ModelError if an output is NaN or infinite, as a network with damaged weights makes them."""
    arrays = output.rotations, output.std, *(() if output.place is None else (output.place,))
    if not all(np.isfinite(array).all() for array in arrays):
        raise ModelError(
            "the network computes NaN or infinite numbers, so its archive is damaged; get or export it again"
        )


class EngineInput(NamedTuple):
    """The arguments of `Engine.push` for one frame."""

    frame: Any
    orientation: Input
    acceleration: Input


class Engine(Protocol):
    """The interface of engines for one wearer, such as `WindowEngine` and `StreamEngine`."""

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """Process a frame, and return the poses that are ready.

        Args:
            tag: returned with the frame's pose.
            orientation: (6, 3, 3) R_TB.
            acceleration: (6, 3) accelerations in T without gravity, m/s^2.
        """

    def finish(self) -> list[EngineOutput]:
        """Return the poses of the frames that still wait for their future."""


class _Results(NamedTuple):
    """A network's results for B wearers: rotations, deviations and places, None if these are not wanted."""

    rotations: torch.Tensor
    std: torch.Tensor
    place: torch.Tensor | None = None

    def of_wearers(self) -> Iterator[tuple[Array, Array, Sequence[Array | None]]]:
        """Yield rotations, deviations and places for each wearer."""
        rotations, std = self.rotations.numpy(), self.std.numpy()
        place = [[None] * len(row) for row in std] if self.place is None else self.place.numpy()
        return zip(rotations, std, place, strict=True)


class _Network:
    """A loaded archive that is called with or without the place; its poses are the same."""

    def __init__(self, module: torch.jit.ScriptModule, place: bool) -> None:
        self._module, self._ending = module, "_place" if place else ""

    def start(self, batch: int, future: int) -> list[torch.Tensor]:
        """Return the state before the first frame of a stream."""
        state: list[torch.Tensor] = self._module.start(batch, future)
        return state

    def window(self, orientation: torch.Tensor, acceleration: torch.Tensor, index: int) -> _Results:
        """Return the results for frame `index` of a window, with a time axis of one frame."""
        results = self._method("window")(orientation, acceleration, index)
        return _Results(*(tensor[:, None] for tensor in results))

    def stream(
        self, orientation: torch.Tensor, acceleration: torch.Tensor, state: list[torch.Tensor]
    ) -> tuple[_Results, list[torch.Tensor]]:
        """Return the results that are ready after a frame, and the new state."""
        *results, state = self._method("stream")(orientation, acceleration, state)
        return _Results(*results), state

    def stream_many(
        self, orientation: torch.Tensor, acceleration: torch.Tensor, state: list[torch.Tensor]
    ) -> tuple[_Results, list[torch.Tensor]]:
        """Return the results that are ready after several frames, and the new state."""
        *results, state = self._method("stream_many")(orientation, acceleration, state)
        return _Results(*results), state

    def drain(self, state: list[torch.Tensor]) -> _Results:
        """Return the results of the frames that still wait for their future."""
        return _Results(*self._method("drain")(state))

    def _method(self, name: str) -> Any:
        return getattr(self._module, name + self._ending)


class WindowEngine:
    """Runs the network for each frame over `past` frames before it, itself and `future` frames after it."""

    def __init__(
        self, module: torch.jit.ScriptModule, past: int, future: int, *, place: bool = False
    ) -> None:
        """Warm the module up.

        Args:
            module: a loaded archive.
            past: number of frames before the present one, 0 or more.
            future: number of frames after it, 0 or more.
            place: estimate the place as well, for archives that have it (`archive.has_place`).
        """
        self._network, self._past, self._future = _Network(module, place), past, future
        self._tags: deque[Any] = deque()
        self._seen = 0
        self._orientation = torch.zeros(1, 0, 6, 3, 3)
        self._acceleration = torch.zeros(1, 0, 6, 3)
        length = past + 1 + future
        with torch.inference_mode():
            for _ in range(WARM_UP):
                self._network.window(
                    torch.eye(3).expand(1, length, 6, 3, 3), torch.zeros(1, length, 6, 3), past
                )

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
        """Return the pose of the oldest frame without one, `future` frames behind the newest."""
        length = self._orientation.shape[1]
        index = length - 1 - future
        first = max(0, index - self._past)
        with torch.inference_mode():
            results = self._network.window(
                self._orientation[:, first:], self._acceleration[:, first:], index - first
            )
        ((rotations, std, place),) = results.of_wearers()
        return EngineOutput(self._tags.popleft(), rotations[0], std[0], index < self._past, place[0])


class _StreamState:
    """One wearer's network state, and the tags of the frames that wait for poses."""

    def __init__(self, state: list[torch.Tensor]) -> None:
        self.state = state
        self.tags: deque[Any] = deque()
        self.done = 0

    def outputs(
        self, rotations: Array, std: Array, places: Sequence[Array | None], past: int
    ) -> list[EngineOutput]:
        """Return the wearer's next T poses, from rotations (T, 24, 3, 3), deviations (T, 24) and T places."""
        outputs = []
        for pose, deviation, place in zip(rotations, std, places, strict=True):
            outputs.append(EngineOutput(self.tags.popleft(), pose, deviation, self.done < past, place))
            self.done += 1
        return outputs


class StreamEngine:
    """Runs the network on each frame once, carrying its state; `future` is 0 for a unidirectional network."""

    def __init__(
        self,
        module: torch.jit.ScriptModule,
        past: int,
        future: int,
        frames_per_step: int = 1,
        *,
        place: bool = False,
    ) -> None:
        """Warm the module up.

        Args:
            module: a loaded archive.
            past: number of first poses that are marked as `warming_up`.
            future: number of frames that a pose waits for.
            frames_per_step: number of frames run at once, if poses need not come frame by frame.
            place: estimate the place as well, for archives that have it (`archive.has_place`).
        """
        self._network, self._past, self._frames_per_step = _Network(module, place), past, frames_per_step
        self._frames: list[tuple[torch.Tensor, torch.Tensor]] = []
        with torch.inference_mode():
            self._stream = _StreamState(self._network.start(1, future))
            at_rest = (torch.eye(3).expand(6, 3, 3), torch.zeros(6, 3))
            for _ in range(WARM_UP + future):
                self._frames = [at_rest] * frames_per_step
                self._run()
            self._stream = _StreamState(self._network.start(1, future))

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`; with several frames per step, their poses come all at once."""
        self._stream.tags.append(tag)
        self._frames.append((_tensor(orientation), _tensor(acceleration)))
        if len(self._frames) < self._frames_per_step:
            return []
        with torch.inference_mode():
            return self._outputs(self._run())

    def finish(self) -> list[EngineOutput]:
        """See `Engine.finish`."""
        with torch.inference_mode():
            outputs = self._outputs(self._run()) if self._frames else []
            return outputs + self._outputs(self._network.drain(self._stream.state))

    def _run(self) -> _Results:
        """Run the network on the collected frames; return the results that are ready."""
        frames, self._frames = self._frames, []
        if len(frames) == 1:
            orientation, acceleration = frames[0]
            results, self._stream.state = self._network.stream(
                orientation[None], acceleration[None], self._stream.state
            )
        else:
            orientations, accelerations = (torch.stack(column)[None] for column in zip(*frames, strict=True))
            results, self._stream.state = self._network.stream_many(
                orientations, accelerations, self._stream.state
            )
        return results

    def _outputs(self, results: _Results) -> list[EngineOutput]:
        (columns,) = results.of_wearers()
        return self._stream.outputs(*columns, self._past)


class MultiWearerEngine:
    """A `StreamEngine` for any number of wearers, which batches the wearers that have a frame.

    Each wearer has a separate state and gets the same poses as alone, no matter when the others begin, pause
    or end. One pass of the network serves all wearers whose states have the same shape; only wearers with too
    few frames for a first pose have a different one.
    """

    def __init__(
        self,
        module: torch.jit.ScriptModule,
        past: int,
        future: int,
        wearers: int,
        isolate_wearers: bool = False,
        *,
        place: bool = False,
    ) -> None:
        """Warm the module up.

        Args:
            module: a loaded archive.
            past: number of each wearer's first poses that are marked as `warming_up`.
            future: number of frames that a pose waits for.
            wearers: number of wearers; they are numbered from 0.
            isolate_wearers: run the network once per wearer, for models whose results batching would change.
            place: estimate the places as well, for archives that have them (`archive.has_place`).
        """
        self._network, self._past, self._isolate = _Network(module, place), past, isolate_wearers
        with torch.inference_mode():
            # Whether each tensor of a state has a row per wearer; the others are the same for all.
            self._has_rows = [
                one.shape != two.shape
                for one, two in zip(*(self._network.start(count, future) for count in (1, 2)), strict=True)
            ]
            at_rest = EngineInput(None, np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3)))
            for count in {1, wearers}:
                self._streams = [_StreamState(self._network.start(1, future)) for _ in range(count)]
                for _ in range(WARM_UP + future):
                    self.push(dict.fromkeys(range(count), at_rest))
            self._streams = [_StreamState(self._network.start(1, future)) for _ in range(wearers)]

    def push(self, inputs: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Process the next frame of some wearers; return the poses that are ready, by wearer."""
        groups: defaultdict[Any, list[int]] = defaultdict(list)
        for wearer, engine_input in inputs.items():
            stream = self._streams[wearer]
            stream.tags.append(engine_input.frame)
            shapes = tuple(tensor.shape for tensor in stream.state)
            groups[(wearer, *shapes) if self._isolate else shapes].append(wearer)
        outputs = {}
        with torch.inference_mode():
            for wearers in groups.values():
                outputs.update(self._step(wearers, inputs))
        return outputs

    def finish(self, wearer: int) -> list[EngineOutput]:
        """Return the poses of a wearer's frames that still wait for their future."""
        stream = self._streams[wearer]
        with torch.inference_mode():
            (columns,) = self._network.drain(stream.state).of_wearers()
        return stream.outputs(*columns, self._past)

    def _step(self, wearers: list[int], inputs: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Run one pass for wearers whose states have the same shape; return their poses."""
        streams = [self._streams[wearer] for wearer in wearers]
        orientation = _tensor(np.array([inputs[wearer].orientation for wearer in wearers]))
        acceleration = _tensor(np.array([inputs[wearer].acceleration for wearer in wearers]))
        state = [
            torch.cat(column) if has_rows else column[0]
            for column, has_rows in zip(
                zip(*(stream.state for stream in streams), strict=True), self._has_rows, strict=True
            )
        ]
        results, state = self._network.stream(orientation, acceleration, state)
        columns = [
            tensor.split(1) if has_rows else [tensor] * len(streams)
            for tensor, has_rows in zip(state, self._has_rows, strict=True)
        ]
        outputs = {}
        for i, (wearer, arrays) in enumerate(zip(wearers, results.of_wearers(), strict=True)):
            streams[i].state = [column[i] for column in columns]
            outputs[wearer] = streams[i].outputs(*arrays, self._past)
        return outputs


def _tensor(array: Input) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, np.float32))
