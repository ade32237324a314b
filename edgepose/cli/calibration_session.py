"""The hold and the heading reset of a calibration, from a live source or from a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from edgepose import calibration
from edgepose.calibration import HeadingReset, Hold, HoldSummary
from edgepose.cli.prompts import Prompter, record_hold, record_motion, wait_for_all_sensors, wait_for_enter
from edgepose.config import SourceConfig
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.registry import read_recording
from edgepose.orientation.stage import OrientationStage
from edgepose.sources import Device, open_source
from edgepose.sources.replay import is_recording

ROUTINE_S = 30.0
"""Longest motion that is taken from a recording unless --motion says from where to where."""


def finds_forward(heading_reset: str | None) -> bool:
    """Whether that way of heading reset also finds out where the wearer faces."""
    return heading_reset is not None and heading_reset.partition(":")[0] in ("motion", "mounting")


class CalibrationPlan(NamedTuple):
    """What the wearer will do: the command's flags, and how the sensors sit if the heading reset needs it."""

    pose: str
    heading_reset: str | None
    mounting: list[str]
    motion: tuple[float, float] | None
    hold_s: float
    from_s: float | None
    countdown_s: float

    @property
    def lying(self) -> Path | None:
        """The recording of sensors that lie side by side."""
        way = self.heading_reset
        return None if way is None or way == "live" or finds_forward(way) else Path(way)


class Measured(NamedTuple):
    """What a calibration is made of.

    Attributes:
        summary: the hold.
        reset: the heading reset, if there is one.
        from_s: when the hold begins in a recording, seconds.
        devices: what sent the samples, by placement.
    """

    summary: HoldSummary
    reset: HeadingReset | None
    from_s: float | None
    devices: Mapping[int, Device]


def live(source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, say: Prompter) -> Measured:
    """The hold and the heading reset of a wearer in front of a live source."""
    reset = _side_by_side(source, plan, orient, say)
    with open_source(**source.arguments()) as opened:
        batches = wait_for_all_sensors((b._replace(samples=orient(b.samples)) for b in opened), say)
        if plan.heading_reset == "live":
            reset = record_hold(
                batches, "lying", plan.countdown_s, plan.hold_s, say, calibration.headings_side_by_side
            )
            wait_for_enter(batches, say)
        summary = record_hold(batches, plan.pose, plan.countdown_s, plan.hold_s, say, calibration.check_hold)
        # Not before: magnetometers may be slower than the rest.
        _check_north(orient, plan)
        if plan.heading_reset == "motion":
            upright = summary.orientation
            reset = record_motion(
                batches, say, lambda moving: calibration.headings_from_motion(moving, upright)
            )
    return Measured(summary, reset or _mounted(plan, summary), None, opened.devices)


def recorded(
    source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, say: Prompter
) -> Measured:
    """The hold and the heading reset in a recording."""
    reset = _side_by_side(source, plan, orient, say)
    everything, damage, devices = _read(source, orient)
    _check_north(orient, plan)
    still, start_s = _window(source.name, (everything, damage), plan.from_s, plan.hold_s, say)
    if plan.from_s is None:
        say("If the wearer stood in the pose at another time, say so with --from.")
    summary = calibration.check_hold(still, "choose a still part with --from, or record again")
    if plan.heading_reset == "motion":
        end_s = start_s + plan.hold_s
        moving = calibration.trim(everything, *(plan.motion or (end_s, end_s + ROUTINE_S)))
        if not all(len(sensor.time_s) for sensor in moving):
            raise EdgeposeError(
                f"{source.name}: not all six sensors report where the movements should be; say where "
                "with --motion FROM:TO, or use another --heading-reset"
            )
        reset = calibration.headings_from_motion(moving, summary.orientation)
    return Measured(summary, reset or _mounted(plan, summary), start_s, devices)


def _side_by_side(
    source: SourceConfig, plan: CalibrationPlan, orient: OrientationStage, say: Prompter
) -> HeadingReset | None:
    """Heading reset from a recording of the sensors lying side by side, if there is one.

    Raises:
        EdgeposeError: they do not lie so, or their headings mean nothing in another recording.
    """
    if plan.lying is None:
        return None
    say(f"Heading reset from {plan.lying}.")
    own = orient.fresh()
    everything, damage, _ = _read(dataclasses.replace(source, file=plan.lying, port=None, can=None), own)
    if not own.north:
        raise EdgeposeError(
            "the filter's headings begin anew in each recording, so another one cannot reset them: "
            "use --heading-reset motion, live or mounting"
        )
    return calibration.headings_side_by_side(
        _window(str(plan.lying), (everything, damage), None, plan.hold_s, say)[0]
    )


def _mounted(plan: CalibrationPlan, summary: HoldSummary) -> HeadingReset | None:
    """Heading reset from how the sensors sit, if that is wanted."""
    way, _, axis = (plan.heading_reset or "").partition(":")
    if way != "mounting":
        return None
    if plan.mounting:
        return calibration.headings_from_mounting(summary.orientation, plan.mounting)
    return calibration.headings_from_axis(summary.orientation, axis)


def _check_north(orient: OrientationStage, plan: CalibrationPlan) -> None:
    """Raises EdgeposeError if a filter has begun with any headings and nothing will bring them together."""
    if orient.mixed:
        raise EdgeposeError(
            "some sensors have a magnetometer and others none: their headings would differ; add --no-mag"
        )
    # Sensors that lay side by side in another recording had a north there.
    if (plan.heading_reset is None or plan.lying is not None) and not orient.north:
        raise EdgeposeError(
            "without a magnetometer in each sensor the filter's headings are arbitrary: "
            "add --heading-reset motion, live or mounting"
        )


# --- recordings ---------------------------------------------------------------------------------------------


def _read(source: SourceConfig, orient: OrientationStage) -> tuple[Hold, str | None, Mapping[int, Device]]:
    """Everything in a recording or a raw capture, what is wrong with it, and what sent it."""
    path = source.file
    assert path is not None
    if is_recording(path):
        recording = read_recording(path, _serial_numbers(source.sensors))
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
    """Placements by serial number in a map of sensors."""
    if sensors is None:
        return None
    from edgepose.sources.sensor_map import read_map

    return read_map(sensors).serial_numbers()


def _window(
    name: str, read: tuple[Hold, str | None], from_s: float | None, seconds: float, say: Prompter
) -> tuple[Hold, float]:
    """The part of a recording that is a hold, and its start on the recording's clock, seconds."""
    everything, damage = read
    if damage:
        say(f"warning: {damage}")
    start = calibration.stillest_start(everything, seconds) if from_s is None else from_s
    first = min((s.time_s[0] for s in everything if len(s.time_s)), default=0.0)
    last = max((s.time_s[-1] for s in everything if len(s.time_s)), default=0.0)
    # The last sample comes a little before the end.
    if from_s is not None and not first - 1e-6 <= start <= last - seconds + 0.1:
        raise EdgeposeError(
            f"{name}: it has no {seconds:g} s from {start:g} s; it lasts from {first:.2f} to {last:.2f} s, "
            "choose --from and --hold within that"
        )
    why = "" if from_s is not None else ", the first as still as the stillest"
    say(f"{name}: hold from {start:.2f} to {start + seconds:.2f} s{why}.")
    return calibration.trim(everything, start, start + seconds), start
