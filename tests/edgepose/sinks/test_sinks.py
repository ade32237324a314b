import csv
import json
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgepose.errors import EdgeposeError
from edgepose.formats.poses.registry import read_poses
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame, parse_status
from edgepose.rotations import matrix_to_euler_zxy
from edgepose.sinks import pose_file
from edgepose.sinks.csv import CsvSink, pose_columns
from edgepose.sinks.registry import SINKS
from edgepose.sinks.tcp import TcpSink
from edgepose.sinks.udp import UdpSink, decode, decode_binary, encode_binary, encode_json
from edgepose.sinks.vmc import VmcSink
from edgepose.skeleton import JOINTS
from edgepose.utils.sockets import bound_socket, resolve

DOCS = Path(__file__).parents[3] / "docs" / "reference" / "outputs.md"
STATUSES = ("ok", "held head", "held left_forearm pelvis; filling window", "filling window")


def make_pose(index: int, status: str = "ok") -> PoseFrame:
    rng = np.random.default_rng(index)
    rotations = Rotation.random(24, random_state=rng).as_matrix().astype(np.float32)
    std, state = rng.random(24).astype(np.float32), parse_status(status)
    return PoseFrame(index, 1.7e9 + index / 60, rotations, std, None, *state)


def run_python(code: str, *args: str, **options) -> subprocess.Popen:
    prelude = (
        "import sys, time, numpy as np\n"
        "from edgepose.pose import PoseFrame\n"
        "from edgepose.errors import EdgeposeError\n"
        "from edgepose.sinks.csv import CsvSink\n"
        "def pose(i): return PoseFrame(i, i / 60, np.tile(np.eye(3), (24, 1, 1)), np.zeros(24))\n"
    )
    return subprocess.Popen([sys.executable, "-c", prelude + code, *args], text=True, **options)


# --- CSV ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("std", [False, True])
@pytest.mark.parametrize("form", ["axis-angle", "quat", "matrix", "euler"])
def test_csv_comes_back(tmp_path, form, std):
    path = tmp_path / "poses.csv"
    poses = [make_pose(i, STATUSES[i % 4]) for i in range(10)]
    with CsvSink(path, form, std) as sink:
        for pose in poses:
            sink.write(pose)
    read = read_poses(path)
    frames, times, status, rotations = read.frames, read.time_s, read.status, read.rotations
    assert frames.tolist() == list(range(10))
    np.testing.assert_allclose(times, [p.time_s for p in poses], atol=1e-6)
    assert status == [p.status for p in poses]
    np.testing.assert_allclose(rotations, [p.rotations for p in poses], atol=5e-6)


def test_csv_columns_hold_what_their_names_say(tmp_path):
    pose = make_pose(3)
    truth = Rotation.from_matrix(pose.rotations)
    q = truth.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    expected = {
        "axis-angle": (("x", "y", "z"), truth.as_rotvec()),
        "quat": (("w", "x", "y", "z"), q),
        "matrix": ([f"r{i}{j}" for i in range(3) for j in range(3)], pose.rotations.reshape(24, 9)),
        "euler": (("rz", "rx", "ry"), truth.as_euler("ZXY")),
    }
    for form, (ends, values) in expected.items():
        with CsvSink(tmp_path / form, form, std=True) as sink:
            sink.write(pose)
        with (tmp_path / form).open() as file:
            (row,) = csv.DictReader(file)
        assert list(row)[:3] == ["frame", "time_s", "status"]
        assert len(row) == 3 + 24 * len(ends) + 24
        for j, joint in enumerate(JOINTS):
            for end, value in zip(ends, values[j], strict=True):
                assert float(row[f"{joint}_{end}"]) == pytest.approx(value, abs=2e-6)
            assert float(row[f"{joint}_std"]) == pytest.approx(pose.std[j], abs=1e-6)
    names = pose_columns("axis-angle", False)
    assert (names[3], names[-1], len(names)) == ("pelvis_x", "right_hand_z", 75)


