"""Viewer of poses in the browser: from a file, with a time line, or live over UDP.

The scene and its controls are viser's, which serves its own page; nothing is loaded from elsewhere.
"""

from __future__ import annotations

import io
import re
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
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame, PoseSequence, held_sensors, longest_holds
from edgepose.sinks.udp import decode
from edgepose.skeleton import Body, forward_kinematics
from edgepose.viewer.body_mesh import build, ground
from edgepose.viewer.camera import FollowingCameras, place_first_camera
from edgepose.viewer.same_origin import same_origin_only

Array = NDArray[np.float64]

POSE = {"left": "#1F8FDB", "trunk": "#17588A", "right": "#082C47"}
REFERENCE = {"left": "#B0B0B0", "trunk": "#808080", "right": "#585858"}
"""Colours; sides differ in lightness, which every eye sees. The lights of the scene brighten them."""

FRAME_S = 1.0 / 60.0
"""Time between two pictures, seconds."""

TABLE_S = 0.25
"""Time between two updates of the text beside the figure, seconds."""

WINDOW_S = 5.0
"""Time over which rates and gaps are computed, seconds."""

SPEEDS = ("0.25", "0.5", "1", "2", "4")


class SkeletonView:
    """A body in the scene."""

    def __init__(
        self, server: Any, name: str, body: Body, colours: dict[str, str], opacity: float | None
    ) -> None:
        """Put a body in its zero pose into the scene of a viser server."""
        import trimesh

        self._offsets = body.offsets
        self._solids = build(body.offsets)
        meshes = (
            trimesh.creation.cylinder(radius=1.0, height=1.0, sections=20),
            trimesh.creation.icosphere(subdivisions=2),
        )
        self._handles = []
        for kind, solids, mesh in zip(("bones", "joints"), self._solids, meshes, strict=True):
            count = len(solids.joints)
            handle = server.scene.add_batched_meshes_simple(
                f"/{name}/{kind}",
                np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32),
                np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                np.zeros((count, 3)),
                batched_scales=solids.sizes,
                batched_colors=np.array([_rgb(colours[side]) for side in solids.sides], np.uint8),
                opacity=opacity,
                lod="off",
            )
            self._handles.append((solids, handle))

    def show(self, rotations: Array, position: Array | None) -> Array:
        """Pose the body, and return the position (3,) of its pelvis, metres.

        Args:
            rotations: (24, 3, 3) local rotations.
            position: (3,) of the pelvis, metres; None puts the body on the ground.
        """
        global_rotations, joints = forward_kinematics(rotations, self._offsets, position)
        if position is None:
            joints = joints - [0.0, ground(rotations, self._offsets), 0.0]
        for solids, handle in self._handles:
            handle.batched_wxyzs, handle.batched_positions = solids.posed(global_rotations, joints)
        return np.asarray(joints[0])


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))


