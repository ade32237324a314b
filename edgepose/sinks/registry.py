"""The table of outputs: the flag of each, and the location of its sink."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from edgepose.errors import ConfigError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.opensim import MODELS
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.formats.poses.npz_amass import JOINT_COUNTS
from edgepose.utils.output_targets import FileTarget, parse_file, part_path
from edgepose.utils.sockets import (
    Address,
    Destination,
    address_text,
    parse_datagram_address,
    parse_destination,
    parse_host_and_port,
)

if TYPE_CHECKING:
    from edgepose.sinks.base import SinkFactory

ENTRY_POINTS = "edgepose.sinks"
"""Group of entry points under which other packages register their factories."""


LONGEST_NAME = 100
"""Most characters of the name of a stream."""


def parse_stream_name(text: str) -> str:
    """Return the name of a stream.

    Raises:
        ConfigError: it is empty, too long, or has characters that cannot be printed.
    """
    if not text.strip() or not text.isprintable() or len(text) > LONGEST_NAME:
        raise ConfigError(f"{text!r} is no name of a stream: write up to {LONGEST_NAME} printable characters")
    return text


@dataclass(frozen=True)
class Output:
    """An output of poses, which has the flag --NAME and the TOML key NAME.

    Attributes:
        factory: "module:function" of its `SinkFactory`; imported when the output is opened.
        help: help text of the flag.
        metavar: form of the flag's value; None for a switch.
        parse: makes the sink's target from that value. Raises ConfigError if the value has another form.
        form: class of the targets; a tuple of the first of its values stands for one.
        suffix: ending of its files, such as ".csv"; empty if it does not write to a file.
        options: options that may follow a file's name, with their values, the default first; it may be empty.
        one_wearer: its receivers cannot tell several wearers apart.
        part: returns the name of the file that holds the poses during a run, given that of the output; None
            if there is no such file.
    """

    factory: str
    help: str
    metavar: str | None = "FILE"
    parse: Callable[[str], Any] = str
    form: Callable[..., Any] | None = None
    suffix: str = ""
    options: Mapping[str, Sequence[str]] = field(default_factory=dict)
    one_wearer: bool = False
    part: Callable[[str], Path] | None = None

    def target(self, value: Any) -> Any:
        """Return the sink's target for a value: text is parsed, tuples are completed.

        Raises:
            ConfigError: the text has another form, or a switch is not True.
        """
        if self.metavar is None and value is not True:
            raise ConfigError(f"{value!r} is neither True nor False")
        if isinstance(value, str | Path):
            return parse_file(str(value), self.options) if self.options else self.parse(str(value))
        return value if self.form is None else self.form(*value)

    def file(self, target: Any) -> str:
        """Return the file to which a target of an output with a suffix leads."""
        return target.path if isinstance(target, FileTarget) else str(target)

    def in_folder(self, target: Any, name: Path) -> Any:
        """Return the target of a file of some name, without ending, in the folder to which a target leads."""
        path = str(Path(self.file(target)) / name.parent / f"{name.name}{self.suffix}")
        return target._replace(path=path) if isinstance(target, FileTarget) else path


_NAMES = ", ".join(BVH_NAMES)

SINKS = {
    "csv": Output(
        "edgepose.sinks.csv:open_sink",
        "Write poses as CSV; - is standard output. FORMAT is as in --rotations, which holds without it.",
        "FILE[,rotations=FORMAT]",
        suffix=".csv",
        options={"rotations": ("", *ROTATION_FORMATS)},
    ),
    "npz": Output(
        "edgepose.sinks.npz:open_sink",
        "Write poses as NPZ with the keys of AMASS at the end. Numbers of joints: "
        f"{', '.join(f'{count} as in {model}' for count, model in JOINT_COUNTS.items())}.",
        f"FILE[,joints={'|'.join(map(str, JOINT_COUNTS))}]",
        suffix=".npz",
        options={"joints": tuple(map(str, JOINT_COUNTS))},
        part=part_path,
    ),
    "bvh": Output(
        "edgepose.sinks.bvh:open_sink",
        f"Write poses as BVH, for Blender and similar programs. Names of the joints: {_NAMES}.",
        "FILE[,names=SKELETON][,unit=cm|m][,start=t-pose]",
        suffix=".bvh",
        options={"names": tuple(BVH_NAMES), "unit": ("cm", "m"), "start": ("motion", "t-pose")},
    ),
    "glb": Output(
        "edgepose.sinks.glb:open_sink",
        "Write a figure that moves as binary glTF at the end, for Blender and browsers. Names of its joints: "
        f"{_NAMES}.",
        "FILE[,names=SKELETON]",
        suffix=".glb",
        options={"names": tuple(BVH_NAMES)},
        part=part_path,
    ),
    "sto": Output(
        "edgepose.sinks.opensim:open_sto_sink",
        "Write orientations of bodies for OpenSim.",
        suffix=".sto",
    ),
    "mot": Output(
        "edgepose.sinks.opensim:open_mot_sink",
        "Write joint angles for OpenSim's full-body models. Flexed knees are positive with rajagopal, "
        "negative with gait2392.",
        f"FILE[,model={'|'.join(MODELS)}]",
        suffix=".mot",
        options={"model": tuple(MODELS)},
    ),
    "udp": Output(
        "edgepose.sinks.udp:open_sink",
        "Send each pose as a datagram.",
        "HOST:PORT[,format=json|binary|binary-v1][,broadcast|multicast]",
        partial(parse_destination, key="format", choices=("json", "binary", "binary-v1")),
        Destination,
    ),
    "osc": Output(
        "edgepose.sinks.vmc:open_sink",
        "Send each pose over OSC (the VMC protocol) to programs that show VRM avatars; most of them listen "
        "on port 39539.",
        "HOST:PORT[,broadcast|multicast]",
        parse_datagram_address,
        Address,
        one_wearer=True,
    ),
    "vrchat": Output(
        "edgepose.sinks.vrchat:open_sink",
        "Send trackers to VRChat over OSC; it listens on port 9000. 8: hip, feet, knees, chest, elbows; "
        "6: without elbows; 3: hip and feet.",
        "HOST:PORT[,trackers=8|6|3][,broadcast|multicast]",
        partial(parse_destination, key="trackers", choices=("8", "6", "3")),
        Destination,
        one_wearer=True,
    ),
    "mocopi": Output(
        "edgepose.sinks.mocopi:open_sink",
        "Send each pose as Sony's mocopi does, to its receivers for Unity, Unreal, MotionBuilder and "
        "Blender, which listen on port 12351.",
        "HOST:PORT[,broadcast|multicast]",
        parse_datagram_address,
        Address,
        one_wearer=True,
    ),
    "lsl": Output(
        "edgepose.sinks.lsl:open_sink",
        "Offer the poses as a stream of this name to the Lab Streaming Layer, to all of the network.",
        "NAME",
        parse_stream_name,
        one_wearer=True,
    ),
    "tcp": Output(
        "edgepose.sinks.tcp:open_sink",
        "Listen here for viewers that read poses as text, such as TransPose's on port 8888.",
        "HOST:PORT",
        parse_host_and_port,
    ),
    "view": Output(
        "edgepose.sinks.viewer:open_sink", "Show a figure in the browser; see `edgepose view`.", metavar=None
    ),
}
"""All outputs of this package by name, in the order of their flags."""


def target_texts(targets: Iterable[tuple[str, Any]]) -> list[tuple[str, str]]:
    """Return name and target of outputs as text: a file, an address, or empty."""
    return [(name, _target_text(name, target)) for name, target in targets]


def described(targets: Iterable[tuple[str, Any]]) -> list[dict[str, str]]:
    """Return outputs for scripts; docs/reference/scripts.md describes the keys."""
    return [{"kind": name, "target": text} for name, text in target_texts(targets)]


def _target_text(name: str, target: Any) -> str:
    if name in SINKS and SINKS[name].suffix:
        return SINKS[name].file(target)
    if isinstance(target, tuple):
        return address_text(*target[:2])
    return "" if target is True else str(target)


def sink_factory(name: str) -> SinkFactory:
    """Return the factory of a sink, from the table or from another package.

    Raises:
        ConfigError: there is none of that name, or the other package cannot be imported.
    """
    if name in SINKS:
        factory: SinkFactory = resolve_name(SINKS[name].factory)
        return factory
    for point in entry_points(group=ENTRY_POINTS, name=name):
        try:
            loaded: SinkFactory = point.load()
        except (Exception, SystemExit) as error:  # third-party code
            raise ConfigError(f"output {name!r}: {point.value} cannot be imported: {error}") from error
        return loaded
    known = ", ".join(sorted({point.name for point in entry_points(group=ENTRY_POINTS)})) or "none"
    raise ConfigError(f"unknown output {name!r}; installed packages add: {known}")
