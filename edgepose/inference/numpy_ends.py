"""The layers of the network in numpy before and after the recurrent ones, see `numpy_network`."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy

import numpy as np

from edgepose.inference.rotation_rows import SEEN, SEEN_ROOT, rotation_rows
from edgepose.inference.runtime import Array, Results
from edgepose.inference.weights import Recipe
from edgepose.placements import ROOT
from edgepose.pose import CONTACTS

State = list[Array]

HALF: Array = np.array(0.5, np.float32)
"""As an array, with which numpy calculates faster than with its numbers."""

_TINY: Array = np.array(1e-12, np.float32)
_IDENTITY: Array = np.eye(3, dtype=np.float32).reshape(1, 1, 3, 3)
_ONES: Array = np.ones((3, 1), np.float32)
_YZXY = np.array([1, 2, 0, 1])
_CONTACTS = len(CONTACTS)

# Sums of a rotation's entries that are sine and cosine of its turn about Y, times a number. Where that is
# zero, the root is upside down, and counts as not turned.
_TURN: Array = np.array([[0, 0, 1, 0, 0, 0, -1, 0, 0], [1, 0, 0, 0, 0, 0, 0, 0, 1]], np.float32).T.copy()
_NO_TURN: Array = np.array([0.0, 1e-12], np.float32)
# The rotation that takes a turn back, from its sine and cosine.
_BACK: Array = np.array([[0, 0, -1, 0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0, 0, 0, 1]], np.float32)
_VERTICAL: Array = np.array([0, 0, 0, 0, 1, 0, 0, 0, 0], np.float32)


class Ends:
    """The layers before and after the recurrent ones."""

    def __init__(self, recipe: Recipe, weights: Mapping[str, Array]) -> None:
        """Use weights of the shapes that `Recipe.shapes` returns."""
        self._weights = {name.removeprefix("ends."): array for name, array in weights.items()}
        self.vectors = 2 * len(recipe.joints)
        self._smoothing, self.place = np.array(recipe.smoothing, np.float32), recipe.place
        self._own, self._above = map(np.array, rotation_rows(recipe.joints, recipe.passed))

    def with_place(self, place: bool) -> Ends:
        """See `NumpyNetwork.with_place`."""
        ends = copy(self)
        ends.place = self.place if place else 0
        return ends

    def inputs(self, orientation: Array, acceleration: Array) -> tuple[Array, Array]:
        """Return the first hidden layer (N, hidden) of N frames, and the frames seen from the root."""
        count, root = len(orientation), orientation[:, ROOT]
        columns, rows = orientation.swapaxes(2, 3), acceleration.reshape(count, 2, 3, 3)
        vectors = np.concatenate([columns, rows, _IDENTITY.repeat(count, axis=0)], axis=1)
        seen = vectors.reshape(count, -1, 3) @ root
        x = seen.reshape(count, -1) @ self._weights["dense.weight"]
        x += self._weights["dense.bias"]
        return np.maximum(x, 0.0, out=x), seen.reshape(count, SEEN, 3, 3)

    def poses(self, seen: Array, hidden: Array, lowpass: State, count: int) -> tuple[Results, State]:
        """Return the results for the last `count` frames, and the new state of the low-pass.

        Args:
            seen: (B, T, 9, 3, 3) frames, from `inputs`.
            hidden: (B, T, units) recurrent outputs.
            lowpass: outputs (B, vectors, 3) of both stages of the low-pass.
            count: number of frames.
        """
        batch, frames = hidden.shape[:2]
        numbers = rows(hidden) @ self._weights["heads.weight"]
        numbers += self._weights["heads.bias"]
        numbers, size = numbers.reshape(batch, frames, -1), 3 * self.vectors
        vectors = numbers[:, :, :size].reshape(batch, frames, -1, 3)
        if self._smoothing:
            vectors, lowpass = self._smoothed(vectors, seen[:, :, SEEN_ROOT], lowpass)
        rotations = self._rotations(rows(seen[:, -count:]), rows(vectors[:, -count:]))
        deviation = np.logaddexp(numbers[:, -count:, size : 2 * size], 0.0)  # SoftPlus
        deviation += self._weights["floor"]
        std = np.sqrt(rows(deviation * deviation) @ self._weights["variances"])
        place = None
        if self.place:
            place = numbers[:, -count:, 2 * size :]
            contacts = place[:, :, :_CONTACTS]
            contacts *= HALF
            np.tanh(contacts, out=contacts)
            contacts *= HALF
            contacts += HALF
        shape = (batch, count, 24)
        return Results(rotations.reshape(*shape, 3, 3), std.reshape(shape), place), lowpass

    def _smoothed(self, vectors: Array, root: Array, lowpass: State) -> tuple[Array, State]:
        """Apply the low-pass to vectors (B, T, N, 3) in the level frame of roots (B, T, 3, 3)."""
        level, (first, second) = _level(root), lowpass
        vectors = vectors @ level.swapaxes(-1, -2)
        for t in range(vectors.shape[1]):
            first = vectors[:, t] + self._smoothing * (first - vectors[:, t])
            vectors[:, t] = second = first + self._smoothing * (second - first)
        return vectors @ level, [first, second]

    def _rotations(self, seen: Array, vectors: Array) -> Array:
        """Return local rotations (N, 24, 3, 3) from vectors (N, 2 joints, 3), first all first columns."""
        count, joints = len(seen), self.vectors // 2
        # Transposed, as in `seen`: the rows of each matrix are its rotation's columns.
        axes = np.empty((count, joints, 3, 3), np.float32)
        axes[:, :, 0] = first = vectors[:, :joints]
        axes[:, :, 2] = third = _cross(first, vectors[:, joints:])
        axes[:, :, 1] = _cross(third, first)
        axes /= np.maximum(_lengths(axes), _TINY)
        known = np.concatenate([seen, axes, _IDENTITY.repeat(count, axis=0)], axis=1)
        return known.take(self._above, axis=1) @ known.take(self._own, axis=1).swapaxes(2, 3)


def rows(x: Array) -> Array:
    """Return (B, T, ...) as (B T, ...)."""
    return x.reshape(-1, *x.shape[2:])


def _cross(a: Array, b: Array) -> Array:
    """Return cross products of vectors (..., 3); numpy's takes five times as long for a few."""
    a, b = a.take(_YZXY, -1), b.take(_YZXY, -1)
    product: Array = a[..., :3] * b[..., 1:]
    product -= a[..., 1:] * b[..., :3]
    return product


def _lengths(vectors: Array) -> Array:
    """Return the lengths (..., 1) of vectors (..., 3)."""
    squares: Array = np.matmul(vectors * vectors, _ONES)
    return np.sqrt(squares, out=squares)


def _level(root: Array) -> Array:
    """Return roots (..., 3, 3) without their turn about Y."""
    turn = root.reshape(*root.shape[:-2], 9) @ _TURN
    turn += _NO_TURN
    turn /= np.hypot(turn[..., :1], turn[..., 1:])
    back = turn @ _BACK
    back += _VERTICAL
    return np.matmul(back.reshape(root.shape), root)
