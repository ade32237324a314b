"""Configuration of a run, filled from flags, from a TOML file or from Python.

WearerConfig(source=SourceConfig(port="/dev/ttyUSB0"), calibration=Path("calib.json"),
             outputs=OutputConfig(csv="poses.csv"))
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgepose.errors import ConfigError, EdgeposeError
from edgepose.formats.poses.csv_columns import ROTATION_FORMATS
from edgepose.imu import FILTERS
from edgepose.pose import RATES
from edgepose.sinks.output_files import check_output
from edgepose.sinks.receivers import check_receivers
from edgepose.sinks.registry import SINKS
from edgepose.skeleton import DEFAULT_HEIGHT, Body, check_measures, default_body
from edgepose.sources import LINES
from edgepose.sources.protocol_detection import checked_protocol
from edgepose.utils.output_targets import is_stream
from edgepose.utils.similar_names import choices
from edgepose.utils.sockets import parse_host_and_port
from edgepose.utils.text_files import read_toml
from edgepose.utils.toml_values import NUMBER, SWITCH, TEXT, TEXTS, WHOLE, checked_value, texts_by_name

ANY_OUTPUT = "give at least one output, such as --csv FILE, --udp HOST:PORT or --view"
ONE_SOURCE = "give one source: --port PORT, --can BUS, --listen, --connect, --ble, --hid or --file PATH"


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
        listen: addresses of this machine to receive datagrams on, HOST:PORT, separated by commas.
        connect: devices to connect to over TCP, HOST:PORT, separated by commas.
        ble: Bluetooth addresses of Movella DOT sensors, separated by commas.
        hid: USB receivers by serial number or path, separated by commas, or "slimevr" for the only one.
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
    listen: str | None = None
    connect: str | None = None
    ble: str | None = None
    hid: str | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError unless the fields name exactly one source and are in their ranges."""
        for name in ("file", "sensors"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, Path(getattr(self, name)))
        lines = any(name is not None for name in self.lines)
        for name, line in (("baud", "port"), ("bitrate", "can"), ("fd", "can")):
            value = getattr(self, name)
            if name != "fd" and value is not None and not value >= 1:  # NaN, too
                raise ConfigError(f"{name}: {value} is not in the range x>=1")
            if value and getattr(self, line) is None and (lines or self.file is not None):
                raise ConfigError(f"--{name} is for --{line}")
        if (self.file is not None and lines) or not (lines or self.file or self.sensors):
            raise ConfigError(ONE_SOURCE)
        if self.realtime and self.file is None:
            raise ConfigError("--realtime is for a --file: live sensors have their own pace")

    @property
    def live(self) -> bool:
        """Whether samples come in real time."""
        return self.file is None or self.realtime

    @property
    def lines(self) -> tuple[str | None, ...]:
        """Names of the live lines, by kind."""
        return tuple(getattr(self, kind) for kind in LINES)

    @property
    def name(self) -> str:
        """Name of the source for messages and metadata."""
        return ",".join(str(name) for name in (self.file, *self.lines, self.sensors) if name is not None)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments for `edgepose.sources.open_source`."""
        return {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}


@dataclass(frozen=True, init=False)
class OutputConfig:
    """The outputs of a run, by the names in `edgepose.sinks.registry.SINKS`.

    OutputConfig(csv="poses.csv", udp="127.0.0.1:9000", view=True, height=1.68)

    Attributes:
        targets: name and target of each output.
        rotations: representation of rotations in the CSV.
        std: add the network's standard deviations to the CSV.
        height: the wearer's height, metres; None for that of the calibration, or an average one.
        leg_length: length of the wearer's thigh and shank, metres; None for the average at this height.
        overwrite: replace existing files.
        rate: poses per second that are written, interpolated; None for the network's.
        page_port: TCP port of the viewer's page; None for 8080 or the next one that is free.
    """

    targets: tuple[tuple[str, Any], ...]
    rotations: str
    std: bool
    height: float | None
    leg_length: float | None
    overwrite: bool
    rate: float | None
    page_port: int | None

    def __init__(
        self,
        targets: Iterable[tuple[str, Any]] = (),
        *,
        rotations: str = "axis-angle",
        std: bool = False,
        height: float | None = None,
        leg_length: float | None = None,
        overwrite: bool = False,
        rate: float | None = None,
        page_port: int | None = None,
        sinks: Mapping[str, str | list[str]] | None = None,
        **outputs: Any,
    ) -> None:
        """Parse the targets.

        Args:
            targets: outputs as pairs of name and target.
            rotations: representation of rotations in CSV files that do not name their own.
            std: add the network's standard deviations to the CSV.
            height: the wearer's height, metres.
            leg_length: length of the wearer's thigh and shank, metres.
            overwrite: replace existing files.
            rate: poses per second that are written; None for the network's.
            page_port: TCP port of the viewer's page.
            sinks: targets of outputs from other packages (entry points `edgepose.sinks`), by output name; a
                list of them for several.
            **outputs: targets of this package's outputs, as text or parsed; True for `view`. A list stands
                for several outputs of a kind; None and False mean none.

        Raises:
            ConfigError: an output is unknown, given twice or in the wrong place, or a value is invalid.
        """
        pairs = _pairs(targets, outputs, sinks or {})
        check_receivers(("", name, target) for name, target in pairs)
        if rotations not in ROTATION_FORMATS:
            raise ConfigError(
                f"rotations: {rotations!r} is not one of {', '.join(map(repr, ROTATION_FORMATS))}"
            )
        if rate is not None and not RATES[0] <= rate <= RATES[1]:
            raise ConfigError(f"rate: {rate:g} is not from {RATES[0]:g} to {RATES[1]:g} poses per second")
        try:
            check_measures(height, leg_length)
        except EdgeposeError as error:
            raise ConfigError(str(error)) from None
        if page_port is not None and "view" not in dict(pairs):
            raise ConfigError(f"--page-port {page_port} is that of the page of --view: give --view as well")
        if page_port is not None and not 1 <= page_port <= 65535:
            raise ConfigError(f"--page-port {page_port} is not from 1 to 65535")
        values = (tuple(pairs), rotations, std, height, leg_length, overwrite, rate, page_port)
        for each, value in zip(dataclasses.fields(self), values, strict=True):
            object.__setattr__(self, each.name, value)

    @property
    def any(self) -> bool:
        """Whether there is any output."""
        return bool(self.targets)

    @property
    def body(self) -> Body:
        """The wearer's body.

        Raises:
            EdgeposeError: `height` or `leg_length` is impossible.
        """
        height = DEFAULT_HEIGHT if self.height is None else self.height
        return default_body(height, leg_length_m=self.leg_length)

    @property
    def files(self) -> list[tuple[str, str | Path]]:
        """Flag and name of each file that is written."""
        files: list[tuple[str, str | Path]] = []
        for name, target in self._files():
            part = SINKS[name].part
            files.append((f"--{name}", target))
            if part is not None and not is_stream(target):
                files.append((f"--{name} (while it grows)", part(target)))
        return files

    def check(self) -> None:
        """Check that no existing file would be lost.

        Raises:
            EdgeposeError: a file exists already, or cannot be written.
        """
        for name, target in self._files():
            check_output(target, "poses", (SINKS[name].suffix,), self.overwrite)

    def _files(self) -> list[tuple[str, str]]:
        files = [(name, target) for name, target in self.targets if name in SINKS and SINKS[name].suffix]
        return [(name, SINKS[name].file(target)) for name, target in files]


def _pairs(
    targets: Iterable[tuple[str, Any]], outputs: Mapping[str, Any], sinks: Mapping[str, str | list[str]]
) -> list[tuple[str, Any]]:
    """Return the name and the parsed target of each output; see `OutputConfig`."""
    if unknown := outputs.keys() - SINKS.keys():
        raise ConfigError(f"unknown output {min(unknown)!r}; outputs are {', '.join(SINKS)}")
    if own := sinks.keys() & SINKS.keys():
        raise ConfigError(f"{min(own)} is not an output of another package: give --{min(own)}")
    given = [*targets, *((name, outputs[name]) for name in SINKS if name in outputs), *sinks.items()]
    several = [(name, value if isinstance(value, list) else [value]) for name, value in given]
    flat = ((name, value) for name, values in several for value in values)
    pairs = [(name, _target(name, value)) for name, value in flat if value not in (None, False)]
    for i, (name, target) in enumerate(pairs):
        if (name, target) in pairs[:i]:
            what = "" if target is True else " with the same target"
            raise ConfigError(f"the output {name} is given twice{what}")
    return pairs


def _target(name: str, value: Any) -> Any:
    if name not in SINKS:
        return value
    try:
        return SINKS[name].target(value)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def setting_names(config: type) -> tuple[str, ...]:
    """Return the keywords of a configuration class."""
    names = tuple(each.name for each in dataclasses.fields(config))
    return (*SINKS, *names[1:], "sinks") if config is OutputConfig else names


@dataclass(frozen=True, kw_only=True)
class WearerConfig:
    """One wearer of a run.

    Attributes:
        source: the source of samples.
        calibration: file written by `edgepose calibrate`.
        outputs: the outputs for poses.
        filter: orientation filter, one of `edgepose.imu.FILTERS`; None for that of the calibration.
        no_mag: do not use magnetometers in the filter; they are not used either if the calibration did not.
        no_place: do not follow the wearer through the room; poses have no translation.
        no_drift_correction: leave the headings of sensors without a common north as they are.
        control: address to listen on for requests, see `edgepose.pipeline.remote_control`.
        name: the wearer's name in messages; empty for a single wearer.
        path: the TOML file that the configuration was read from, if any.
    """

    source: SourceConfig
    calibration: Path
    outputs: OutputConfig
    filter: str | None = None
    no_mag: bool = False
    no_place: bool = False
    no_drift_correction: bool = False
    control: tuple[str, int] | None = None
    name: str = ""
    path: Path | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError if fields contradict each other."""
        object.__setattr__(self, "calibration", Path(self.calibration))
        if self.filter is not None and self.filter not in FILTERS:
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
            values = {key.replace("-", "_"): _value(key, v, path.parent) for key, v in content.items()}
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

        def take_settings(kind: type) -> dict[str, Any]:
            return {name: values.pop(name) for name in setting_names(kind) if name in values}

        source = SourceConfig(**take_settings(SourceConfig))
        outputs = OutputConfig(**take_settings(OutputConfig))
        if values.get("calibration") is None:
            raise ConfigError("calibration is missing")
        return cls(source=source, outputs=outputs, **values, **more)


