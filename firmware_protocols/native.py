"""The native packet of self-built sensors, serial form: COBS(body + CRC-16) + 00.

Layouts are in README.md next to this file; `c/edgepose_packet.h` is the sender for firmware.
"""

from __future__ import annotations

from binascii import crc_hqx

from firmware_protocols._sequence import Sequence
from firmware_protocols._stream import Receiver
from firmware_protocols.base import Encode, Protocol
from firmware_protocols.native_packet import (
    DATA_TYPE,
    INFO_TYPE,
    MAX_BODY,
    Info,
    Packet,
    decode_body,
    encode_body,
    encode_info_body,
    packet_of,
)
from firmware_protocols.sample import Sample

MAX_FRAME = MAX_BODY + 2 + 1
"""Longest frame without its closing 00, bytes: body, CRC, one byte that COBS adds."""


# --- framing --------------------------------------------------------------------------------------


def cobs_encode(data: bytes) -> bytes:
    """Consistent Overhead Byte Stuffing: the same bytes without any 00, and without the closing 00."""
    out = bytearray()
    runs = data.split(b"\0")
    for last, run in zip([False] * (len(runs) - 1) + [True], runs, strict=True):
        start = 0
        while len(run) - start >= 254:
            out.append(255)
            out += run[start : start + 254]
            start += 254
        # A full block stands for no 00, so the end of the data after one needs no code byte of its own.
        if not last or start < len(run) or not start:
            out.append(len(run) - start + 1)
            out += run[start:]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """Inverse of `cobs_encode`.

    Raises:
        ValueError: data contains a 00 or ends inside a block.
    """
    if 0 in data:
        raise ValueError("COBS data contains a zero byte")
    out = bytearray(data)
    after_full = []
    code_at, end = 0, len(data)
    while code_at < end:
        code = data[code_at]
        out[code_at] = 0
        code_at += code
        if code == 255:
            after_full.append(code_at)
    if code_at > end:
        raise ValueError("COBS data ends inside a block")
    # Each code byte stands for a 00, except the first one and those behind a full block.
    for code_at in reversed(after_full):
        del out[code_at : code_at + 1]
    return bytes(out[1:])


def frame_body(body: bytes) -> bytes:
    """The bytes that go over the line for a body: checksum, COBS, closing 00."""
    return cobs_encode(body + crc_hqx(body, 0xFFFF).to_bytes(2, "little")) + b"\0"


def encode(packet: Packet, *, floats: bool = False) -> bytes:
    """The bytes that go over the line for a measurement; see `encode_body`."""
    return frame_body(encode_body(packet, floats=floats))


def encode_info(info: Info) -> bytes:
    """The bytes that go over the line for an INFO packet; see `encode_info_body`."""
    return frame_body(encode_info_body(info))


# --- the stream -----------------------------------------------------------------------------------


class NativeReceiver(Receiver):
    """What the serial and the CAN decoder do alike: count, keep INFO and battery, drop late messages.

    Attributes:
        infos: the last INFO packet of each sensor id.
        batteries: the last charge in percent and status bits of each sensor id that sends them.
    """

    def __init__(self) -> None:
        """Start with nothing seen."""
        super().__init__()
        self.infos: dict[int, Info] = {}
        self.batteries: dict[int, tuple[int, int]] = {}
        self._sequence = Sequence(self.counters, 1 << 32)

    def _take(self, message: Packet | Info) -> list[Sample]:
        """The sample in an intact message, if it holds a new one."""
        samples: list[Sample] = []
        self._count_good()
        if isinstance(message, Info):
            self.infos[message.sensor_id] = message
            self.counters.skipped += 1
        elif self._sequence.is_new(message.sensor_id, message.seq, message.t_us):
            if message.battery is not None:
                self.batteries[message.sensor_id] = message.battery
            self._emit(Sample(message.sensor_id, message.t_us, *message[3:8]), samples)
        return samples


class NativeDecoder(NativeReceiver):
    """Samples out of a byte stream that may be cut anywhere, start anywhere and contain noise.

    INFO packets and packets with nothing for a Sample count as skipped; `NativeReceiver` says where they go.
    """

    WRAP_US = 1 << 32

    def __init__(self) -> None:
        """Start with nothing seen."""
        super().__init__()
        self._rest = b""  # the frame under way; at most MAX_FRAME + 1 bytes, the last of a longer one

    def feed(self, data: bytes) -> list[Sample]:
        """Samples completed by the next bytes of the stream, in the order they came."""
        self.counters.bytes += len(data)
        *frames, rest = (self._rest + data).split(b"\0")
        self._rest = rest[-MAX_FRAME - 1 :]
        samples: list[Sample] = []
        for frame in frames:
            # Nothing between two 00 is legal: senders may open with a 00 to end any noise.
            message = self._message(frame) if frame else None
            if message is not None:
                samples += self._take(message)
        return samples

    def _message(self, frame: bytes) -> Packet | Info | None:
        if len(frame) <= MAX_FRAME:
            try:
                return _open_frame(frame)
            except ValueError:
                pass
        self._count_bad()
        # Noise, or a packet without its 00, may have run into a good packet at the end. Its first body byte
        # is known, which leaves few places to try.
        frame = frame[-MAX_FRAME:]
        for start in range(len(frame) - 2):
            if frame[start + 1] in (DATA_TYPE, INFO_TYPE):
                try:
                    return _open_frame(frame[start:])
                except ValueError:
                    continue
        return None


def _open_frame(frame: bytes) -> Packet | Info:
    """Packet or Info of a frame without its closing 00; ValueError if there is anything wrong with it."""
    body = cobs_decode(frame)
    if crc_hqx(body[:-2], 0xFFFF) != int.from_bytes(body[-2:], "little"):
        raise ValueError("wrong checksum")
    return decode_body(body[:-2])


def _encoder() -> Encode:
    return lambda sample, seq: encode(packet_of(sample, seq))


PROTOCOL = Protocol(
    name="native",
    transport="bytes",
    default_bitrate=115200,
    description="edgepose's own packet: COBS and CRC-16, many sensors on one line",
    decoder=NativeDecoder,
    encoder=_encoder,
    ids=range(6),
)
