"""`edgepose view` and `edgepose run --view` in a real browser."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click
import msgspec
import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from edgepose.cli import cli
from edgepose.config import OutputConfig
from edgepose.errors import ConfigError, EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.pipeline.remote_control import Requests
from edgepose.pose import CONTACTS, PoseFrame, PoseSequence, held_sensors, parse_status
from edgepose.sinks.bvh import BvhSink
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.open import open_outputs
from edgepose.sinks.udp import UdpSink, decode, encode_binary, encode_json
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from edgepose.viewer.body_mesh import TIPS, build, ground
from edgepose.viewer.camera import sees, wanted_shift
from edgepose.viewer.path import PIECES, SEGMENTS
from edgepose.viewer.stream import UdpPoseStream, plain, sensor_table
from edgepose.viewer.viewer import Viewer
from tests.support import processes
from tests.support.browser import Browser, needs_browser, until


def standing(index: int = 0, status: str = "ok") -> PoseFrame:
    """Arms down, left one lifted to the front as time goes by."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (24, 1, 1))
    rotations[16] = Rotation.from_euler("z", -75, degrees=True).as_matrix()
    rotations[17] = Rotation.from_euler("z", 75, degrees=True).as_matrix()
    rotations[18] = Rotation.from_euler("y", -index % 90, degrees=True).as_matrix()
    state = parse_status(status)
    return PoseFrame(index, 1.7e9 + index / 60, rotations, np.zeros(24, np.float32), None, *state)


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


# --- the solids and the text --------------------------------------------------------------------------------


def test_a_status_is_no_markup():
    """Anybody may send one, and a browser would act on it."""
    assert plain("held left_forearm head; filling window") == "held left_forearm head; filling window"
    sent = plain('<img src=x onerror="alert(1)">**[a](b)' + "x" * 1000)
    assert not re.search(r"[<>\[\]*()\"=]", sent)
    assert len(sent) == 200


