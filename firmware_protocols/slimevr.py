"""SlimeVR trackers over UDP: a decoder for one tracker, and the host that trackers call for.

Layouts are in docs/slimevr.md. A tracker broadcasts a handshake until a host answers, and calls again after
three seconds without a word from it. Orientations and accelerations without gravity come in separate packets,
in one packet, or bundled; there is no time.
"""

from __future__ import annotations

import struct
from collections.abc import Hashable, Iterator
from math import isfinite

from firmware_protocols import rotation
from firmware_protocols._numbers import int16, vector
from firmware_protocols._recent import BoundedDict
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Encode, Protocol
from firmware_protocols.sample import STANDARD_G, Quaternion, Sample, Vector3, unit_quaternion

PORT = 6969
"""UDP port that trackers call."""

VERSION = 22
"""Protocol version from which accelerations have the axes of the orientation on every board."""

_HEARTBEAT, _KEEP_ALIVE, _HANDSHAKE, _ACCELERATION, _PING = 0, 1, 3, 4, 10
_SENSOR_INFO, _ROTATION_1, _ROTATION, _FEATURES, _BOTH = 15, 16, 17, 22, 23
_BUNDLE, _COMPACT = 100, 101
_KINDS = frozenset({*range(27), _BUNDLE, _COMPACT, 102, 105, 200})

_HEADER = struct.Struct(">IQ")
_QUAT = struct.Struct(">4f")
_VECTOR = struct.Struct(">3f")
_SHORTS = struct.Struct(">7h")
_VERSION_AT = 36  # in a handshake
_NORMAL = 1  # kind of rotation; others are corrections by the magnetometer

_NEAR = 64  # a number that is farther away from the last one is that of a tracker that has restarted
_MAX_G = 100.0 * STANDARD_G


