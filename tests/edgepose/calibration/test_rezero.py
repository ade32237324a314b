"""Headings found anew during a run, wishes by datagram, and sensors that fall silent."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import struct
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgepose import calibration as cal
from edgepose import rotations as rot
from edgepose.calibration.rezero import BLEND_S, HOLD_S, START_HOLD_S, HeadingRezero
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuFrame
from edgepose.pipeline.dropout_monitor import QUIET_S, SILENT_S, DropoutMonitor
from edgepose.pipeline.remote_control import Control, Requests, key_requests, parse
from edgepose.placements import PLACEMENTS

RNG = np.random.default_rng(11)
R_BS = rot.rotvec_to_matrix(RNG.normal(0.0, 1.0, (6, 3)))
R_TI = cal.body_from_inertial(np.zeros((6, 4)), "heading:25")
OFFSET = RNG.uniform(-2.0, 2.0, 6)
STRAIGHT = cal.POSES["straight"]


def worn(bones: np.ndarray, drift: np.ndarray | float = 0.0) -> np.ndarray:
    """Quaternions (6, 4) of sensors whose headings have drifted since the calibration."""
    true = rot.matrix_to_quat(R_TI.T @ bones @ R_BS)
    return rot.quat_multiply(rot.quat_about_z(drift - OFFSET), true)


def calibration() -> cal.Calibration:
    summary = cal.HoldSummary([100] * 6, worn(STRAIGHT), np.zeros(6), np.zeros((6, 3)), [])
    return cal.calibrate(summary, pose="straight", body_frame="heading:25", created="", heading_offset=OFFSET)


class Walk:
    """Frames at 60 Hz through `HeadingRezero`, and what it says."""

    def __init__(self, **options: object) -> None:
        self.said: list[str] = []
        self.wishes: list[float] = []
        self.index = 0
        self.headings = HeadingRezero(calibration(), requests=self._take, notify=self.said.append, **options)

    def _take(self) -> list[float]:
        taken, self.wishes = self.wishes, []
        return taken

    def go(self, seconds: float, orientation: np.ndarray, held: tuple[str, ...] = (), shake: float = 0.0):
        """Calibrations of the frames of some seconds."""
        found = []
        for _ in range(round(seconds * 60)):
            self.index += 1
            turn = rot.rotvec_to_quat(np.array([shake * math.sin(self.index), 0.0, 0.0]))
            marks = np.array([name in held for name in PLACEMENTS])
            shaken = rot.quat_multiply(orientation, turn)
            frame = ImuFrame(self.index, self.index / 60, shaken, np.zeros((6, 3)), marks, 0.0)
            found.append(self.headings.calibration_for(frame))
        return found


def apart(found: cal.Calibration, orientation: np.ndarray) -> np.ndarray:
    """Angles (6,), degrees, between measured bones and the straight pose."""
    bones, _ = cal.apply_calibration(found, orientation, np.zeros((6, 3)))
    return np.degrees(rot.geodesic_angle(bones, STRAIGHT))


DRIFT = np.radians([20.0, -35.0, 5.0, 0.0, 170.0, -12.0])


def test_many_requests_do_not_put_off_a_hold():
    walk = Walk()
    walk.wishes = [3.0]
    walk.go(0.5, worn(STRAIGHT))
    for _ in range(20):
        walk.wishes = [60.0, 3.0]
        walk.go(0.1, worn(STRAIGHT))
    walk.go(2.5, worn(STRAIGHT))
    assert [line.partition(":")[0] for line in walk.said] == ["re-zero in 3 s", "re-zeroed"]
    walk.wishes = [60.0]
    walk.go(0.1, worn(STRAIGHT))
    walk.wishes = [0.0]
    walk.go(2.0, worn(STRAIGHT))
    assert [line.partition(":")[0] for line in walk.said[2:]] == [
        "re-zero in 60 s",
        "re-zero now",
        "re-zeroed",
    ]


def test_nothing_changes_unless_it_is_asked_for():
    walk = Walk()
    assert {id(found) for found in walk.go(3.0, worn(STRAIGHT, DRIFT))} == {id(walk.headings._calibration)}
    assert walk.said == []


def test_a_wish_turns_the_headings_smoothly():
    walk, orientation = Walk(), worn(STRAIGHT, DRIFT)
    walk.wishes = [2.0]
    before = walk.go(2.0 + HOLD_S - 0.1, orientation)
    assert apart(before[-1], orientation).max() > 100
    assert walk.said == ["re-zero in 2 s: stand straight, arms hanging, palms to the thighs, facing forward"]
    after = walk.go(BLEND_S + 0.5, orientation)
    assert apart(after[-1], orientation).max() < 0.01
    offsets = np.array([found.heading_offset for found in [*before, *after]])
    steps = np.degrees(np.abs(np.angle(np.exp(1j * np.diff(offsets, axis=0)))))
    # Half as fast again as evenly.
    assert (steps.max(axis=0) < 1.6 * np.degrees(np.abs(DRIFT)) / (60 * BLEND_S) + 0.01).all()
    assert walk.said[1].startswith("re-zeroed: headings turned by left_forearm -20.0, right_forearm 35.0, ")
    assert walk.said[1].endswith("pelvis 0.0 deg")
    # Nothing is pending: other poses do not change them.
    assert walk.go(3.0, worn(STRAIGHT))[-1] is after[-1]


def test_a_second_wish_while_headings_still_turn():
    walk, orientation = Walk(), worn(STRAIGHT, DRIFT)
    walk.wishes = [0.0]
    walk.go(HOLD_S + 0.3 * BLEND_S, orientation)
    walk.wishes = [0.0]
    assert apart(walk.go(HOLD_S + BLEND_S + 0.2, orientation)[-1], orientation).max() < 0.01


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"shake": 0.2}, "headings stay as they are: moved: left_forearm 8 deg, "),
        ({"held": ("head",)}, "headings stay as they are: nothing new from head"),
        ({"lift": 0.6}, "headings stay as they are: tilt differs from the calibration's: left_forearm 34 "),
    ],
)
def test_a_bad_hold_changes_nothing_and_says_why(changes, says):
    walk = Walk()
    walk.wishes = [0.0]
    bones = STRAIGHT.copy()
    bones[0] = rot.rotation_about_axis("x", -changes.pop("lift", 0.0)) @ bones[0]
    found = walk.go(HOLD_S + 2.0, worn(bones, DRIFT), **changes)
    assert found[-1] is found[0]
    assert len(walk.said) == 2
    assert walk.said[1].startswith(says)


def test_a_start_without_headings_waits_for_the_pose():
    walk = Walk(hold_first=True)
    assert set(walk.go(6.0, worn(STRAIGHT, DRIFT), shake=0.2)) == {None}
    assert walk.said[0].endswith("facing forward, and hold still: poses start after that")
    assert walk.said[1].startswith("waiting for the pose: moved: left_forearm 8 deg")
    assert len(walk.said) == 2
    found = walk.go(START_HOLD_S + 1.5, worn(STRAIGHT, DRIFT))
    assert apart(found[-1], worn(STRAIGHT, DRIFT)).max() < 0.01
    assert walk.said[-1].startswith("headings found; tilt off by left_forearm 0.0, ")


def test_a_wish_before_the_first_headings_is_answered():
    walk = Walk(hold_first=True)
    walk.wishes = [3.0, 3.0]
    walk.go(0.5, worn(STRAIGHT), shake=1.0)
    assert walk.said[1:] == [
        "re-zero ignored: no headings have been found yet; stand straight, arms hanging, palms to the "
        "thighs, facing forward"
    ]
    walk.go(START_HOLD_S + 1.0, worn(STRAIGHT, DRIFT))
    assert walk.said[-1].startswith("headings found; ")


# --- wishes by datagram -------------------------------------------------------------------------------------

OSC, ORIGIN = b"/edgepose/rezero\0\0\0\0", b"/edgepose/origin\0\0\0\0"


@pytest.mark.parametrize(
    ("datagram", "request_"),
    [
        (b"rezero", ("rezero", 0.0)),
        (b"rezero\n", ("rezero", 0.0)),
        (OSC, ("rezero", 0.0)),
        (OSC + b",\0\0\0", ("rezero", 0.0)),
        (OSC + b",i\0\0" + struct.pack(">i", 4), ("rezero", 4.0)),
        (OSC + b",f\0\0" + struct.pack(">f", 2.5), ("rezero", 2.5)),
        (b"origin", ("origin", 0.0)),
        (ORIGIN, ("origin", 0.0)),
        (ORIGIN + b",f\0\0" + struct.pack(">f", 2.5), ("origin", 2.5)),
        (b"/edgepose/origin", None),
        (b"originrezero", None),
        (b"", None),
        (b"rezero please", None),
        (b"REZERO", None),
        (b"/edgepose/rezero", None),
        (b"/edgepose/rezeros\0\0\0", None),
        (OSC + b",f\0\0", None),
        (OSC + b",f\0\0" + struct.pack(">f", math.nan), None),
        (OSC + b",f\0\0" + struct.pack(">f", -1.0), None),
        (OSC + b",i\0\0" + struct.pack(">i", 10_000), None),
        (OSC + b",s\0\0now\0", None),
        (OSC + b",ff\0" + bytes(8), None),
    ],
)
def test_what_a_datagram_asks_for(datagram, request_):
    assert parse(datagram) == request_


@given(st.one_of(st.binary(max_size=60), st.binary(max_size=16).map(lambda tail: OSC + tail)))
def test_any_datagram_is_a_wish_within_bounds_or_nothing(datagram):
    request = parse(datagram)
    known = request is not None and request.action in ("rezero", "origin")
    assert request is None or (known and 0.0 <= request.delay_s <= 60.0)


def test_a_socket_hears_wishes_and_counts_the_rest():
    with Control("127.0.0.1", 0) as control, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(control._socket.getsockname())
        assert control.requests() == []
        for datagram in (
            b"rezero",
            b"origin",
            b"hello",
            os.urandom(2000),
            OSC + b",f\0\0" + struct.pack(">f", 1.5),
        ):
            sender.send(datagram)
        heard, until = [], time.monotonic() + 10
        while len(heard) < 3 and time.monotonic() < until:
            heard += control.requests()
        assert heard == [("rezero", 0.0), ("origin", 0.0), ("rezero", 1.5)]
        assert control.ignored == 2
        port = control._socket.getsockname()[1]
        with pytest.raises(EdgeposeError, match=f"cannot listen on 127.0.0.1 port {port}: .* a free port"):
            Control("127.0.0.1", port)
    with pytest.raises(EdgeposeError, match=r"cannot listen on 192\.0\.2\.1 port 9: "):
        Control("192.0.2.1", 9)
    with pytest.raises(EdgeposeError, match="cannot find 'no such host' to listen on"):
        Control("no such host", 9)


def test_each_action_has_its_own_requests():
    """Those of one wait while another is asked for."""
    pressed = iter(["or", "", "O"])
    (by_key,) = key_requests(1, lambda: next(pressed, ""))
    with contextlib.ExitStack() as stack, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        requests = Requests(stack, ("127.0.0.1", 0), by_key)
        sender.connect(requests._control._socket.getsockname())
        for datagram in (b"origin", b"rezero"):
            sender.send(datagram)
        headings, places, until = [], [], time.monotonic() + 10
        while len(headings) < 2 and time.monotonic() < until:
            headings += requests.poll("rezero")
        while len(places) < 3 and time.monotonic() < until:
            places += requests.poll("origin")
        assert sorted(headings) == [0.0, 3.0]
        assert places == [0.0, 0.0, 0.0]
        assert requests.poll("rezero") == requests.poll("origin") == requests.summary_lines() == []


# --- silence ------------------------------------------------------------------------------------------------


def test_a_sensor_that_falls_silent_is_told_once_and_when_it_is_back():
    silences, lines = DropoutMonitor(), []
    head = PLACEMENTS.index("head")

    def go(start_s: float, seconds: float, silent: bool) -> None:
        for k in range(round(seconds * 10)):
            marks = np.zeros(6, bool)
            marks[head] = silent
            frame = ImuFrame(0, start_s + k / 10, np.zeros((6, 4)), np.zeros((6, 3)), marks, 0.0)
            lines.extend(silences.update(frame))

    go(0.0, 5.0, False)
    go(5.0, SILENT_S / 2, True)
    go(6.0, 1.0, False)
    assert lines == []
    go(7.0, 5.0, True)
    assert lines == ["head: no data for 1 s; its last values are repeated: check its power and connection"]
    go(12.0, 1.0, False)
    assert lines[1:] == ["head: back after 5.0 s"]
    # A loose plug.
    for k in range(5):
        go(13.0 + 3 * k, 2.0, True)
        go(15.0 + 3 * k, 1.0, False)
    assert len(lines) == 2
    go(13.0 + QUIET_S, 2.0, True)
    assert len(lines) == 3