@pytest.mark.parametrize("x", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-4, 0.3])
def test_euler_holds_at_gimbal_lock(x):
    r = Rotation.from_euler("ZXY", [0.4, x, -1.1]).as_matrix().astype(np.float32)
    back = Rotation.from_euler("ZXY", matrix_to_euler_zxy(r)).as_matrix()
    np.testing.assert_allclose(back, r, atol=1e-6)


def test_csv_to_a_pipe_comes_at_once():
    code = "with CsvSink('-') as sink:\n    sink.write(pose(7)); sys.stdin.read()\nprint('still open')\n"
    process = run_python(code, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline().startswith("frame,")
    assert process.stdout.readline().startswith("7,")  # Before the sink closes.
    assert process.communicate(timeout=120)[0] == "still open\n"


def test_csv_close_twice_and_after_an_error(tmp_path):
    sink = CsvSink(tmp_path / "a.csv")
    sink.write(make_pose(0))
    with pytest.raises(RuntimeError, match="elsewhere"), sink:
        raise RuntimeError("elsewhere")
    sink.close()
    assert len(read_poses(tmp_path / "a.csv").frames) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux only")
def test_csv_full_disk():
    with pytest.raises(EdgeposeError, match="disk is full"):
        CsvSink("/dev/full")


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_csv_ends_at_a_whole_row_when_the_disk_fills(tmp_path):
    # A limit on the file's size stops the write in the middle of a row, as a full disk does.
    path = tmp_path / "a.csv"
    code = (
        "import resource, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "try:\n"
        "    with CsvSink(sys.argv[1]) as sink:\n"
        "        for i in range(1000): sink.write(pose(i))\n"
        "except EdgeposeError as error: print(error)\n"
    )
    out, _ = run_python(code, str(path), stdout=subprocess.PIPE).communicate(timeout=120)
    assert "cannot write poses" in out
    assert 15_000 < path.stat().st_size < 20_000
    assert path.read_bytes().endswith(b"\n")
    frames = read_poses(path).frames
    assert frames.tolist() == list(range(len(frames)))


def test_csv_killed_run_keeps_its_rows(tmp_path):
    path = tmp_path / "a.csv"
    code = (
        "import edgepose.sinks.pose_file as c\n"
        "c.FLUSH_S = 0.05\n"
        "sink = CsvSink(sys.argv[1])\n"
        "for i in range(100):\n"
        "    sink.write(pose(i)); time.sleep(0.002)\n"
        "print('written', flush=True); time.sleep(60)\n"
    )
    process = run_python(code, str(path), stdout=subprocess.PIPE)
    assert process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    process.communicate()
    frames = read_poses(path).frames
    assert 0 < len(frames) <= 100
    assert pose_file.FLUSH_S == 1.0


def test_csv_reader_of_the_pipe_ends():
    code = (
        "try:\n"
        "    with CsvSink('-') as sink:\n"
        "        for i in range(100000): sink.write(pose(i))\n"
        "except EdgeposeError as error: sys.exit(str(error))\n"
    )
    process = run_python(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.readline()
    process.stdout.close()
    message = process.stderr.read()
    process.stderr.close()
    assert message == "the program that read the poses from standard output has ended\n"
    assert process.wait(timeout=120) == 1


def test_csv_unwritable(tmp_path):
    with pytest.raises(EdgeposeError, match="folder does not exist"):
        CsvSink(tmp_path / "no" / "a.csv")
    with pytest.raises(EdgeposeError, match=r"Is a directory|Permission denied"):
        CsvSink(tmp_path)
    with pytest.raises(EdgeposeError, match="choose one of axis-angle, quat"):
        CsvSink(tmp_path / "a.csv", "rodrigues")


# --- reading --------------------------------------------------------------------------------------


def _damaged(lines: list[str], damage: str) -> bytes:
    row = lines[2].split(",")
    if damage == "frames go back":
        lines[3] = lines[2]
    elif damage == "huge frame":
        lines[2] = ",".join(["9" * 30, *row[1:]])
    elif damage == "text":
        lines[2] = ",".join([*row[:7], "abc", *row[8:]])
    elif damage == "nan":
        lines[2] = ",".join([*row[:7], "nan", *row[8:]])
    elif damage == "cut row":
        lines[-1] = lines[-1][:100]
    elif damage == "two files":
        lines += lines
    elif damage == "long line":
        lines[2] = "1" * 100_000
    elif damage == "only a header":
        del lines[1:]
    elif damage == "joints":
        lines[0] = lines[0].replace("pelvis", "hips")
    elif damage == "zeros":
        lines[2] = ",".join([*row[:3], *["0"] * (len(row) - 3)])
    elif damage == "empty":
        return b""
    elif damage == "binary":
        return b"\xff\xfe\x00" * 100
    return ("\n".join(lines) + "\n").encode()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("frames go back", "first: row 4 has frame 1 after frame 1; sort the rows"),
        ("huge frame", "row 3 has a number that is infinite"),
        ("text", "row 3 has a cell that is not a number"),
        ("nan", "row 3 has a number that is infinite, not a number"),
        ("cut row", r"row 6 has \d+ columns, the header has 99"),
        ("two files", "5 bad rows left out, the first: row 8 has frame 0 after frame 4"),
        ("long line", "row 3 is longer than 16384 characters"),
        ("only a header", "no poses"),
        ("joints", "not a file of poses"),
        ("zeros", "row 3 has numbers of pelvis that are not a rotation"),
        ("empty", "the file is empty"),
        ("binary", "starts with .*, not with 'frame,time_s"),
    ],
)
def test_damaged_files(tmp_path, damage, message):
    path = tmp_path / "a.csv"
    with CsvSink(path, "quat") as sink:
        for i in range(5):
            sink.write(make_pose(i))
    path.write_bytes(_damaged(path.read_text().splitlines(), damage))
    with pytest.raises(EdgeposeError, match=message):
        read_poses(path)


