"""Buttons of a run's page, which do what the keys of the run do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

BUTTONS = {
    "re-zero headings": ("r", "Stand in the pose of the calibration: the headings are re-zeroed in 3 s."),
    "back to the origin": ("o", "The wearer is put back to the origin, on the ground."),
}
"""Key and explanation of each button."""

SHOWN_S = 5.0
"""Time for which an explanation is shown, seconds."""


def add_buttons(server: Any, press: Callable[[str], None]) -> None:
    """Put the buttons on the page of a viser server.

    Args:
        server: the server.
        press: called with the key of a button that is pressed.
    """
    for label, (key, explanation) in BUTTONS.items():
        button = server.gui.add_button(label, hint=f"key {key} of the run")
        button.on_click(_pressed(key, label, explanation, press))


def _pressed(key: str, label: str, explanation: str, press: Callable[[str], None]) -> Callable[[Any], None]:
    def on_click(event: Any) -> None:
        press(key)
        if event.client is not None:
            event.client.add_notification(label, explanation, auto_close_seconds=SHOWN_S)

    return on_click
