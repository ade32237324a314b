"""Settings of a run that its calibration knows: orientation filter, magnetometers, the wearer's height."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone

from edgepose.calibration import Calibration
from edgepose.config import WearerConfig
from edgepose.errors import CalibrationError

HEIGHT_TOLERANCE_M = 0.03
"""Heights of one person differ by this over a day, and with shoes."""


def with_calibrated_settings(config: WearerConfig, calibration: Calibration) -> WearerConfig:
    """Return a configuration whose open settings are those of its calibration."""
    outputs = config.outputs
    if outputs.height is None:
        outputs = replace(outputs, height=calibration.height_m)
    return replace(config, filter=calibration.filter, outputs=outputs)


def check_settings(
    calibration: Calibration, filter: str | None, no_mag: bool, height_m: float | None
) -> list[str]:
    """Compare the settings of a run with its calibration's; return a line on each that is odd.

    Args:
        calibration: of the wearer.
        filter: filter of the run; None for the calibration's.
        no_mag: whether the run is not to use magnetometers; the calibration may not have done so either.
        height_m: the wearer's height, metres; None for the calibration's.

    Raises:
        CalibrationError: headings would differ from the calibration's, and all poses would be subtly wrong.
    """
    if filter is not None and filter != calibration.filter:
        raise CalibrationError(
            f"the calibration was made with --filter {calibration.filter}, and this run has --filter "
            f"{filter}: headings would differ; leave --filter out, or calibrate again"
        )
    if no_mag and calibration.filter == "none":
        raise CalibrationError("--no-mag is for a --filter, and the calibration was made without one")
    if no_mag and calibration.north:
        raise CalibrationError(
            "the calibration was made with magnetometers: leave --no-mag out, or calibrate again with it"
        )
    known_m = calibration.height_m
    if height_m is None or known_m is None or abs(height_m - known_m) < HEIGHT_TOLERANCE_M:
        return []
    return [
        f"the calibration is of a wearer of {known_m:g} m, and --height is {height_m:g}: "
        "leave --height out, or calibrate again if this is another wearer"
    ]


def age_days(calibration: Calibration) -> int:
    """Return the age of a calibration in whole days; 0 if unknown, because users may edit the file."""
    try:
        made = datetime.fromisoformat(calibration.created)
    except ValueError:
        return 0
    if made.tzinfo is None:
        made = made.astimezone()
    return max(0, (datetime.now(timezone.utc) - made).days)