def test_no_such_file(tmp_path):
    with pytest.raises(EdgeposeError, match="No such file"):
        read_poses(tmp_path / "a.csv")


def test_matrices_that_are_no_rotations(tmp_path):
    path = tmp_path / "a.csv"
    with CsvSink(path, "matrix") as sink:
        sink.write(make_pose(0)._replace(rotations=-np.tile(np.eye(3, dtype=np.float32), (24, 1, 1))))
    with pytest.raises(EdgeposeError, match="row 2 has numbers of pelvis that are not a rotation"):
        read_poses(path)


def test_file_with_a_byte_order_mark_and_windows_line_ends(tmp_path):
    path = tmp_path / "a.csv"
    with CsvSink(path) as sink:
        sink.write(make_pose(0))
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert len(read_poses(path).frames) == 1


# --- UDP ------------------------------------------------------------------------------------------


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(5)
        yield sock


def test_udp_json(receiver):
    pose = make_pose(7, "held head")
    with UdpSink("localhost", receiver.getsockname()[1]) as sink:
        sink.write(pose)
        data = receiver.recv(2048)
    assert data.endswith(b"}\n")
    assert data.count(b"\n") == 1
    assert len(data) < 1200
    message = json.loads(data)
    assert list(message) == ["frame", "time_s", "status", "pose"]
    assert (message["frame"], message["status"]) == (7, "held head")
    assert message["time_s"] == pytest.approx(pose.time_s, abs=1e-6)
    expected = Rotation.from_matrix(pose.rotations).as_rotvec().ravel()
    np.testing.assert_allclose(message["pose"], expected, atol=2e-6)


@pytest.mark.parametrize("status", STATUSES)
def test_udp_binary(receiver, status):
    pose = make_pose(7, status)
    with UdpSink("127.0.0.1", receiver.getsockname()[1], "binary") as sink:
        sink.write(pose)
        data = receiver.recv(2048)
    assert len(data) == 404
    back = decode_binary(data)
    assert (back.index, back.time_s, back.status) == (7, pose.time_s, status)
    assert (back.held, back.warming_up) == (pose.held, pose.warming_up)
    np.testing.assert_allclose(back.rotations, pose.rotations, atol=1e-6)
    assert np.isnan(back.std).all()