def sensor_table(held: NDArray[np.bool_], rate: float) -> str:
    """Format a Markdown table of the sensors in the last poses: held (N, 6), oldest first.

    A held sensor has sent nothing new for a pose, so the table shows rates up to that of the poses.
    """
    lines = ["| sensor | new/s | longest gap | now |", "|---|--:|--:|---|"]
    for name, column, longest in zip(PLACEMENTS, held.T, longest_holds(held), strict=True):
        new = rate * float((~column).mean()) if len(column) else 0.0
        gap = longest / rate
        now = "held" if len(column) and column[-1] else "ok"
        lines.append(f"| {name.replace('_', ' ')} | {new:.0f} | {f'{gap:.2f} s' if gap else '-'} | {now} |")
    return "\n".join(lines)


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
        _check_free(host, 0 if next_free else port)
        # viser prints a greeting to standard output, which belongs to the caller.
        with redirect_stdout(io.StringIO()), same_origin_only():
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
            reference: also drawn, transparently, on the same clock, or from its start if the two have no time
                in common.
            stopped: called for every picture.
        """
        times, status = poses.time_s - poses.time_s[0], poses.status
        line = _TimeLine(self._server.gui, float(times[-1]))
        cameras = FollowingCameras(self._server)
        text = self._server.gui.add_markdown("")
        track = _Track(self.figure, poses, self._body)
        second = None
        if reference is not None:
            figure = SkeletonView(self._server, "reference", self._body, REFERENCE, 0.4)
            second = _Track(figure, reference, self._body)
        held = held_sensors(poses.held)
        window = max(1, round(WINDOW_S * poses.rate))
        shown = -1
        while not stopped():
            now = time.monotonic()
            i = int(np.searchsorted(times, line.advance(now) + 1e-9, side="right")) - 1
            if i != shown:
                with self._server.atomic():
                    cameras.follow(track.show(i))
                    if second is not None:
                        second.show(_nearest_reference(second.poses, poses, i))
                shown = i
            if now - self._updated_s >= TABLE_S:
                self._updated_s = now
                line.update_slider()
                table = sensor_table(held[max(0, i + 1 - window) : i + 1], poses.rate)
                text.content = (
                    f"pose {i + 1} of {len(times)}, {poses.rate:g} poses/s\n\n"
                    f"**{plain(status[i])}**\n\n{table}"
                )
            time.sleep(max(0.0, FRAME_S - (time.monotonic() - now)))

    # --- poses as they come ---------------------------------------------------------------------------------

    def follow(self, receiver: socket.socket, stopped: Callable[[], bool]) -> None:
        """Show poses that come as datagrams, always the newest one, until `stopped`.

        Args:
            receiver: bound socket; datagrams are JSON or binary as `edgepose run --udp` sends them.
            stopped: called for every picture.
        """
        cameras = FollowingCameras(self._server)
        text = self._server.gui.add_markdown("waiting for poses")
        stream = UdpPoseStream()
        receiver.setblocking(False)
        while not stopped():
            # Wake up when a pose comes; a fixed pace would skip some.
            select.select([receiver], [], [], TABLE_S)
            now = time.monotonic()
            newest = stream.take(receiver, now)
            if newest is not None:
                with self._server.atomic():
                    cameras.follow(self.figure.show(newest.rotations.astype(float), newest.translation))
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
    """A figure and its poses."""

    def __init__(self, figure: SkeletonView, poses: PoseSequence, body: Body) -> None:
        self.poses = poses
        self._figure = figure
        self._positions = _grounded_positions(poses, body)

    def show(self, i: int) -> Array:
        position = None if self._positions is None else self._positions[i]
        return self._figure.show(self.poses.rotations[i], position)


class UdpPoseStream:
    """Receives poses as datagrams, with statistics of the last seconds."""

    def __init__(self) -> None:
        """Start with no poses."""
        self.poses, self.lost, self.bad = 0, 0, 0
        self._last: PoseFrame | None = None
        self._recent: deque[tuple[float, frozenset[str]]] = deque()
        self._newest_s = 0.0

    def take(self, receiver: socket.socket, now: float) -> PoseFrame | None:
        """Return the newest pose waiting at a non-blocking socket; `now` is on a monotonic clock, seconds."""
        newest = None
        for _ in range(1000):  # limited, so that a flood of datagrams cannot stop the picture
            try:
                datagram = receiver.recv(65536)
            except OSError:
                break
            try:
                newest = self._add(decode(datagram), now) or newest
            except EdgeposeError:
                self.bad += 1
        while self._recent and self._recent[0][0] < now - WINDOW_S:
            self._recent.popleft()
        return newest

    def _add(self, pose: PoseFrame, now: float) -> PoseFrame | None:
        if self._last is not None:
            step = pose.index - self._last.index
            if -60 < step <= 0:  # late or duplicated; further back is a new run
                return None
            self.lost += max(0, step - 1)
        self.poses += 1
        self._last, self._newest_s = pose, now
        self._recent.append((now, pose.held))
        return pose

    def text(self, now: float) -> str:
        """Return Markdown about the poses so far."""
        if self._last is None:
            bad = f"; {self.bad} datagrams were not poses" if self.bad else ""
            return f"waiting for poses{bad}"
        span = min(WINDOW_S, max(1.0, now - self._recent[0][0])) if self._recent else WINDOW_S
        rate = len(self._recent) / span
        held = held_sensors([held for _, held in self._recent])
        silent = now - self._newest_s
        state = plain(self._last.status) if silent < 1.0 else f"nothing for {silent:.0f} s"
        counts = [f"{rate:.0f} poses/s", f"{self.poses} poses", f"{self.lost} lost"]
        counts += [f"{self.bad} bad"] if self.bad else []
        return f"{', '.join(counts)}\n\n**{state}**\n\n{sensor_table(held, rate or 60.0)}"


def plain(status: str) -> str:
    """Remove from a status, which anyone may have sent, everything that a browser could interpret."""
    return re.sub(r"[^A-Za-z0-9_ ;]", "?", status[:200])


def _nearest_reference(reference: PoseSequence, poses: PoseSequence, i: int) -> int:
    """Return the index of the reference pose nearest to pose i."""
    common = reference.time_s[0] <= poses.time_s[-1] and poses.time_s[0] <= reference.time_s[-1]
    start = 0.0 if common else poses.time_s[0] - reference.time_s[0]
    return int(np.abs(reference.time_s - (poses.time_s[i] - start)).argmin())


def _grounded_positions(poses: PoseSequence, body: Body) -> Array | None:
    """Return pelvis positions (T, 3), metres, lowest point of all on the ground; None if unknown."""
    if poses.translation is None:
        return None
    some = slice(None, None, max(1, len(poses.frames) // 1000))
    lowest = ground(poses.rotations[some], body.offsets, poses.translation[some])
    return poses.translation - [poses.translation[0, 0], lowest, poses.translation[0, 2]]


def _check_free(host: str, port: int) -> None:
    """Raise EdgeposeError if no page can be served there; 0 stands for any port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        # Errors of name resolution have negative numbers.
        flag = "--port" if isinstance(error, OSError) and (error.errno or -1) > 0 else "--host"
        raise EdgeposeError(
            f"cannot show poses at {host} port {port}: {reason}; choose another {flag}"
        ) from error
