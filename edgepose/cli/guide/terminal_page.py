"""The page that guides a wearer on a terminal: a big word, a picture, the time that is left."""

from __future__ import annotations

from collections.abc import Sequence

from edgepose.cli.guide.big_words import big_word
from edgepose.cli.guide.stage import Stage
from edgepose.cli.terminal.messages import pieces

_FIGURES = {
    "straight": ("    O    ", "   /|\\   ", "  | | |  ", "   / \\   ", "   | |   ", "  _| |_  "),
    "t-pose": ("    O    ", " ---+--- ", "    |    ", "   / \\   ", "   | |   ", "  _| |_  "),
    "lying": ("         ", " [] [] []", "         ", " [] [] []", "         ", "         "),
    "bow": ("         ", "   ____O ", "  /  |   ", "  |      ", "  |      ", "  |_     "),
    "forearm": ("   O     ", "   |     ", "   |__   ", "   |     ", "   |     ", "   |_    "),
    "step": ("   O     ", "  /|\\    ", " / | \\   ", "   |\\    ", "  /  \\   ", " /   |_  "),
    "heel": ("   O     ", "   |     ", "   |     ", "   |     ", " --|     ", "   |_    "),
}
_MOST_NOTES = 3


def page_lines(stage: Stage, passed_s: float, notes: Sequence[str], columns: int, rows: int) -> list[str]:
    """Return the lines of the page.

    Args:
        stage: what the wearer is to do.
        passed_s: seconds of it that have passed.
        notes: messages so far; the last ones are shown.
        columns: columns of the terminal.
        rows: rows of the terminal.
    """
    figure = _FIGURES[stage.figure]
    margin = len(figure[0]) + 2
    text = pieces(stage.text, max(20, columns - margin))
    height = max(len(figure), len(text))
    beside = [
        f"{figure[i] if i < len(figure) else '':{margin}}{text[i] if i < len(text) else ''}".rstrip()
        for i in range(height)
    ]
    below = [piece for note in notes[-_MOST_NOTES:] for piece in pieces(note, columns)]
    bar = [_bar(passed_s / stage.total_s, columns - 1)] if stage.total_s else []
    free = rows - 1 - len(beside) - len(below) - len(bar) - 2
    word = big_word(stage.shown_word(passed_s), columns - 1, max(free, 5))
    title = "edgepose calibrate; Ctrl-C ends it"
    return [line[:columns] for line in [title, *word, "", *beside, *bar, *below]]


def _bar(share: float, columns: int) -> str:
    full = round(min(max(share, 0.0), 1.0) * (columns - 2))
    return f"[{'#' * full}{'-' * (columns - 2 - full)}]"
