"""Cameras of the browsers that watch a figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOOK_AT = np.array([0.0, 0.9, 0.0])
POSITION = LOOK_AT + np.array([0.8, 0.4, 2.1])
"""Camera of a new page, for a figure at the origin, metres."""

SMALLEST_STEP_M = 0.02
"""Smallest movement of a camera: one that moved all the time could not be turned by hand."""

LEVEL_M = 0.6
"""Height by which the pelvis may rise or sink before the camera follows, so that it ignores sitting down."""


def wanted_shift(pelvis: Array) -> Array:
    """Return the displacement (3,) of a camera that follows a pelvis (3,), from its place on a new page."""
    height = pelvis[1] - LOOK_AT[1]
    beyond = np.sign(height) * max(0.0, abs(height) - LEVEL_M)
    return np.array([pelvis[0], beyond, pelvis[2]])


def place_first_camera(server: Any) -> None:
    """Place the camera of a viser server's new pages."""
    server.initial_camera.position = tuple(POSITION)
    server.initial_camera.look_at = tuple(LOOK_AT)


class FollowingCameras:
    """Moves the cameras of all browsers along with the figure; users may turn them, and switch this off."""

    def __init__(self, server: Any) -> None:
        """Put the switch on the page of a viser server."""
        self._server = server
        self._switch = server.gui.add_checkbox("camera follows", True)
        self._shifts: dict[int, Array] = {}  # displacement of each client's camera

    def follow(self, pelvis: Array) -> None:
        """Move the cameras for a figure whose pelvis is at (3,), metres."""
        if not self._switch.value:
            return
        wanted = wanted_shift(pelvis)
        clients = self._server.get_clients()
        self._shifts = {key: self._shifts.get(key, np.zeros(3)) for key in clients}
        for key, client in clients.items():
            step = wanted - self._shifts[key]
            if np.linalg.norm(step) > SMALLEST_STEP_M:
                client.camera.position = np.asarray(client.camera.position) + step  # and what it looks at
                self._shifts[key] = wanted
