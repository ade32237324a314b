"""All outputs of `edgepose run` at once, and however a run ends."""

from __future__ import annotations

import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle

from edgepose.formats.bvh import read_bvh
from edgepose.formats.joint_tree import forward
from edgepose.formats.poses.registry import read_poses
from edgepose.skeleton import default_body, forward_kinematics
from edgepose_export.mocap import read_motion
from tests.support import processes
from tests.support.datagrams import Listener, free_address


def test_all_outputs_say_the_same(command, wearer, tmp_path):
    with Listener() as mailbox, Listener() as vrchat, Listener() as mocopi:
        result = command(
            *("run", "--file", wearer.short, "--realtime"),
            *("--vrchat", f"{vrchat.address},trackers=6", "--mocopi", mocopi.address),
            *("--calibration", wearer.calibration, "--model", "rnn"),
            *("--csv", tmp_path / "a.csv", "--npz", f"{tmp_path / 'a.npz'},joints=52"),
            *("--bvh", tmp_path / "a.bvh", "--glb", tmp_path / "a.glb"),
            *("--sto", tmp_path / "a.sto", "--mot", tmp_path / "a.mot"),
            *("--osc", mailbox.address, "--tcp", free_address(), "--height", "1.9"),
        )
    datagrams = mailbox.datagrams
    assert result.returncode == 0, result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"a.{ending}" for ending in ("bvh", "csv", "glb", "mot", "npz", "sto")
    ]
    assert (tmp_path / "a.glb").read_bytes().startswith(b"glTF\2\0\0\0")
    for name in ("a.sto", "a.mot"):
        assert len((tmp_path / name).read_text().partition("endheader\n")[2].splitlines()) == 1 + 180
    poses = read_poses(tmp_path / "a.csv")
    assert len(poses.frames) == 180
    again = read_poses(tmp_path / "a.npz")
    assert again.status == poses.status
    np.testing.assert_array_equal(again.frames, poses.frames)
    np.testing.assert_allclose(again.time_s, poses.time_s, atol=1e-9)
    np.testing.assert_allclose(again.rotations, poses.rotations, atol=2e-6)
    assert np.load(tmp_path / "a.npz")["poses"].shape == (180, 156)
    assert again.about.keys() == {"model", "calibration", "source", "date", "edgepose"}
    assert (again.about["model"], again.about["calibration"]) == ("rnn", str(wearer.calibration))
    assert read_motion(tmp_path / "a.npz").rate == 60.0
    read = read_bvh(tmp_path / "a.bvh")
    assert (len(read.rotations), read.rate) == (180, 60.0)
    offsets = default_body(1.9).offsets
    wanted = forward_kinematics(poses.rotations, offsets)[1]
    order = [read.names.index(name) for name in ("pelvis", "head", "left_hand", "right_foot")]
    places = forward(read)[1][:, order] / 100.0
    true = wanted[:, [0, 15, 22, 11]]
    np.testing.assert_allclose(places - places[:, :1], true - true[:, :1], atol=1e-4)
    assert len(datagrams) == 2 * 180
    assert len(vrchat.datagrams) == 180
    assert len(mocopi.datagrams) == 180 + 3
    assert {message.address for message in OscBundle(datagrams[0])} >= {"/VMC/Ext/OK", "/VMC/Ext/Bone/Pos"}


def test_another_rate(command, wearer, tmp_path):
    """Half of the poses in all outputs, whose files say so; a rig file has the key, too."""
    rig = tmp_path / "anna.toml"
    rig.write_text(
        f"file = '{wearer.short}'\ncalibration = '{wearer.calibration}'\nrate = 30\n"
        "csv = 'a.csv'\nnpz = 'a.npz'\nbvh = 'a.bvh,unit=m,start=t-pose'\n"
    )
    result = command("run", "--rig", rig, "--model", "rnn", "--runtime", "numpy")
    assert result.returncode == 0, result.stderr
    poses = read_poses(tmp_path / "a.csv")
    assert (len(poses.frames), poses.rate) == (90, 30.0)
    assert "rate     written at 30 poses per second" in result.stderr
    assert np.load(tmp_path / "a.npz")["mocap_framerate"] == 30.0
    tree = read_bvh(tmp_path / "a.bvh")
    assert (len(tree.rotations), tree.rate) == (91, 30.0)
    result = command("run", "--rig", rig, "--rate", "0.5")
    assert result.returncode == 2


