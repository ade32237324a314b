"""The wire formats by name: what a line of a format is, how it is read, how it is written for simulation.

A family's module is imported when a decoder or an encoder of it is made, not before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal
from typing import Protocol as Interface

from firmware_protocols.sample import Counters, Sample

Frame = tuple[int, bytes, bool, bool]
"""Identifier, data, whether the identifier has 29 bits, whether it is CAN FD."""

Encode = Callable[[Sample, int], Any]
"""Bytes, or a list of Frames on CAN, of a sample and its sensor's count of samples."""


class Decoder(Interface):
    """What every decoder has, see `sample.py`."""

    counters: Counters
    WRAP_US: int
    feed: Callable[..., list[Sample]]


@dataclass(frozen=True)
class Protocol:
    """One wire format.

    Attributes:
        name: as a user types it.
        transport: "bytes" of a serial line or frames on a "can" bus.
        speed: usual baud or bit rate as the devices are delivered, bit/s.
        text: what it is, one line.
        decoder: makes a decoder with nothing seen.
        encoder: makes a function that encodes samples; one for each line, as some count for themselves. Where
            a device has an id on its line, `sample.sensor` is it. None where the format is only read.
        ids: ids of six devices on one line when nothing else is said; empty where nothing is usual.
        alone: a device usually has a line to itself.
        request: what has to be sent to the device with an id for one sample, and the length of its answer,
            where devices speak only when asked.
    """

    name: str
    transport: Literal["bytes", "can"]
    speed: int
    text: str
    decoder: Callable[[], Decoder]
    encoder: Callable[[], Encode] | None
    ids: Sequence[int] = ()
    alone: bool = False
    request: Callable[[int], tuple[bytes, int]] | None = None

    @property
    def wrap_us(self) -> int:
        """Where the time of its samples starts again at 0, microseconds."""
        return self.decoder().WRAP_US

    def encode(self, sample: Sample, seq: int) -> Any:
        """`encoder()(sample, seq)`, for formats without a count of their own.

        Raises:
            ValueError: the format is only read.
        """
        if self.encoder is None:
            raise ValueError(f"{self.name} is only read")
        return self.encoder()(sample, seq)


def _module(name: str) -> Any:
    return import_module(f"firmware_protocols.{name}")


def _made(module: str, name: str, *words: Any) -> Callable[[], Any]:
    """A function that makes something of a module that is imported only then."""
    return lambda: getattr(_module(module), name)(*words)


# --- encoders -------------------------------------------------------------------------------------


def _packet(sample: Sample, seq: int) -> Any:
    sensor, time_us, *quantities = sample
    return _module("native").Packet(sensor, seq & 0xFFFF, (time_us or 0) & 0xFFFFFFFF, *quantities)


def _native() -> Encode:
    encode = _module("native").encode
    return lambda sample, seq: encode(_packet(sample, seq))


def _native_can() -> Encode:
    module = _module("native_can")

    def encode(sample: Sample, seq: int) -> list[Frame]:
        # The whole time: a wrap at 2^32 us would be a jump in the 16 bit time.
        packet = _packet(sample, seq)._replace(t_us=sample.time_us or 0)
        return [(can_id, data, False, False) for can_id, data in module.encode(packet)]

    return encode


def _xsens() -> Encode:
    return _module("xsens").encode_mtdata2


_XSENS_STEP = 0x100


def _xsens_ids() -> dict[int, dict[str, int]]:
    """CAN ids of six devices: those as delivered, plus 0x100 for each sensor before.

    All fit in 11 bits and stay clear of CANopen's process data of low node ids.
    """
    ids = _module("xsens").MTI600_IDS
    return {
        sensor: {kind: can_id + _XSENS_STEP * sensor for kind, can_id in ids.items()} for sensor in range(6)
    }


def _xsens_can_decoder() -> Decoder:
    return _module("xsens").Mti600CanDecoder(ids=_xsens_ids())


