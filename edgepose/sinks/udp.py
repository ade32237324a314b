"""Output over UDP, one datagram per frame, as JSON or binary. Layouts: docs/reference/outputs.md."""

from __future__ import annotations

import json
import socket
import struct
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from ipaddress import ip_address
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.joint_tree import LARGEST
from edgepose.placements import PLACEMENTS
from edgepose.pose import CONTACTS, PoseFrame, format_status, held_bits, parse_status
from edgepose.rotations import quat_to_matrix, rotvec_to_matrix
from edgepose.sinks.base import Sink, SinkContext
from edgepose.sinks.shared_numbers import quats, rotvec_text
from edgepose.skeleton import JOINTS
from edgepose.utils.sockets import Destination, address_text, failure_text, resolve

MAGIC = b"EPOS"

_UNKNOWN_STD = np.full(len(JOINTS), np.nan, np.float32)
_UNKNOWN_STD.setflags(write=False)

_FILLING_WINDOW = 1
"""Bit of a datagram's flags: the network has seen fewer frames than its window holds."""

_CONTACTS = 2
"""Bit of a datagram's flags: the contacts are known."""

_JSON = '{"frame":%d,"time_s":%.6f,"status":%s,"pose":[%s]'
# Magic, version, flags, held sensors, joints, time, frame, quaternions: each at a multiple of its size.
_BINARY = struct.Struct("<4sBBBBdI96f")
_PLACE = struct.Struct("<3f7f")
"""Translation and contacts, which follow in version 2."""

_SIZES = {1: _BINARY.size, 2: _BINARY.size + _PLACE.size}
"""Bytes of a binary datagram of each version."""


def encode_json(pose: PoseFrame) -> bytes:
    """Encode a pose as a line of JSON: frame, time_s, status, pose (72 axis-angle numbers, SMPL order).

    Known translations and contacts follow as trans and contacts.
    """
    status = _quoted(format_status(pose.held, pose.warming_up))
    text = _JSON % (pose.index, pose.time_s, status, rotvec_text(pose))
    for key, values in (("trans", pose.translation), ("contacts", pose.contacts)):
        if values is not None:
            text += f',"{key}":[{",".join(f"{value:.6f}" for value in values.tolist())}]'
    return f"{text}}}\n".encode()


def encode_binary(pose: PoseFrame, newest: int = 2) -> bytes:
    """Encode a pose as a binary datagram: of version 2 if its translation is known, of version 1 otherwise.

    Args:
        pose: the pose.
        newest: highest version that the receiver reads.
    """
    flags = _FILLING_WINDOW if pose.warming_up else 0
    place = b""
    if pose.translation is not None and newest > 1:
        flags |= 0 if pose.contacts is None else _CONTACTS
        contacts = np.zeros(len(CONTACTS)) if pose.contacts is None else pose.contacts
        place = _PLACE.pack(*pose.translation.tolist(), *contacts.tolist())
    numbers = quats(pose).ravel().tolist()
    index = pose.index & 0xFFFFFFFF  # wraps after two years at 60 Hz
    version, held = 2 if place else 1, held_bits(pose.held)
    return _BINARY.pack(MAGIC, version, flags, held, len(JOINTS), pose.time_s, index, *numbers) + place


def decode_binary(datagram: bytes) -> PoseFrame:
    """Decode a binary datagram of any version; `std`, which is not sent, is NaN.

    Raises:
        EdgeposeError: not a datagram of this kind and version, or its numbers are not valid.
    """
    if len(datagram) not in _SIZES.values() or not datagram.startswith(MAGIC):
        raise EdgeposeError(f"not a pose datagram: {len(datagram)} bytes that begin with {datagram[:4]!r}")
    _, version, flags, held, joints, time_s, index, *numbers = _BINARY.unpack_from(datagram)
    if _SIZES.get(version) != len(datagram) or joints != len(JOINTS):
        raise EdgeposeError(
            f"pose datagram of version {version} with {joints} joints in {len(datagram)} bytes; supported "
            "are versions 1 and 2 with 24"
        )
    received = np.array(numbers).reshape(-1, 4)
    norms = np.linalg.norm(received, axis=-1, keepdims=True)
    if not np.isfinite(time_s) or not np.all(np.abs(norms - 1.0) < 1e-3):
        raise EdgeposeError(
            f"damaged pose datagram: time or quaternions of frame {index} are not valid numbers"
        )
    rotations = quat_to_matrix(received / norms).astype(np.float32)
    names = frozenset(name for i, name in enumerate(PLACEMENTS) if held >> i & 1)
    place = _PLACE.unpack_from(datagram, _BINARY.size) if version > 1 else ()
    return PoseFrame(
        *(index, time_s, rotations, _UNKNOWN_STD, _translation(place[:3] or None, index), names),
        bool(flags & _FILLING_WINDOW),
        _contacts(place[3:] if flags & _CONTACTS else None, index),
    )