class SlimevrDecoder(Receiver):
    """Decoder for the datagrams of one tracker, one `feed` for each.

    Samples have the orientation, and the acceleration with gravity added back. `sensor` is 0 for the tracker
    itself, 1 and more for the extensions on its cables. An orientation waits for the acceleration that its
    sensor sends next, as long as the sensor sends any.
    """

    WRAP_US = 1 << 64

    def __init__(self) -> None:
        """Create the decoder, for a tracker of the present version until a handshake says otherwise."""
        super().__init__()
        self._version = VERSION
        self._calls = 0  # handshakes so far
        self._mac = ""
        self._last: int | None = None  # number of the last datagram
        self._jumped = False  # it did not follow the one before it
        self._held: BoundedDict[int, Quaternion] = BoundedDict()
        self._accelerated: BoundedDict[int, bool] = BoundedDict()  # whether a sensor sends accelerations

    @property
    def refused(self) -> str | None:
        """See `Decoder.refused`: calls without an answer, or accelerations with the axes of the chip."""
        if self._calls > 1 and not self.counters.packets:
            return (
                f"the tracker {self._mac} calls and gets no answer: give --protocol slimevr, or check the "
                "firewall"
            )
        if self._version >= VERSION:
            return None
        return (
            f"the tracker's firmware has protocol {self._version}: its accelerations are right only on "
            f"SlimeVR's own boards; update it to {VERSION} or later"
        )

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples that a datagram completes."""
        self.counters.bytes += len(data)
        if len(data) < _HEADER.size:
            return self._count_bad()
        kind, number = _HEADER.unpack_from(data)
        if kind not in _KINDS:
            return self._count_bad()
        if kind == _HANDSHAKE:
            return self._start(data)
        if not self._is_new(number):
            return []
        parts: list[tuple[int, Quaternion | None, Vector3 | None]] = []
        for inner, content in _packets(kind, data):
            found = self._part(inner, content)
            if found is None:
                self._count_bad()
            elif found[1] is None and found[2] is None:
                self.counters.skipped += 1
            else:
                self._count_good()
                parts.append(found)
        samples: list[Sample] = []
        for part in _joined(parts):
            self._take(*part, samples)
        return samples

    def flush(self) -> list[Sample]:
        """Return the orientations that still wait for their acceleration."""
        samples: list[Sample] = []
        for sensor, quat in self._held.items():
            self._emit(Sample(sensor, None, quat), samples)
        self._held.clear()
        return samples

    def _start(self, data: bytes) -> list[Sample]:
        """Begin again at a handshake; one that is cut short has no version."""
        version = data[_VERSION_AT : _VERSION_AT + 4]
        self._version = int.from_bytes(version, "big") if len(version) == 4 else 0
        self._calls += 1
        self._mac = mac_of(data)
        self._last = None
        self._held.clear()
        self.counters.skipped += 1
        return []

    def _is_new(self, number: int) -> bool:
        """Return whether a datagram is not late, and count those lost before it.

        A number that does not follow its predecessor may be forged: it makes no later datagram late.
        """
        step = 1 if self._last is None else number - self._last
        if -_NEAR <= step <= 0 and not self._jumped:
            self.counters.late += 1
            return False
        self._last, self._jumped = number, step != 1
        if abs(step) > _NEAR:
            self.counters.restarts += 1
        else:
            self.counters.lost += max(step - 1, 0)
        return True

    def _part(self, kind: int, data: bytes) -> tuple[int, Quaternion | None, Vector3 | None] | None:
        """Return sensor, orientation and acceleration of a packet without its header; None if it is bad."""
        nothing = (0, None, None)
        if kind == _ROTATION:
            if len(data) < 18:
                return None
            if data[1] != _NORMAL:
                return nothing
            quat = unit_quaternion(*_scalar_first(_QUAT.unpack_from(data, 2)))
            return None if quat is None else (data[0], quat, None)
        if kind in (_KEEP_ALIVE, _ROTATION_1):  # of old firmware and phones
            if len(data) < _QUAT.size:
                return None
            quat = unit_quaternion(*_scalar_first(_QUAT.unpack_from(data)))
            return None if quat is None else (int(kind == _ROTATION_1), quat, None)
        if kind == _ACCELERATION:
            if len(data) < _VECTOR.size:
                return None
            acc = self._acceleration(_VECTOR.unpack_from(data), 1.0)
            return None if acc is None else (data[12] if len(data) > 12 else 0, None, acc)
        if kind == _BOTH:
            if len(data) < 1 + _SHORTS.size:
                return None
            x, y, z, w, *shorts = _SHORTS.unpack_from(data, 1)
            scale = 1.0 / 32768.0
            quat = unit_quaternion(w * scale, x * scale, y * scale, z * scale)
            acc = self._acceleration(tuple(shorts), 1.0 / 128.0)
            return None if quat is None or acc is None else (data[0], quat, acc)
        return nothing

    def _acceleration(self, values: tuple[float, ...], scale: float) -> Vector3 | None:
        acc = vector(values, scale)
        if acc is None or max(map(abs, acc)) > _MAX_G:
            return None
        # Until version 22 it had the chip's axes, which official boards turn by -90 degrees about Z.
        return acc if self._version >= VERSION else (acc[1], -acc[0], acc[2])

    def _take(self, sensor: int, quat: Quaternion | None, acc: Vector3 | None, samples: list[Sample]) -> None:
        """Append the samples that an orientation, an acceleration or both complete."""
        held = self._held.pop(sensor, None)
        if quat is not None and held is not None:
            self._emit(Sample(sensor, None, held), samples)
            self._accelerated[sensor] = False
        if acc is not None:
            self._accelerated[sensor] = True
        if quat is None:
            quat = held
        if quat is None:
            self.counters.skipped += 1
        elif acc is not None:
            a, b, c = rotation.rotate_back(quat, (0.0, 0.0, STANDARD_G))
            self._emit(Sample(sensor, None, quat, (acc[0] + a, acc[1] + b, acc[2] + c)), samples)
        elif self._accelerated.get(sensor, True):
            self._held[sensor] = quat
        else:
            self._emit(Sample(sensor, None, quat), samples)


def mac_of(datagram: bytes) -> str:
    """Return the MAC address in a handshake, such as "5c:cf:7f:00:00:01"; "" if it is none or has none."""
    if int.from_bytes(datagram[:4], "big") != _HANDSHAKE or len(datagram) <= _VERSION_AT + 4:
        return ""
    at = _VERSION_AT + 5 + datagram[_VERSION_AT + 4]
    mac = datagram[at : at + 6]
    return mac.hex(":") if len(mac) == 6 and any(mac) else ""


def _scalar_first(xyzw: tuple[float, ...]) -> tuple[float, float, float, float]:
    x, y, z, w = xyzw
    return w, x, y, z


def _packets(kind: int, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the packets in a datagram; a bundle that is cut short yields a bad one."""
    at = _HEADER.size
    if kind not in (_BUNDLE, _COMPACT):
        yield kind, data[at:]
        return
    length_size, kind_size = (2, 4) if kind == _BUNDLE else (1, 1)
    while at < len(data):
        start = at + length_size
        at = start + int.from_bytes(data[at:start], "big")
        if at == start:
            continue
        content = start + kind_size
        if at > len(data) or content > at:
            yield _ROTATION, b""
            return
        yield int.from_bytes(data[start:content], "big"), data[content:at]


