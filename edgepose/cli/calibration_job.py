"""The calibration of what was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any, NamedTuple

import numpy as np

from edgepose import __version__, calibration
from edgepose.calibration import Calibration
from edgepose.cli.calibration_session import CalibrationPlan, Measured, finds_forward
from edgepose.cli.recorded_holds import Notify
from edgepose.config import SourceConfig
from edgepose.orientation.stage import OrientationStage
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.rotations import Array
from edgepose.sources.sensor_map import SensorMap


class CalibrationJob(NamedTuple):
    """What to calibrate and how."""

    source: SourceConfig
    plan: CalibrationPlan
    filter: str
    magnetometer: bool
    height_m: float | None
    sensor_map: SensorMap | None


def calibration_of(
    job: CalibrationJob, orient: OrientationStage, measured: Measured, notify: Notify
) -> tuple[Measured, Calibration, list[str]]:
    """Return the measurements as used, their calibration, and warnings about it.

    Args:
        job: what to calibrate and how.
        orient: the stage through which the samples went.
        measured: what was measured.
        notify: called with what a T-pose shows.

    Raises:
        EdgeposeError: the measurements contradict each other.
    """
    source, plan = job.source, job.plan
    reset, facing = _facing(plan, measured, notify)
    measured = measured._replace(reset=reset)
    result = calibration.calibrate(
        measured.summary,
        pose=plan.first_pose,
        body_frame=facing,
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        heading_offset=None if reset is None else reset.offset,
        metadata=_metadata(source, plan, measured),
        filter=job.filter,
        north=orient.north and (job.filter != "none" or reset is None),
        height_m=job.height_m,
    )
    warnings = list(measured.warnings)
    if measured.t_pose is not None:
        result, differences = calibration.with_t_pose(result, measured.t_pose.orientation)
        warnings += differences
    if job.sensor_map is not None:
        stated = {name: device.mounting for name, device in job.sensor_map.devices.items()}
        warnings += calibration.mounting_warnings(result, stated, job.sensor_map.path)
    return measured, result, warnings


def _facing(
    plan: CalibrationPlan, measured: Measured, notify: Notify
) -> tuple[calibration.HeadingReset | None, str]:
    """Return the heading reset and the body frame, both improved by the raised arms of a T-pose.

    Raises:
        EdgeposeError: the arms contradict each other, or the heading reset.
    """
    reset = measured.reset
    if measured.t_pose is None:
        return reset, plan.facing
    arms = calibration.forward_of_raised_arms(measured.summary.orientation, measured.t_pose.orientation)
    if reset is not None and finds_forward(plan.heading_reset):
        return calibration.with_raised_arms(reset, arms), plan.facing
    offset = np.zeros(len(PLACEMENTS)) if reset is None else reset.offset
    angle_deg, error_deg = calibration.facing_deg(arms, offset)
    notify(f"The raised arms show that the wearer faces {angle_deg:.1f} deg, to within {error_deg:.0f} deg.")
    return reset, plan.body_frame or f"heading:{angle_deg:.2f}"


def _metadata(source: SourceConfig, plan: CalibrationPlan, measured: Measured) -> dict[str, Any]:
    """Return the part of a calibration file that says how it was made."""
    summary, reset = measured.summary, measured.reset
    metadata: dict[str, Any] = {
        "program": f"edgepose {__version__}",
        "source": source.name,
        "hold_s": plan.hold_s,
    }
    if measured.from_s is not None:
        metadata["from_s"] = measured.from_s
    if measured.devices:
        metadata["devices"] = {
            SENSORS[index]: device._asdict() for index, device in sorted(measured.devices.items())
        }
    metadata["samples"] = dict(zip(summary.names, summary.samples, strict=True))
    metadata["force_m_s2"] = _by_name(summary.names, np.linalg.norm(summary.force, axis=-1))
    metadata["warnings"] = measured.warnings
    if reset is not None:
        metadata["heading_reset"] = {
            "source": plan.heading_reset,
            "error_deg": _by_name(reset.names, reset.error_deg),
        }
    return metadata


def _by_name(names: Sequence[str], values: Array) -> dict[str, float | None]:
    """Return the numbers (N,) rounded, by sensor; None for NaN."""
    pairs = zip(names, values, strict=True)
    return {name: None if math.isnan(v) else round(float(v), 3) for name, v in pairs}
