"""The recurrent networks in numpy, for machines without torch, from the weights of the same archives.

This is the readable twin of `edgepose_export.networks.lstm`, function for function, apart from networks that
are not shipped. Its results are the same to 1e-5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from math import prod
from typing import Any

import numpy as np

from edgepose.errors import ModelError
from edgepose.inference.archive import ArchiveInfo
from edgepose.inference.numpy_ends import HALF, Ends, State, rows
from edgepose.inference.rotation_rows import SEEN
from edgepose.inference.runtime import Array, Results, Runtime
from edgepose.inference.weights import Recipe, read_weights, recipe_of

_BLOCK = 64
"""Columns of a block of weights. BLAS takes a third of the time for several rows if matrices are small."""


def load(info: ArchiveInfo) -> Rnn | Birnn:
    """Read an archive's network for numpy; nothing in the archive is run, so it needs no trust.

    Raises:
        ModelError: numpy cannot run the network, or the archive is damaged or lacks the weights.
    """
    try:
        recipe = recipe_of(info.metadata)
        shapes = recipe.shapes()
        # One array, because numpy asks for huge pages for a large one: they are read a tenth faster.
        space = np.empty(sum(map(prod, shapes.values())), np.float32)
        weights: dict[str, Array] = {}
        for name, array in read_weights(info.path, shapes):
            weight = array if name.startswith("ends.") else _prepared(name, array, recipe.hidden)
            weights[name], space = space[: weight.size].reshape(weight.shape), space[weight.size :]
            weights[name][...] = weight
    except ModelError as error:
        raise ModelError(f"{info.path}: {error}") from error
    except MemoryError as error:
        raise ModelError(f"{info.path}: not enough memory for its weights") from error
    return (Rnn if recipe.kind == "rnn" else Birnn)(recipe, weights)


class _Cell:
    """One direction of an LSTM layer, without the product of its inputs."""

    def __init__(self, weight: Array, size: int) -> None:
        self._weight, self._size = weight, size

    def run(
        self, steps: Array | list[Array], h: Array | None = None, c: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return the outputs (T, B, hidden) of T steps, and the last h and c (B, hidden).

        Args:
            steps: products (B, 4 hidden) of each step's inputs.
            h: outputs (B, hidden) before; without them and c, the state before is zero.
            c: cell states (B, hidden) before.
        """
        size = self._size
        outputs = np.empty((len(steps), len(steps[0]), size), np.float32)
        for products, output in zip(steps, outputs, strict=True):
            gates = products.copy() if h is None else _times(h, self._weight)
            if h is not None:
                gates += products
            np.tanh(gates, out=gates)
            sigmoids, candidate = gates[:, : 3 * size], gates[:, 3 * size :]
            sigmoids *= HALF
            sigmoids += HALF
            candidate *= sigmoids[:, :size]
            if c is not None:
                candidate += sigmoids[:, size : 2 * size] * c
            c = candidate
            h = np.tanh(c, out=output)
            h *= sigmoids[:, 2 * size :]
        assert h is not None, "there is at least one step"
        assert c is not None
        return outputs, h, c


class NumpyNetwork(Runtime):
    """Base of both networks. The methods are those of `runtime.Runtime`."""

    def __init__(self, recipe: Recipe, weights: Mapping[str, Array]) -> None:
        """Use weights as `load` prepares them."""
        self._ends = Ends(recipe, weights)
        self._cells: dict[str, _Cell] = {}
        self._layers: dict[str, tuple[Array, Array | None]] = {}
        for path, weight in weights.items():
            name = path.removesuffix(".weight")
            if name.endswith(".state"):
                self._cells[name.removesuffix(".state")] = _Cell(weight, recipe.hidden)
            elif not path.endswith(".bias") and not path.startswith("ends."):
                self._layers[name] = weight, weights.get(f"{name}.bias")
        self._zero = np.zeros((1, recipe.hidden), np.float32)

    def with_place(self, place: bool) -> Runtime:
        """Return this network with or without the place among its results, if it estimates the place."""
        network = copy(self)
        network._ends = self._ends.with_place(place)
        return network

    def _product(self, name: str, x: Array) -> Array:
        """Return the products of inputs (..., N) with the weights of a layer, with its bias if any."""
        weight, bias = self._layers[name]
        product = _times(x.reshape(-1, x.shape[-1]), weight)
        if bias is not None:
            product += bias
        return product.reshape(*x.shape[:-1], -1)

    def _over(self, cell: str, products: Array, *state: Array) -> tuple[Array, Array, Array]:
        """Return the outputs (B, T, hidden) of a cell for products (B, T, 4 hidden), and the last h and c."""
        outputs, h, c = self._cells[cell].run(products.swapaxes(0, 1), *state)
        return outputs.swapaxes(0, 1), h, c

    def _inputs(self, orientation: Array, acceleration: Array) -> tuple[Array, Array]:
        """Return the first hidden layer (B, T, hidden) of frames, and the frames seen from the root."""
        shape = orientation.shape[:2]
        x, seen = self._ends.inputs(rows(orientation), rows(acceleration))
        return x.reshape(*shape, -1), seen.reshape(*shape, SEEN, 3, 3)

    def _start(self, batch: int) -> tuple[State, State]:
        """Return the states before the first frame: h and c of two cells, and the stages of the low-pass."""
        stage = np.zeros((batch, self._ends.vectors, 3), np.float32)
        return [self._zero.repeat(batch, axis=0)] * 4, [stage, stage]

    def _none(self, batch: int) -> Results:
        """Return no results."""
        place = np.zeros((batch, 0, self._ends.place), np.float32) if self._ends.place else None
        return Results(
            np.zeros((batch, 0, 24, 3, 3), np.float32), np.zeros((batch, 0, 24), np.float32), place
        )

    def shapes(self, state: State) -> tuple[Any, ...]:
        """See `Runtime.shapes`."""
        return tuple(array.shape for array in state)

    def join(self, states: Sequence[State]) -> State:
        """See `Runtime.join`."""
        return [np.concatenate(column) for column in zip(*states, strict=True)]

    def split(self, state: State, batch: int) -> list[State]:
        """See `Runtime.split`."""
        return [[array[i : i + 1] for array in state] for i in range(batch)]


