"""Hold and heading reset of a calibration, from a live source or from a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from edgepose import calibration
from edgepose.calibration import TWO_POSES, HeadingReset, Hold, HoldSummary
from edgepose.cli.guide.guide import Guide
from edgepose.cli.guide.stage import LISTEN, Stage
from edgepose.cli.options.recording_time import RecordingTime
from edgepose.cli.prompts import (
    MOVE_COUNTDOWN_S,
    collect,
    record_hold,
    record_motion,
    record_steps,
    wait_for_all_sensors,
    wait_for_start,
)
from edgepose.cli.recorded_holds import END_S, Notify, extent, hold_in, read_holds
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.orientation.stage import OrientationStage
from edgepose.pipeline.rig_comparison import without_common_heading
from edgepose.placements import PLACEMENTS
from edgepose.rotations import Array
from edgepose.sources import Batch, Device, open_source
from edgepose.utils.fault_messages import HEADING_RESETS

LISTEN_S = 1.0
"""Time in which most sensors send all that they measure, seconds."""

LISTENS = 3
"""Number of such times after which something is missing: some magnetometers are slow."""

ROUTINE_S = 30.0
"""Length of the motion that is taken from a recording without --motion, seconds."""


def finds_forward(heading_reset: str | None) -> bool:
    """Return whether this kind of heading reset also finds the direction that the wearer faces."""
    return heading_reset is not None and heading_reset.partition(":")[0] in ("motion", "mounting", "steps")


@dataclass(frozen=True, kw_only=True)
class CalibrationPlan:
    """Steps of a calibration; all fields except the last two are flags of `edgepose calibrate`.

    Attributes:
        pose: pose of the hold, or `TWO_POSES`.
        body_frame: the direction that the wearer faces; None is the default for the heading reset.
        heading_reset: "live", "motion", "steps", "mounting[:AXIS]" or a file; None for none.
        motion: start and end of the movements in a recording.
        hold_s: length of the hold, seconds.
        start: start of the hold in a recording; None looks for the stillest part.
        countdown_s: time before each live hold, seconds.
        names: sensors of the rig; recordings may hold further ones.
        mounting: how the sensors are worn, by name, if the heading reset needs it.
    """

    pose: str
    body_frame: str | None
    heading_reset: str | None
    motion: tuple[RecordingTime, RecordingTime] | None
    hold_s: float
    start: RecordingTime | None
    countdown_s: float
    names: Sequence[str] = PLACEMENTS
    mounting: Mapping[str, str] = field(default_factory=dict)

    @property
    def first_pose(self) -> str:
        """The pose of the first hold."""
        return self.pose.partition("+")[0]

    @property
    def side_by_side(self) -> Path | None:
        """The recording of sensors that lie side by side, if the heading reset names one."""
        reset = self.heading_reset
        return None if reset is None or reset == "live" or finds_forward(reset) else Path(reset)

    @property
    def facing(self) -> str:
        """The body frame, or its default."""
        return self.body_frame or ("heading:0" if finds_forward(self.heading_reset) else "pelvis:-z")


class Measured(NamedTuple):
    """Measurements for a calibration.

    Attributes:
        summary: the hold.
        reset: the heading reset, if there is one.
        from_s: start of the hold in a recording, seconds; None if it was live.
        devices: the devices that sent the samples, by placement.
        damaged: a part of a recording was left out.
        t_pose: a second hold, of the T-pose, if the plan asks for it.
    """

    summary: HoldSummary
    reset: HeadingReset | None
    from_s: float | None
    devices: Mapping[int, Device]
    damaged: bool = False
    t_pose: HoldSummary | None = None

    @property
    def warnings(self) -> list[str]:
        """Warnings about the hold and the heading reset."""
        return [*self.summary.warnings, *(() if self.reset is None else self.reset.warnings)]


def measure_live(
    source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, guide: Guide
) -> Measured:
    """Guide a wearer through the hold and the heading reset with live sensors.

    Raises:
        EdgeposeError: sensors are missing, the wearer moved, or headings would be arbitrary.
    """
    names = plan.names
    _check_six(plan, names)
    reset, damaged = _side_by_side(source, plan, orient, guide)
    orient.names = names
    with open_source(**source.arguments()) as opened:
        batches = wait_for_all_sensors((b._replace(samples=orient(b.samples)) for b in opened), guide, names)
        _check_before_hold(batches, guide, orient, plan, opened.devices)
        if plan.heading_reset == "live":
            check = calibration.headings_side_by_side
            reset = record_hold(batches, "lying", plan.countdown_s, plan.hold_s, guide, check, names)
            if guide.phone is None:  # otherwise every hold begins with its start button
                text = "Put the sensors on. Press Enter when the wearer is ready."
                wait_for_start(batches, guide, text, plan.first_pose)
        check_hold, pose = calibration.check_hold, plan.first_pose
        summary = record_hold(batches, pose, plan.countdown_s, plan.hold_s, guide, check_hold, names)
        _check_north(orient, plan, opened.devices)
        t_pose, straight = None, summary.orientation
        if plan.pose == TWO_POSES:
            wait_s = min(plan.countdown_s, MOVE_COUNTDOWN_S)
            t_pose = record_hold(
                *(batches, "t-pose", wait_s, plan.hold_s, guide),
                lambda held: _raised(straight, held),
                at_once=True,
            )
        if plan.heading_reset == "motion":
            reset = record_motion(
                batches,
                plan.countdown_s,
                guide,
                lambda moving: calibration.headings_from_motion(moving, straight),
                names,
            )
        elif plan.heading_reset == "steps":
            reset = record_steps(
                batches,
                plan.countdown_s,
                guide,
                lambda moving: calibration.headings_from_steps(moving, straight),
            )
    reset = _reset_of(names, reset or _mounted(plan, summary))
    return Measured(summary, reset, None, opened.devices, damaged, t_pose)


def _check_before_hold(
    batches: Iterator[Batch],
    guide: Guide,
    orient: OrientationStage,
    plan: CalibrationPlan,
    devices: Mapping[int, Device],
) -> None:
    """Check that sensors send all that the calibration needs, before the wearer takes the pose.

    Raises:
        EdgeposeError: orientations, or a common heading, are missing.
    """
    samples: list[ImuSample] = []
    for left in range(LISTENS - 1, -1, -1):
        listening = Stage(LISTEN, "...", "Listening to the sensors.", plan.first_pose, LISTEN_S)
        samples += collect(batches, listening, guide)[0]
        try:
            calibration.check_reported(calibration.hold_from_samples(samples, plan.names))
            _check_north(orient, plan, devices)
            return
        except EdgeposeError:
            if not left:
                raise


def measure_recorded(
    source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, notify: Notify
) -> Measured:
    """Find the hold and the heading reset in a recording.

    Raises:
        EdgeposeError: they are not in it, the wearer moved, or headings would be arbitrary.
    """
    reset, damaged = _side_by_side(source, plan, orient, notify)
    everything, damage, devices = read_holds(source, orient, plan.names)
    _check_six(plan, orient.names)
    _check_north(orient, plan, devices)
    everything, still, start_s = hold_in(source.name, (everything, damage), plan.start, plan.hold_s, notify)
    if plan.start is None:
        notify("If the wearer stood in the pose at another time, give its start with --from.")
    summary = calibration.check_hold(still, "choose a still part with --from, or record again")
    t_pose = None
    if plan.pose == TWO_POSES:
        end_s = start_s + plan.hold_s
        t_start_s = calibration.t_pose_start(everything, summary.orientation, end_s, plan.hold_s)
        notify(f"{source.name}: T-pose from {t_start_s:.2f} to {t_start_s + plan.hold_s:.2f} s.")
        held = calibration.trim(everything, t_start_s, t_start_s + plan.hold_s)
        t_pose = _raised(summary.orientation, held)
    if plan.heading_reset == "motion":
        moving = _movements(source.name, everything, plan, start_s + plan.hold_s)
        reset = calibration.headings_from_motion(moving, summary.orientation)
    elif plan.heading_reset == "steps":
        moving = _movements(source.name, everything, plan, start_s)  # with the stand before the steps
        reset = calibration.headings_from_steps(moving, summary.orientation, must_stop=False)
    reset = _reset_of(summary.names, reset or _mounted(plan, summary))
    return Measured(summary, reset, start_s, devices, damaged or damage is not None, t_pose)


def _check_six(plan: CalibrationPlan, names: Sequence[str]) -> None:
    """Raise EdgeposeError if the plan needs a rig of the six sensors, and it has others."""
    flag = "--heading-reset steps" if plan.heading_reset == "steps" else f"--pose {plan.pose}"
    if (plan.heading_reset == "steps" or plan.pose == TWO_POSES) and list(names) != list(PLACEMENTS):
        raise EdgeposeError(
            f"{flag} works with the six sensors only, and this rig has {len(names)}: choose another way"
        )


def _raised(straight: Array, held: Hold) -> HoldSummary:
    """Check the hold of the T-pose that follows a straight pose, (6, 4) mean quaternions."""
    summary = calibration.check_hold(held)
    calibration.forward_of_raised_arms(straight, summary.orientation)
    return summary


def _movements(name: str, everything: Hold, plan: CalibrationPlan, begin_s: float) -> Hold:
    """Return the part of a recording with the movements of a heading reset.

    Args:
        name: of the recording.
        everything: its samples.
        plan: of the calibration.
        begin_s: start of the movements without --motion, on the recording's clock, seconds.

    Raises:
        EdgeposeError: the recording does not contain it, or a sensor reports nothing in it.
    """
    span = begin_s, begin_s + ROUTINE_S
    if plan.motion is not None:
        first_s, last_s = extent(everything)
        start_s, end_s = (time.on_clock(first_s) for time in plan.motion)
        span = start_s, end_s
        if not first_s - 1e-6 <= start_s < end_s <= last_s + END_S:
            raise EdgeposeError(
                f"{name}: it does not contain {start_s:g} to {end_s:g} s; it lasts from {first_s:.2f} to "
                f"{last_s:.2f} s, choose --motion within that"
            )
    moving = calibration.trim(everything, *span)
    if not all(len(sensor.time_s) for sensor in moving):
        raise EdgeposeError(
            f"{name}: not all sensors report during the movements; give their time with "
            "--motion FROM:TO, or use another --heading-reset"
        )
    return moving


def _side_by_side(
    source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, notify: Notify
) -> tuple[HeadingReset | None, bool]:
    """Return the heading reset from a recording of the sensors lying side by side, if the plan names one.

    The second value is whether a part of that recording was left out.

    Raises:
        EdgeposeError: the sensors do not lie side by side, or their headings do not hold in other recordings.
    """
    path = plan.side_by_side
    if path is None:
        return None, False
    fresh = orient.fresh()
    # What the lying sensors of a rig are connected to is in their file.
    lying_source = dataclasses.replace(source, file=path, port=None, can=None)
    everything, damage, _ = read_holds(lying_source, fresh, plan.names)
    notify(f"Heading reset from {path}.")
    if not fresh.north:
        raise EdgeposeError(
            "without magnetometers the filter starts each recording with arbitrary headings, which another "
            f"recording cannot reset: use {HEADING_RESETS}"
        )
    _, lying, _ = hold_in(str(path), (everything, damage), None, plan.hold_s, notify)
    return calibration.headings_side_by_side(lying), damage is not None


def _mounted(plan: CalibrationPlan, summary: HoldSummary) -> HeadingReset | None:
    """Return the heading reset from the mounting of the sensors, if the plan asks for it."""
    kind, _, axis = (plan.heading_reset or "").partition(":")
    if kind != "mounting":
        return None
    names = summary.names
    if not plan.mounting:
        return calibration.headings_from_axis(summary.orientation, axis, names)
    if unknown := [name for name in names if name not in plan.mounting]:
        raise EdgeposeError(
            f"--sensors has no mounting of {', '.join(unknown)}, which --heading-reset mounting needs"
        )
    mounting = [plan.mounting[name] for name in names]
    return calibration.headings_from_mounting(summary.orientation, mounting, names)


def _reset_of(names: Sequence[str], reset: HeadingReset | None) -> HeadingReset | None:
    """Return the part of a heading reset for some of its sensors.

    Raises:
        EdgeposeError: it lacks one of them.
    """
    if reset is None or list(reset.names) == list(names):
        return reset
    if lacking := [name for name in names if name not in reset.names]:
        raise EdgeposeError(
            f"the heading reset has no {', '.join(lacking)}: record it with all sensors of the rig"
        )
    rows = [list(reset.names).index(name) for name in names]
    return HeadingReset(reset.offset[rows], reset.error_deg[rows], reset.warnings, names)


def _check_north(orient: OrientationStage, plan: CalibrationPlan, devices: Mapping[int, Device]) -> None:
    """Raise EdgeposeError if a filter, or devices, started with arbitrary headings that no reset aligns."""
    apart = without_common_heading(devices)
    if apart is not None and orient.passes and plan.heading_reset is None:
        raise EdgeposeError(apart)
    if orient.mixed:
        raise EdgeposeError(
            "some sensors have a magnetometer and others do not: their headings would differ; add --no-mag"
        )
    # A reset from another recording assumes that headings have a north.
    if (plan.heading_reset is None or plan.side_by_side is not None) and not orient.north:
        raise EdgeposeError(
            f"without a magnetometer in each sensor the filter's headings are arbitrary: add {HEADING_RESETS}"
        )
