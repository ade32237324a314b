"""Lines of an untrusted text file."""

from __future__ import annotations

from typing import TextIO

MAX_LINE = 4096
"""Longest line of a table or log, characters, with its end."""


class CountedLines:
    """Lines of a text file, counted; a longer one than the limit comes in pieces.

    Attributes:
        number: of the current line, from 1.
        line: the current line, or piece.
        limit: longest piece, characters.
    """

    def __init__(self, file: TextIO, limit: int = MAX_LINE) -> None:
        """Start before the first line of an open file."""
        self._file, self.limit = file, limit
        self.number = 0
        self.line = "\n"

    def __iter__(self) -> CountedLines:
        """Iterate over the rest of the file."""
        return self

    def __next__(self) -> str:
        """Return the next line, or piece of one."""
        line = self._file.readline(self.limit)
        if not line:
            raise StopIteration
        self.number += self.ended
        self.line = line
        return line

    @property
    def ended(self) -> bool:
        """Whether the current line has a line end; without one it is the last line, or a piece."""
        return self.line.endswith(("\n", "\r"))

    @property
    def too_long(self) -> bool:
        """Whether the current line is a piece, or as long as one."""
        return len(self.line) == self.limit