def test_solids_join_the_joints():
    body = default_body()
    rotations, joints = forward_kinematics(Rotation.random(24, random_state=1).as_matrix(), body.offsets)
    cylinders, balls = build(body.offsets)
    quats, centres = cylinders.posed(rotations, joints)
    along = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).apply([0, 0, 1]) * cylinders.sizes[:, 2:] / 2
    for j, parent in enumerate(
        [0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
    ):
        np.testing.assert_allclose(centres[j] - along[j], joints[parent], atol=1e-6)
        np.testing.assert_allclose(centres[j] + along[j], joints[j + 1], atol=1e-6)
    assert len(centres) == 23 + len(TIPS)
    places = balls.posed(rotations, joints)[1]
    for place in joints:
        assert np.abs(places - place).sum(axis=1).min() < 1e-9
    for joint, side in zip(cylinders.joints, cylinders.sides, strict=True):
        assert side in ("trunk", *(s for s in ("left", "right") if s in JOINTS[joint])) or joint in (0, 9)


def test_ground_is_below_the_feet():
    body = default_body()
    up = ground(np.tile(np.eye(3), (24, 1, 1)), body.offsets)
    assert -1.1 < up < -0.85
    assert ground(np.tile(np.eye(3), (2, 24, 1, 1)), body.offsets, [[0, 1, 0], [0, 3, 0]]) == pytest.approx(
        up + 1
    )


def test_table_of_sensors():
    held = np.zeros((60, 6), bool)
    held[30:45, 4] = True
    held[50:, 5] = True
    rows = [row.split("|")[1:-1] for row in sensor_table(held, 60.0).splitlines()[2:]]
    assert [cell.strip() for cell in rows[0]] == ["left forearm", "60", "-", "ok"]
    assert [cell.strip() for cell in rows[4]] == ["head", "45", "0.25 s", "ok"]
    assert [cell.strip() for cell in rows[5]] == ["pelvis", "50", "0.17 s", "held"]
    assert "| pelvis | 0 | - | ok |" in sensor_table(np.zeros((0, 6), bool), 60.0)
    texts = ["held head pelvis; filling window", "held tail; and what nobody knows"]
    flags = held_sensors([parse_status(text)[0] for text in texts])
    assert flags.tolist() == [[False] * 4 + [True] * 2, [False] * 6]


@pytest.fixture
def line() -> Iterator[tuple[UdpSink, socket.socket]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        with UdpSink("127.0.0.1", receiver.getsockname()[1]) as sink:
            yield sink, receiver


def take(stream: UdpPoseStream, receiver: socket.socket, now: float) -> PoseFrame | None:
    select.select([receiver], [], [], 5)
    return stream.take(receiver, now)


def test_only_the_newest_pose_is_shown_and_losses_are_counted(line):
    sink, receiver = line
    stream = UdpPoseStream(0.0)
    assert stream.take(receiver, 0.0) is None
    assert stream.text(0.0) == "waiting for poses"
    assert stream.text(7.2) == "waiting for poses for 7 s: do the sensors send?"
    for i in (0, 1, 2, 5, 4, 5):
        sink.write(standing(i, "held head" if i == 5 else "ok"))
    assert take(stream, receiver, 1.0).index == 5
    assert stream.text(1.0).startswith("4 poses/s, 4 poses, 2 lost\n\n**held head**\n\n| sensor")
    assert (
        stream.text(9.5).startswith("4 poses/s, 4 poses, 2 lost\n\n**nothing for 8 s: do the sensors send?**")
        is False
    )
    stream.take(receiver, 9.5)
    assert stream.text(9.5).startswith(
        "0 poses/s, 4 poses, 2 lost\n\n**nothing for 8 s: do the sensors send?**"
    )
    sink.write(standing(5))  # once more, late
    assert take(stream, receiver, 10.0) is None
    for i in (900, 0):  # then another run
        sink.write(standing(i))
    assert take(stream, receiver, 10.0).index == 0


def test_what_stands_still_and_how_late_it_is(line):
    """Noise of the sensors is no motion; poses of a recording are not late."""
    sink, receiver = line
    stream = UdpPoseStream(0.0)
    noise = Rotation.from_rotvec(np.radians(0.1) * np.ones(3)).as_matrix()
    for second in range(9):
        pose = standing(second)._replace(time_s=time.time() - 0.25)
        rotations = standing(40 if second == 8 else 0).rotations.copy()
        sink.write(pose._replace(rotations=rotations @ noise if second % 2 else rotations))
        take(stream, receiver, float(second))
        still = 3 <= second < 8
        assert (f"**ok, nothing has moved for {second} s**" in stream.text(second)) is still
        assert ("**ok**" in stream.text(second)) is not still
    late = int(re.search(r"(\d+) ms late", stream.text(8.0))[1])
    assert 250 <= late < 5000
    sink.write(standing(9))
    stream = UdpPoseStream(0.0)
    take(stream, receiver, 1.0)
    assert "late" not in stream.text(1.0)


def test_what_is_no_pose_is_counted_and_left_out(line):
    sink, receiver = line
    stream = UdpPoseStream(0.0)
    whole = json.loads(encode_json(standing()))
    bad = [
        b"",
        b"\xff" * 100,
        b"[" * 5000,
        b"{}",
        b'{"frame":1e999,"time_s":0,"status":"ok","pose":[]}',
        *(json.dumps({**whole, key: value}).encode() for key, value in [
            ("pose", [0] * 71), ("pose", [[0] * 72]), ("pose", ["a"] * 72), ("pose", [1e9] * 72),
            ("pose", [float("nan")] * 72), ("time_s", float("inf")), ("frame", None), ("time_s", {}),
        ]),
        encode_binary(standing())[:-1],
    ]  # fmt: skip
    for datagram in bad:
        with pytest.raises(EdgeposeError, match="datagram"):
            decode(datagram)
        sink._socket.send(datagram)
    sink.write(standing(3))
    until(lambda: stream.take(receiver, 0.0) or stream.poses, "the good one")
    assert stream.bad == len(bad)
    assert f"{len(bad)} bad" in stream.text(0.0)


@pytest.mark.parametrize("encode", [encode_json, encode_binary])
def test_datagrams_of_both_kinds_are_read(encode):
    pose = standing(7, "held head")
    back = decode(encode(pose))
    assert (back.index, back.status) == (7, "held head")
    assert back.time_s == pytest.approx(pose.time_s, abs=1e-6)
    np.testing.assert_allclose(back.rotations, pose.rotations, atol=2e-6)


# --- in the browser -----------------------------------------------------------------------------------------


PLAY = "[...document.querySelectorAll('input[type=checkbox]')].find(box => !box.id.startsWith('mantine'))"
"""The box beside "play" is the only one of ours; the others are viser's."""


@pytest.fixture
def browser(tmp_path) -> Iterator[Browser]:
    with contextlib.closing(Browser(tmp_path / "chromium")) as browser:
        yield browser


@contextlib.contextmanager
def started(*words: object) -> Iterator[subprocess.Popen]:
    """The command, running; at the end of the block it is interrupted."""
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", *map(str, words)],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        yield process
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=60)
        assert out == ""
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.communicate()


def colours(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the pixels of the light blue left and of the dark blue right limbs, the panels left out."""
    scene = image[:, :460]
    blue = scene[..., 2] - scene[..., 0] > 0.12
    light = scene.mean(axis=-1)
    return np.nonzero(blue & (light > 0.55))[1], np.nonzero(blue & (light < 0.4))[1]


@needs_browser
def test_poses_of_a_file_in_the_browser(browser, tmp_path):
    twist = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    for name in ("poses", "truth"):
        with CsvSink(tmp_path / f"{name}.csv") as sink:
            for i in range(600):
                pose = standing(i, "held head" if 200 <= i < 400 else "ok")
                pose.rotations[19] = twist if name == "truth" else pose.rotations[19]  # the right elbow
                sink.write(pose)
    port = free_port()
    words = ("view", tmp_path / "poses.csv", "--reference", tmp_path / "truth.csv", "--page-port", port)
    with started(*words) as process:
        assert f"open http://127.0.0.1:{port} in a browser" in process.stderr.readline()
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}")
        until(lambda: "of 600, 60 poses/s" in browser.text(), "the text beside the figure")
        assert "right lower leg" in browser.text()
        # 30 degrees at one of 15 joints; hand and wrist, which it moves, are none of them.
        assert "error 2.0°, most at right elbow: 30°; mean of the file 2.0°" in browser.text()

        def number() -> int:
            return int(re.search(r"pose (\d+) of 600", browser.text())[1])

        first = number()
        until(lambda: number() != first, "the next pose")
        until(lambda: "held head" in browser.text(), "the status")
        # The wearer's left is at the viewer's right.
        until(lambda: min(map(len, colours(browser.image()))) > 100, "the figure")
        left, right = colours(browser.image())
        assert left.mean() > right.mean() + 20
        # Pause, and go somewhere else on the time line.
        browser.run(f"{PLAY}.click()")
        until(lambda: not browser.run(f"{PLAY}.checked"), "the pause")
        time.sleep(0.6)

        def go_to_the_first() -> bool:
            """A page that is drawing at the moment may miss a key."""
            browser.run("document.querySelector('[role=slider]').focus()")
            key = {"key": "Home", "code": "Home", "windowsVirtualKeyCode": 36}
            browser.call("Input.dispatchKeyEvent", type="keyDown", **key)
            browser.call("Input.dispatchKeyEvent", type="keyUp", **key)
            time.sleep(0.5)
            return number() == 1

        until(go_to_the_first, "the first pose")
        time.sleep(0.6)
        assert number() == 1


def walking(folder: Path) -> Path:
    """Straight ahead, past the place where the camera stands, and on to 18 m."""
    with CsvSink(folder / "walk.csv", translation=True) as sink:
        for i in range(600):
            sink.write(standing(i)._replace(translation=np.array([0.0, 0.95, 0.03 * i])))
    return folder / "walk.csv"


@needs_browser
def test_the_camera_follows_a_walk(browser, tmp_path):
    port = free_port()
    with started("view", walking(tmp_path), "--page-port", port) as process:
        process.stderr.readline()
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}")
        until(lambda: re.search(r"pose [3-5]\d\d of 600", browser.text()), "the second half of the walk")
        until(lambda: min(map(len, colours(browser.image()))) > 100, "the figure")


def test_where_cameras_go():
    """Along with the pelvis; not down with a wearer who sits down, but with one who sinks into the floor."""
    np.testing.assert_allclose(wanted_shift(np.array([3.0, 0.95, -2.0])), [3.0, 0.0, -2.0])
    np.testing.assert_allclose(wanted_shift(np.array([0.0, 0.5, 0.0])), 0.0)
    np.testing.assert_allclose(wanted_shift(np.array([0.0, -1.7, 0.0])), [0.0, -2.0, 0.0], atol=1e-12)


def test_a_camera_arrives_while_one_pose_is_shown():
    """As after a jump on a time line that is stopped: the second pose is shown until the test ends."""
    camera = {
        "type": "ViewerCameraMessage",
        "wxyz": (0, 1, 0, 0),
        "position": (0, 1, 3),
        "look_at": (0, 1, 0),
        "up_direction": (0, 1, 0),
        **{"fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 500, "image_width": 800},
    }
    still = np.tile(np.eye(3), (3, 24, 1, 1))
    places = np.array([[0.0, 0.95, 0.0], [9.0, 0.95, 0.0], [9.0, 0.95, 0.0]])
    times = np.array([0.0, 0.02, 1000.0])
    poses = PoseSequence(np.arange(3), times, still, places, [frozenset()] * 3, [False] * 3)
    with (
        contextlib.closing(Viewer("127.0.0.1", free_port(), default_body(), next_free=True)) as viewer,
        connect(
            f"ws://127.0.0.1:{viewer.port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            max_queue=None,  # or closing would wait for the messages that are not read
        ) as line,
    ):
        line.send(msgspec.msgpack.encode(camera))
        until(viewer._server.get_clients, "the page")
        [page] = viewer._server.get_clients().values()
        end_s = time.monotonic() + 60
        viewer.play(poses, None, lambda: page.camera.position[0] > 8 or time.monotonic() > end_s)
        assert page.camera.position[0] > 8


class Camera(NamedTuple):
    """As viser knows it: looks along its own z, with y downwards."""

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 0.0)  # looks along -Z of the scene, upright
    fov: float = np.radians(60.0)
    aspect: float = 1.5


@pytest.mark.parametrize(
    ("pelvis", "seen"),
    [
        ((0.0, 1.0, 0.0), True),
        ((1.2, 1.0, 0.0), True),
        ((-2.1, 1.0, 0.0), False),  # leaves to the side
        ((0.0, 2.5, 0.0), False),  # above
        ((0.0, 1.0, 2.5), False),  # runs into the camera
        ((0.0, 1.0, 5.0), False),  # is behind it
        ((0.0, 1.0, -9.0), False),  # is too far to be seen
    ],
)
def test_who_is_in_the_picture(pelvis, seen):
    assert sees(Camera((0.0, 1.0, 3.0)), np.array(pelvis)) is seen


def test_path_and_contacts_of_a_figure():
    with contextlib.closing(Viewer("127.0.0.1", free_port(), default_body(), next_free=True)) as viewer:
        path = viewer._path
        for i in range(1000):  # 9.99 m to the left, as poses come
            path.extend([np.array([0.01 * i, 0.9, 0.0])])
        path.extend(np.array([[0.0, 0.9, 5.0], [0.0, 0.9, 5.2]]))  # its place was reset
        segments = np.concatenate([piece.points for piece in path._pieces])
        assert np.abs(segments[..., 1]).max() < 0.01
        lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
        assert lengths.max() == pytest.approx(0.2, abs=1e-6)
        assert lengths.sum() == pytest.approx(10.2, abs=0.1)
        path.extend(np.array([[0.1 * i, 0.9, 5.2] for i in range(10_000)]))
        segments = np.concatenate([piece.points for piece in path._pieces])
        assert len(segments) == SEGMENTS * PIECES  # what is long ago is forgotten
        assert segments[..., 0].max() == pytest.approx(999.9, abs=1e-3)
        assert segments[..., 0].min() > 999.9 - 0.1 * SEGMENTS * PIECES - 1
        marks = viewer.figure._marks
        one = standing()
        shown = viewer.figure.show(one.rotations.astype(float), np.array([1.0, 0.9, 2.0]), np.eye(7)[3])
        assert shown.tolist() == [1.0, 0.9, 2.0]
        assert (np.asarray(marks.batched_scales)[:, 0] > 0.01).tolist() == [False] * 3 + [True] + [False] * 3
        _, joints = forward_kinematics(one.rotations, default_body().offsets, shown)
        right_foot = JOINTS.index(CONTACTS[3])
        np.testing.assert_allclose(marks.batched_positions[3], joints[right_foot], atol=1e-6)
        viewer.figure.show(one.rotations.astype(float), None)
        assert np.max(marks.batched_scales) < 0.01


def test_poses_of_a_bvh_file(tmp_path):
    with BvhSink(tmp_path / "poses.bvh") as sink:
        for i in range(60):
            sink.write(standing(i))
    port = free_port()
    with started("view", tmp_path / "poses.bvh", "--page-port", port) as process:
        assert f"open http://127.0.0.1:{port} in a browser" in process.stderr.readline()


@needs_browser
def test_poses_as_they_come_in_the_browser(browser):
    page, line = free_port(), free_port(socket.SOCK_DGRAM)
    with started("view", "--udp", f"127.0.0.1:{line}", "--page-port", page) as process:
        process.stderr.readline()
        browser.call("Page.navigate", url=f"http://127.0.0.1:{page}")
        until(lambda: "waiting for poses" in browser.text(), "the page")
        with UdpSink("127.0.0.1", line, "binary") as sink:
            i = 0

            def send_and_see(text: str) -> bool:
                nonlocal i
                for _ in range(10):
                    i += 2 if i == 50 else 1
                    sink.write(standing(i, "held pelvis"))
                    time.sleep(1 / 60)
                return text in browser.text()

            until(lambda: send_and_see("1 lost"), "the lost pose")
            until(lambda: send_and_see("held pelvis"), "the status")
            until(lambda: send_and_see("poses/s"), "the rate")
            until(lambda: send_and_see("") and min(map(len, colours(browser.image()))) > 100, "the figure")
        until(lambda: re.search(r"nothing for \d+ s", browser.text()), "the silence")


# --- run --view ---------------------------------------------------------------------------------------------


def viewers() -> list[int]:
    """Processes `edgepose view` that this test session's commands have started and not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if b"--with-parent" in entry.read_bytes().split(b"\0"):
                found.append(int(entry.parent.name))
    return found


def child(process: subprocess.Popen) -> int | None:
    """The viewer that a run has started."""
    for pid in viewers():
        with contextlib.suppress(OSError):
            if int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]) == process.pid:
                return pid
    return None