def test_binary_layout_is_the_documented_one():
    data = encode_binary(make_pose(5, "held left_forearm head; filling window"))
    assert data[:8] == b"EPOS" + bytes([1, 1, 0b010001, 24])
    assert np.frombuffer(data, "<f8", 1, 8)[0] == make_pose(5).time_s
    assert np.frombuffer(data, "<u4", 1, 16)[0] == 5
    q = Rotation.from_matrix(make_pose(5).rotations).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.frombuffer(data, "<f4", 96, 20).reshape(24, 4), q, atol=1e-6)


def placed(index: int) -> PoseFrame:
    contacts = np.linspace(0.0, 1.0, 7, dtype=np.float32)
    return make_pose(index, "held head")._replace(translation=np.array([1.5, 0.9, -2.25]), contacts=contacts)


def test_version_2_adds_the_place():
    pose = placed(5)
    data, old = encode_binary(pose), encode_binary(pose._replace(translation=None, contacts=None))
    assert (len(data), data[:6], data[6:404]) == (444, b"EPOS\x02\x02", old[6:])
    assert np.frombuffer(data, "<f4", 3, 404).tolist() == [1.5, np.float32(0.9), -2.25]
    assert np.frombuffer(data, "<f4", 7, 416).tolist() == pose.contacts.tolist()
    back = decode(data)
    np.testing.assert_allclose(back.translation, pose.translation, atol=1e-6)
    assert back.contacts.tolist() == pose.contacts.tolist()
    without = decode(encode_binary(pose._replace(contacts=None)))
    assert (without.translation.tolist(), without.contacts) == (back.translation.tolist(), None)
    assert encode_binary(pose, newest=1) == old
    assert (decode(old).translation, decode(old).contacts) == (None, None)


def test_json_with_the_place():
    pose = placed(5)
    data = encode_json(pose)
    assert data.endswith(b"}\n")
    message = json.loads(data)
    assert list(message) == ["frame", "time_s", "status", "pose", "trans", "contacts"]
    back = decode(data)
    np.testing.assert_allclose(back.translation, pose.translation, atol=1e-6)
    np.testing.assert_allclose(back.contacts, pose.contacts, atol=1e-6)


@pytest.mark.parametrize(("form", "size"), [("binary", 444), ("binary-v1", 404)])
def test_version_1_on_request(receiver, form, size):
    destination = SINKS["udp"].parse(f"127.0.0.1:{receiver.getsockname()[1]},format={form}")
    with UdpSink(*destination) as sink:
        sink.write(placed(1))
        data = receiver.recv(2048)
    assert (len(data), decode(data).index) == (size, 1)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("trans", [1.0, 2.0]), ("trans", [1.0, 2.0, 1e9]), ("trans", [1.0, 2.0, float("nan")]),
        ("trans", "here"),
        ("contacts", [0.5] * 6), ("contacts", [0.5] * 6 + [1.01]), ("contacts", [float("nan")] * 7),
        ("contacts", [1e300] * 7), ("contacts", {}),
    ],
)  # fmt: skip
def test_a_place_that_is_none_is_refused(key, value):
    message = {**json.loads(encode_json(placed(5))), key: value}
    with pytest.raises(EdgeposeError, match="pose datagram"):
        decode(json.dumps(message).encode())
    if np.shape(value) in ((3,), (7,)):
        data, at = bytearray(encode_binary(placed(5))), 404 if key == "trans" else 416
        with np.errstate(over="ignore"):
            data[at : at + 4 * len(value)] = np.array(value, "<f4").tobytes()
        with pytest.raises(EdgeposeError, match=r"damaged pose datagram: .* of frame 5"):
            decode(bytes(data))


def test_decode_binary_refuses_what_it_does_not_know():
    data = encode_binary(make_pose(0))
    nan = np.float32(np.nan).tobytes()
    for bad in (
        b"",
        data[:-1],
        data + b"x",
        b"EPOT" + data[4:],
        b"EPOS\x02" + data[5:],
        b"EPOS\x03" + data[5:],
        b"EPOS\x01" + encode_binary(placed(0))[5:],
        encode_binary(placed(0))[:-4],
        data[:20] + nan + data[24:],
    ):
        with pytest.raises(EdgeposeError, match="datagram"):
            decode_binary(bad)
    rng = np.random.default_rng(0)
    for _ in range(200):
        with pytest.raises(EdgeposeError):
            decode_binary(data[:20] + rng.bytes(384))


