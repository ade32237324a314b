"""One step of a guided calibration."""

from __future__ import annotations

import math
from typing import NamedTuple

LISTEN, COUNTDOWN, HOLD, MOVE, WAIT, DONE = "listen", "countdown", "hold", "move", "wait", "done"
"""Kinds of stages."""


class Stage(NamedTuple):
    """What the wearer is to do.

    Attributes:
        kind: one of the kinds above.
        word: the same in one word of at most five letters; a countdown shows its seconds instead.
        text: the same in a sentence.
        figure: key of the picture: a pose, "lying", "bow", "forearm", "heel" or "step".
        total_s: its length, seconds; 0 if it waits for the wearer.
        what: a line of text for each second of a countdown; empty for one line at its beginning.
    """

    kind: str
    word: str
    text: str
    figure: str
    total_s: float = 0.0
    what: str = ""

    def shown_word(self, passed_s: float) -> str:
        """Return the word to show big."""
        return str(math.ceil(self.total_s - passed_s)) if self.kind == COUNTDOWN else self.word

    def line(self, whole_s: int) -> str | None:
        """Return the line of text for a number of whole seconds that have passed; None if there is none."""
        if self.kind == COUNTDOWN and not self.what:
            return None if whole_s else f"In {self.total_s:g} s: {self.text}."
        if self.kind == COUNTDOWN:
            return self.what.format(math.ceil(self.total_s - whole_s))
        if self.kind == MOVE:
            return None if whole_s else f"{self.text} ({self.total_s:g} s)."
        if self.kind == HOLD:
            return f"{whole_s} of {self.total_s:g} s" if whole_s else f"Hold still for {self.total_s:g} s."
        return None