def gone(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


def running_run(wearer, out: Path) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "edgepose",
        "run",
        "--file",
        wearer.short,
        "--realtime",
        "--model",
        "rnn",
    ]
    command += ["--calibration", wearer.calibration, "--csv", out, "--view"]
    return processes.Popen([*map(str, command)], text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes as Linux shows them")
def test_a_run_loses_nothing_while_its_viewer_sleeps_and_ends_it(wearer, tmp_path):
    process = running_run(wearer, tmp_path / "poses.csv")
    until(lambda: child(process), "the viewer")
    viewer = child(process)
    os.kill(viewer, signal.SIGSTOP)
    until(lambda: process.poll() is not None or (tmp_path / "poses.csv").stat().st_size > 50_000, "poses")
    os.kill(viewer, signal.SIGCONT)
    errors = process.communicate(timeout=60)[1]
    assert process.returncode == 0, errors
    assert len(read_poses(tmp_path / "poses.csv").frames) == 180
    assert gone(viewer)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes as Linux shows them")
def test_a_viewer_ends_with_a_run_that_is_killed(wearer, tmp_path):
    process = running_run(wearer, tmp_path / "poses.csv")
    until(lambda: child(process), "the viewer")
    viewer = child(process)
    until(lambda: "in a browser" in process.stderr.readline(), "the page")
    process.kill()
    process.communicate()
    until(lambda: gone(viewer), "its end")


# --- wrong use ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("", 2, "give a file of POSES, or --udp HOST:PORT"),
        ("poses.csv --udp 127.0.0.1:9000", 2, "give a file of POSES, or --udp HOST:PORT, not both"),
        ("--udp 127.0.0.1:9000 --reference poses.csv", 2, "--reference needs a file of POSES"),
        ("nothing.csv", 1, "cannot read poses from nothing.csv"),
        ("poses.csv --reference notes.md", 1, "notes.md is not a file of poses"),
        ("poses.csv --height 175", 2, "175.0 is not in the range 0.8<=x<=2.5 metres"),
        ("poses.csv --leg-length 1.2", 1, "leg length 1.2 m does not fit a height of 1.75 m"),
        ("poses.csv --host no-such-host.invalid", 1, "cannot show poses at no-such-host.invalid port 8080"),
        ("--udp 127.0.0.1", 2, "no port in '127.0.0.1'"),
        ("--udp no-such-host.invalid:9", 1, "cannot find 'no-such-host.invalid' to listen on"),
        ("--udp 192.0.2.1:9000", 1, "cannot listen on 192.0.2.1 port 9000"),
    ],
)
def test_wrong_use(command, tmp_path, words, code, says):
    with CsvSink(tmp_path / "poses.csv") as sink:
        sink.write(standing())
    (tmp_path / "notes.md").write_text("notes\n")
    result = command("view", *words.split(), cwd=tmp_path)
    assert result.returncode == code
    assert says in result.stderr
    assert "Traceback" not in result.stderr


