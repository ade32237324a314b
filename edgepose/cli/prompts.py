"""Prompts that guide a wearer through holds and movements, and collect the samples of a live source."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import click

from edgepose import calibration
from edgepose.calibration import Hold, HoldError, MovedError, WeakMotionError
from edgepose.cli.terminal import messages as terminal
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import Batch

REPEATS = 3
"""Number of retries of a live hold with movement in it, or of movements that are too weak."""

ALL_REPORT_S = 10.0
"""Longest wait for the first samples of all six sensors of a live source, seconds."""

_INSTRUCTIONS = {
    "straight": "Stand straight: feet parallel, arms hanging, palms on the thighs, looking ahead.",
    "t-pose": "Stand in a T-pose: feet parallel, arms out to the sides, palms down, looking ahead.",
    "lying": "Lay all six sensors side by side, same face up, same edge forward, and let go of them.",
}


class Prompter:
    """Writes prompts for the wearer to stdout, or to stderr if stdout carries the result.

    Attributes:
        err: whether prompts go to stderr.
        stream: where they go.
    """

    def __init__(self, err: bool) -> None:
        """Choose stderr or stdout."""
        self.err = err
        self.stream = sys.stderr if err else sys.stdout

    def __call__(self, text: str) -> None:
        """Write one line."""
        if self.err:
            terminal.say(text)
        else:
            terminal.show(terminal.wrapped(text, self.stream))


def wait_for_all_sensors(batches: Iterator[Batch], say: Prompter) -> Iterator[Batch]:
    """Wait until all six sensors have reported, and return the remaining batches.

    Raises:
        EdgeposeError: a sensor is still missing after `ALL_REPORT_S`.
    """
    passed_s, prompted_s = 0.0, 0
    start_s: float | None = None
    missing = set(range(len(PLACEMENTS)))
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        passed_s = now_s - start_s
        missing -= {sample.sensor for sample in samples}
        if not missing:
            say("All six sensors report.")
            return batches
        if int(passed_s) > prompted_s:
            prompted_s = int(passed_s)
            say(f"Waiting for {_names(missing)}.")
        if passed_s > ALL_REPORT_S:
            break
    raise EdgeposeError(
        f"nothing from {_names(missing)} in {passed_s:.0f} s: check power, link and id of each"
    )


def _names(sensors: set[int]) -> str:
    return ", ".join(PLACEMENTS[i] for i in sorted(sensors))


def record_hold(
    batches: Iterator[Batch],
    pose: str,
    countdown_s: float,
    hold_s: float,
    say: Prompter,
    check: Callable[[Hold], Any],
) -> Any:
    """Record a live hold, and return what `check` returns for it.

    Args:
        batches: samples of the live source.
        pose: key of the instruction to show.
        countdown_s: time before the hold, seconds.
        hold_s: length of the hold, seconds.
        say: shows prompts.
        check: evaluates the hold; if it raises HoldError, the hold is repeated.

    Raises:
        HoldError: there was movement, or a silent sensor, in every repetition.
        EdgeposeError: the source ended too early.
    """
    say(_INSTRUCTIONS[pose])
    for left in range(REPEATS, -1, -1):
        for second in range(math.ceil(countdown_s), 0, -1):
            say(f"The hold starts in {second} s")
            _collect(batches, min(1.0, countdown_s - second + 1.0))
        say(f"Hold still for {hold_s:g} s.")
        samples = _with_progress(batches, hold_s, say)
        try:
            return check(calibration.hold_from_samples(samples))
        except HoldError as error:
            if not left:
                raise
            say(f"{'Not still: ' if isinstance(error, MovedError) else ''}{error}. Trying again.")
    raise AssertionError("the last repeat returns or raises")


def _collect(
    batches: Iterator[Batch], seconds: float, on_progress: Callable[[float], None] | None = None
) -> list[ImuSample]:
    """Return the samples of the next `seconds` on the source's clock.

    `on_progress` is called after each batch with the number of seconds so far.
    """
    collected: list[ImuSample] = []
    start_s: float | None = None
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        collected += samples
        if on_progress is not None:
            on_progress(min(now_s - start_s, seconds))
        if now_s - start_s >= seconds:
            return collected
    raise EdgeposeError(
        "the source ended before the hold was over; use a longer recording or a shorter --countdown"
    )


def _with_progress(batches: Iterator[Batch], seconds: float, say: Prompter) -> list[ImuSample]:
    if say.stream.isatty():
        with click.progressbar(length=100, label="Hold still", file=say.stream, show_eta=False) as bar:
            return _collect(
                batches, seconds, lambda passed: bar.update(int(100 * passed / seconds) - bar.pos)
            )
    whole_s = 0

    def say_each_second(passed: float) -> None:
        nonlocal whole_s
        if int(passed) > whole_s and passed < seconds:
            whole_s = int(passed)
            say(f"{whole_s} of {seconds:g} s")

    return _collect(batches, seconds, say_each_second)


def record_motion(batches: Iterator[Batch], say: Prompter, check: Callable[[Hold], Any]) -> Any:
    """Record the movements of `calibration.ROUTINE`, and return what `check` returns for them.

    Args:
        batches: samples of the live source.
        say: shows prompts.
        check: evaluates the movements; if it raises WeakMotionError, they are repeated.

    Raises:
        WeakMotionError: every repetition was too weak.
        EdgeposeError: the source ended too early.
    """
    say("Keep facing the same way and follow the instructions.")
    for left in range(REPEATS, -1, -1):
        samples = []
        for exercise in calibration.ROUTINE:
            say(f"{exercise.text} ({calibration.EXERCISE_S:g} s).")
            samples += _collect(batches, calibration.EXERCISE_S)
        try:
            return check(calibration.hold_from_samples(samples))
        except WeakMotionError as error:
            if not left:
                raise
            say(f"{error}. Trying again.")
    raise AssertionError("the last repeat returns or raises")


def wait_for_enter(batches: Iterator[Batch], say: Prompter) -> None:
    """Wait until the wearer has put the sensors on and presses Enter; not at all without a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        return
    say("Put the sensors on. Press Enter when the wearer is ready.")
    # Keep reading the port meanwhile, so that the next samples are not old ones.
    reader = threading.Thread(target=sys.stdin.readline, daemon=True)
    reader.start()
    for _ in batches:
        if not reader.is_alive():
            return
