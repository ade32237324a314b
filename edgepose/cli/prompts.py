"""Leads a wearer through holds and movements in front of a live source, and collects what the sensors say."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import click

from edgepose import calibration
from edgepose.calibration import Hold, MovedError, WeakMotionError
from edgepose.cli.terminal import messages as terminal
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import Batch

REPEATS = 3
"""How often a live hold with movement in it, or motion that shows nothing, is tried again."""

ALL_REPORT_S = 10.0
"""How long all six sensors may take to report on a live source."""

_DO = {
    "straight": "Stand straight: feet parallel, arms hanging, palms to the thighs, looking ahead.",
    "t-pose": "Stand in a T-pose: feet parallel, arms out to the sides, palms down, looking ahead.",
    "lying": "Lay all six sensors side by side, same face up, same edge forward, and let go of them.",
}


class Prompter:
    """Says things to the wearer: on stdout, or on stderr where stdout is the result."""

    def __init__(self, err: bool) -> None:
        """Says them on stderr if asked to."""
        self.err = err
        self.stream = sys.stderr if err else sys.stdout

    def __call__(self, text: str) -> None:
        """Says a line."""
        (terminal.say if self.err else terminal.show)(text)


def wait_for_all_sensors(batches: Iterator[Batch], say: Prompter) -> Iterator[Batch]:
    """The rest of the batches once all six sensors have reported; says which are missing."""
    passed, said = 0.0, 0
    start_s: float | None = None
    missing = set(range(len(PLACEMENTS)))
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        passed = now_s - start_s
        missing -= {sample.sensor for sample in samples}
        if not missing:
            say("All six sensors report.")
            return batches
        if int(passed) > said:
            said = int(passed)
            say(f"Waiting for {_names(missing)}.")
        if passed > ALL_REPORT_S:
            break
    raise EdgeposeError(f"nothing from {_names(missing)} in {passed:.0f} s: check power, link and id of each")


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
    """What `check` makes of a live hold; one with movement in it is repeated."""
    say(_DO[pose])
    for left in range(REPEATS, -1, -1):
        for second in range(math.ceil(countdown_s), 0, -1):
            say(f"The hold starts in {second} s")
            _during(batches, min(1.0, countdown_s - second + 1.0))
        say(f"Hold still for {hold_s:g} s.")
        samples = _with_progress(batches, hold_s, say)
        try:
            return check(calibration.hold_from_samples(samples))
        except MovedError as error:
            if not left:
                raise
            say(f"Not still: {error}. Once more.")
    raise AssertionError("the last repeat returns or raises")


def _during(
    batches: Iterator[Batch], seconds: float, step: Callable[[float], None] | None = None
) -> list[ImuSample]:
    """Samples that come within some seconds of the source's clock; `step` hears how many by now."""
    collected: list[ImuSample] = []
    start_s: float | None = None
    for now_s, samples, *_ in batches:
        start_s = now_s if start_s is None else start_s
        collected += samples
        if step is not None:
            step(min(now_s - start_s, seconds))
        if now_s - start_s >= seconds:
            return collected
    raise EdgeposeError(
        "the source ended before the hold was over; use a longer one or a shorter --countdown"
    )


def _with_progress(batches: Iterator[Batch], seconds: float, say: Prompter) -> list[ImuSample]:
    if say.stream.isatty():
        with click.progressbar(length=100, label="Hold still", file=say.stream, show_eta=False) as bar:
            return _during(batches, seconds, lambda passed: bar.update(int(100 * passed / seconds) - bar.pos))
    whole = 0

    def line(passed: float) -> None:
        nonlocal whole
        if int(passed) > whole and passed < seconds:
            whole = int(passed)
            say(f"{whole} of {seconds:g} s")

    return _during(batches, seconds, line)


def record_motion(batches: Iterator[Batch], say: Prompter, check: Callable[[Hold], Any]) -> Any:
    """What `check` makes of the movements of `calibration.ROUTINE`; too little of them is repeated."""
    say("Keep facing the same way and do what comes.")
    for left in range(REPEATS, -1, -1):
        samples = []
        for exercise in calibration.ROUTINE:
            say(f"{exercise.text} ({calibration.EXERCISE_S:g} s).")
            samples += _during(batches, calibration.EXERCISE_S)
        try:
            return check(calibration.hold_from_samples(samples))
        except WeakMotionError as error:
            if not left:
                raise
            say(f"{error}. Once more.")
    raise AssertionError("the last repeat returns or raises")


def wait_for_enter(batches: Iterator[Batch], say: Prompter) -> None:
    """Time to put the sensors on; elsewhere than on a terminal --countdown has to give it."""
    if sys.stdin is None or not sys.stdin.isatty():
        return
    say("Put the sensors on. Press Enter when the wearer stands ready.")
    # Samples have to be taken off the port meanwhile, so that none of them is old afterwards.
    reader = threading.Thread(target=sys.stdin.readline, daemon=True)
    reader.start()
    for _ in batches:
        if not reader.is_alive():
            return