def _joined(
    parts: list[tuple[int, Quaternion | None, Vector3 | None]],
) -> list[tuple[int, Quaternion | None, Vector3 | None]]:
    """Join orientation and acceleration of a sensor that came in one datagram, in either order."""
    result: list[tuple[int, Quaternion | None, Vector3 | None]] = []
    for sensor, quat, acc in parts:
        if result and result[-1][0] == sensor:
            _, before, acc_before = result[-1]
            if (before is None) != (quat is None) and (acc_before is None) != (acc is None):
                result[-1] = (sensor, before or quat, acc_before or acc)
                continue
        result.append((sensor, quat, acc))
    return result


# --- the host -------------------------------------------------------------------------------------

KEEP_ALIVE_S = 0.5
"""Time between two keep-alive messages to a tracker, seconds; it gives up after 3 s without any."""

UNHEARD_S = 1.0
"""Time without a datagram after which keep-alives pause, seconds: a tracker replies to each of them.

An address in a handshake may be forged, so what is sent there stays in proportion to what came.
"""

GONE_S = 10.0
"""Time without a datagram after which a tracker is forgotten, seconds."""

MAX_TRACKERS = 64
"""Number of trackers that are answered."""

ANSWER = bytes([_HANDSHAKE]) + b"Hey OVR =D 5" + bytes(51)
_ALIVE = _HEADER.pack(_KEEP_ALIVE, 0)
_BUNDLES = _HEADER.pack(_FEATURES, 0) + b"\x03"  # both kinds of bundle are understood


class SlimevrHost:
    """The part of SlimeVR's server that keeps trackers sending.

    Datagrams are for the decoder only after a handshake, which tells the version. A tracker that was sending
    to an earlier host calls again when that has been silent for three seconds.
    """

    def __init__(self) -> None:
        """Start without trackers."""
        self._trackers: dict[Hashable, list[float]] = {}  # times of last datagram and next keep-alive
        self._macs: dict[Hashable, str] = {}
        self._next_s = 0.0

    def receive(self, datagram: bytes, tracker: Hashable, now_s: float) -> tuple[bool, bytes]:
        """See `Host.receive`."""
        if len(datagram) < _HEADER.size:
            return True, b""  # counted as bad by the decoder
        kind = int.from_bytes(datagram[:4], "big")
        known = self._trackers.get(tracker)
        if kind == _HANDSHAKE:
            # A short one may be forged, to have the longer answer sent to somebody else.
            full = len(datagram) > _VERSION_AT + 4
            if not full or (known is None and len(self._trackers) >= MAX_TRACKERS):
                return False, b""
            self._trackers[tracker] = [now_s, now_s + KEEP_ALIVE_S]
            self._macs[tracker] = mac_of(datagram)
            self._next_s = min(self._next_s, now_s + KEEP_ALIVE_S)
            return True, ANSWER
        if known is None:
            return kind not in _KINDS, b""
        known[0] = now_s
        if kind == _SENSOR_INFO and len(datagram) >= 14:
            return True, _SENSOR_INFO.to_bytes(4, "big") + datagram[12:14]
        return True, _BUNDLES if kind == _FEATURES else b""

    def identity(self, datagram: bytes, tracker: Hashable) -> str:
        """See `Host.identity`: the MAC address that is in the handshake."""
        return mac_of(datagram) or self._macs.get(tracker, "")

    def due(self, now_s: float) -> list[tuple[Hashable, bytes]]:
        """See `Host.due`."""
        if now_s < self._next_s:
            return []
        messages: list[tuple[Hashable, bytes]] = []
        for tracker, (heard_s, due_s) in list(self._trackers.items()):
            if now_s - heard_s > GONE_S:
                del self._trackers[tracker], self._macs[tracker]
            elif now_s >= due_s:
                self._trackers[tracker][1] = now_s + KEEP_ALIVE_S
                if now_s - heard_s <= UNHEARD_S:
                    messages.append((tracker, _ALIVE))
        self._next_s = min((due_s for _, due_s in self._trackers.values()), default=now_s + KEEP_ALIVE_S)
        return messages


