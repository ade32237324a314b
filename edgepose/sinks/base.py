"""The interface of outputs; `registry` has the table of available ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType, TracebackType
from typing import Any, ClassVar, NamedTuple, TypeVar

from edgepose.pose import PoseFrame
from edgepose.skeleton import Body

Self = TypeVar("Self", bound="Sink")


class Sink(ABC):
    """An output of poses, open from its construction until `close`; use it in a `with` statement.

    Attributes:
        live: the receiver shows poses as they come, so that old ones are of no use; files keep all.
    """

    live: ClassVar[bool] = False

    def start(self) -> None:  # noqa: B027 - most outputs have nothing to do
        """Begin the run: from now on files may appear.

        Raises:
            EdgeposeError: a file cannot be created.
        """

    @abstractmethod
    def write(self, pose: PoseFrame) -> None:
        """Write the next pose.

        Raises:
            EdgeposeError: the output cannot be written to any more; the poses written before are complete.
        """

    @abstractmethod
    def close(self) -> None:
        """Finish the output; a second call does nothing."""

    def discard(self) -> None:
        """Finish the output after a failure: like `close`, but no file appears if no pose was written."""
        self.close()

    def summary_lines(self) -> list[str]:
        """Return messages for the end of a run, one line each."""
        return []

    def __enter__(self: Self) -> Self:
        """Return the sink itself, which is open since its construction."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the sink, or discard it after an error."""
        if kind is None:
            self.close()
        else:
            self.discard()


class SinkContext(NamedTuple):
    """Settings for sinks besides their own targets.

    Attributes:
        body: the wearer's body, for bone lengths.
        height: the wearer's stature, metres.
        rate: poses per second.
        rotations: representation of rotations in CSV, a key of `ROTATION_FORMATS` in
            `edgepose.formats.poses.csv_columns`.
        std: write standard deviations, if the format has room for them.
        translation: poses have a translation.
        contacts: poses have contacts.
        overwrite: replace existing files.
        about: origin of the poses, see `PoseSequence`.
        stopped: whether the run is to end; a reader that has stopped reading is then not waited for.
        wearer: the wearer's name, for messages; empty for a single wearer.
        clock: returns the present time on the clock of the poses, seconds, if they are measured now; None
            for recordings.
        paced: poses come at the pace of their measurement, so that no reader is waited for.
        page_port: TCP port of a page in the browser; None for any.
        press: passes on keys that a user presses in an output, such as "r"; None if the run takes none.
    """

    body: Body
    height: float = 1.75
    rate: float = 60.0
    rotations: str = "axis-angle"
    std: bool = False
    translation: bool = False
    contacts: bool = False
    overwrite: bool = False
    about: Mapping[str, str] = MappingProxyType({})
    stopped: Callable[[], bool] = lambda: False
    wearer: str = ""
    clock: Callable[[], float] | None = None
    paced: bool = False
    page_port: int | None = None
    press: Callable[[str], None] | None = None


SinkFactory = Callable[[Any, SinkContext], Sink]
"""Opens a sink, given its target (a file, an address) and the context.

Raises:
    EdgeposeError: the sink cannot be opened.
"""