def test_json_quotes_the_status():
    pose = make_pose(0)._replace(held=frozenset(['a "quoted" name']))
    assert json.loads(encode_json(pose))["status"] == 'held a "quoted" name'


def test_udp_nobody_listens_and_then_somebody_does(receiver):
    port = receiver.getsockname()[1]
    receiver.close()
    with UdpSink("127.0.0.1", port) as sink:
        for i in range(10):
            sink.write(make_pose(i))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
            late.bind(("127.0.0.1", port))
            late.settimeout(5)
            sink.write(make_pose(10))
            assert json.loads(late.recv(2048))["frame"] == 10
        assert sink.unsent <= 10


def test_udp_ipv6():
    try:
        sock = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        sock.bind(("::1", 0))
    except OSError:
        pytest.skip("no IPv6 here")
    with sock:
        sock.settimeout(5)
        destination = SINKS["udp"].parse(f"[::1]:{sock.getsockname()[1]},format=binary")
        with UdpSink(*destination) as sink:
            sink.write(make_pose(1))
        assert decode_binary(sock.recv(2048)).index == 1


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_names_stand_for_their_address_of_ipv4(kind):
    # No name is this machine, by both kinds of addresses, as localhost is on many systems.
    assert socket.AF_INET6 in {family for family, *_ in socket.getaddrinfo(None, 9, type=kind)}
    assert resolve(None, 9, kind) == (socket.AF_INET, ("127.0.0.1", 9))
    assert resolve("localhost", 9, kind) == (socket.AF_INET, ("127.0.0.1", 9))
    assert resolve("::1", 9, kind)[0] == socket.AF_INET6


def test_broadcast_reaches_those_who_listen():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("", 0))
        receiver.settimeout(5)
        port = receiver.getsockname()[1]
        destination = SINKS["udp"].parse(f"127.255.255.255:{port},format=binary,broadcast")
        with UdpSink(*destination) as sink:
            sink.write(make_pose(1))
        assert decode_binary(receiver.recv(2048)).index == 1


@pytest.mark.parametrize(
    ("host", "cast"),
    [
        ("127.255.255.255", "broadcast"),
        ("255.255.255.255", "broadcast"),
        ("224.0.0.251", "multicast"),
        ("ff02::1", "multicast"),
    ],
)
@pytest.mark.parametrize("sink", [UdpSink, VmcSink])
def test_many_machines_must_be_asked_for(sink, host, cast):
    with pytest.raises(EdgeposeError, match=f"{host} is a {cast} address, .*: write .*:9000,{cast} to send"):
        sink(host, 9000)


@pytest.mark.parametrize("use", [UdpSink, TcpSink, bound_socket])
def test_an_address_of_one_link_needs_its_interface(use):
    with pytest.raises(
        EdgeposeError, match=r"fe80::1 port 9000: it needs the network interface.*fe80::1%eth0"
    ):
        use("fe80::1", 9000)
    with pytest.raises(EdgeposeError, match="fe80::1%nosuch0"):
        use("fe80::1%nosuch0", 9000)


def test_udp_unknown_host():
    with pytest.raises(EdgeposeError, match="cannot find host"):
        UdpSink("no-such-host.invalid", 9000)
    with pytest.raises(EdgeposeError, match="cannot find host"):
        UdpSink("a" * 70 + ".example", 9000)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:9000", ("127.0.0.1", 9000, "json", "")),
        ("pc.local:1,format=binary", ("pc.local", 1, "binary", "")),
        ("[::1]:65535,format=json", ("::1", 65535, "json", "")),
        ("[fe80::1%eth0]:9000", ("fe80::1%eth0", 9000, "json", "")),
        ("10.0.0.255:9000,format=binary,broadcast", ("10.0.0.255", 9000, "binary", "broadcast")),
        ("224.0.0.251:9000,multicast", ("224.0.0.251", 9000, "json", "multicast")),
    ],
)
def test_parse_destination(text, expected):
    assert SINKS["udp"].parse(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no port"),
        ("localhost", "no port"),
        ("localhost:", "no port"),
        ("[::1]", "no port"),
        ("::1:9000", r"write an IPv6 address as \[::1\]:9000"),
        (":9000", "no host"),
        ("[]:9000", "no host"),
        ("a b:9000", "no host"),
        ("localhost:0", "1 to 65535"),
        ("localhost:65536", "1 to 65535"),
        ("localhost:-1", "1 to 65535"),
        ("localhost:9e3", "1 to 65535"),
        ("localhost:９０", "1 to 65535"),
        ("localhost:" + "9" * 5000, "1 to 65535"),
        ("localhost:9000,format=xml", "unknown option 'format=xml'"),
        ("localhost:9000,format", "unknown option 'format'"),
        ("localhost:9000,rate=3", "unknown option 'rate=3'"),
        ("localhost:9000,", "unknown option ''"),
    ],
)
def test_parse_destination_errors(text, message):
    with pytest.raises(EdgeposeError, match=message):
        SINKS["udp"].parse(text)


