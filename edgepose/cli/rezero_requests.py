"""What the wearer wishes during a run, by key or datagram."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from edgepose.cli.terminal.keys import Keys
from edgepose.pipeline.remote_control import Control

KEY_DELAY_S = 3.0
"""Time from a key to the hold: somebody has to walk away from the keyboard, or let go of it."""


class Wishes:
    """Hears wishes to re-zero the headings."""

    def __init__(
        self, stack: ExitStack, control: tuple[str, int] | None, by_key: Callable[[], list[float]]
    ) -> None:
        """Listens until the stack is closed.

        Args:
            stack: ends it.
            control: host and port to listen on.
            by_key: wishes that come by key, one of `heard_by`.

        Raises:
            EdgeposeError: the address cannot be listened on.
        """
        self._control = None if control is None else stack.enter_context(Control(*control))
        self._by_key = by_key

    def poll(self) -> list[float]:
        """For each new wish, in how many seconds."""
        return self._by_key() + ([] if self._control is None else self._control.requests())

    def remarks(self) -> list[str]:
        """What there is to say at the end."""
        if self._control is None or not self._control.ignored:
            return []
        return [f"control  {self._control.ignored} datagrams that ask for nothing known"]


def heard_by(count: int, keys: Keys) -> list[Callable[[], list[float]]]:
    """For each of so many wearers what gives the wishes by key since it was asked last: a key is for all."""
    unheard: list[list[float]] = [[] for _ in range(count)]

    def by_key(wearer: int) -> list[float]:
        wishes = [KEY_DELAY_S for key in keys.pressed() if key in "rR\r\n"]
        for own in unheard:
            own += wishes
        own, unheard[wearer] = unheard[wearer], []
        return own

    return [partial(by_key, wearer) for wearer in range(count)]
