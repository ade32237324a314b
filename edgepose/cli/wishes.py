"""What the wearer wishes during a run, by key or datagram."""

from __future__ import annotations

from contextlib import ExitStack

from edgepose.cli.keys import Keys
from edgepose.control import Control

KEY_DELAY_S = 3.0
"""Time from a key to the hold: somebody has to walk away from the keyboard, or let go of it."""


class Wishes:
    """Hears wishes to re-zero the headings."""

    def __init__(self, stack: ExitStack, control: tuple[str, int] | None, keys: bool) -> None:
        """Listens until the stack is closed.

        Args:
            stack: ends it.
            control: host and port to listen on.
            keys: listen to the terminal too, if there is one.

        Raises:
            EdgeposeError: the address cannot be listened on.
        """
        self._control = None if control is None else stack.enter_context(Control(*control))
        self._keys = stack.enter_context(Keys()) if keys else None

    @property
    def hint(self) -> str:
        """What can be pressed, for a message."""
        return ", r re-zeroes headings" if self._keys is not None and self._keys.listening else ""

    def poll(self) -> list[float]:
        """For each new wish, in how many seconds."""
        pressed = "" if self._keys is None else self._keys.pressed()
        by_key = [KEY_DELAY_S for key in pressed if key in "rR\r\n"]
        return by_key + ([] if self._control is None else self._control.requests())

    def remarks(self) -> list[str]:
        """What there is to say at the end."""
        if self._control is None or not self._control.ignored:
            return []
        return [f"control  {self._control.ignored} datagrams that ask for nothing known"]
