"""Messages about faults of sensors that several commands find; each names the fault and what to do.

The messages do not name the sensor: put `placement: ` before them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from edgepose.imu import GRAVITY

GRAVITY_SCALE_LIMIT = 0.05
"""Largest relative error of the acceleration at rest."""

NO_GRAVITY_M_S2 = 0.5
"""Acceleration at rest below which gravity has been removed, m/s^2."""

HEADING_RESETS = "--heading-reset steps, motion, live or mounting"
"""Advice for headings that no reset aligns."""

JUMPS_OF_TWO = 20
"""Restarts of a clock within a second, or in a log, that a single device does not make."""


def two_devices(apart_deg: float | None = None) -> str:
    """Return the message about two devices with one id.

    Args:
        apart_deg: angle between their orientations, degrees; None if only their clocks differ.
    """
    how = "whose clocks differ" if apart_deg is None else f"{apart_deg:.0f} deg apart"
    return f"two devices, {how}, send under its id: give each an id of its own"


def no_gravity(norm_m_s2: float) -> str | None:
    """Return the message about an acceleration that lacks gravity, by its size at rest; None if it has it."""
    if not norm_m_s2 < NO_GRAVITY_M_S2:
        return None
    return (
        f"it reads {norm_m_s2:.2f} m/s² at rest, so gravity is already removed: "
        "send the acceleration as measured (specific force)"
    )


def wrong_unit(norm_m_s2: float) -> str | None:
    """Return the message about an acceleration in another unit; None if its size at rest fits none."""
    for unit, size in (("g", 1.0), ("milli-g", 1000.0), ("cm/s²", 100.0 * GRAVITY)):
        if abs(norm_m_s2 / size - 1.0) < 2.0 * GRAVITY_SCALE_LIMIT:
            return f"it reads {norm_m_s2:.4g} at rest, which is in {unit}: send m/s², {GRAVITY} at rest"
    return None


def wrong_scale(norm_m_s2: float) -> str | None:
    """Return the message about a wrong size of the acceleration at rest; None if it is right, or unknown."""
    if not abs(norm_m_s2 / GRAVITY - 1.0) > GRAVITY_SCALE_LIMIT:
        return None
    return (
        f"it reads {norm_m_s2:.2f} m/s² at rest, not {GRAVITY}: "
        "check the accelerometer's range setting, and calibrate it"
    )


def wrong_frame(tilt_deg: float, convention: str | None) -> str:
    """Return the message about an orientation that does not rotate the acceleration at rest upwards.

    Args:
        tilt_deg: angle between that acceleration and up, degrees.
        convention: the convention that would, if one is known.
    """
    why = convention or "no usual convention fits"
    return f"orientation and gravity disagree by {tilt_deg:.0f} deg at rest: {why}"


def shared_convention(fitting: Mapping[str, Sequence[str]]) -> dict[str, str | None]:
    """Return for each sensor the convention that explains it, one that explains all sensors if there is one.

    Devices of one rig have one convention, although another one may fit a single sensor by chance.

    Args:
        fitting: conventions that explain each sensor, the likeliest first.
    """
    first = next(iter(fitting.values()), ())
    shared = [why for why in first if all(why in each for each in fitting.values())]
    return {name: next(iter(shared or each), None) for name, each in fitting.items()}


def clock_restarted(times: int = 1) -> str:
    """Return the message about a device that was switched off and on, or restarted by itself."""
    count = f" {times} times" if times > 1 else ""
    return f"its clock restarted{count}; its heading may differ after that"


def no_common_heading(protocols: Iterable[str]) -> str:
    """Return the message about devices of these protocols, whose headings have no common zero."""
    names = ", ".join(sorted(set(protocols)))
    return f"sensors of {names} have no common heading: calibrate with {HEADING_RESETS}"
