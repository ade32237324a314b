"""Cameras of the browsers that watch a figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.rotations import quat_to_matrix

Array = NDArray[np.float64]

LOOK_AT = np.array([0.0, 0.9, 0.0])
POSITION = LOOK_AT + np.array([0.8, 0.4, 2.1])
"""Camera of a new page, for a figure at the origin, metres."""

SMALLEST_STEP_M = 0.02
"""Smallest movement of a camera: one that moved all the time could not be turned by hand."""

LEVEL_M = 0.6
"""Height by which the pelvis may rise or sink before the camera follows, so that it ignores sitting down."""

INSIDE = 0.75
"""Share of the picture's width and height, about its centre, outside which the pelvis is leaving it."""

NEAREST_M, FURTHEST_M = 0.7, 7.0
"""Distances from the camera at which a figure is too near or too far to be seen."""

GLIDE = 0.08
"""Share of the distance to the figure that a camera moves for each pose while it catches up."""

CATCHES_UP, FOLLOWS, STAYS = "catches up", "follows", "stays"


def wanted_shift(pelvis: Array) -> Array:
    """Return the displacement (3,) of a camera that follows a pelvis (3,), from its place on a new page."""
    height = pelvis[1] - LOOK_AT[1]
    beyond = np.sign(height) * max(0.0, abs(height) - LEVEL_M)
    return np.array([pelvis[0], beyond, pelvis[2]])


def sees(camera: Any, point: Array) -> bool:
    """Return whether a point (3,) is well inside the picture of a client's camera."""
    x, y, depth = quat_to_matrix(np.asarray(camera.wxyz)).T @ (point - np.asarray(camera.position))
    half = INSIDE * depth * np.tan(camera.fov / 2.0)
    return bool(NEAREST_M < depth < FURTHEST_M and abs(y) < half and abs(x) < half * camera.aspect)


def place_first_camera(server: Any) -> None:
    """Place the camera of a viser server's new pages."""
    server.initial_camera.position = tuple(POSITION)
    server.initial_camera.look_at = tuple(LOOK_AT)


class FollowingCameras:
    """Moves the cameras of all browsers to the figure; users may turn them, and choose when they move."""

    def __init__(self, server: Any) -> None:
        """Put the choice on the page of a viser server."""
        self._server = server
        self._choice = server.gui.add_dropdown(
            *("camera", (CATCHES_UP, FOLLOWS, STAYS)),
            hint="moves if the figure leaves the picture, with every pose, or never",
        )
        self._shifts: dict[int, Array] = {}  # displacement of each client's camera
        self._late: set[int] = set()  # clients whose cameras are catching up

    @property
    def catching_up(self) -> bool:
        """Whether a camera is on its way to the figure, and `follow` is to be called again."""
        return bool(self._late)

    def follow(self, pelvis: Array) -> None:
        """Move the cameras for a figure whose pelvis is at (3,), metres."""
        wanted = wanted_shift(pelvis)
        clients = self._server.get_clients()
        self._shifts = {key: self._shifts.get(key, np.zeros(3)) for key in clients}
        self._late &= clients.keys()
        if self._choice.value == STAYS:
            return
        for key, client in clients.items():
            step = wanted - self._shifts[key]
            if self._choice.value == CATCHES_UP:
                if not sees(client.camera, pelvis):
                    self._late.add(key)
                if key not in self._late:
                    continue
                if np.linalg.norm(step) < SMALLEST_STEP_M / GLIDE:
                    self._late.discard(key)
                step = GLIDE * step
            if np.linalg.norm(step) > SMALLEST_STEP_M:
                client.camera.position = np.asarray(client.camera.position) + step  # and what it looks at
                self._shifts[key] = self._shifts[key] + step