SHORT_OF_MEMORY = """
import re, resource, sys
from pathlib import Path
import edgepose.cli.commands.view, edgepose.formats.poses.registry
held = int(re.search(r"VmSize:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) << 10
resource.setrlimit(resource.RLIMIT_AS, (held + (60 << 20),) * 2)
edgepose.cli.main()
"""


def test_a_file_that_does_not_fit_into_memory(tmp_path):
    joints = "".join(f"JOINT j{i}\n{{\nOFFSET 0 0 0\nCHANNELS 0\n}}\n" for i in range(500))
    head = f"HIERARCHY\nROOT r\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n{joints}}}\nMOTION\n"
    path = tmp_path / "a.bvh"
    path.write_text(f"{head}Frames: 5000\nFrame Time: .01\n" + "0\n" * 5000)
    command = [sys.executable, "-c", SHORT_OF_MEMORY, "view", str(path)]
    result = processes.run(command, text=True, capture_output=True, check=False)
    assert result.returncode == 1
    assert result.stderr == "edgepose: not enough memory; use a shorter file\n"


def test_a_port_that_is_taken(command, tmp_path):
    with CsvSink(tmp_path / "poses.csv") as sink:
        sink.write(standing())
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        result = command("view", tmp_path / "poses.csv", "--page-port", port)
    assert result.returncode == 1
    assert re.fullmatch(
        rf"edgepose: cannot show poses at 127\.0\.0\.1 port {port}: .*choose another --page-port\n",
        result.stderr,
    )


