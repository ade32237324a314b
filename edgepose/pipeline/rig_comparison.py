"""Whether samples come from the devices that a calibration was made with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edgepose.calibration import Calibration
from edgepose.placements import PLACEMENTS
from edgepose.sources import Device


def other_devices(calibration: Calibration, devices: Mapping[int, Device]) -> str | None:
    """What is different, one line; None where nothing is, or nobody knows.

    Args:
        calibration: keeps the devices that it was made with, if it was made with any.
        devices: those that send now, by placement.
    """
    before = _devices_of(calibration)
    different = [
        f"{PLACEMENTS[place]} was {then} and is {now}"
        for place, now in sorted(devices.items())
        if (then := before.get(place)) is not None and _differs(then, now)
    ]
    if not different:
        return None
    more = f" (and {len(different) - 1} others)" if different[1:] else ""
    return (
        f"warning: the calibration was made with other sensors: {different[0]}{more}; "
        "unless each sits as the other did, calibrate again"
    )


def _differs(then: Device, now: Device) -> bool:
    # A file does not say what line it is of.
    lines = then.line is not None and now.line is not None and then.line != now.line
    return (then.protocol, then.id) != (now.protocol, now.id) or lines


def _devices_of(calibration: Calibration) -> dict[int, Device]:
    """The devices in the metadata of a calibration, which anybody may have edited."""
    noted = calibration.metadata.get("devices")
    if not isinstance(noted, Mapping):
        return {}
    return {
        place: device
        for place, name in enumerate(PLACEMENTS)
        if (device := _device(noted.get(name))) is not None
    }


def _device(noted: Any) -> Device | None:
    if not isinstance(noted, Mapping):
        return None
    protocol, line, number = (noted.get(key) for key in ("protocol", "line", "id"))
    if not isinstance(protocol, str) or not isinstance(number, int) or not isinstance(line, str | None):
        return None
    return Device(protocol, line, number)
