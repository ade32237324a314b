"""Opening of the outputs of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import MappingProxyType

from edgepose.config import OutputConfig
from edgepose.sinks.base import SINKS, Sink, SinkContext, sink_factory
from edgepose.skeleton import default_body


def open_outputs(
    stack: ExitStack,
    outputs: OutputConfig,
    rate: float = 60.0,
    stopped: Callable[[], bool] = lambda: False,
    about: Mapping[str, str] = MappingProxyType({}),
) -> list[Sink]:
    """Open the sinks of one wearer. No file appears or is replaced before all of them are open.

    Args:
        stack: closes the sinks.
        outputs: the outputs to open.
        rate: poses per second.
        stopped: whether the run is to end, see `SinkContext`.
        about: origin of the poses, see `PoseSequence`.

    Raises:
        EdgeposeError: a file or address cannot be written to.
    """
    outputs.check()
    if outputs.view:
        from edgepose.sinks.viewer import check_viewer

        check_viewer()
    context = SinkContext(
        body=default_body(outputs.height),
        height=outputs.height,
        rate=rate,
        rotations=outputs.rotations,
        std=outputs.std,
        overwrite=outputs.overwrite,
        joints=outputs.joints,
        names=outputs.names,
        about=about,
        stopped=stopped,
    )
    targets = {name: getattr(outputs, name) for name in SINKS if name != "view"} | dict(outputs.sinks)
    sinks = []
    for name, target in targets.items():
        if target is not None:
            sinks.append(stack.enter_context(sink_factory(name)(target, context)))
    for sink in sinks:
        sink.start()
    if outputs.view:  # last: when the viewer is up, the files exist
        sinks.append(stack.enter_context(sink_factory("view")(True, context)))
    return sinks