def documented_receiver(language: str, port: int) -> str:
    (code,) = re.findall(rf"```{language}\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert "9000" in code
    return code.replace("9000", str(port))


def python_receiver(folder: Path, port: int) -> list[str]:
    code = documented_receiver("python", port)
    assert len(code.splitlines()) <= 16
    return [sys.executable, "-c", code]


def javascript_receiver(folder: Path, port: int) -> list[str]:
    if shutil.which("node") is None:
        pytest.skip("no node here to run the receiver in JavaScript")
    return ["node", "-e", documented_receiver("javascript", port)]


def c_receiver(folder: Path, port: int) -> list[str]:
    code = documented_receiver("c", port)
    assert len(code.splitlines()) <= 29
    (folder / "receiver.c").write_text(code)
    subprocess.run(
        ["cc", "-Wall", "-Wextra", "-Werror", "-o", folder / "receiver", folder / "receiver.c"], check=True
    )
    return [str(folder / "receiver")]


def found_in(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)]


@pytest.mark.parametrize(
    ("command", "formats"),
    [
        (python_receiver, ("json", "binary", "binary-v1")),
        (javascript_receiver, ("json", "binary", "binary-v1")),
        (c_receiver, ("binary", "binary-v1")),
    ],
)
def test_receivers_of_the_documentation(receiver, tmp_path, command, formats):
    port = receiver.getsockname()[1]
    receiver.close()
    process = subprocess.Popen(command(tmp_path, port), stdout=subprocess.PIPE, text=True)
    numbers = {"json": 4, "binary": 5, "binary-v1": 6}
    vectors = Rotation.from_matrix([make_pose(number).rotations[0] for number in numbers.values()])
    wanted = {"json": vectors[0].as_rotvec(), "binary": vectors[1].as_quat(canonical=True)[[3, 0, 1, 2]]}
    wanted["binary-v1"] = vectors[2].as_quat(canonical=True)[[3, 0, 1, 2]]
    poses = {form: placed(number) for form, number in numbers.items()}
    try:
        for form in formats:
            number = numbers[form]
            with UdpSink("127.0.0.1", port, form) as sink:
                for _ in range(200):  # It takes a moment to bind; what is sent before is lost.
                    sink.write(poses[form])
                    if select.select([process.stdout], [], [], 0.05)[0]:
                        break
            # The pipe of the first kind may hold several lines of one pose.
            while not (line := process.stdout.readline()).startswith(f"{number} "):
                assert line
            what, _, rotation = line.partition("axis-angle" if form == "json" else "quaternion")
            _, _, place = what.partition(" at ")
            assert "pelvis" in what
            np.testing.assert_allclose(found_in(rotation), wanted[form], atol=2e-6)
            np.testing.assert_allclose(
                found_in(place), [] if form == "binary-v1" else [1.5, 0.9, -2.25], atol=1e-6
            )
    finally:
        process.kill()
        process.communicate()


def test_documented_tables_are_those_of_the_code():
    text = DOCS.read_text()
    assert " ".join(JOINTS) in " ".join(text.split())
    for i, name in enumerate(PLACEMENTS):
        assert re.search(rf"\b{i} {name}\b", text)
