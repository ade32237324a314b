"""Times in a recording as values of flags."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import click


class RecordingTime(NamedTuple):
    """A time in a recording.

    Attributes:
        seconds: on the recording's clock, or since its start.
        since_start: whether it counts from the start.
    """

    seconds: float
    since_start: bool = False

    def on_clock(self, first_s: float) -> float:
        """Return the time on the clock of a recording whose first sample has the time `first_s`, seconds."""
        return self.seconds + first_s if self.since_start else self.seconds


class RecordingTimeType(click.ParamType):
    """A number of seconds on a recording's clock; with a plus sign, since its start."""

    name = "[+]seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> RecordingTime:
        """Return the time that a flag's value stands for."""
        if isinstance(value, RecordingTime):
            return value
        try:
            time = RecordingTime(float(value), str(value).startswith("+"))
        except ValueError:
            time = RecordingTime(math.nan)
        if not math.isfinite(time.seconds):
            self.fail(
                f"{value!r} is not a time in seconds, such as 12.5, or +12.5 from the start on", param, ctx
            )
        return time
