"""Opening of the outputs of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import MappingProxyType
from typing import Any

from edgepose.config import OutputConfig
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.registry import SINKS, sink_factory
from edgepose.skeleton import DEFAULT_HEIGHT, Body
from edgepose.utils.output_targets import has_reader


def open_outputs(
    stack: ExitStack,
    outputs: OutputConfig,
    rate: float = 60.0,
    stopped: Callable[[], bool] = lambda: False,
    *,
    body: Body | None = None,
    translation: bool = False,
    contacts: bool = False,
    wearer: str = "",
    about: Mapping[str, str] = MappingProxyType({}),
    clock: Callable[[], float] | None = None,
    paced: bool = False,
    press: Callable[[str], None] | None = None,
) -> list[Sink]:
    """Open the sinks of one wearer. No file appears or is replaced before all of them are open.

    Args:
        stack: closes the sinks.
        outputs: the outputs to open.
        rate: poses per second.
        stopped: whether the run is to end, see `SinkContext`.
        body: the wearer's body; None for that of the configuration.
        translation: every pose has a translation.
        contacts: every pose has contacts.
        wearer: the wearer's name, for messages.
        about: origin of the poses, see `PoseSequence`.
        clock: see `SinkContext`.
        paced: see `SinkContext`.
        press: passes on keys that a user presses in an output, see `SinkContext`.

    Returns:
        The sinks in the order in which each pose should be written to them.

    Raises:
        EdgeposeError: a file or address cannot be written to.
    """
    outputs.check()
    context = SinkContext(
        body=body or outputs.body,
        height=DEFAULT_HEIGHT if outputs.height is None else outputs.height,
        rate=rate,
        rotations=outputs.rotations,
        std=outputs.std,
        translation=translation,
        contacts=contacts,
        overwrite=outputs.overwrite,
        about=about,
        stopped=stopped,
        wearer=wearer,
        clock=clock,
        paced=paced,
        page_port=outputs.page_port,
        press=press,
    )
    targets = sorted(outputs.targets, key=_rank)
    sinks = [stack.enter_context(sink_factory(name)(target, context)) for name, target in targets]
    for sink in reversed(sinks):  # the viewer starts when the files exist
        sink.start()
    return sinks


def _rank(output: tuple[str, Any]) -> int:
    """Return the rank of an output in the order of opening: a pipe is last, because it waits for its reader.

    Poses are written in the same order, so what shows or forwards them comes before the files.
    """
    name, target = output
    if name not in SINKS:
        return 1
    if not SINKS[name].suffix:
        return 0
    return 2 if has_reader(SINKS[name].file(target)) else 1