def test_without_viser(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(EdgeposeError, match=r"pip install 'edgepose\[view\]'"):
        Viewer("127.0.0.1", free_port(), default_body())


def test_documented_commands_are_understood():
    docs = (Path(__file__).parents[3] / "docs" / "guide" / "view.md").read_text()
    documented = re.findall(r"^edgepose view (.*?)(?: *#.*)?$", docs, re.MULTILINE)
    assert len(documented) >= 3
    for words in documented:
        cli.get_command(click.Context(cli), "view").make_context("view", words.split())


def test_a_port_in_use_moves_the_page_of_a_run():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with contextlib.closing(Viewer("127.0.0.1", port, default_body(), next_free=True)) as viewer:
            assert port < viewer.port < port + 1000
            page = urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=60)
            assert b"<title>" in page.read()
    with pytest.raises(EdgeposeError, match=r"choose another --host"):
        Viewer("nosuch.invalid", port, default_body(), next_free=True)


@pytest.mark.parametrize(
    ("origin", "status"),
    [("http://evil.example", 403), ("null", 403), ("http://127.0.0.1:1", 403), (None, 101), ("its own", 101)],
)
def test_pages_of_others_cannot_read_the_view(origin, status):
    with contextlib.closing(Viewer("127.0.0.1", free_port(), default_body())) as viewer:
        address = f"127.0.0.1:{viewer.port}"
        origin = f"http://{address}" if origin == "its own" else origin
        if status == 403:
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws://{address}", origin=origin)
        else:
            with connect(
                f"ws://{address}", origin=origin, subprotocols=[f"viser-v{viser.__version__}"]
            ) as line:
                assert line.recv(timeout=60)


