"""Viewer of poses in the browser: from a file, with a time line, or live over UDP.

The scene and its controls are viser's, which serves its own page; nothing is loaded from elsewhere.
"""

from __future__ import annotations

import io
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.pose import CONTACTS, PoseSequence, held_sensors, known_sensors
from edgepose.skeleton import JOINTS, Body, forward_kinematics
from edgepose.utils.sockets import check_page
from edgepose.viewer.body_mesh import RADII, build, ground, radius
from edgepose.viewer.buttons import add_buttons
from edgepose.viewer.camera import FollowingCameras, place_first_camera
from edgepose.viewer.path import FloorPath
from edgepose.viewer.reference import Reference
from edgepose.viewer.same_origin import same_origin_only
from edgepose.viewer.stream import WINDOW_S, UdpPoseStream, plain, sensor_table

Array = NDArray[np.float64]

POSE = {"left": "#1F8FDB", "trunk": "#17588A", "right": "#082C47"}
"""Colours; sides differ in lightness, which every eye sees. The lights of the scene brighten them."""

REFERENCE = dict.fromkeys(POSE, "#B4236F")
"""Colour of a reference: one, which no eye takes for that of the poses or for a contact."""

CONTACT = "#E69F00"
"""Colour of the joints that rest on something."""

TOUCHING = 0.5
"""Probability of contact above which a joint is marked."""

FRAME_S = 1.0 / 60.0
"""Time between two pictures, seconds."""

TABLE_S = 0.25
"""Time between two updates of the text beside the figure, seconds."""

POINTS_PER_S = 20
"""Poses per second of a file that its path goes through."""

SPEEDS = ("0.25", "0.5", "1", "2", "4")


_TOUCHING_JOINTS = [JOINTS.index(name) for name in CONTACTS]
_MARK_SIZES = 1.2 * np.array([radius(joint) for joint in _TOUCHING_JOINTS])
_HIDDEN = 1e-6
"""Size of the marks of joints that rest on nothing."""

SOLE_M = np.array([0.0, RADII["foot"], 0.0])
"""From a joint on the floor up to where it is drawn, so that its solids lie on the floor."""


class SkeletonView:
    """A body in the scene."""

    def __init__(
        self, server: Any, name: str, body: Body, colours: dict[str, str], opacity: float | None
    ) -> None:
        """Put a body in its zero pose into the scene of a viser server."""
        import trimesh

        def add(kind: str, mesh: Any, sizes: Array, colours: list[tuple[int, ...]]) -> Any:
            return server.scene.add_batched_meshes_simple(
                f"/{name}/{kind}",
                np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32),
                np.tile([1.0, 0.0, 0.0, 0.0], (len(sizes), 1)),
                np.zeros((len(sizes), 3)),
                batched_scales=sizes,
                batched_colors=np.array(colours, np.uint8),
                opacity=opacity,
                lod="off",
            )

        self._offsets = body.offsets
        ball = trimesh.creation.icosphere(subdivisions=2)
        cylinder = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=20)
        self._handles = [
            (solids, add(kind, mesh, solids.sizes, [_rgb(colours[side]) for side in solids.sides]))
            for kind, mesh, solids in zip(
                ("bones", "joints"), (cylinder, ball), build(body.offsets), strict=True
            )
        ]
        hidden = np.full((len(CONTACTS), 3), _HIDDEN)
        self._marks = add("contacts", ball, hidden, [_rgb(CONTACT)] * len(CONTACTS))
        self._marked = False

    def show(self, rotations: Array, position: Array | None, contacts: NDArray[Any] | None = None) -> Array:
        """Pose the body, and return the position (3,) of its pelvis, metres.

        Args:
            rotations: (24, 3, 3) local rotations.
            position: (3,) of the pelvis, metres; None puts the body on the ground.
            contacts: (7,) probabilities that the joints `CONTACTS` rest on something; None marks no joint.
        """
        global_rotations, joints = forward_kinematics(rotations, self._offsets, position)
        if position is None:
            joints = joints - [0.0, ground(rotations, self._offsets), 0.0]
        for solids, handle in self._handles:
            handle.batched_wxyzs, handle.batched_positions = solids.posed(global_rotations, joints)
        touching = np.zeros(len(CONTACTS), bool) if contacts is None else contacts > TOUCHING
        if touching.any() or self._marked:
            sizes = np.where(touching, _MARK_SIZES, _HIDDEN)
            self._marks.batched_scales = np.tile(sizes[:, None], 3)
            self._marks.batched_positions = joints[_TOUCHING_JOINTS]
            self._marked = bool(touching.any())
        return np.asarray(joints[0])


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))