# --- TOML ---------------------------------------------------------------------------------------------------

_FILES = ("file", "sensors", "calibration", *(name for name, output in SINKS.items() if output.suffix))
"""Keys whose values are files, relative to the TOML file; that of `protocol` may be one too."""

_KEYS = {
    "port": TEXT,
    "baud": WHOLE,
    "can": TEXT,
    "bitrate": WHOLE,
    "fd": SWITCH,
    "file": TEXT,
    "realtime": SWITCH,
    "protocol": TEXT,
    "sensors": TEXT,
    "listen": TEXT,
    "connect": TEXT,
    "ble": TEXT,
    "hid": TEXT,
    "filter": TEXT,
    "no-mag": SWITCH,
    "calibration": TEXT,
    **{name: SWITCH if output.metavar is None else TEXTS for name, output in SINKS.items()},
    "rotations": TEXT,
    "std": SWITCH,
    "height": NUMBER,
    "leg-length": NUMBER,
    "overwrite": SWITCH,
    "rate": NUMBER,
    "page-port": WHOLE,
    "no-place": SWITCH,
    "no-drift-correction": SWITCH,
    "control": TEXT,
}


def _value(key: str, value: object, folder: Path) -> Any:
    """Convert a value of the TOML file to that of the configuration.

    Raises:
        ConfigError: there is no such key, or the value has the wrong type or is invalid.
    """
    if key == "sinks":
        return texts_by_name(key, value)
    what = _KEYS.get(key)
    if what is None:
        raise ConfigError(f"unknown key {key!r}; {choices(key, ['name', *_KEYS, 'sinks'], 'keys are')}")
    value = checked_value(key, value, what)
    if isinstance(value, list):
        return [_text(key, item, folder) for item in value]
    return _text(key, value, folder) if isinstance(value, str) else value


def _text(key: str, value: str, folder: Path) -> Any:
    if key in _FILES and value != "-":
        value = str(folder / value)
    if key in ("file", "sensors", "calibration"):
        return Path(value)
    try:
        if key == "protocol":
            return str(folder / value) if value.endswith(".toml") else checked_protocol(value)
        return parse_host_and_port(value) if key == "control" else value
    except EdgeposeError as error:
        raise ConfigError(f"{key}: {error}") from None