class Rnn(NumpyNetwork):
    """Unidirectional network."""

    def start(self, batch: int, future: int) -> State:
        """See `Runtime.start`; the state is [h1, c1, h2, c2, the two stages of the low-pass]."""
        if future:
            raise ValueError("a unidirectional network has no future frames")
        cells, lowpass = self._start(batch)
        return cells + lowpass

    def window(self, orientation: Array, acceleration: Array, index: int) -> Results:
        """See `Runtime.window`; later frames are not used."""
        seen, state = slice(index + 1), self.start(len(orientation), 0)
        return self._run(orientation[:, seen], acceleration[:, seen], state, 1)[0]

    def stream(self, orientation: Array, acceleration: Array, state: State) -> tuple[Results, State]:
        """See `Runtime.stream`."""
        return self._run(orientation[:, None], acceleration[:, None], state, 1)

    def stream_many(self, orientation: Array, acceleration: Array, state: State) -> tuple[Results, State]:
        """See `Runtime.stream_many`."""
        return self._run(orientation, acceleration, state, orientation.shape[1])

    def drain(self, state: State) -> Results:
        """See `Runtime.drain`; no frame ever waits."""
        return self._none(len(state[0]))

    def _run(
        self, orientation: Array, acceleration: Array, state: State, count: int
    ) -> tuple[Results, State]:
        """Process frames (B, T, ...); return the results for the last `count`, and the new state."""
        x, seen = self._inputs(orientation, acceleration)
        x, h1, c1 = self._over("cell1", self._product("inputs1", x), *state[:2])
        x, h2, c2 = self._over("cell2", self._product("inputs2", x), *state[2:4])
        results, lowpass = self._ends.poses(seen, x, state[4:], count)
        return results, [h1, c1, h2, c2, *lowpass]


