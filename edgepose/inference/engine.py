"""Engines that run a model archive frame by frame: windowed, streaming or batched (DIP 3.4, 5.1.3, 5.1.4).

There is one pose for every frame, in order. The first frames are processed with the past available so far,
the last ones, at `finish`, with the future that is left.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import ModelError
from edgepose.inference.numpy_network import NumpyNetwork
from edgepose.inference.runtime import Array, Results, Runtime

if TYPE_CHECKING:
    import torch

Input = NDArray[np.floating[Any]]

FRAMES_PER_STEP = 64
"""Frames of a recording to run at once, see `StreamEngine`."""

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
    # A square is finite if all numbers are, and none is huge; it costs a third of looking at each of them.
    if all([isfinite(np.vdot(array, array)) for array in arrays]):
        return
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


class WindowEngine:
    """Runs the network for each frame over `past` frames before it, itself and `future` frames after it."""

    def __init__(
        self, module: torch.jit.ScriptModule | NumpyNetwork, past: int, future: int, *, place: bool = False
    ) -> None:
        """Warm the module up.

        Args:
            module: a loaded archive.
            past: number of frames before the present one, 0 or more.
            future: number of frames after it, 0 or more.
            place: estimate the place as well, for archives that have it (`archive.has_place`).
        """
        self._network, self._past, self._future = as_runtime(module, place), past, future
        self._tags: deque[Any] = deque()
        self._seen = 0
        self._orientation = np.zeros((1, 0, 6, 3, 3), np.float32)
        self._acceleration = np.zeros((1, 0, 6, 3), np.float32)
        length = past + 1 + future
        orientation, acceleration = (array[None].repeat(length, 0)[None] for array in _at_rest())
        for _ in range(WARM_UP):
            self._network.window(orientation, acceleration, past)

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`."""
        length = self._past + 1 + self._future
        self._orientation = _appended(self._orientation, orientation)[:, -length:]
        self._acceleration = _appended(self._acceleration, acceleration)[:, -length:]
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
        results = self._network.window(
            self._orientation[:, first:], self._acceleration[:, first:], index - first
        )
        ((rotations, std, place),) = results.of_wearers()
        return EngineOutput(self._tags.popleft(), rotations[0], std[0], index < self._past, place[0])


class _StreamState:
    """One wearer's network state, its shapes, and the tags of the frames that wait for poses."""

    def __init__(self, state: Any, shapes: tuple[Any, ...] = ()) -> None:
        self.state, self.shapes = state, shapes
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
        module: torch.jit.ScriptModule | NumpyNetwork,
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
        self._network, self._past, self._frames_per_step = as_runtime(module, place), past, frames_per_step
        self._frames: list[tuple[Array, Array]] = []
        self._stream = _StreamState(self._network.start(1, future))
        for _ in range(WARM_UP + future if frames_per_step == 1 else 0):  # no one waits for several
            self._frames = [_at_rest()]
            self._run()
        self._stream = _StreamState(self._network.start(1, future))

    def push(self, tag: Any, orientation: Input, acceleration: Input) -> list[EngineOutput]:
        """See `Engine.push`; with several frames per step, their poses come all at once."""
        self._stream.tags.append(tag)
        self._frames.append((_float32(orientation), _float32(acceleration)))
        return [] if len(self._frames) < self._frames_per_step else self._outputs(self._run())

    def finish(self) -> list[EngineOutput]:
        """See `Engine.finish`."""
        outputs = self._outputs(self._run()) if self._frames else []
        return outputs + self._outputs(self._network.drain(self._stream.state))

    def _run(self) -> Results:
        """Run the network on the collected frames; return the results that are ready."""
        frames, self._frames = self._frames, []
        if len(frames) == 1:
            orientation, acceleration = frames[0]
            results, self._stream.state = self._network.stream(
                orientation[None], acceleration[None], self._stream.state
            )
        else:
            orientations, accelerations = (np.stack(column)[None] for column in zip(*frames, strict=True))
            results, self._stream.state = self._network.stream_many(
                orientations, accelerations, self._stream.state
            )
        return results

    def _outputs(self, results: Results) -> list[EngineOutput]:
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
        module: torch.jit.ScriptModule | NumpyNetwork,
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
        self._network, self._past, self._isolate = as_runtime(module, place), past, isolate_wearers
        at_rest = EngineInput(None, *_at_rest())
        for count in {1, wearers}:
            self._streams = self._new_streams(count, future)
            for _ in range(WARM_UP + future):
                self.push(dict.fromkeys(range(count), at_rest))
        self._streams = self._new_streams(wearers, future)

    def _new_streams(self, count: int, future: int) -> list[_StreamState]:
        states = [self._network.start(1, future) for _ in range(count)]
        return [_StreamState(state, self._network.shapes(state)) for state in states]

    def push(self, inputs: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Process the next frame of some wearers; return the poses that are ready, by wearer."""
        groups: defaultdict[Any, list[int]] = defaultdict(list)
        for wearer, engine_input in inputs.items():
            stream = self._streams[wearer]
            stream.tags.append(engine_input.frame)
            groups[(wearer, *stream.shapes) if self._isolate else stream.shapes].append(wearer)
        outputs = {}
        for wearers in groups.values():
            outputs.update(self._step(wearers, inputs))
        return outputs

    def finish(self, wearer: int) -> list[EngineOutput]:
        """Return the poses of a wearer's frames that still wait for their future."""
        stream = self._streams[wearer]
        (columns,) = self._network.drain(stream.state).of_wearers()
        return stream.outputs(*columns, self._past)

    def _step(self, wearers: list[int], inputs: Mapping[int, EngineInput]) -> dict[int, list[EngineOutput]]:
        """Run one pass for wearers whose states have the same shape; return their poses."""
        streams = [self._streams[wearer] for wearer in wearers]
        orientation = _float32([inputs[wearer].orientation for wearer in wearers])
        acceleration = _float32([inputs[wearer].acceleration for wearer in wearers])
        state = self._network.join([stream.state for stream in streams])
        results, state = self._network.stream(orientation, acceleration, state)
        states = self._network.split(state, len(streams))
        shapes = self._network.shapes(states[0])
        outputs = {}
        for i, (wearer, arrays) in enumerate(zip(wearers, results.of_wearers(), strict=True)):
            streams[i].state, streams[i].shapes = states[i], shapes
            outputs[wearer] = streams[i].outputs(*arrays, self._past)
        return outputs


def as_runtime(module: torch.jit.ScriptModule | NumpyNetwork, place: bool) -> Runtime:
    """Return the runtime of a loaded archive, which estimates the place if `place` and the archive has it."""
    if isinstance(module, NumpyNetwork):
        return module.with_place(place)
    from edgepose.inference.torch_runtime import TorchRuntime

    return TorchRuntime(module, place)


def _float32(array: Input | list[Input]) -> Array:
    return np.asarray(array, np.float32)


def _at_rest() -> tuple[Array, Array]:
    """Return orientations and accelerations of a frame in which nothing moves."""
    return np.eye(3, dtype=np.float32)[None].repeat(6, 0), np.zeros((6, 3), np.float32)


def _appended(frames: Array, frame: Input) -> Array:
    """Return frames (1, T, ...) and another one."""
    return np.concatenate([frames, _float32(frame)[None, None]], axis=1)
