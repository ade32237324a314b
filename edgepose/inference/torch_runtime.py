"""The TorchScript module of an archive as a runtime."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from edgepose.inference.runtime import Array, Results


class TorchRuntime:
    """A loaded archive that is called with or without the place; its poses are the same. See `Runtime`."""

    def __init__(self, module: torch.jit.ScriptModule, place: bool) -> None:
        """Wrap a module; `place` needs an archive that has it (`archive.has_place`)."""
        self._module, self._ending = module, "_place" if place else ""
        self._stream = getattr(module, "stream" + self._ending)  # looked up once: a module is slow at it
        # Whether each tensor of a state has a row per wearer; the others are the same for all.
        self._has_rows: list[bool] = []

    def start(self, batch: int, future: int) -> list[torch.Tensor]:
        """See `Runtime.start`."""
        with torch.inference_mode():
            state: list[torch.Tensor] = self._module.start(batch, future)
            other = self._module.start(batch + 1, future)
        self._has_rows = [one.shape != two.shape for one, two in zip(state, other, strict=True)]
        return state

    def window(self, orientation: Array, acceleration: Array, index: int) -> Results:
        """See `Runtime.window`."""
        results = self._call("window", orientation, acceleration, index)
        return Results(*(tensor.numpy()[:, None] for tensor in results))

    def stream(
        self, orientation: Array, acceleration: Array, state: list[torch.Tensor]
    ) -> tuple[Results, list[torch.Tensor]]:
        """See `Runtime.stream`."""
        with torch.inference_mode():
            *results, state = self._stream(
                torch.from_numpy(orientation), torch.from_numpy(acceleration), state
            )
        return Results(*[tensor.numpy() for tensor in results]), state

    def stream_many(
        self, orientation: Array, acceleration: Array, state: list[torch.Tensor]
    ) -> tuple[Results, list[torch.Tensor]]:
        """See `Runtime.stream_many`."""
        *results, state = self._call("stream_many", orientation, acceleration, state)
        return Results(*(tensor.numpy() for tensor in results)), state

    def drain(self, state: list[torch.Tensor]) -> Results:
        """See `Runtime.drain`."""
        with torch.inference_mode():
            results = getattr(self._module, "drain" + self._ending)(state)
        return Results(*(tensor.numpy() for tensor in results))

    def shapes(self, state: list[torch.Tensor]) -> tuple[Any, ...]:
        """See `Runtime.shapes`."""
        return tuple(tensor.shape for tensor in state)

    def join(self, states: Sequence[list[torch.Tensor]]) -> list[torch.Tensor]:
        """See `Runtime.join`."""
        with torch.inference_mode():
            return [
                torch.cat(column) if has_rows else column[0]
                for column, has_rows in zip(zip(*states, strict=True), self._has_rows, strict=True)
            ]

    def split(self, state: list[torch.Tensor], batch: int) -> list[list[torch.Tensor]]:
        """See `Runtime.split`."""
        with torch.inference_mode():
            columns = [
                tensor.split(1) if has_rows else [tensor] * batch
                for tensor, has_rows in zip(state, self._has_rows, strict=True)
            ]
        return [list(row) for row in zip(*columns, strict=True)]

    def _call(self, name: str, orientation: Array, acceleration: Array, last: Any) -> Any:
        with torch.inference_mode():
            return getattr(self._module, name + self._ending)(
                torch.from_numpy(orientation), torch.from_numpy(acceleration), last
            )
