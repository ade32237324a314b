"""Progress and results of commands that work on many files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

from edgepose.cli.terminal.messages import has_terminal, printable, progress_bar, say
from edgepose.errors import EdgeposeError

ResultT = TypeVar("ResultT")


class Outcome(NamedTuple):
    """The outcome for one file.

    Attributes:
        source: name of the file.
        word: its row's last cell, such as "ok" or "damaged".
        problem: one line on what was lost; None if nothing was.
        warnings: further lines for the user.
    """

    source: str
    word: str
    problem: str | None = None
    warnings: Sequence[str] = ()


def with_progress(
    results: Iterable[ResultT], count: int, label: str, outcome: Callable[[ResultT], Outcome]
) -> Iterator[ResultT]:
    """Yield results, and show a bar and problems on a terminal, a line per result elsewhere.

    Args:
        results: results as they finish.
        count: number of results.
        label: shown before the bar.
        outcome: returns what to show of a result.
    """
    with progress_bar(count, label) as bar:
        for number, result in enumerate(results, start=1):
            yield result  # before its line, so that after Ctrl-C the table has every result that was shown
            source, word, problem, warnings = outcome(result)
            problem = None if problem is None else problem.replace(f"{source}: ", "")
            line = f"{source}: {word}" + ("" if problem is None else f": {problem}")
            for warning in warnings:
                say(one_line(f"{source}: {warning}"))
            if not has_terminal():
                say(one_line(f"{number} of {count}  {line}"))
            elif problem is not None:
                say(one_line(line))
            bar.update(1)


def raise_failures(failed: int, planned: int, what: str) -> None:
    """Raise EdgeposeError if files failed, in whole or in part; `what` says what they lack."""
    if failed:
        raise EdgeposeError(f"{failed} of {planned} recordings {what}; see the messages above")


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table whose first and last columns are text, and the others numbers."""
    rows = [head, *rows]
    width = max(len(row[0]) for row in rows)
    return "\n".join(
        one_line("  ".join([row[0].ljust(width), *(cell.rjust(9) for cell in row[1:-1]), row[-1]]))
        for row in rows
    )


def one_line(text: str) -> str:
    """Replace line breaks and tabs, which may be in file names."""
    return printable(text).replace("\n", "?").replace("\t", "?")
