"""LP-Research LPMS: LPBUS frames over a serial line (USB, UART, Bluetooth SPP).

The layout is in docs/lpms.md. Everything is little-endian. A frame does not say which quantities it holds:
they are a setting of the sensor, which has to be passed to the decoder. Its length shows the kind of numbers.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterable

from firmware_protocols._numbers import number, vector
from firmware_protocols._stream import StreamDecoder
from firmware_protocols.base import Protocol, uncounted
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample, Vector3, unit_quaternion

SENSOR_DATA = 9
"""Command of a measurement."""

MAX_DATA = 256
"""Limit of the data in a frame, bytes; a measurement with all quantities has 108."""

TICK_US = 2500
"""Step of the time, microseconds."""

# Number of values of each quantity and int16 steps per unit, in wire order.
_QUANTITIES = {
    "gyr": (3, 1000),  # rad/s, as measured
    "acc": (3, 1000),  # g
    "mag": (3, 100),  # uT
    "rate": (3, 1000),  # rad/s, after the filter
    "quat": (4, 10000),
    "euler": (3, 10000),
    "linear": (3, 1000),  # g, without gravity
    "pressure": (1, 100),
    "altitude": (1, 10),
    "temperature": (1, 100),  # degC
}

FIELDS = tuple(_QUANTITIES)
"""Quantities that a sensor can send."""

USUAL_FIELDS = ("gyr", "acc", "mag", "quat")
"""Quantities that sensors should be set to send."""

_NAMES = {"gyr": "angular rate", "acc": "acceleration", "mag": "field", "quat": "quaternion"}

_HEAD = struct.Struct("<3H")
_START_BYTE, _END = b"\x3a", b"\r\n"
_OVERHEAD = 1 + _HEAD.size + 2 + len(_END)


def _layout(fields: Iterable[str], floats: bool) -> tuple[tuple[str, ...], struct.Struct]:
    """Return the quantities in wire order, and the layout of time and values."""
    wanted = tuple(fields)
    unknown = [name for name in wanted if name not in FIELDS]
    if unknown or not wanted:
        raise ValueError(f"fields must be among {', '.join(FIELDS)}, not {', '.join(unknown) or 'none'}")
    names = tuple(name for name in FIELDS if name in wanted)
    count = sum(_QUANTITIES[name][0] for name in names)
    return names, struct.Struct(f"<I{count}{'f' if floats else 'h'}")


class LpmsDecoder(StreamDecoder):
    """Decoder for the sensors on a line; `sensor` is the id in the frame (OpenMAT id).

    On the wire, the orientation maps inertial to sensor and the acceleration points down at rest: the decoder
    inverts both.
    """

    WRAP_US = (1 << 32) * TICK_US
    _START = re.compile(_START_BYTE)

    def __init__(self, fields: Iterable[str] = USUAL_FIELDS) -> None:
        """Create the decoder.

        Args:
            fields: quantities that the sensors are set to send, out of FIELDS, in any order.

        Raises:
            ValueError: unknown fields.
        """
        super().__init__()
        names, as_floats = _layout(fields, True)
        _, as_integers = _layout(fields, False)
        self._layouts = {
            as_floats.size: (as_floats, dict.fromkeys(names, 1.0)),
            as_integers.size: (as_integers, {name: 1.0 / _QUANTITIES[name][1] for name in names}),
        }
        self._other_lengths: Counter[int] = Counter()
        self._index_of: dict[str, int] = {}
        at = 1
        for name in names:
            self._index_of[name] = at
            at += _QUANTITIES[name][0]
        self._rate = "rate" if "rate" in names else "gyr"

    def _length(self, buffer: bytes, at: int) -> int:
        if len(buffer) - at < 1 + _HEAD.size:
            return 0
        length = buffer[at + 5] | buffer[at + 6] << 8
        return length + _OVERHEAD if length <= MAX_DATA else -1

    def _intact(self, buffer: bytes, at: int, length: int) -> bool:
        end = at + length
        total = sum(buffer[at + 1 : end - 4]) & 0xFFFF
        return buffer[end - 2 : end] == _END and total == buffer[end - 4] | buffer[end - 3] << 8

    def _message(self, frame: bytes, samples: list[Sample]) -> None:
        sensor, command, length = _HEAD.unpack_from(frame, 1)
        if command != SENSOR_DATA:
            self.counters.skipped += 1
            return
        if length not in self._layouts:  # the sensor is set to send other quantities
            self._other_lengths[length] += 1
            self.counters.bad += 1
            return
        layout, scale = self._layouts[length]
        v = layout.unpack_from(frame, 1 + _HEAD.size)
        quat: Quaternion | None = None
        at = self._index_of.get("quat")
        if at is not None:
            s = scale["quat"]
            quat = unit_quaternion(v[at] * s, -v[at + 1] * s, -v[at + 2] * s, -v[at + 3] * s)
        acc = self._vector(v, "acc", scale, -STANDARD_G)
        gyr = self._vector(v, self._rate, scale)
        mag = self._vector(v, "mag", scale)
        temperature = None
        at = self._index_of.get("temperature")
        if at is not None:
            temperature = number(v[at] * scale["temperature"])
        self._emit(Sample(sensor, v[0] * TICK_US, quat, acc, gyr, mag, temperature), samples)

    def _vector(
        self, v: tuple[float, ...], name: str, scale: dict[str, float], unit: float = 1.0
    ) -> Vector3 | None:
        at = self._index_of.get(name)
        if at is None:
            return None
        return vector(v[at : at + 3], scale[name] * unit)

    @property
    def refused(self) -> str | None:
        """Measurements whose length shows that they hold other quantities."""
        if not self._other_lengths:
            return None
        (length, _), *_ = self._other_lengths.most_common(1)
        floats, integers = self._layouts
        names = [_NAMES.get(name, name) for name in self._index_of]
        return (
            f"{sum(self._other_lengths.values())} measurements came whole, but with {length} bytes instead "
            f"of {floats} (floats) or {integers} (16 bit): set the sensor to send {', '.join(names[:-1])} "
            f"and {names[-1]}, and nothing else"
        )


def encode(sample: Sample, fields: Iterable[str] = USUAL_FIELDS, floats: bool = True) -> bytes:
    """Return the frame of a sample; see `LpmsDecoder` for the settings. Missing quantities are sent as zeros.

    Raises:
        ValueError: unknown fields, or a number that does not fit.
    """
    names, layout = _layout(fields, floats)
    w, x, y, z = sample.quat or (0.0, 0.0, 0.0, 0.0)
    known: dict[str, tuple[float, ...] | None] = {
        "gyr": sample.gyr,
        "acc": sample.acc and tuple(-value / STANDARD_G for value in sample.acc),
        "mag": sample.mag,
        "rate": sample.gyr,
        "quat": (w, -x, -y, -z),
        "temperature": None if sample.temperature is None else (sample.temperature,),
    }
    values: list[float] = []
    for name in names:
        count, steps = _QUANTITIES[name]
        numbers = known.get(name) or (0.0,) * count
        values += numbers if floats else (max(-32768, min(32767, round(n * steps))) for n in numbers)
    try:
        data = layout.pack((sample.time_us or 0) // TICK_US & 0xFFFFFFFF, *values)
        body = _HEAD.pack(sample.sensor, SENSOR_DATA, len(data)) + data
    except (struct.error, OverflowError) as error:
        raise ValueError(f"cannot send {sample}: {error}") from None
    return _START_BYTE + body + (sum(body) & 0xFFFF).to_bytes(2, "little") + _END


PROTOCOL = Protocol(
    name="lpms",
    transport="bytes",
    default_bitrate=115200,
    description="LP-Research LPMS",
    decoder=LpmsDecoder,
    encoder=uncounted(encode),
    ids=range(1, 7),
    single_device=True,
    setup="rate, acceleration, field, quaternion, and nothing else",
)
