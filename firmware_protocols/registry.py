"""The wire formats by name.

The module of a format is imported when its `Protocol` is looked up. Other packages add formats through the
entry-point group `edgepose.protocols`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points

from firmware_protocols.base import Decoder, Encode, Frame, Protocol

__all__ = ["PROTOCOLS", "Decoder", "Encode", "Frame", "Protocol", "protocol_names"]

_log = logging.getLogger(__name__)

GROUP = "edgepose.protocols"
"""Group of the entry points of other packages: name of the format -> its `Protocol`."""

BUILT_IN = {
    "native": "native:PROTOCOL",
    "native-can": "native_can:PROTOCOL",
    "xsens": "xsens:PROTOCOL",
    "xsens-can": "xsens_can:PROTOCOL",
    "hipnuc": "hipnuc:PROTOCOL",
    "hipnuc-canopen": "hipnuc_can:PROTOCOL_CANOPEN",
    "hipnuc-j1939": "hipnuc_can:PROTOCOL_J1939",
    "witmotion": "witmotion:PROTOCOL",
    "witmotion-ble": "witmotion_ble:PROTOCOL",
    "witmotion-modbus": "witmotion_modbus:PROTOCOL",
    "witmotion-can": "witmotion_can:PROTOCOL",
    "ximu3": "ximu3:PROTOCOL",
    "slimevr": "slimevr:PROTOCOL",
    "slimevr-hid": "slimevr_hid:PROTOCOL",
    "dot": "dot:PROTOCOL",
    "haritorax": "haritorax:PROTOCOL",
    "lpms": "lpms:PROTOCOL",
    "bno08x-rvc": "bno08x:PROTOCOL",
    "mip": "mip:PROTOCOL",
    "vectornav": "vectornav:PROTOCOL",
    "vectornav-ascii": "vectornav:PROTOCOL_ASCII",
    "adafruit": "text:PROTOCOL_ADAFRUIT",
    "razor": "text:PROTOCOL_RAZOR",
    "openlog": "text:PROTOCOL_OPENLOG",
    "openlog-dmp": "text:PROTOCOL_OPENLOG_DMP",
    "mavlink": "mavlink:PROTOCOL",
}
"""Module in this package and its constant, by name of the format."""


def protocol_names() -> tuple[str, ...]:
    """Return the names of all formats, those of other packages last, without importing any."""
    others = {point.name for point in entry_points(group=GROUP)}
    return (*BUILT_IN, *sorted(others - set(BUILT_IN)))


class _Registry(Mapping[str, Protocol]):
    """The formats of this package in the order of `BUILT_IN`, then those of other packages by name."""

    def __getitem__(self, name: str) -> Protocol:
        if name not in BUILT_IN:
            return _installed()[name]
        module, _, constant = BUILT_IN[name].partition(":")
        protocol: Protocol = getattr(import_module(f"firmware_protocols.{module}"), constant)
        return protocol

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or name in _installed()

    def __iter__(self) -> Iterator[str]:
        yield from BUILT_IN
        yield from _installed()

    def __len__(self) -> int:
        return len(BUILT_IN) + len(_installed())


@cache
def _installed() -> dict[str, Protocol]:
    """Return the formats of other packages, sorted by name. Warn about unusable ones and leave them out."""
    found: dict[str, Protocol] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        package = f"protocol {point.name!r} of {point.dist.name if point.dist else point.value}"
        if point.name in BUILT_IN or point.name in found:
            _log.warning("%s is ignored: the name is taken", package)
            continue
        try:
            protocol = point.load()
        except (Exception, SystemExit) as error:  # whatever the import of another package's module raises
            _log.warning("%s cannot be loaded: %s: %s", package, type(error).__name__, error)
            continue
        if not isinstance(protocol, Protocol) or protocol.name != point.name:
            _log.warning("%s is ignored: %s is not a Protocol of that name", package, point.value)
            continue
        found[point.name] = protocol
    return found


PROTOCOLS: Mapping[str, Protocol] = _Registry()
"""All wire formats by name."""