def _xsens_can() -> Encode:
    encode_mti600, ids = _module("xsens").encode_mti600, _xsens_ids()
    return lambda sample, seq: [
        (can_id, data, False, False)
        for can_id, data in encode_mti600(sample, seq & 0xFFFF, ids=ids[sample.sensor])
    ]


def _without_count(module: str, name: str, *words: Any) -> Callable[[], Encode]:
    """Encoder of a format whose samples have no count."""

    def make() -> Encode:
        encode = getattr(_module(module), name)
        return lambda sample, seq: encode(sample, *words)

    return make


def _without_fd(module: str, name: str) -> Callable[[], Encode]:
    """Encoder of a CAN 2.0 format whose samples have no count."""

    def make() -> Encode:
        encode = getattr(_module(module), name)
        return lambda sample, seq: [(*frame, False) for frame in encode(sample)]

    return make


def _bno08x() -> Encode:
    return _module("bno08x").encode


def _mavlink() -> Encode:
    encoder = _module("mavlink").Encoder()  # counts for itself
    return lambda sample, seq: encoder.encode(sample)


def _text(pattern: str) -> Callable[[], Encode]:
    def make() -> Encode:
        module = _module("text")

        def encode(sample: Sample, seq: int) -> bytes:
            header: bytes = b"" if seq else module.encode_header(pattern)
            return header + module.encode(sample, pattern)

        return encode

    return make


def _wit_request(sensor: int) -> tuple[bytes, int]:
    module = _module("witmotion")
    return module.poll(sensor), 5 + 2 * module.ANGLE_REGISTERS


# --- table ----------------------------------------------------------------------------------------

_WIT_IDS = range(0x50, 0x56)
_vectornav = _made("vectornav", "VectorNavDecoder")

PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            "native",
            "bytes",
            115200,
            "edgepose's own packet: COBS and CRC-16, many sensors on one line",
            _made("native", "Decoder"),
            _native,
            ids=range(6),
        ),
        Protocol(
            "native-can",
            "can",
            500_000,
            "edgepose's own packet on CAN 2.0 and CAN FD",
            _made("native_can", "NativeCanDecoder"),
            _native_can,
            ids=range(6),
        ),
        Protocol(
            "xsens",
            "bytes",
            115200,
            "Xsens / Movella MTi: Xbus with MTData2; ids are bus ids behind a master",
            _made("xsens", "XbusDecoder"),
            _xsens,
            ids=range(1, 7),
            alone=True,
        ),
        Protocol(
            "xsens-can",
            "can",
            250_000,
            "Xsens / Movella MTi-600 on CAN; sensor n has the ids as delivered plus n times 0x100",
            _xsens_can_decoder,
            _xsens_can,
            ids=range(6),
        ),
        Protocol(
            "hipnuc",
            "bytes",
            115200,
            "HiPNUC HI2xx, CH0x0, CH10x, HI221 and its wireless receiver",
            _made("hipnuc", "HipnucDecoder"),
            _without_count("hipnuc", "encode"),
            ids=range(6),
            alone=True,
        ),
        Protocol(
            "hipnuc-canopen",
            "can",
            500_000,
            "HiPNUC CANopen process data; ids are node ids",
            _made("hipnuc", "HipnucCanopenDecoder"),
            _without_fd("hipnuc", "encode_canopen"),
            ids=range(1, 7),
        ),
        Protocol(
            "hipnuc-j1939",
            "can",
            500_000,
            "HiPNUC J1939 groups, CAN 2.0 and CAN FD; ids are source addresses",
            _made("hipnuc", "HipnucJ1939Decoder"),
            _without_fd("hipnuc", "encode_j1939"),
            ids=range(1, 7),
        ),
        Protocol(
            "witmotion",
            "bytes",
            9600,
            "WitMotion standard protocol: WT61, WT901, HWT901B, HWT905",
            _made("witmotion", "WitDecoder"),
            _without_count("witmotion", "encode"),
            alone=True,
        ),
        Protocol(
            "witmotion-modbus",
            "bytes",
            9600,
            "WitMotion on RS-485; ids are Modbus addresses, which are asked in turn",
            _made("witmotion", "WitModbusDecoder"),
            _without_count("witmotion", "encode_modbus"),
            ids=_WIT_IDS,
            request=_wit_request,
        ),
        Protocol(
            "witmotion-can",
            "can",
            250_000,
            "WitMotion on CAN; ids are CAN ids",
            _made("witmotion", "WitCanDecoder"),
            _without_fd("witmotion", "encode_can"),
            ids=_WIT_IDS,
        ),
        Protocol(
            "ximu3",
            "bytes",
            115200,
            "x-io x-IMU3, ASCII and binary; ids are channels of multiplexed messages",
            _made("ximu3", "Decoder"),
            _without_count("ximu3", "encode"),
            alone=True,
        ),
        Protocol(
            "haritorax",
            "bytes",
            500_000,
            "HaritoraX trackers, by a GX dongle or wired; ids are slots of the dongle",
            _made("haritorax", "Decoder"),
            _without_count("haritorax", "encode"),
            ids=range(6),
        ),
        Protocol(
            "lpms",
            "bytes",
            115200,
            "LP-Research LPMS, set to send rate, acceleration, field and quaternion as f32",
            _made("lpms", "LpmsDecoder"),
            _without_count("lpms", "encode"),
            ids=range(1, 7),
            alone=True,
        ),
        Protocol(
            "bno08x-rvc",
            "bytes",
            115200,
            "BNO08x in UART-RVC mode: angles without a common heading, acceleration",
            _made("bno08x", "Decoder"),
            _bno08x,
            alone=True,
        ),
        Protocol(
            "mip",
            "bytes",
            115200,
            "MicroStrain MIP: 3DM-GX, 3DM-CV",
            _made("mip", "MipDecoder"),
            _without_count("mip", "encode"),
            alone=True,
        ),
        Protocol(
            "vectornav",
            "bytes",
            115200,
            "VectorNav binary outputs (reads the ASCII lines too)",
            _vectornav,
            _without_count("vectornav", "encode_binary"),
            alone=True,
        ),
        Protocol(
            "vectornav-ascii",
            "bytes",
            115200,
            "VectorNav ASCII lines (reads the binary outputs too)",
            _vectornav,
            _without_count("vectornav", "encode_ascii", "VNQMR"),
            alone=True,
        ),
        Protocol(
            "adafruit",
            "bytes",
            115200,
            'text lines "Quaternion: w, x, y, z" of sketches for Adafruit\'s libraries',
            _made("text", "Decoder", "adafruit"),
            _text("adafruit"),
            alone=True,
        ),
        Protocol(
            "razor",
            "bytes",
            57600,
            'text lines "#YPR=" of the Razor AHRS firmware',
            _made("text", "Decoder", "razor"),
            _text("razor"),
            alone=True,
        ),
        Protocol(
            "openlog",
            "bytes",
            115200,
            "text lines of OpenLog Artemis as delivered, without orientation",
            _made("text", "Decoder", "artemis"),
            _text("artemis"),
            alone=True,
        ),
        Protocol(
            "openlog-dmp",
            "bytes",
            115200,
            "text lines of OpenLog Artemis with the sensor's own orientation",
            _made("text", "Decoder", "artemis-dmp"),
            _text("artemis-dmp"),
            alone=True,
        ),
        Protocol(
            "mavlink",
            "bytes",
            57600,
            "MAVLink 1 and 2 (needs pymavlink); ids are system id << 8 | component id",
            _made("mavlink", "Decoder"),
            _mavlink,
            ids=[system << 8 | 1 for system in range(1, 7)],
            alone=True,
        ),
    )
}
"""All wire formats by name."""
