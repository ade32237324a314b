"""Comparison of the devices in use with a calibration: other devices, headings that it does not align."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from edgepose.calibration import Calibration, mounting_warnings
from edgepose.calibration.fit import telling
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.sources import Device
from edgepose.sources.sensor_map import SensorMap
from edgepose.utils.fault_messages import no_common_heading
from firmware_protocols.registry import PROTOCOLS


def changes(
    calibration: Calibration, devices: Mapping[int, Device], sensor_map: SensorMap | None
) -> list[str]:
    """Return a warning for each kind of change of a rig since its calibration.

    Args:
        calibration: a calibration, whose metadata may name the devices it was made with.
        devices: devices in use now, by placement.
        sensor_map: the map in use, which may say how sensors are mounted.
    """
    lines = other_devices(calibration, devices)
    if sensor_map is not None:
        lines += _other_sensors(calibration, sensor_map)
        stated = {name: device.mounting for name, device in sensor_map.devices.items()}
        lines += mounting_warnings(calibration, stated, str(sensor_map.path))
    return lines


def _other_sensors(calibration: Calibration, sensor_map: SensorMap) -> list[str]:
    """Return a warning if a map has other sensors than a calibration."""
    lacking = [name for name in calibration.sensors if name not in sensor_map.devices]
    further = [name for name in sensor_map.devices if name not in calibration.sensors]
    parts = [f"it has {', '.join(lacking)} besides"] if lacking else []
    parts += [f"it lacks {', '.join(further)}"] if further else []
    if not parts:
        return []
    return [
        f"the calibration has other sensors than {sensor_map.path}, {' and '.join(parts)}: calibrate again"
    ]


def unlike_six(calibration: Calibration) -> str | None:
    """Return a line on the sensors that a rig has besides the six, or lacks; None if it has just these."""
    parts = []
    if calibration.added.names:
        drift = "" if calibration.north else ", without drift correction"
        parts.append(f"{', '.join(calibration.added.names)} measured besides the six{drift}")
    if calibration.without:
        parts.append(f"{', '.join(calibration.without)} not measured: poses are less accurate")
        parts += _not_judged(calibration)
    return f"sensors  {len(calibration.sensors)}; {'; '.join(parts)}" if parts else None


def _not_judged(calibration: Calibration) -> list[str]:
    """Return what a run cannot find out about a rig that lacks some of the six sensors."""
    worn = [name for name in PLACEMENTS if name not in calibration.without]
    judged = telling(worn)
    hidden = [name for name in worn if name not in judged]
    parts = [f"a slip of {', '.join(hidden)} does not show" if judged else "no slip shows"] if hidden else []
    if not calibration.north and not any(name.endswith("forearm") for name in worn):
        parts.append("without a forearm, the straight pose does not correct drift")
    return parts


def missing_quantities(
    calibration: Calibration, raw: Sequence[str], without_field: Sequence[str]
) -> list[str]:
    """Return a warning if sensors do not send what the headings of their calibration are based on.

    Args:
        calibration: of the wearer.
        raw: placements whose sensors send no orientation.
        without_field: placements whose sensors send no magnetic field.
    """
    if calibration.filter == "none" and raw:
        return [
            f"the calibration was made with the sensors' own orientations, and {', '.join(raw)} send none: "
            "set them to send quaternions, or calibrate again with --filter kalman"
        ]
    if calibration.filter != "none" and calibration.north and without_field:
        return [
            f"the calibration was made with magnetometers, and {', '.join(without_field)} send no magnetic "
            "field: switch it on, or calibrate again with --no-mag"
        ]
    return []


def other_devices(calibration: Calibration, devices: Mapping[int, Device]) -> list[str]:
    """Return a warning if devices have changed since the calibration; nothing if not, or if unknown.

    Args:
        calibration: a calibration, whose metadata may name the devices it was made with.
        devices: devices in use now, by placement.
    """
    before = _devices_of(calibration)
    different = [
        f"{SENSORS[placement]} was {then} and is {now}"
        for placement, now in sorted(devices.items())
        if (then := before.get(placement)) is not None and _differs(then, now)
    ]
    if not different:
        return []
    more = f" (and {len(different) - 1} others)" if different[1:] else ""
    return [
        f"the calibration was made with other sensors: {different[0]}{more}; "
        "calibrate again unless each is worn exactly as the other was"
    ]


def without_common_heading(devices: Mapping[int, Device]) -> str | None:
    """Return a message on devices whose headings have no common zero; None if all have one."""
    # Formats of text lines that the user describes are not in the table.
    protocols = {device.protocol for device in devices.values() if device.protocol in PROTOCOLS}
    apart = [name for name in protocols if not PROTOCOLS[name].common_heading]
    return no_common_heading(apart) if apart else None


def missing_heading_reset(calibration: Calibration | None, devices: Mapping[int, Device]) -> list[str]:
    """Return a warning if headings have no common zero and the calibration does not align them.

    Args:
        calibration: of the wearer; None if there is none yet.
        devices: devices in use now, by placement.
    """
    message = without_common_heading(devices)
    aligned = calibration is not None and (calibration.filter != "none" or calibration.heading_offset.any())
    return [] if message is None or aligned else [message]


def _differs(then: Device, now: Device) -> bool:
    # A file does not name its line.
    lines = then.line is not None and now.line is not None and then.line != now.line
    return (then.protocol, then.id) != (now.protocol, now.id) or lines


def _devices_of(calibration: Calibration) -> dict[int, Device]:
    """Return the devices in a calibration's metadata, which is untrusted because users may edit the file."""
    entries = calibration.metadata.get("devices")
    if not isinstance(entries, Mapping):
        return {}
    return {
        placement: device
        for placement, name in enumerate(SENSORS)
        if (device := _device_from_entry(entries.get(name))) is not None
    }


def _device_from_entry(entry: Any) -> Device | None:
    if not isinstance(entry, Mapping):
        return None
    protocol, line, number = (entry.get(key) for key in ("protocol", "line", "id"))
    if not isinstance(protocol, str) or not isinstance(number, int) or not isinstance(line, str | None):
        return None
    return Device(protocol, line, number)