@pytest.mark.parametrize("numbers", [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)])
def test_an_interrupted_run_leaves_whole_files(wearer, tmp_path, numbers):
    """Programs that start others may pass on a signal that these have got already."""
    address = free_address()
    command = [sys.executable, "-m", "edgepose", "run", "--file", wearer.recording, "--realtime"]
    command += ["--calibration", wearer.calibration, "--model", "rnn", "--tcp", address]
    command += ["--csv", tmp_path / "a.csv", "--npz", tmp_path / "a.npz", "--bvh", tmp_path / "a.bvh"]
    process = processes.Popen(list(map(str, command)), text=True, stderr=subprocess.PIPE)
    host, _, port = address.partition(":")
    while True:
        try:
            viewer = socket.create_connection((host, int(port)))
            break
        except ConnectionRefusedError:
            assert process.poll() is None
            time.sleep(0.05)
    with viewer:
        seen = b""
        while seen.count(b"$") < 30:
            assert select.select([viewer], [], [], 30)[0]
            seen += viewer.recv(65536)
        for number in numbers:
            process.send_signal(number)
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 0, errors
    count = len(read_poses(tmp_path / "a.csv").frames)
    assert count >= 30
    assert f"poses    {count} " in errors
    assert len(read_poses(tmp_path / "a.npz").frames) == count
    assert len(read_bvh(tmp_path / "a.bvh").rotations) == count
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bvh", "a.csv", "a.npz"]


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--bvh", "-"], 1, "cannot write BVH to -"),
        (["--npz", "-"], 1, "cannot write poses to -"),
        (["--npz", "no/a.npz"], 1, "its folder does not exist"),
        (["--osc", "127.0.0.1"], 2, "no port in '127.0.0.1'"),
        (
            ["--osc", "127.255.255.255:39539"],
            1,
            "is a broadcast address, at which many machines receive: write",
        ),
        (
            ["--udp", "224.0.0.251:9000"],
            1,
            "write 224.0.0.251:9000,multicast to send there, or the address of",
        ),
        (
            ["--npz", "a.npz,joints=53"],
            2,
            "unknown option 'joints=53' of a.npz: possible are joints=24|52|55",
        ),
        (["--bvh", "a.bvh,unit=m,unit=cm"], 2, "the option unit is given twice"),
        (["--bvh", "a.bvh,names=maya"], 2, "possible are names=smpl|mixamo|unity|motionbuilder|rokoko"),
        (["--tcp", "192.0.2.1:8888"], 1, "cannot listen for viewers at 192.0.2.1 port 8888"),
        (["--bvh", "a.bvh", "--height", "175"], 2, "175.0 is not in the range 0.8<=x<=2.5 metres"),
        (["--bvh", "a.bvh", "--leg-length", "1.4"], 1, "leg length 1.4 m does not fit a height of 1.75 m"),
        (["--bvh", "RECORDING"], 2, "--bvh would overwrite"),
        (["--csv", "a.csv", "--csv", "./a.csv"], 2, "--csv and --csv name the same file, ./a.csv"),
        (["--csv", "-", "--csv", "/dev/stdout"], 2, "--csv and --csv name the same file, /dev/stdout"),
        (["--udp", "127.0.0.1:9", "--udp", "127.0.0.1:9"], 2, "udp is given twice with the same target"),
    ],
)
def test_wrong_use(command, wearer, tmp_path, words, code, says):
    words = [str(wearer.short) if word == "RECORDING" else word for word in words]
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn", *words),
        cwd=tmp_path,
    )
    assert result.returncode == code, result.stderr
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert Path(wearer.short).exists()


def test_each_output_may_be_given_several_times(command, wearer, tmp_path):
    with Listener() as one, Listener() as other:
        result = command(
            *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
            *("--csv", tmp_path / "a.csv", "--csv", f"{tmp_path / 'b.csv'},rotations=quat"),
            *("--bvh", tmp_path / "a.bvh", "--bvh", f"{tmp_path / 'b.bvh'},names=unity"),
            *("--npz", tmp_path / "a.npz", "--npz", f"{tmp_path / 'b.npz'},joints=52"),
            *("--udp", one.address, "--udp", f"{other.address},format=binary", "--realtime"),
            *("--tcp", free_address(), "--tcp", free_address()),
        )
    assert result.returncode == 0, result.stderr
    poses = [read_poses(tmp_path / name) for name in ("a.csv", "b.csv", "a.npz", "b.npz")]
    for each in poses[1:]:
        np.testing.assert_allclose(each.rotations, poses[0].rotations, atol=2e-6)
    assert len(poses[0].frames) == 180
    assert (tmp_path / "b.csv").read_text().startswith("frame,time_s,status,pelvis_w,")
    assert [read_bvh(tmp_path / name).names[0] for name in ("a.bvh", "b.bvh")] == ["pelvis", "Hips"]
    assert [len(one.datagrams), len(other.datagrams)] == [180, 180]
    assert one.datagrams[0].startswith(b"{")
    assert other.datagrams[0].startswith(b"EPOS")


def test_an_output_whose_reader_ends_costs_only_itself(wearer, tmp_path):
    words = ["run", "--file", wearer.recording, "--calibration", wearer.calibration, "--model", "rnn"]
    process = processes.start(
        *words, "--csv", "-", "--csv", tmp_path / "a.csv", "--bvh", tmp_path / "a.bvh", stdout=subprocess.PIPE
    )
    process.stdout.readline()
    process.stdout.close()
    code, errors = process.wait(120), process.stderr.read()
    process.stderr.close()
    lost = "the program that read the poses from standard output has ended"
    assert code == 1
    assert f"{lost}; this output has ended, the others go on\n" in errors
    assert errors.endswith(f"edgepose: 1 of 3 outputs failed: {lost}\n")
    assert len(read_poses(tmp_path / "a.csv").frames) == len(read_bvh(tmp_path / "a.bvh").rotations) == 720


def test_a_reader_that_sleeps_delays_no_other_output(wearer, tmp_path):
    words = ["run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"]
    with processes.start(
        *words, "--realtime", "--csv", "-", "--csv", tmp_path / "a.csv", stdout=subprocess.PIPE
    ) as process:
        try:
            end_s = time.monotonic() + 120.0
            while not (tmp_path / "a.csv").exists() or (tmp_path / "a.csv").read_text().count("\n") < 181:
                assert time.monotonic() < end_s
                assert process.poll() is None, process.stderr.read()
                time.sleep(0.1)
            lines, errors = process.communicate(timeout=120)
        finally:
            process.kill()
    assert len(lines) > 1 << 16  # more than a pipe holds
    assert lines == (tmp_path / "a.csv").read_text()
    assert process.returncode == 0, errors


def test_nobody_listens_for_osc(command, wearer):
    address = free_address()
    result = command(
        *("run", "--file", wearer.short, "--calibration", wearer.calibration, "--model", "rnn"),
        *("--osc", address),
    )
    assert result.returncode == 0, result.stderr
    assert f"datagrams did not arrive; is anything listening at {address}?" in result.stderr