def decode_json(datagram: bytes) -> PoseFrame:
    """Decode a JSON datagram; `std`, which is not sent, is NaN.

    Raises:
        EdgeposeError: not a datagram of this kind, or its numbers are not valid.
    """
    try:
        message = json.loads(datagram)
        index, time_s = int(message["frame"]), float(message["time_s"])
        held, warming_up = parse_status(str(message["status"]))
        vectors = np.array(message["pose"], float)
        translation = _translation(message.get("trans"), index)
        contacts = _contacts(message.get("contacts"), index)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise EdgeposeError(f"not a pose datagram: {len(datagram)} bytes, {type(error).__name__}") from None
    if vectors.shape != (3 * len(JOINTS),) or not (np.abs(vectors) < 1e3).all() or not np.isfinite(time_s):
        raise EdgeposeError(f"damaged pose datagram: time or angles of frame {index} are not valid numbers")
    rotations = rotvec_to_matrix(vectors.reshape(-1, 3)).astype(np.float32)
    return PoseFrame(index, time_s, rotations, _UNKNOWN_STD, translation, held, warming_up, contacts)


def _translation(numbers: Any, index: int) -> NDArray[np.float64] | None:
    """Return the translation (3,) of a frame; None if there is none, EdgeposeError if it cannot be one."""
    if numbers is None:
        return None
    translation = np.array(numbers, float)
    if translation.shape != (3,) or not (np.abs(translation) < LARGEST).all():
        raise EdgeposeError(f"damaged pose datagram: the place of frame {index} is not a valid position")
    return translation


def _contacts(numbers: Any, index: int) -> NDArray[np.float32] | None:
    """Return the contacts (7,) of a frame; None if there are none, EdgeposeError if they cannot be any."""
    if numbers is None:
        return None
    contacts = np.array(numbers, float)
    if contacts.shape != (len(CONTACTS),) or not ((contacts >= 0.0) & (contacts <= 1.0)).all():
        raise EdgeposeError(f"damaged pose datagram: contacts of frame {index} are not from 0 to 1")
    return contacts.astype(np.float32)


def decode(datagram: bytes) -> PoseFrame:
    """Decode a datagram of either kind; see `decode_binary` and `decode_json`."""
    return decode_binary(datagram) if datagram.startswith(MAGIC) else decode_json(datagram)


ENCODERS: dict[str, Callable[[PoseFrame], bytes]] = {
    "json": encode_json,
    "binary": encode_binary,
    "binary-v1": partial(encode_binary, newest=1),
}
"""Encoders of each format; "binary-v1" is for receivers that do not know version 2."""


class DatagramSink(Sink):
    """Sends each pose to one address.

    A run does not depend on a listener: datagrams that could not be sent are counted in `unsent`.
    """

    live = True
    NAME = "udp"

    def __init__(self, host: str, port: int, cast: str = "") -> None:
        """Resolve the host name, once.

        Args:
            host: name or address.
            port: UDP port.
            cast: "broadcast" or "multicast" if the address may stand for many machines.

        Raises:
            EdgeposeError: the host is unknown, there is no network to reach it, or it stands for many
                machines although `cast` does not say so.
        """
        self.unsent = 0
        self._address = address_text(host, port)
        try:
            family, address = resolve(host, port, socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            reason = failure_text(error, host)
            raise EdgeposeError(f"cannot find host {host!r} to send poses to: {reason}") from error
        if ip_address(address[0].partition("%")[0]).is_multicast and cast != "multicast":
            raise EdgeposeError(_many_machines(host, port, "multicast"))
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # a full network queue loses a datagram instead of delaying a frame
        try:
            if cast == "broadcast":
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.connect(address)
        except PermissionError as error:  # Linux refuses broadcasts in this way
            self._socket.close()
            raise EdgeposeError(_many_machines(host, port, "broadcast")) from error
        except OSError as error:
            self._socket.close()
            reason = failure_text(error, host)
            raise EdgeposeError(f"cannot send poses to {host} port {port}: {reason}") from error

    @abstractmethod
    def encode(self, pose: PoseFrame) -> Sequence[bytes]:
        """Return the datagrams of a pose."""

    def write(self, pose: PoseFrame) -> None:
        """Send a pose."""
        for datagram in self.encode(pose):
            try:
                self._send(datagram)
            except OSError:
                self.unsent += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def summary_lines(self) -> list[str]:
        """Return a line with the number of datagrams that did not arrive, if any."""
        if not self.unsent:
            return []
        question = f"is anything listening at {self._address}?"
        return [f"{self.NAME:<8} {self.unsent} datagrams did not arrive; {question}"]

    def _send(self, datagram: bytes) -> None:
        try:
            self._socket.send(datagram)
        except ConnectionRefusedError:
            # This reports that nothing received the previous datagram; the present one has not been sent yet.
            self.unsent += 1
            self._socket.send(datagram)


def _many_machines(host: str, port: int, cast: str) -> str:
    """Return the message about an address that stands for many machines."""
    target = f"{address_text(host, port)},{cast}"
    return (
        f"{host} is a {cast} address, at which many machines receive: write {target} to send there, or the "
        "address of one machine"
    )


class UdpSink(DatagramSink):
    """Sends each pose as one datagram, JSON or binary."""

    def __init__(self, host: str, port: int, format: str = "json", cast: str = "") -> None:
        """Resolve the host name; `format` is a key of `ENCODERS`. See `DatagramSink`."""
        self._encode = ENCODERS[format]
        super().__init__(host, port, cast)

    def encode(self, pose: PoseFrame) -> Sequence[bytes]:
        """Return the datagram of a pose."""
        return (self._encode(pose),)


@lru_cache(maxsize=64)
def _quoted(text: str) -> str:
    return json.dumps(text)


def open_sink(target: Destination, context: SinkContext) -> Sink:
    """Open a `UdpSink` to a destination."""
    return UdpSink(*target)
