"""Where poses go: each module is one kind of output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import TypeVar

from edgepose.pose import PoseFrame

Self = TypeVar("Self", bound="Sink")


class Sink(ABC):
    """An output of poses, open from its construction until `close`; use it in a `with` statement."""

    def start(self) -> None:  # noqa: B027 - most outputs have nothing to do
        """The run begins: a file may appear.

        Raises:
            EdgeposeError: it cannot.
        """

    @abstractmethod
    def write(self, pose: PoseFrame) -> None:
        """Take the next pose.

        Raises:
            EdgeposeError: the output can take no more; what it has taken so far is complete.
        """

    @abstractmethod
    def close(self) -> None:
        """Finish the output; a second call does nothing."""

    def discard(self) -> None:
        """Finish the output after a failure: as `close`, but without a pose no file appears."""
        self.close()

    def __enter__(self: Self) -> Self:
        """The sink itself, open since its construction."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close, whatever happened."""
        if kind is None:
            self.close()
        else:
            self.discard()
