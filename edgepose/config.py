"""Configuration of a run, filled from flags, from a TOML file or from Python.

WearerConfig(source=SourceConfig(port="/dev/ttyUSB0"), calibration=Path("calib.json"),
             outputs=OutputConfig(csv="poses.csv"))
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edgepose.errors import ConfigError, EdgeposeError
from edgepose.formats.bvh_names import BVH_NAMES
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.formats.poses.npz_amass import JOINT_COUNTS
from edgepose.imu import FILTERS
from edgepose.utils.output_targets import check_output, is_stream, part_path, split_option
from edgepose.utils.sockets import (
    Address,
    Destination,
    parse_address,
    parse_datagram_address,
    parse_destination,
)
from edgepose.utils.text_files import read_toml

ANY_OUTPUT = "give at least one output, such as --csv FILE, --udp HOST:PORT or --view"
ONE_SOURCE = "give one source: --port PORT, --can INTERFACE:CHANNEL or --file PATH"


def parse_host_and_port(text: str) -> tuple[str, int]:
    """Parse a text that is exactly HOST:PORT.

    Raises:
        ConfigError: the text is something else.
    """
    if "," in text:
        raise ConfigError(f"{text!r} is more than HOST:PORT")
    return parse_address(text)


FILE_OUTPUTS = ("csv", "npz", "bvh")
"""Outputs to a file with that ending. It must not be an input, and is replaced only with --overwrite."""

NETWORK_OUTPUTS: dict[str, Callable[[str], Any]] = {
    "udp": parse_destination,
    "osc": parse_datagram_address,
    "tcp": parse_host_and_port,
}
"""Outputs to an address, with the parser of the address."""


def split_options(npz: str | None, bvh: str | None) -> dict[str, Any]:
    """Split the texts FILE[,joints=N] and FILE[,names=SKELETON] of outputs.

    Returns:
        Values of the fields `npz`, `bvh`, `joints` and `names`, as far as they are given.

    Raises:
        ConfigError: an option is unknown.
    """
    values: dict[str, Any] = {}
    if npz is not None:
        values["npz"], joints = split_option(npz, "joints", list(map(str, JOINT_COUNTS)))
        values |= {} if joints is None else {"joints": int(joints)}
    if bvh is not None:
        values["bvh"], names = split_option(bvh, "names", list(BVH_NAMES))
        values |= {} if names is None else {"names": names}
    return values


@dataclass(frozen=True, kw_only=True)
class SourceConfig:
    """The source of samples; the fields are the arguments of `edgepose.sources.open_source`.

    Attributes:
        port: serial ports, separated by commas.
        baud: speed of the ports, bit/s; None means the protocol's usual speed.
        can: CAN bus, INTERFACE:CHANNEL.
        bitrate: speed of the bus, bit/s; None means the protocol's usual speed.
        fd: receive CAN FD frames too.
        file: recording, raw serial capture or log of a CAN bus; "-" is standard input.
        realtime: replay the file at its own pace.
        protocol: name of a wire format, a TOML file that describes text lines, or "auto".
        sensors: TOML file that maps devices to placements.
    """

    port: str | None = None
    baud: int | None = None
    can: str | None = None
    bitrate: int | None = None
    fd: bool = False
    file: Path | None = None
    realtime: bool = False
    protocol: str = "auto"
    sensors: Path | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError unless the fields name exactly one source and are in their ranges."""
        for name in ("file", "sensors"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, Path(getattr(self, name)))
        for name in ("baud", "bitrate"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"{name}: {value} is not in the range x>=1")
        lines = self.port is not None or self.can is not None
        if (self.file is not None and lines) or not (lines or self.file or self.sensors):
            raise ConfigError(ONE_SOURCE)

    @property
    def live(self) -> bool:
        """Whether samples come in real time."""
        return self.file is None or self.realtime

    @property
    def name(self) -> str:
        """Name of the source for messages and metadata."""
        return ",".join(
            str(name) for name in (self.file, self.port, self.can, self.sensors) if name is not None
        )

    def arguments(self) -> dict[str, Any]:
        """Return the arguments for `edgepose.sources.open_source`."""
        return {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}