class Birnn(NumpyNetwork):
    """Bidirectional network: exact windows, or streams with carried forward states."""

    def start(self, batch: int, future: int) -> State:
        """See `Runtime.start`.

        The state is [h1, c1, h2, c2; for the frames that wait for their future: products of layer 1
        backwards, known products of layer 2 forwards, the same backwards, frames seen from the root; the two
        stages of the low-pass; an array whose second length is `future`].
        """
        cells, lowpass = self._start(batch)
        waiting = [np.zeros((batch, 0, 4 * self._zero.shape[1]), np.float32)] * 3
        seen = np.zeros((batch, 0, SEEN, 3, 3), np.float32)
        return [*cells, *waiting, seen, *lowpass, np.zeros((batch, future), np.float32)]

    def window(self, orientation: Array, acceleration: Array, index: int) -> Results:
        """See `Runtime.window`; the second layer runs over the frames up to `index` forwards."""
        x, seen = self._inputs(orientation, acceleration)
        ahead, back = _halves(self._product("inputs1", x))
        ahead = self._over("forward1", ahead)[0]
        back = _reversed(self._over("backward1", _reversed(back))[0])
        past, later = _halves(self._product("ahead2", ahead))
        end = index + 1
        past = past[:, :end] + self._product("back2_forward", back[:, :end])
        past = self._over("forward2", past)[0]
        later = later + self._product("back2_backward", back)
        later = _reversed(self._over("backward2", _reversed(later))[0])[:, :end]
        hidden = np.concatenate([past, later], axis=2)
        return self._ends.poses(seen[:, :end], hidden, self._start(len(seen))[1], 1)[0]

    def stream(self, orientation: Array, acceleration: Array, state: State) -> tuple[Results, State]:
        """See `Runtime.stream`."""
        return self.stream_many(orientation[:, None], acceleration[:, None], state)

    def stream_many(self, orientation: Array, acceleration: Array, state: State) -> tuple[Results, State]:
        """See `Runtime.stream_many`."""
        x, seen = self._inputs(orientation, acceleration)
        ahead, back = _halves(self._product("inputs1", x))
        ahead, h1, c1 = self._over("forward1", ahead, *state[:2])
        new = [back, *_halves(self._product("ahead2", ahead)), seen]
        waiting = [np.concatenate(pair, axis=1) for pair in zip(state[4:8], new, strict=True)]
        state = [h1, c1, *state[2:4], *waiting, *state[8:]]
        future = state[10].shape[1]
        due = waiting[0].shape[1] - future
        return self._oldest(state, due) if due > 0 else (self._none(len(seen)), state)

    def drain(self, state: State) -> Results:
        """See `Runtime.drain`, oldest first."""
        results = [self._none(len(state[0]))]
        while state[4].shape[1]:
            result, state = self._oldest(state, 1)
            results.append(result)
        rotations, std, places = zip(*results, strict=True)
        place = np.concatenate(places, axis=1) if self._ends.place else None
        return Results(np.concatenate(rotations, axis=1), np.concatenate(std, axis=1), place)

    def _oldest(self, state: State, count: int) -> tuple[Results, State]:
        """Return the results for the `count` oldest waiting frames, and the state without them.

        Of W waiting frames, each pose uses the W - count behind its own. Forward states carry over; the
        backward pass of each frame starts afresh at the last frame it uses.
        """
        batch = len(state[0])
        back = self._cells["backward1"].run(_fields(state[4], count))[0]
        known = self._product("back2_forward", back[-1]).reshape(batch, count, -1)
        known += state[5][:, :count]
        past, h2, c2 = self._over("forward2", known, *state[2:4])
        steps = self._product("back2_backward", back)
        for step, waiting in zip(steps, _fields(state[6], count), strict=True):
            step += waiting
        later = self._cells["backward2"].run(steps)[1].reshape(batch, count, -1)
        hidden = np.concatenate([past, later], axis=2)
        results, lowpass = self._ends.poses(state[7][:, :count], hidden, state[8:10], count)
        left = [array[:, count:] for array in state[4:8]]
        return results, [*state[:2], h2, c2, *left, *lowpass, state[10]]


def _reversed(x: Array) -> Array:
    """Return (B, T, ...) with the last frame first."""
    return x[:, ::-1]


def _halves(x: Array) -> tuple[Array, Array]:
    """Return the halves of (B, T, 2 N)."""
    size = x.shape[2] // 2
    return x[:, :, :size], x[:, :, size:]


def _fields(waiting: Array, count: int) -> list[Array]:
    """Return the frames that each of the first `count` of (B, T, N) uses, step by step, the last first.

    Each step is an array (B count, N).
    """
    return [rows(waiting[:, t : t + count]) for t in range(waiting.shape[1] - count, -1, -1)]


def _prepared(name: str, weight: Array, size: int) -> Array:
    """Return weights (N, M) or biases (M,) of gates i, f, g, o in the order i, f, o, g, all halved.

    Exports double those of g, so tanh of a product is the candidate, and gives the gates, see `_Cell.run`.
    Weights that are multiplied with several rows of each frame come as blocks, see `_blocks`.
    """
    gates = weight.reshape(*weight.shape[:-1], -1, 4, size).take([0, 1, 3, 2], axis=-2)
    gates *= 0.5
    gates = gates.reshape(weight.shape)
    return np.ascontiguousarray(_blocks(gates)) if name == "back2_backward.weight" else gates


def _blocks(weight: Array) -> Array:
    """Return weights (N, M) as blocks (M / 64, N, 64), or (1, N, M) if there are no such blocks."""
    width = _BLOCK if weight.shape[1] % _BLOCK == 0 else weight.shape[1]
    return weight.reshape(len(weight), -1, width).swapaxes(0, 1)


def _times(x: Array, weight: Array) -> Array:
    """Return the product (N, M) of rows (N, K) and weights, whole or in blocks."""
    if weight.ndim == 2:
        if len(x) == 1:
            return x @ weight
        weight = _blocks(weight)
    return np.matmul(x, weight).swapaxes(0, 1).reshape(len(x), -1)
