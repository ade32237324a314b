"""Exit codes of all commands."""

from __future__ import annotations

DONE, FAILED, WRONG_USE, ATTENTION, INTERRUPTED = 0, 1, 2, 3, 130

MEANINGS = {
    DONE: "done, nothing was lost",
    FAILED: "failed, or not all done: the message says what is missing",
    WRONG_USE: "wrong use: the command was not started",
    ATTENTION: "check: a sensor or the rig needs attention",
    INTERRUPTED: "interrupted; what was written is whole",
}
"""Meaning of each exit code, for `edgepose --help` and docs/reference/scripts.md."""


def table() -> str:
    """Return a line for each code."""
    return "\n".join(f"  {code:<3}  {meaning}" for code, meaning in MEANINGS.items())
