"""Journal of a folder of recordings: which motion files are done, so that an interrupted call can go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from edgepose.errors import EdgeposeError

NAME = ".synthesized"
"""Name of the journal in the folder."""


class Journal:
    """Motion files whose recordings are complete, and the settings with which they were made.

    The first line of the file is the settings, each other line a motion file, by its path below the folder of
    the motion. A line that was cut off by a crash is no known file, which is then converted again.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        """Open the journal of a folder; it is written with the first file that is done.

        Raises:
            EdgeposeError: the journal cannot be read, or was begun with other settings.
        """
        self._path = folder / NAME
        self._head = json.dumps(settings, sort_keys=True, default=str)
        try:
            head, *lines = self._path.read_text(encoding="utf-8").split("\n")
        except FileNotFoundError:
            head, lines = "", []
        except (OSError, UnicodeDecodeError) as error:
            raise EdgeposeError(f"{self._path}: cannot be read ({error}); give another --out") from error
        self.begun = head == self._head
        if head and not self.begun and (lines or not self._head.startswith(head)):
            raise EdgeposeError(f"{folder}: was begun with other flags; give the same or another --out")
        self._done = {json.loads(line) for line in lines if _is_text(line)}

    def __contains__(self, file: str) -> bool:
        """Return whether the recordings of a motion file are complete."""
        return file in self._done

    def add(self, file: str) -> None:
        """Note that the recordings of a motion file are complete.

        Raises:
            EdgeposeError: the journal cannot be written.
        """
        try:
            with self._path.open("a", encoding="utf-8") as journal:
                journal.write(f"\n{json.dumps(file)}")
        except OSError as error:
            raise EdgeposeError(f"{self._path}: cannot be written: {error.strerror or error}") from error

    def begin(self) -> None:
        """Write the settings, unless they are there already.

        Raises:
            EdgeposeError: the journal cannot be written.
        """
        if self.begun:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_text(self._head, encoding="utf-8")
        except OSError as error:
            raise EdgeposeError(f"{self._path}: cannot be written: {error.strerror or error}") from error


def _is_text(line: str) -> bool:
    try:
        return isinstance(json.loads(line), str)
    except ValueError:
        return False
