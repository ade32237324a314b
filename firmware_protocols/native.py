"""The native packet of self-built sensors on a serial line: COBS(body + CRC-16) + 00.

Layouts are in README.md next to this file; `c/edgepose_packet.h` is the encoder for firmware.
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
"""Longest frame without its closing 00, bytes: body, CRC, one byte added by COBS."""


# --- framing --------------------------------------------------------------------------------------


def cobs_encode(data: bytes) -> bytes:
    """Return data in Consistent Overhead Byte Stuffing, which has no 00; the closing 00 is left out."""
    out = bytearray()
    runs = data.split(b"\0")
    for last, run in zip([False] * (len(runs) - 1) + [True], runs, strict=True):
        start = 0
        while len(run) - start >= 254:
            out.append(255)
            out += run[start : start + 254]
            start += 254
        # A full block implies no 00, so data that end with one need no further code byte.
        if not last or start < len(run) or not start:
            out.append(len(run) - start + 1)
            out += run[start:]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """Return the data of `cobs_encode`'s output.

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
    # Each code byte stands for a 00, except the first one and those after a full block.
    for code_at in reversed(after_full):
        del out[code_at : code_at + 1]
    return bytes(out[1:])


def frame_body(body: bytes) -> bytes:
    """Return the bytes on the wire for a body: checksum, COBS, closing 00."""
    return cobs_encode(body + crc_hqx(body, 0xFFFF).to_bytes(2, "little")) + b"\0"


def encode(packet: Packet, *, floats: bool = False) -> bytes:
    """Return the bytes on the wire for a measurement; see `encode_body`."""
    return frame_body(encode_body(packet, floats=floats))


def encode_info(info: Info) -> bytes:
    """Return the bytes on the wire for an INFO packet; see `encode_info_body`."""
    return frame_body(encode_info_body(info))


# --- the stream -----------------------------------------------------------------------------------


class NativeReceiver(Receiver):
    """Common part of the serial and the CAN decoder: counters, INFO, battery, late packets.

    Attributes:
        infos: the last INFO packet, by sensor id.
        batteries: the last charge in percent and status bits, by sensor id.
    """

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self.infos: dict[int, Info] = {}
        self.batteries: dict[int, tuple[int, int]] = {}
        self._sequence = Sequence(self.counters, 1 << 32)

    def _take(self, message: Packet | Info) -> list[Sample]:
        """Return the sample of an intact message, if it is new and not empty."""
        samples: list[Sample] = []
        if not self._in_sync:
            self._count_good()
        if isinstance(message, Info):
            self.infos[message.sensor_id] = message
            self.counters.skipped += 1
            return samples
        sensor, seq, t_us, quat, acc, gyr, mag, temperature, battery = message
        if self._sequence.is_new(sensor, seq, t_us):
            if battery is not None:
                self.batteries[sensor] = battery
            self._emit(Sample(sensor, t_us, quat, acc, gyr, mag, temperature), samples)
        return samples


class NativeDecoder(NativeReceiver):
    """Decoder for a byte stream that may be split anywhere, start anywhere and contain noise.

    INFO packets and packets without any quantity count as skipped. INFO and battery are in the attributes of
    `NativeReceiver`.
    """

    WRAP_US = 1 << 32

    def __init__(self) -> None:
        """Create the decoder."""
        super().__init__()
        self._rest = b""  # incomplete frame; at most its last MAX_FRAME + 1 bytes

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples completed by the next bytes of the stream, in order of arrival."""
        self.counters.bytes += len(data)
        *frames, rest = (self._rest + data).split(b"\0")
        self._rest = rest[-MAX_FRAME - 1 :]
        samples: list[Sample] = []
        for frame in frames:
            # An empty frame is legal: senders may begin with a 00 to end any noise.
            if not frame:
                continue
            try:
                message: Packet | Info | None = _open_frame(frame)
            except ValueError:
                message = self._recovered(frame)
            if message is not None:
                samples += self._take(message)
        return samples

    def _recovered(self, frame: bytes) -> Packet | Info | None:
        """Return the message at the end of a bad frame; None if there is none."""
        self._count_bad()
        # A good packet may follow noise, or a packet whose 00 is lost. Its first body byte is known, so there
        # are few offsets to try.
        frame = frame[-MAX_FRAME:]
        for start in range(len(frame) - 2):
            if frame[start + 1] in (DATA_TYPE, INFO_TYPE):
                try:
                    return _open_frame(frame[start:])
                except ValueError:
                    continue
        return None


def _open_frame(frame: bytes) -> Packet | Info:
    """Return the message in a frame without its closing 00.

    Raises:
        ValueError: the frame is invalid.
    """
    if len(frame) > MAX_FRAME:
        raise ValueError("too long")
    body = cobs_decode(frame)
    content = body[:-2]
    if crc_hqx(content, 0xFFFF) != int.from_bytes(body[-2:], "little"):
        raise ValueError("wrong checksum")
    return decode_body(content)


def _encoder() -> Encode:
    return lambda sample, seq: encode(packet_of(sample, seq))


PROTOCOL = Protocol(
    name="native",
    transport="bytes",
    default_bitrate=115200,
    description="self-built boards: edgepose's own packet",
    decoder=NativeDecoder,
    encoder=_encoder,
    ids=range(6),
    page="../README",
)
