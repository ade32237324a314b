"""OSC messages, and the axes of Unity, in which their receivers work."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

TO_UNITY = np.array([-1.0, 1.0, 1.0])
"""Mirrors points from T (X left, Y up, Z forward) to Unity, X right; rotations about Y and Z reverse."""


def osc_string(text: str) -> bytes:
    """Encode a text, such as an address or the types of arguments."""
    data = text.encode() + b"\0"
    return data + bytes(-len(data) % 4)


def osc_bundle(messages: Sequence[bytes]) -> bytes:
    """Return a bundle of messages for immediate execution."""
    parts = [b"#bundle\0", struct.pack(">Q", 1)]
    for message in messages:
        parts += [struct.pack(">i", len(message)), message]
    return b"".join(parts)