@dataclass(frozen=True, kw_only=True)
class OutputConfig:
    """The outputs of a run; those that are None or false are not written.

    Attributes:
        csv: CSV file; "-" is standard output.
        rotations: representation of rotations in the CSV.
        std: add the network's standard deviations to the CSV.
        npz: NPZ file.
        bvh: BVH file.
        udp: destination of datagrams.
        osc: host and port of a VMC receiver.
        tcp: address to listen on for viewers.
        view: show a figure in the browser.
        height: the wearer's stature, metres.
        overwrite: replace existing files.
        joints: number of joints in the NPZ file, a key of `JOINT_COUNTS`; also ",joints=52" after its name.
        names: names of the joints in the BVH file, a key of `BVH_NAMES`; also ",names=unity" after its name.
        sinks: targets of outputs from other packages (entry points `edgepose.sinks`), by output name.
    """

    csv: str | None = None
    rotations: str = "axis-angle"
    std: bool = False
    npz: str | None = None
    bvh: str | None = None
    udp: Destination | None = None
    osc: Address | tuple[str, int] | None = None
    tcp: tuple[str, int] | None = None
    view: bool = False
    height: float = 1.75
    overwrite: bool = False
    joints: int = 24
    names: str = "smpl"
    sinks: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Split options from the names of files, and complete addresses.

        Raises:
            ConfigError: an unknown option, or an unknown representation of rotations.
        """
        values = split_options(self.npz, self.bvh)
        values |= {"udp": Destination(*self.udp)} if self.udp else {}
        values |= {"osc": Address(*self.osc)} if self.osc else {}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.joints not in JOINT_COUNTS or self.names not in BVH_NAMES:
            raise ConfigError(f"joints or names: {self.joints!r}, {self.names!r} are not possible")
        if self.rotations not in ROTATION_FORMATS:
            raise ConfigError(
                f"rotations: {self.rotations!r} is not one of {', '.join(map(repr, ROTATION_FORMATS))}"
            )

    @property
    def any(self) -> bool:
        """Whether there is any output."""
        targets = (getattr(self, name) for name in (*FILE_OUTPUTS, *NETWORK_OUTPUTS))
        return self.view or bool(self.sinks) or any(target is not None for target in targets)

    @property
    def files(self) -> dict[str, str | None]:
        """The files that are written, by flag."""
        # During a run, the poses for an NPZ file are in a CSV file next to it.
        growing = None if self.npz is None or is_stream(self.npz) else str(part_path(self.npz))
        by_flag = {f"--{name}": getattr(self, name) for name in FILE_OUTPUTS}
        return by_flag | {"--npz (while it grows)": growing}

    def check(self) -> None:
        """Check that no existing file would be lost.

        Raises:
            EdgeposeError: a file exists already, or cannot be written.
        """
        for name in FILE_OUTPUTS:
            path = getattr(self, name)
            if path is not None:
                check_output(path, "poses", (f".{name}",), self.overwrite)


@dataclass(frozen=True, kw_only=True)
class WearerConfig:
    """One wearer of a run.

    Attributes:
        source: the source of samples.
        calibration: file written by `edgepose calibrate`.
        outputs: the outputs for poses.
        filter: orientation filter, one of `edgepose.imu.FILTERS`.
        no_mag: do not use magnetometers in the filter.
        control: address to listen on for re-zero requests.
        name: the wearer's name in messages; empty for a single wearer.
        path: the TOML file that the configuration was read from, if any.
    """

    source: SourceConfig
    calibration: Path
    outputs: OutputConfig
    filter: str = "none"
    no_mag: bool = False
    control: tuple[str, int] | None = None
    name: str = ""
    path: Path | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError if fields contradict each other."""
        object.__setattr__(self, "calibration", Path(self.calibration))
        if self.filter not in FILTERS:
            raise ConfigError(f"filter: {self.filter!r} is not one of {', '.join(map(repr, FILTERS))}")
        if not self.outputs.any:
            raise ConfigError(ANY_OUTPUT)
        if self.control is not None and not self.source.live:
            raise ConfigError("--control needs live sensors, or --realtime")

    @classmethod
    def from_toml(cls, path: Path) -> WearerConfig:
        """Read a wearer's configuration from a TOML file, whose keys are the flags of `edgepose run`.

        File names in it are relative to the folder of the TOML file.

        Raises:
            ConfigError: the file cannot be read, or a key or value is not valid.
        """
        content = read_toml(path)
        name = content.pop("name", path.stem)
        if not isinstance(name, str) or not name.isprintable() or not name.strip():
            raise ConfigError(f"{path}: name must be text in quotes on one line, not {name!r}")
        try:
            values = {
                key.replace("-", "_"): _value(key, value, path.parent) for key, value in content.items()
            }
            return cls.from_values(values, name=name, path=path)
        except EdgeposeError as error:
            # Messages name flags; the keys of the file are the flags without hyphens.
            raise ConfigError(f"{path}: {str(error).replace('--', '')}") from None

    @classmethod
    def from_values(cls, values: Mapping[str, Any], **more: Any) -> WearerConfig:
        """Build a wearer's configuration from values by field name, for the fields of all three classes.

        Raises:
            ConfigError: a value is invalid, or the calibration is missing.
        """
        values = dict(values)

        def take_fields(kind: type) -> dict[str, Any]:
            return {
                each.name: values.pop(each.name) for each in dataclasses.fields(kind) if each.name in values
            }

        source = SourceConfig(**take_fields(SourceConfig))
        outputs = OutputConfig(**take_fields(OutputConfig))
        if values.get("calibration") is None:
            raise ConfigError("calibration is missing")
        return cls(source=source, outputs=outputs, **values, **more)


