"""Holds and movements of a wearer in front of a live source: prompts, and the samples of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from edgepose import calibration
from edgepose.calibration import Hold, HoldError, MovedError, WeakMotionError
from edgepose.cli.guide.guide import Guide, start_stage
from edgepose.cli.guide.stage import COUNTDOWN, HOLD, MOVE, Stage
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import LACKING, PLACEMENTS, SENSORS
from edgepose.sources import Batch

REPEATS = 3
"""Number of retries of a live hold with movement in it, or of movements that are too weak."""

ALL_REPORT_S = 10.0
"""Longest wait for the first samples of all sensors of a live source, seconds."""

MOVE_COUNTDOWN_S = 3.0
"""Longest time before each movement, seconds."""

_INSTRUCTIONS = {
    "straight": "Stand straight: feet parallel, arms hanging, palms on the thighs, looking ahead.",
    "t-pose": "Stand in a T-pose: feet parallel, arms out to the sides, palms down, looking ahead.",
    "lying": "Lay {all_of_them} sensors side by side, same face up, same edge forward, and let go of them.",
}

_STEPS = "Take two or three steps straight ahead, stop with arms hanging, and stand still"

_MOVES = {
    "head": ("BOW", "bow"),
    "left_forearm": ("LEFT", "forearm"),
    "right_forearm": ("RIGHT", "forearm"),
    "left_lower_leg": ("LEFT", "heel"),
    "right_lower_leg": ("RIGHT", "heel"),
    "left_upper_arm": ("LEFT", "forearm"),
    "right_upper_arm": ("RIGHT", "forearm"),
    "left_upper_leg": ("LEFT", "heel"),
    "right_upper_leg": ("RIGHT", "heel"),
}
"""Word and picture of each movement, by the first sensor that it moves."""


def wait_for_all_sensors(batches: Iterator[Batch], guide: Guide, names: Sequence[str]) -> Iterator[Batch]:
    """Wait until all sensors of a rig have reported, and return the remaining batches.

    Raises:
        EdgeposeError: a sensor is still missing after `ALL_REPORT_S`.
    """
    passed_s, prompted_s = 0.0, 0
    start_s: float | None = None
    missing = {SENSORS.index(name) for name in names}
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        passed_s = now_s - start_s
        missing -= {sample.sensor for sample in samples}
        if not missing:
            guide(f"{calibration.all_of(names).capitalize()} sensors report.")
            return batches
        if int(passed_s) > prompted_s:
            prompted_s = int(passed_s)
            guide(f"Waiting for {_names(missing)}.")
        if passed_s > ALL_REPORT_S:
            break
    silent = [SENSORS[i] for i in sorted(missing)]
    lacking = f"; if the rig lacks them: --without {','.join(silent)}" if LACKING.issuperset(silent) else ""
    raise EdgeposeError(
        f"nothing from {_names(missing)} in {passed_s:.0f} s: check power, link and id of each{lacking}"
    )


def _names(sensors: set[int]) -> str:
    return ", ".join(SENSORS[i] for i in sorted(sensors))


def record_hold(
    batches: Iterator[Batch],
    pose: str,
    countdown_s: float,
    hold_s: float,
    guide: Guide,
    check: Callable[[Hold], Any],
    names: Sequence[str] = PLACEMENTS,
    at_once: bool = False,
) -> Any:
    """Record a live hold, and return what `check` returns for it.

    Args:
        batches: samples of the live source.
        pose: key of the instruction to show.
        countdown_s: time before the hold, seconds.
        hold_s: length of the hold, seconds.
        guide: shows the wearer what to do.
        check: evaluates the hold; if it raises HoldError, the hold is repeated.
        names: sensors of the rig.
        at_once: do not wait for the phone's start button: the wearer must not move away.

    Raises:
        HoldError: there was movement, or a silent sensor, in every repetition.
        EdgeposeError: the source ended too early.
    """
    text = _INSTRUCTIONS[pose].format(all_of_them=calibration.all_of(names))
    if guide.phone is not None and not at_once:
        wait_for_start(batches, guide, f"Press start; {countdown_s:g} s later the hold begins. {text}", pose)
    guide.instruct(text)
    countdown = Stage(COUNTDOWN, "", text, pose, countdown_s, "The hold starts in {} s")
    hold = Stage(HOLD, "HOLD", f"Hold still. {text}", pose, hold_s)
    for left in range(REPEATS, -1, -1):
        if countdown_s:
            collect(batches, countdown, guide)
        samples, start_s = collect(batches, hold, guide)
        try:
            held = calibration.hold_from_samples(samples, names)
            calibration.check_covered(held, start_s, start_s + hold_s)
            return check(held)
        except HoldError as error:
            if not left:
                raise
            guide(f"{'Not still: ' if isinstance(error, MovedError) else ''}{error}. Trying again.")
    raise AssertionError("the last repeat returns or raises")


def collect(batches: Iterator[Batch], stage: Stage, guide: Guide) -> tuple[list[ImuSample], float]:
    """Return the samples of a stage, and its start on the source's clock, seconds.

    Raises:
        EdgeposeError: the source ended too early.
    """
    collected: list[ImuSample] = []
    start_s: float | None = None
    guide.begin()
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        collected += samples
        guide.show(stage, min(now_s - start_s, stage.total_s))
        if now_s - start_s >= stage.total_s:
            return collected, start_s
    raise EdgeposeError(
        "the source ended before the hold was over; use a longer recording or a shorter --countdown"
    )


def record_motion(
    batches: Iterator[Batch],
    countdown_s: float,
    guide: Guide,
    check: Callable[[Hold], Any],
    names: Sequence[str] = PLACEMENTS,
) -> Any:
    """Record the movements of `calibration.routine`, and return what `check` returns for them.

    Args:
        batches: samples of the live source.
        countdown_s: time before the hold, seconds; that before each movement is `MOVE_COUNTDOWN_S` at most.
        guide: shows the wearer what to do.
        check: evaluates the movements; if it raises WeakMotionError, they are repeated.
        names: sensors of the rig.

    Raises:
        WeakMotionError: every repetition was too weak.
        EdgeposeError: the source ended too early.
    """
    guide.instruct("Keep facing the same way and follow the instructions.")
    wait_s = min(countdown_s, MOVE_COUNTDOWN_S)

    def movements() -> Iterator[ImuSample]:
        for exercise in calibration.routine(names):
            word, figure = _MOVES[exercise.sensors[0]]
            text = exercise.text
            if wait_s:
                collect(batches, Stage(COUNTDOWN, "", text, figure, wait_s), guide)
            yield from collect(batches, Stage(MOVE, word, text, figure, calibration.EXERCISE_S), guide)[0]

    return _until_clear(movements, guide, check, names)


def record_steps(
    batches: Iterator[Batch], countdown_s: float, guide: Guide, check: Callable[[Hold], Any]
) -> Any:
    """Record some steps, with the stand before them, and return what `check` returns for them.

    Args:
        batches: samples of the live source.
        countdown_s: time before the hold, seconds; that before the steps is `MOVE_COUNTDOWN_S` at most.
        guide: shows the wearer what to do.
        check: evaluates the steps; if it raises WeakMotionError, they are repeated.

    Raises:
        WeakMotionError: every repetition was refused.
        EdgeposeError: the source ended too early.
    """
    guide.instruct(f"Stand still until the steps begin. {_STEPS}.")
    wait_s = min(countdown_s, MOVE_COUNTDOWN_S) or 1.0  # the stand before the steps is needed
    stand = Stage(COUNTDOWN, "", f"Stand still. Then: {_STEPS}", "step", wait_s)
    walk = Stage(MOVE, "STEPS", _STEPS, "step", calibration.STEPS_S)

    def steps() -> Iterator[ImuSample]:
        for stage in (stand, walk):
            yield from collect(batches, stage, guide)[0]

    return _until_clear(steps, guide, check, PLACEMENTS)


def _until_clear(
    record: Callable[[], Iterator[ImuSample]],
    guide: Guide,
    check: Callable[[Hold], Any],
    names: Sequence[str],
) -> Any:
    """Record movements until `check` accepts them, and return what it returns for them."""
    for left in range(REPEATS, -1, -1):
        try:
            return check(calibration.hold_from_samples(record(), names))
        except WeakMotionError as error:
            if not left:
                raise
            guide(f"{error}. Trying again.")
    raise AssertionError("the last repeat returns or raises")


def wait_for_start(batches: Iterator[Batch], guide: Guide, text: str, figure: str) -> None:
    """Wait until the wearer presses start on the phone, or Enter; not at all with neither."""
    if not guide.can_start:
        return
    guide.instruct(text)
    # Keep reading the port meanwhile, so that the next samples are not old ones.
    for _ in batches:
        guide.show(start_stage(text, figure))
        if guide.started():
            return
