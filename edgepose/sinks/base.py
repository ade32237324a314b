"""The interface of outputs, and the table of available ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple, TypeVar

from edgepose.errors import ConfigError
from edgepose.pose import PoseFrame
from edgepose.skeleton import Body

Self = TypeVar("Self", bound="Sink")


class Sink(ABC):
    """An output of poses, open from its construction until `close`; use it in a `with` statement."""

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
        overwrite: replace existing files.
        joints: number of joints in NPZ, a key of `JOINT_COUNTS` in `edgepose.formats.poses.npz_amass`.
        names: names of the joints in BVH, a key of `BVH_NAMES` in `edgepose.formats.bvh_names`.
        about: origin of the poses, see `PoseSequence`.
        stopped: whether the run is to end; a reader that has stopped reading is then not waited for.
    """

    body: Body
    height: float = 1.75
    rate: float = 60.0
    rotations: str = "axis-angle"
    std: bool = False
    translation: bool = False
    overwrite: bool = False
    joints: int = 24
    names: str = "smpl"
    about: Mapping[str, str] = MappingProxyType({})
    stopped: Callable[[], bool] = lambda: False


SinkFactory = Callable[[Any, SinkContext], Sink]
"""Opens a sink, given its target (a file, an address) and the context.

Raises:
    EdgeposeError: the sink cannot be opened.
"""

SINKS = {
    "udp": "edgepose.sinks.udp:open_sink",
    "osc": "edgepose.sinks.vmc:open_sink",
    "tcp": "edgepose.sinks.tcp:open_sink",
    "npz": "edgepose.sinks.npz:open_sink",
    "bvh": "edgepose.sinks.bvh:open_sink",
    "csv": "edgepose.sinks.csv:open_sink",
    "view": "edgepose.sinks.viewer:open_sink",
}
"""Factories by the name of their flag, in the order of opening.

Addresses come first, so that a wrong one is reported before waiting for a pipe's reader; the viewer starts
once everything else is ready.
"""

ENTRY_POINTS = "edgepose.sinks"
"""Group of entry points under which other packages register their factories."""


def sink_factory(name: str) -> SinkFactory:
    """Return the factory of a sink, from the table or from another package.

    Raises:
        ConfigError: there is none of that name, or the other package cannot be imported.
    """
    if name in SINKS:
        module, _, function = SINKS[name].partition(":")
        factory: SinkFactory = getattr(import_module(module), function)
        return factory
    for point in entry_points(group=ENTRY_POINTS, name=name):
        try:
            loaded: SinkFactory = point.load()
        except (Exception, SystemExit) as error:  # third-party code
            raise ConfigError(f"output {name!r}: {point.value} cannot be imported: {error}") from error
        return loaded
    known = ", ".join(sorted({point.name for point in entry_points(group=ENTRY_POINTS)})) or "none"
    raise ConfigError(f"unknown output {name!r}; installed packages add: {known}")