# --- TOML ---------------------------------------------------------------------------------------------------

_TEXT, _SWITCH, _WHOLE, _NUMBER = "text in quotes", "true or false", "a whole number", "a number"

_TYPES: dict[str, tuple[type, ...]] = {_TEXT: (str,), _SWITCH: (bool,), _WHOLE: (int,), _NUMBER: (int, float)}

_FILES = ("file", "sensors", "calibration", *FILE_OUTPUTS)
"""Keys whose values are files, relative to the TOML file; that of `protocol` may be one too."""

_KEYS = {
    "port": _TEXT,
    "baud": _WHOLE,
    "can": _TEXT,
    "bitrate": _WHOLE,
    "fd": _SWITCH,
    "file": _TEXT,
    "realtime": _SWITCH,
    "protocol": _TEXT,
    "sensors": _TEXT,
    "filter": _TEXT,
    "no-mag": _SWITCH,
    "calibration": _TEXT,
    **dict.fromkeys((*FILE_OUTPUTS, *NETWORK_OUTPUTS), _TEXT),
    "rotations": _TEXT,
    "std": _SWITCH,
    "view": _SWITCH,
    "height": _NUMBER,
    "overwrite": _SWITCH,
    "control": _TEXT,
}


def _value(key: str, value: object, folder: Path) -> Any:
    """Convert a value of the TOML file to that of the configuration.

    Raises:
        ConfigError: there is no such key, or the value has the wrong type or is invalid.
    """
    if key == "sinks" and isinstance(value, dict) and all(isinstance(item, str) for item in value.values()):
        return value
    what = _KEYS.get(key)
    if what is None:
        raise ConfigError(f"unknown key {key!r}; keys are name, {', '.join([*_KEYS, 'sinks'])}")
    if type(value) not in _TYPES[what]:  # not isinstance, to which a bool is an int
        raise ConfigError(f"{key} must be {what}, not {value!r}")
    if not isinstance(value, str):
        return float(value) if what == _NUMBER and isinstance(value, int | float) else value
    if "\0" in value:
        raise ConfigError(f"{key} must be text without NUL characters, not {value!r}")
    return _text(key, value, folder)


def _text(key: str, value: str, folder: Path) -> Any:
    if key in _FILES and value != "-":
        value = str(folder / value)
    if key in ("file", "sensors", "calibration"):
        return Path(value)
    parse: dict[str, Callable[[str], Any]] = {
        "protocol": lambda name: str(folder / name) if name.endswith(".toml") else checked_protocol(name),
        "control": parse_host_and_port,
        **NETWORK_OUTPUTS,
    }
    if key not in parse:
        return value
    try:
        return parse[key](value)
    except EdgeposeError as error:
        raise ConfigError(f"{key}: {error}") from None


def checked_protocol(name: str) -> str:
    """Return a name if it is "auto", that of a wire format, or that of a TOML file, which is read later.

    Raises:
        ConfigError: there is no such wire format.
    """
    from firmware_protocols.registry import PROTOCOLS

    if name == "auto" or name.endswith(".toml") or name in PROTOCOLS:
        return name
    raise ConfigError(f"unknown protocol {name!r}; known are {', '.join(PROTOCOLS)}")