def test_a_name_that_was_bent_to_this_machine_sees_nothing():
    with contextlib.closing(Viewer("127.0.0.1", free_port(), default_body())) as viewer:
        for name, status in (("evil.example", 403), ("localhost", 200), (socket.gethostname(), 200)):
            line = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=60)
            with contextlib.closing(line):
                line.request("GET", "/", headers={"Host": f"{name}:{viewer.port}"})
                answer = line.getresponse()
                assert answer.status == status
                if status == 200:  # nor does another page show it in a frame, for clicks meant for that page
                    assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"


def test_the_page_of_a_run_is_where_it_is_wanted_or_nowhere(caplog):
    port = free_port()
    with contextlib.ExitStack() as stack:
        open_outputs(stack, OutputConfig(view=True, page_port=port), wearer="anna")
        until(lambda: f"anna: open http://127.0.0.1:{port} in a browser" in caplog.messages, "the page")
    with socket.create_server(("127.0.0.1", 0)) as taken, contextlib.ExitStack() as stack:
        port = taken.getsockname()[1]
        with pytest.raises(EdgeposeError, match=rf"port {port}: Address already in use.*another --page-port"):
            open_outputs(stack, OutputConfig(view=True, page_port=port))
    with pytest.raises(ConfigError, match="--page-port 8081 is that of the page of --view: give --view"):
        OutputConfig(csv="a.csv", page_port=8081)
    with pytest.raises(ConfigError, match="--page-port 0 is not from 1 to 65535"):
        OutputConfig(view=True, page_port=0)


