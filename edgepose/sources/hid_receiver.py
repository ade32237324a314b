"""SlimeVR's USB receivers as transports.

Needs hidapi. Nothing is sent to a receiver.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, NamedTuple

from edgepose.errors import ConfigError, DeviceError
from edgepose.sources import POLL_S
from edgepose.sources.line_reader import LineDisconnectedError
from edgepose.sources.protocol_detection import Datagram

ANY = "slimevr"
"""Name of the only receiver that is plugged in."""

VENDOR = 0x1209
"""USB vendor id of receivers and trackers, which they share with other open hardware."""

RECEIVER, TRACKER = 0x7690, 0x7692
"""USB product ids of a receiver, and of a tracker on a cable, which sends the same reports."""

RULE = (
    'SUBSYSTEM=="hidraw", ATTRS{idVendor}=="1209", ATTRS{idProduct}=="769[02]", GROUP="dialout", MODE="0660"'
)
"""The udev rule that lets members of the group dialout open them."""

_LONGEST = 1024
"""Length limit of a transfer, bytes; those of the receiver have 64."""

_MOST = 256
"""Most transfers read at a time; the receiver sends up to 1000 a second."""

_HAS_RULES = sys.platform == "linux"


class Receiver(NamedTuple):
    """A receiver, or a tracker on a cable, that is plugged in.

    Attributes:
        path: the system's name.
        serial_number: its serial number; empty if unknown.
        product: its name for people.
        product_id: its USB product id.
    """

    path: str
    serial_number: str
    product: str
    product_id: int

    @property
    def name(self) -> str:
        """The name that stays the same wherever it is plugged in, if there is one."""
        return self.serial_number or self.path

    @property
    def names(self) -> tuple[str, str]:
        """The names by which it can be chosen."""
        return self.serial_number, self.path


def hidapi() -> Any:
    """Import hidapi.

    Raises:
        ConfigError: it is not installed.
    """
    # On Linux its module `hid` takes devices away from the kernel, and needs other rights.
    name = "hidraw" if sys.platform == "linux" else "hid"
    with suppress(ImportError):
        module = import_module(name)
        if hasattr(module, "device"):  # missing in another package that has a module `hid`
            return module
    raise ConfigError("USB receivers need hidapi: install it with pip install 'edgepose[hid]'")


def receivers() -> list[Receiver]:
    """Return what is plugged in, by name.

    Raises:
        ConfigError: hidapi is not installed.
    """
    return receivers_among(hidapi().enumerate(VENDOR, 0))


def receivers_among(devices: Iterable[Mapping[str, Any]]) -> list[Receiver]:
    """Return the receivers among devices as hidapi lists them, each once, by name."""
    found = {
        Receiver(
            os.fsdecode(each["path"]),
            _one_line(each["serial_number"]),
            _one_line(each["product_string"]),
            each["product_id"],
        )
        for each in devices
        if each["vendor_id"] == VENDOR and each["product_id"] in (RECEIVER, TRACKER)
    }
    return sorted(found, key=lambda receiver: (receiver.name, receiver.path))


def _one_line(text: str | None) -> str:
    """Return a text of a device, which may hold anything, without line breaks and spaces around words."""
    return " ".join((text or "").split())


def path_of(name: str, found: Sequence[Receiver]) -> str:
    """Return the path of a receiver.

    Args:
        name: serial number or path, or ANY for the only receiver.
        found: what is plugged in.

    Raises:
        DeviceError: there is no such receiver, or several.
    """
    if name == ANY:
        fitting = [each for each in found if each.product_id == RECEIVER]
    else:
        fitting = [each for each in found if name in each.names]
        if not fitting and "/" in name and "\0" not in name:  # a link to it, which udev has made
            return name
    if not fitting:
        raise DeviceError(f"{name}: {_missing('receiver', found)}")
    if len(fitting) > 1:
        names = [each.name if name == ANY else each.path for each in fitting]
        raise DeviceError(f"{name}: {len(fitting)} receivers: {', '.join(names)}; name the one to read from")
    return fitting[0].path


class HidReceiver:
    """An open receiver.

    Attributes:
        waiting: see `Transport.waiting`; None, because the system keeps less than a tenth of a second.
        file: see `Transport.file`; None, because hidapi does not say.
    """

    waiting = None
    file = None

    def __init__(self, name: str) -> None:
        """Open the receiver.

        Args:
            name: see `path_of`.

        Raises:
            ConfigError: hidapi is not installed.
            DeviceError: there is no such receiver, or several, or it may not be opened.
        """
        self._name = name
        path = path_of(name, receivers())
        self._device = hidapi().device()
        try:
            self._device.open_path(os.fsencode(path))
            self._device.set_nonblocking(True)
        except (OSError, ValueError) as error:
            self.close()
            raise DeviceError(f"{name}: {_opening_problem(path, error)}") from None

    def read(self) -> tuple[list[Datagram], bool]:
        """See `Transport.read`."""
        transfers: list[Datagram] = []
        try:
            data = self._device.read(_LONGEST, round(POLL_S * 1000))
            while data:
                transfers.append(Datagram(self._name, bytes(data)))
                if len(transfers) == _MOST:
                    return transfers, True
                data = self._device.read(_LONGEST)
        except (OSError, ValueError):
            if not transfers:  # otherwise the next read raises
                raise LineDisconnectedError from None
        return transfers, False

    def close(self) -> None:
        """See `Transport.close`."""
        self._device.close()


def _missing(kind: str, found: Sequence[Receiver]) -> str:
    if not found:
        return "no receiver is plugged in"
    return f"no such {kind}; plugged in: {', '.join(each.name for each in found)}"


def _opening_problem(path: str, error: Exception) -> str:
    """Return why a receiver cannot be opened, which hidapi does not say."""
    if _HAS_RULES and not os.access(path, os.F_OK):
        return _missing("device", receivers())
    if _HAS_RULES and not os.access(path, os.R_OK | os.W_OK):
        return (
            "no permission to open it; join the group dialout (sudo usermod -aG dialout $USER), put this "
            f"line into /etc/udev/rules.d/60-edgepose.rules, and plug it in again:  {RULE}"
        )
    return f"cannot open it as a HID device: {error}; check that no other program, such as SlimeVR's, has it"
