"""Hold and heading reset of a calibration, from a live source or from a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
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
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import ImuSample
from edgepose.orientation.stage import OrientationStage
from edgepose.pipeline.rig_comparison import without_common_heading
from edgepose.rotations import Array
from edgepose.sources import Batch, Device, open_source
from edgepose.sources.replay import is_recording
from edgepose.utils.fault_messages import HEADING_RESETS

Notify = Callable[[str], None]
"""Shows a line to the user."""

END_S = 0.1
"""Longest time from the last sample of a recording to its end, seconds."""

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
    """Steps of a calibration; all fields except `mounting` are flags of `edgepose calibrate`.

    Attributes:
        pose: pose of the hold, or `TWO_POSES`.
        body_frame: the direction that the wearer faces; None is the default for the heading reset.
        heading_reset: "live", "motion", "steps", "mounting[:AXIS]" or a file; None for none.
        motion: start and end of the movements in a recording.
        hold_s: length of the hold, seconds.
        start: start of the hold in a recording; None looks for the stillest part.
        countdown_s: time before each live hold, seconds.
        mounting: how the sensors are worn, in the order of PLACEMENTS, if the heading reset needs it.
    """

    pose: str
    body_frame: str | None
    heading_reset: str | None
    motion: tuple[RecordingTime, RecordingTime] | None
    hold_s: float
    start: RecordingTime | None
    countdown_s: float
    mounting: Sequence[str] = ()

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
    reset, damaged = _side_by_side(source, plan, orient, guide)
    with open_source(**source.arguments()) as opened:
        batches = wait_for_all_sensors((b._replace(samples=orient(b.samples)) for b in opened), guide)
        _check_before_hold(batches, guide, orient, plan, opened.devices)
        if plan.heading_reset == "live":
            reset = record_hold(
                batches, "lying", plan.countdown_s, plan.hold_s, guide, calibration.headings_side_by_side
            )
            if guide.phone is None:  # otherwise every hold begins with its start button
                text = "Put the sensors on. Press Enter when the wearer is ready."
                wait_for_start(batches, guide, text, plan.first_pose)
        summary = record_hold(
            batches, plan.first_pose, plan.countdown_s, plan.hold_s, guide, calibration.check_hold
        )
        _check_north(orient, plan, opened.devices)
        t_pose = None
        if plan.pose == TWO_POSES:
            straight = summary.orientation
            wait_s = min(plan.countdown_s, MOVE_COUNTDOWN_S)
            t_pose = record_hold(
                *(batches, "t-pose", wait_s, plan.hold_s, guide),
                lambda held: _raised(straight, held),
                at_once=True,
            )
        if plan.heading_reset == "motion":
            upright = summary.orientation
            reset = record_motion(
                batches,
                plan.countdown_s,
                guide,
                lambda moving: calibration.headings_from_motion(moving, upright),
            )
        elif plan.heading_reset == "steps":
            upright = summary.orientation
            reset = record_steps(
                batches,
                plan.countdown_s,
                guide,
                lambda moving: calibration.headings_from_steps(moving, upright),
            )
    return Measured(summary, reset or _mounted(plan, summary), None, opened.devices, damaged, t_pose)


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
            calibration.check_reported(calibration.hold_from_samples(samples))
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
    everything, damage, devices = _read(source, orient)
    _check_north(orient, plan, devices)
    still, start_s = _window(source.name, (everything, damage), plan.start, plan.hold_s, notify)
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
    reset = reset or _mounted(plan, summary)
    return Measured(summary, reset, start_s, devices, damaged or damage is not None, t_pose)


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
        first_s, last_s = _extent(everything)
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
            f"{name}: not all six sensors report during the movements; give their time with "
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
    notify(f"Heading reset from {path}.")
    fresh = orient.fresh()
    everything, damage, _ = _read(dataclasses.replace(source, file=path, port=None, can=None), fresh)
    if not fresh.north:
        raise EdgeposeError(
            "without magnetometers the filter starts each recording with arbitrary headings, which another "
            f"recording cannot reset: use {HEADING_RESETS}"
        )
    lying, _ = _window(str(path), (everything, damage), None, plan.hold_s, notify)
    return calibration.headings_side_by_side(lying), damage is not None


def _mounted(plan: CalibrationPlan, summary: HoldSummary) -> HeadingReset | None:
    """Return the heading reset from the mounting of the sensors, if the plan asks for it."""
    kind, _, axis = (plan.heading_reset or "").partition(":")
    if kind != "mounting":
        return None
    if plan.mounting:
        return calibration.headings_from_mounting(summary.orientation, plan.mounting)
    return calibration.headings_from_axis(summary.orientation, axis)


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


# --- recordings ---------------------------------------------------------------------------------------------


def _read(source: SourceConfig, orient: OrientationStage) -> tuple[Hold, str | None, Mapping[int, Device]]:
    """Return all samples of a recording or a raw capture, its damage, and the devices that sent them."""
    path = source.file
    assert path is not None
    if is_recording(path):
        recording = read_recording(path, _serial_numbers(source.sensors), salvage=True)
        everything = (
            calibration.hold_from_recording(recording)
            if orient.passes
            else calibration.hold_from_samples(orient(list(iter_samples(recording))))
        )
        return everything, recording.damage, {}
    with open_source(**dataclasses.replace(source, realtime=False).arguments()) as opened:
        everything = calibration.hold_from_samples(
            chain.from_iterable(orient(batch.samples) for batch in opened)
        )
        return everything, opened.damage, opened.devices


def _serial_numbers(sensors: Path | None) -> Mapping[int, str] | None:
    """Return placements by serial number from a sensor map."""
    if sensors is None:
        return None
    from edgepose.sources.sensor_map import read_map

    return read_map(sensors).serial_numbers()


def _window(
    name: str,
    read: tuple[Hold, str | None],
    at: RecordingTime | None,
    seconds: float,
    notify: Notify,
) -> tuple[Hold, float]:
    """Return the hold in a recording, and its start on the recording's clock, seconds."""
    everything, damage = read
    if damage:
        notify(f"warning: {damage}")
    first, last = _extent(everything)
    start = calibration.stillest_start(everything, seconds) if at is None else at.on_clock(first)
    if at is not None and not first - 1e-6 <= start <= last - seconds + END_S:
        raise EdgeposeError(
            f"{name}: it does not contain {seconds:g} s from {start:g} s on; it lasts from {first:.2f} to "
            f"{last:.2f} s, choose --from and --hold within that"
        )
    why = "" if at is not None else ", the first of the stillest parts"
    notify(f"{name}: hold from {start:.2f} to {start + seconds:.2f} s{why}.")
    hold = calibration.trim(everything, start, start + seconds)
    calibration.check_covered(hold, start, start + seconds)
    return hold, start


def _extent(everything: Hold) -> tuple[float, float]:
    """Return the times of the first and the last sample of all sensors; 0 if there are none."""
    times = [sensor.time_s for sensor in everything if len(sensor.time_s)]
    return min((t.min() for t in times), default=0.0), max((t.max() for t in times), default=0.0)