# --- for simulation -------------------------------------------------------------------------------


def encode_handshake(mac: bytes, version: int = VERSION, firmware: str = "edgepose") -> bytes:
    """Return the datagram with which a tracker calls for a host."""
    text = firmware.encode("ascii")
    head = _HEADER.pack(_HANDSHAKE, 0) + struct.pack(">7I", 0, 0, 0, 0, 0, 0, version)
    return head + bytes([len(text)]) + text + mac


def encode_sensor_info(number: int, sensor: int = 0) -> bytes:
    """Return the datagram that announces a sensor that works, a BNO085."""
    return _HEADER.pack(_SENSOR_INFO, number) + bytes([sensor, 1, 4])


def encode(sample: Sample, number: int, *, compact: bool = False) -> bytes:
    """Return a bundle with the orientation and, if there is one, the acceleration of a sample.

    Args:
        sample: the sample.
        number: number of the datagram.
        compact: send 16 bit integers instead of binary32.

    Raises:
        ValueError: the sample has no orientation, or a value that cannot be sent.
    """
    if sample.quat is None or not 0 <= sample.sensor < 256:
        raise ValueError("a SlimeVR packet needs an orientation and an id below 256")
    w, x, y, z = sample.quat
    force = sample.acc
    acc = None
    if force is not None:
        gravity = rotation.rotate_back(sample.quat, (0.0, 0.0, STANDARD_G))
        acc = tuple(f - g for f, g in zip(force, gravity, strict=True))
    if not all(map(isfinite, (w, x, y, z, *(acc or ())))):
        raise ValueError(f"cannot send {sample}")
    if compact:
        shorts = [int16(32768.0 * q) for q in (x, y, z, w)] + [int16(128.0 * a) for a in acc or (0.0,) * 3]
        inner = bytes([_BOTH, sample.sensor]) + _SHORTS.pack(*shorts)
        return _HEADER.pack(_COMPACT, number) + bytes([len(inner)]) + inner
    try:
        packets = [struct.pack(">IBB4fB", _ROTATION, sample.sensor, _NORMAL, x, y, z, w, 0)]
        if acc is not None:
            packets.append(struct.pack(">I3fB", _ACCELERATION, *acc, sample.sensor))
    except OverflowError as error:
        raise ValueError(f"cannot send {sample}: {error}") from None
    bundle = b"".join(len(packet).to_bytes(2, "big") + packet for packet in packets)
    return _HEADER.pack(_BUNDLE, number) + bundle


def _encoder() -> Encode:
    return encode


PROTOCOL = Protocol(
    name="slimevr",
    transport="udp",
    default_bitrate=0,
    description="SlimeVR trackers; ids are those of a tracker's own sensor, 0, and of its extensions",
    decoder=SlimevrDecoder,
    encoder=_encoder,
    single_device=True,
    common_heading=False,
    host=SlimevrHost,
    lacks=["time"],
    setup="firmware of protocol 22 or later; no other SlimeVR server on the network",
)