class Viewer:
    """A page with a scene, controls and a text, served from construction until `close`.

    Attributes:
        port: TCP port of the page.
    """

    def __init__(self, host: str, port: int, body: Body, next_free: bool = False) -> None:
        """Serve the page.

        Args:
            host: address of this machine for browsers.
            port: TCP port.
            body: of the figures.
            next_free: use the next free port if this one is taken.

        Raises:
            EdgeposeError: viser is not installed, or the port is taken.
        """
        try:
            import viser
        except ImportError as error:
            raise EdgeposeError(
                "the viewer needs viser: install it with pip install 'edgepose[view]'"
            ) from error
        check_page(host, 0 if next_free else port)
        # viser prints a greeting to standard output, which belongs to the caller.
        with redirect_stdout(io.StringIO()), same_origin_only(host):
            self._server: Any = viser.ViserServer(host=host, port=port, label="edgepose", verbose=False)
        self.port: int = self._server.get_port()  # viser takes the next free one
        self._body = body
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.scene.set_up_direction("+y")
        self._server.scene.add_grid(
            "/ground", plane="xz", infinite_grid=True, cell_size=0.5, fade_distance=12.0
        )
        place_first_camera(self._server)
        self.figure = SkeletonView(self._server, "pose", body, POSE, None)
        self._path = FloorPath(self._server, "path", _rgb(POSE["trunk"]))
        self._updated_s = 0.0  # when the text was updated

    def close(self) -> None:
        """Close the page."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    # --- poses of a file ------------------------------------------------------------------------------------

    def play(self, poses: PoseSequence, reference: PoseSequence | None, stopped: Callable[[], bool]) -> None:
        """Show poses of a file in a loop until `stopped`.

        Args:
            poses: at least one.
            reference: also drawn, on the same clock, or from its start if the two have no time in common.
            stopped: called for every picture.
        """
        times, status = poses.time_s - poses.time_s[0], poses.status
        line = _TimeLine(self._server.gui, float(times[-1]))
        cameras = FollowingCameras(self._server)
        text = self._server.gui.add_markdown("")
        track = _Track(self.figure, self._path, poses, self._body)
        compared = second = None
        if reference is not None:
            compared = Reference(self._server, poses, reference, "reference")
            figure = SkeletonView(self._server, "reference", self._body, REFERENCE, 0.5)
            path = FloorPath(self._server, "reference/path", _rgb(REFERENCE["trunk"]))
            second = _Track(figure, path, reference, self._body)
        names = known_sensors(poses.held)
        held = held_sensors(poses.held, names)
        window = max(1, round(WINDOW_S * poses.rate))
        shown = -1
        while not stopped():
            now = time.monotonic()
            i = int(np.searchsorted(times, line.advance(now) + 1e-9, side="right")) - 1
            if i != shown:
                with self._server.atomic():
                    pelvis = track.show(i)
                    cameras.follow(pelvis)
                    if compared is not None and second is not None:
                        second.show(compared.nearest(i))
                shown = i
            elif cameras.catching_up:  # after a jump on a time line that is stopped
                cameras.follow(pelvis)
            if now - self._updated_s >= TABLE_S:
                self._updated_s = now
                line.update_slider()
                table = sensor_table(held[max(0, i + 1 - window) : i + 1], poses.rate, names)
                error = "" if compared is None else f"{compared.text(i)}\n\n"
                text.content = (
                    f"pose {i + 1} of {len(times)}, {poses.rate:g} poses/s\n\n"
                    f"**{plain(status[i])}**\n\n{error}{table}"
                )
            time.sleep(max(0.0, FRAME_S - (time.monotonic() - now)))

    # --- poses as they come ---------------------------------------------------------------------------------

    def add_buttons(self, press: Callable[[str], None]) -> None:
        """Put buttons on the page that do what keys of the run do.

        Args:
            press: called with the key of a button that is pressed.
        """
        add_buttons(self._server, press)

    def follow(self, receiver: socket.socket, stopped: Callable[[], bool]) -> None:
        """Show poses that come as datagrams, always the newest one, until `stopped`.

        Args:
            receiver: bound socket; datagrams are JSON or binary as `edgepose run --udp` sends them.
            stopped: called for every picture.
        """
        cameras = FollowingCameras(self._server)
        stream = UdpPoseStream(time.monotonic())
        text = self._server.gui.add_markdown(stream.text(time.monotonic()))
        receiver.setblocking(False)
        while not stopped():
            # Wake up when a pose comes; a fixed pace would skip some.
            select.select([receiver], [], [], TABLE_S)
            now = time.monotonic()
            newest = stream.take(receiver, now)
            if newest is not None:
                place = newest.translation
                with self._server.atomic():
                    shown = self.figure.show(
                        newest.rotations.astype(float),
                        None if place is None else place + SOLE_M,
                        newest.contacts,
                    )
                    cameras.follow(shown)
                    if place is not None:
                        self._path.extend([place])
            if now - self._updated_s >= TABLE_S:
                self._updated_s = now
                text.content = stream.text(now)
            time.sleep(max(0.0, FRAME_S / 2 - (time.monotonic() - now)))


class _TimeLine:
    """Controls of the time that is shown, seconds from the first pose."""

    def __init__(self, gui: Any, length_s: float) -> None:
        """Put the controls on the page."""
        self._end_s = max(length_s, FRAME_S)
        self._playing = gui.add_checkbox("play", True)
        self._slider = gui.add_slider("time, s", 0.0, round(self._end_s + 0.005, 2), 0.01, 0.0)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._at_s, self._last_s = 0.0, time.monotonic()
        self._wanted: deque[float] = deque(maxlen=1)  # time to which a user has moved the slider
        self._slider.on_update(self._note)

    def _note(self, event: Any) -> None:
        if event.client is not None:  # moved by a user, not by `update_slider`
            self._wanted.append(float(self._slider.value))

    def advance(self, now: float) -> float:
        """Return the time to show; `now` is on a monotonic clock."""
        if self._wanted:
            self._at_s = self._wanted.pop()
        elif self._playing.value:
            self._at_s = (self._at_s + (now - self._last_s) * float(self._speed.value)) % self._end_s
        self._last_s = now
        return self._at_s

    def update_slider(self) -> None:
        """Move the slider to the time that is shown."""
        if self._playing.value:
            self._slider.value = round(self._at_s, 2)


class _Track:
    """A figure, its poses, and their path."""

    def __init__(self, figure: SkeletonView, path: FloorPath, poses: PoseSequence, body: Body) -> None:
        self.poses = poses
        self._figure = figure
        self._positions = _grounded_positions(poses, body)
        if self._positions is not None:
            path.extend(self._positions[:: max(1, round(poses.rate / POINTS_PER_S))])

    def show(self, i: int) -> Array:
        position = None if self._positions is None else self._positions[i]
        contacts = None if self.poses.contacts is None else self.poses.contacts[i]
        return self._figure.show(self.poses.rotations[i], position, contacts)


def _grounded_positions(poses: PoseSequence, body: Body) -> Array | None:
    """Return pelvis positions (T, 3), metres, on the ground, starting above the origin; None if unknown.

    Without contacts it is not known where the ground is, so the lowest point of all poses is put there.
    """
    if poses.translation is None:
        return None
    if poses.contacts is not None:
        return poses.translation - poses.translation[0] * [1.0, 0.0, 1.0] + SOLE_M
    some = slice(None, None, max(1, len(poses.frames) // 1000))
    lowest = ground(poses.rotations[some], body.offsets, poses.translation[some])
    return poses.translation - [poses.translation[0, 0], lowest, poses.translation[0, 2]]