def test_two_wearers_want_one_port(command, wearer, tmp_path):
    for name, line in (("anna", "a"), ("ben", "b")):
        text = f'port = "/dev/{line}"\ncalibration = "{wearer.calibration}"\nview = true\npage-port = 8081\n'
        (tmp_path / f"{name}.toml").write_text(text)
    result = command("run", "--rig", "anna.toml", "--rig", "ben.toml", cwd=tmp_path)
    assert result.returncode == 1
    assert "anna.toml, ben.toml: both have page-port 8081; give each its own" in result.stderr


def test_a_button_is_a_key_for_its_wearer():
    with contextlib.ExitStack() as stack:
        requests = Requests(stack, None, lambda: [])
        for key in ("r", "o", "x", ""):
            requests.press(key)
        assert requests.poll("rezero") == [3.0]  # the wearer has to leave the keyboard
        assert requests.poll("origin") == [0.0]
        assert requests.poll("rezero") == []


@needs_browser
def test_buttons_press_the_keys_of_the_run(browser):
    port, keys = free_port(), []
    with contextlib.ExitStack() as stack:
        open_outputs(stack, OutputConfig(view=True, page_port=port), press=keys.append)
        until(lambda: not port_is_free(port), "the page")
        browser.call("Page.navigate", url=f"http://127.0.0.1:{port}")
        until(lambda: "waiting for poses" in browser.text(), "the text")
        for label, key in (("re-zero headings", "r"), ("back to the origin", "o")):
            button = f"[...document.querySelectorAll('button')].find(b => b.innerText == '{label}')"
            until(lambda button=button: browser.run(f"{button} !== undefined"), "the button")
            browser.run(f"{button}.click()")
            until(lambda key=key: keys[-1:] == [key], "the key")
        until(lambda: "headings are re-zeroed in 3 s" in browser.text(), "the explanation")


def port_is_free(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5):
        return False
    return True


def test_two_wearers_have_a_page_each(caplog):
    """Although both viewers start at the same time."""
    with contextlib.ExitStack() as stack:
        for name in ("anna", "ben"):
            open_outputs(stack, OutputConfig(view=True), wearer=name)
        until(lambda: len(caplog.messages) == 2, "the addresses of two pages")
        shown = [
            re.fullmatch(r"(\w+): open (http://127\.0\.0\.1:\d+) in a browser", text)
            for text in caplog.messages
        ]
        assert all(shown), caplog.messages
        assert sorted(match[1] for match in shown) == ["anna", "ben"]
        assert len({match[2] for match in shown}) == 2
        for match in shown:
            assert b"<title>" in urllib.request.urlopen(match[2], timeout=60).read()


def test_an_address_that_is_none(command):
    result = command(
        "view", "tests/data/none.csv", "--host", "nosuch.invalid", "--udp", f"127.0.0.1:{free_port()}"
    )
    assert result.returncode == 2
    result = command("view", "--host", "nosuch.invalid", "--udp", f"127.0.0.1:{free_port()}")
    assert result.returncode == 1
    assert "cannot show poses at nosuch.invalid port 8080" in result.stderr
    assert result.stderr.endswith("; choose another --host\n")
