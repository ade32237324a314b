"""`edgepose convert`: many recordings of many kinds, some of them broken."""

from __future__ import annotations

import gzip
import math
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import can
import click
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgepose.cli import cli
from edgepose.convert import Job, convert, plan
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording, salvage_recording
from edgepose.formats.recordings.xio_session import placement_of
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from firmware_protocols import native_can
from firmware_protocols.native import encode
from firmware_protocols.native_packet import Packet
from firmware_protocols.sample import STANDARD_G
from tests.support import limits, processes
from tests.support.terminals import on_a_terminal

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
DOCS = Path(__file__).parents[3] / "docs" / "guide" / "recordings.md"


def rows(count: int = 10) -> list[ImuSample]:
    return list(iter_samples(read_recording(REAL)))[: 6 * count]


def same(a, b, tolerance: float = 0.0) -> None:
    assert list(a.sensors) == list(b.sensors)
    for x, y in zip(a.sensors.values(), b.sensors.values(), strict=True):
        for p, q in zip(x, y, strict=True):
            assert (p is None) == (q is None)
            if p is not None:
                np.testing.assert_allclose(p, q, rtol=0, atol=tolerance)


def table(result: subprocess.CompletedProcess[str]) -> dict[str, list[str]]:
    """Samples, seconds and result by file name, of the table at the end."""
    assert "Traceback" not in result.stderr
    header, *lines = result.stdout.splitlines()
    assert header.split() == ["file", "samples", "seconds", "result"]
    return {Path(line.split()[0]).name: line.split(maxsplit=3)[1:] for line in lines}


# --- one recording ------------------------------------------------------------------------------------------

numbers = st.floats(-300, 300, width=32)
vectors = st.one_of(st.none(), st.tuples(numbers, numbers, numbers))
text = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Zl", "Zp")), max_size=20).map(
    str.strip
)


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.integers(0, 10**7), vectors, vectors, vectors, st.booleans()),
        min_size=1,
        max_size=20,
    ),
    st.dictionaries(text.filter(lambda key: key and ":" not in key), text, max_size=3),
)
@settings(max_examples=40, deadline=None)
def test_any_recording_to_the_other_kind_and_back(tmp_path_factory, drawn, metadata):
    folder = tmp_path_factory.mktemp("c")
    times = [0] * 6
    drawn_rows = []
    for sensor, step_us, acc, gyr, mag, oriented in drawn:
        times[sensor] += step_us
        # A sample of nothing at all is none.
        quat = (0.6, 0.0, -0.8, 0.0) if oriented or not (acc or gyr or mag) else None
        drawn_rows.append(ImuSample(sensor, times[sensor] * 1e-6, quat, acc, gyr, mag))
    recording = recording_from_samples(drawn_rows, metadata)
    # Text of a CSV file sets no terminal.
    write_csv(folder / "a.csv", recording)
    write_npz(folder / "a.npz", recording)
    for first, second in (("csv", "npz"), ("npz", "csv")):
        there = Job(folder / f"a.{first}", folder / f"b.{second}")
        back = Job(there.target, folder / f"c.{first}")
        for job in (there, back):
            result = convert(job)
            assert result.problem is None
            assert result.samples == len(drawn)
        again = salvage_recording(back.target)
        assert again.metadata == metadata
        same(recording, again, 1e-6)
        same(salvage_recording(there.source), again, 1e-6)


def test_a_real_recording_there_and_back(command, tmp_path):
    result = command("convert", REAL, "--to", "csv", "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    assert table(result) == {REAL.name: ["1800", "3.0", "ok"]}
    assert result.stderr == f"1 of 1  {REAL}: ok\n"
    result = command(
        "convert", tmp_path / "six-sites-3s.csv", "--to", "npz", "--out", tmp_path / "new" / "folder"
    )
    assert result.returncode == 0, result.stderr
    same(read_recording(REAL), read_recording(tmp_path / "new" / "folder" / REAL.name), 1e-7)


def test_standard_input(tmp_path):
    write_csv(tmp_path / "a.csv", read_recording(REAL))
    with (tmp_path / "a.csv").open() as file:
        command = [sys.executable, "-m", "edgepose", "convert", "-", "--to", "npz", "--out", str(tmp_path)]
        processes.run(command, check=True, capture_output=True, stdin=file)
    same(read_recording(REAL), read_recording(tmp_path / "stdin.npz"), 1e-6)


def packets(count: int = 50) -> list[Packet]:
    return [
        Packet(row.sensor, i // 6, int(row.time_s * 1e6), row.quat, row.acc, row.gyr)
        for i, row in enumerate(rows(count))
    ]


def test_a_capture_and_a_can_log(command, tmp_path):
    (tmp_path / "port.bin").write_bytes(b"\x01\x02\x00" + b"".join(map(encode, packets())))
    with can.Logger(tmp_path / "bus.log") as log:
        for packet in packets():
            for number, data in native_can.encode(packet):
                log(can.Message(packet.t_us * 1e-6 + 1e9, number, False, data=data, channel="can0"))
    out = tmp_path / "out"
    result = command(*("convert", tmp_path / "port.bin", tmp_path / "bus.log"), "--to", "npz", "--out", out)
    assert result.returncode == 0, result.stderr
    assert table(result) == {"port.bin": ["300", "0.5", "ok"], "bus.log": ["300", "0.5", "ok"]}
    wanted = recording_from_samples(rows(50))
    for name, acc in (("port", 5.1e-3), ("bus", 5.1e-3)):
        recording = read_recording(out / f"{name}.npz")
        for a, b in zip(wanted.sensors.values(), recording.sensors.values(), strict=True):
            np.testing.assert_allclose(np.diff(a.time_s), np.diff(b.time_s), atol=3e-4)
            np.testing.assert_allclose(a.acc, b.acc, atol=acc)
            np.testing.assert_allclose(a.quat, b.quat, atol=1e-4)


# --- x-io ---------------------------------------------------------------------------------------------------


def xio_session(folder: Path, names: list[str]) -> list[ImuSample]:
    """Sensors' folders as x-io's software writes them."""
    written = rows(100)
    for sensor, name in enumerate(names):
        place = folder / name
        place.mkdir(parents=True)
        mine = [row for row in written if row.sensor == sensor]
        stamps = [round(row.time_s * 1e6) for row in mine]
        lines = {
            "Inertial": "Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
            "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n",
            "Quaternion": "Timestamp (us),W,X,Y,Z\n",
            "Magnetometer": "Timestamp (us),X (a.u.),Y (a.u.),Z (a.u.)\n",
            "Temperature": "Timestamp (us),Temperature (degC)\n",
        }
        for time_us, row in zip(stamps, mine, strict=True):
            inertial = [*map(math.degrees, row.gyr), *(value / STANDARD_G for value in row.acc)]
            lines["Inertial"] += f"{time_us}," + ",".join(f"{value:.6f}" for value in inertial) + "\n"
            lines["Quaternion"] += f"{time_us}," + ",".join(f"{value:.6f}" for value in row.quat) + "\n"
        for time_us in stamps[::5]:
            lines["Magnetometer"] += f"{time_us - 3000},0.500000,0.250000,-0.125000\n"
        for file, content in lines.items():
            (place / f"{file}.csv").write_text(content)
        (place / "Command.json").write_text("[]")
    return written


def check_xio(file: Path, written: list[ImuSample], left_out: int = 0) -> None:
    recording = read_recording(file)
    for a, b in zip(
        recording_from_samples(written).sensors.values(), recording.sensors.values(), strict=True
    ):
        kept = np.isin(np.round(a.time_s, 6), np.round(b.time_s, 6))
        assert kept.sum() == len(b.time_s) >= len(a.time_s) - left_out
        np.testing.assert_allclose(a.acc[kept], b.acc, atol=2e-5)
        np.testing.assert_allclose(a.gyr[kept], b.gyr, atol=1e-6)
        np.testing.assert_allclose(a.quat[kept], b.quat, atol=2e-6)
        assert np.isfinite(b.mag[:, 0]).sum() >= 15


def test_an_xio_session(command, tmp_path):
    names = [f"{name.replace('_', ' ').title()} 64F0000{i} (UDP)" for i, name in enumerate(PLACEMENTS)]
    written = xio_session(tmp_path / "walk.1", names)
    shutil.copytree(tmp_path / "walk.1" / names[0], tmp_path / "walk.1" / "Spare 64F0000A (UDP)")
    result = command("convert", tmp_path, "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    assert table(result) == {"walk.1": ["600", "1.0", "ok"]}
    check_xio(tmp_path / "out" / "walk.1.npz", written)
    result = command("convert", tmp_path / "walk.1" / names[0], "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert "one sensor of an x-io session; give the folder above it" in result.stderr


def test_an_xio_session_by_serial_numbers(command, tmp_path):
    names = [f"IMU {i} 64F0000{i} (UDP)" for i in range(6)]
    written = xio_session(tmp_path / "walk", names)
    result = command("convert", tmp_path / "walk", "--to", "csv", "--out", tmp_path)
    assert result.returncode == 1
    assert "no placement in the names of its folders" in result.stderr
    sensors = tmp_path / "map.toml"
    sensors.write_text("".join(f"{name} = {{ id = 0x64F0000{i} }}\n" for i, name in enumerate(PLACEMENTS)))
    result = command("convert", tmp_path / "walk", "--sensors", sensors, "--to", "csv", "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    check_xio(tmp_path / "walk.csv", written)


def test_a_damaged_xio_session(tmp_path):
    session = tmp_path / "walk"
    written = xio_session(session, list(PLACEMENTS))
    file = session / "head" / "Inertial.csv"
    lines = file.read_bytes().splitlines(keepends=True)
    lines[5] = lines[5].replace(b".", b"x")
    file.write_bytes(b"".join(lines)[:-3])
    result = convert(Job(session, tmp_path / "walk.csv"))
    assert result.problem == f"{session / 'head'}: 2 bad rows left out"
    recording = salvage_recording(tmp_path / "walk.csv")
    assert np.isnan(recording.sensors["head"].acc).any(axis=1).sum() == 2
    assert len(list(iter_samples(recording))) == len(written)
    (session / "head" / "Quaternion.csv").write_text("W,X\n")
    assert "starts with 'W,X', not with 'Timestamp (us)'" in convert(Job(session, tmp_path / "a.csv")).problem
    (session / "head" / "Quaternion.csv").unlink()
    (session / "Head 2").mkdir()
    shutil.copy(file, session / "Head 2")
    assert "'head' are both head; rename one" in convert(Job(session, tmp_path / "a.csv")).problem
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize(
    ("name", "placement"),
    [
        ("Left Lower Leg 64F61CB3 (UDP)", "left_lower_leg"),
        ("pelvis 64F0EDBF (UDP)", "pelvis"),
        ("RightForearm", "right_forearm"),
        ("right-lower-leg", "right_lower_leg"),
        ("Headset", None),
        ("Left Foot 64F0EBCE (UDP)", "left_foot"),
        ("Left Toe 64F0EBCE (UDP)", None),
    ],
)
def test_placements_in_names_of_folders(name, placement):
    assert placement_of(name, None) == placement


# --- many ---------------------------------------------------------------------------------------------------


def test_fifty_files_one_of_them_broken_by_two_processes(command, tmp_path):
    recording = recording_from_samples(rows(), {"rate": "100"})
    folder, out = tmp_path / "in", tmp_path / "out"
    (folder / "deeper").mkdir(parents=True)
    for i in range(25):
        write_csv(folder / f"{i}.csv", recording)
        write_npz(folder / "deeper" / f"{i}.npz", recording)
    lines = (folder / "7.csv").read_text().splitlines(keepends=True)
    lines[20] = "nonsense\n"
    (folder / "7.csv").write_text("".join(lines))
    (folder / "deeper" / "9.npz").write_bytes(b"")
    (folder / "notes.md").write_text("not a recording")
    result = command("convert", folder, "--to", "npz", "--out", out, "--jobs", 2)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == (
        "edgepose: 2 of 50 recordings not converted, or only in part; see the messages above"
    )
    assert len(result.stderr.splitlines()) == 51
    lines = result.stdout.splitlines()[1:]
    assert len(lines) == 50
    assert sum(line.endswith(" 60        0.1  ok") for line in lines) == 48
    assert re.search(rf"^{folder / '7.csv'} +59 +0\.1  damaged$", result.stdout, re.MULTILINE)
    assert re.search(rf"^{folder / 'deeper' / '9.npz'} +- +-  failed$", result.stdout, re.MULTILINE)
    for name, reason in (
        ("7.csv", "damaged: .*1 bad rows left out.* row 21 has 1 col"),
        ("deeper/9.npz", "failed: not a complete NPZ file"),
    ):
        (line,) = (line for line in result.stderr.splitlines() if f"{folder / name}: " in line)
        assert re.search(rf"^\d+ of 50  {folder / name}: {reason}", line)
    written = sorted(path for path in out.rglob("*") if path.is_file())
    assert len(written) == 49
    for path in written:
        assert len(list(iter_samples(read_recording(path)))) == (59 if path == out / "7.npz" else 60)
    # Again, for what is missing.
    os.utime(out / "3.npz", (1, 1))
    result = command("convert", folder, "--to", "npz", "--out", out, "--jobs", 2, "--skip-existing")
    assert result.returncode == 1
    assert result.stdout.count("skipped, already exists") == 49
    assert (out / "3.npz").stat().st_mtime == 1


def test_ctrl_c_leaves_whole_files(tmp_path):
    recording = read_recording(REAL)
    for i in range(40):
        write_npz(tmp_path / f"{i}.npz", recording)
    process = processes.Popen(
        [sys.executable, "-m", "edgepose", "convert", ".", "--to", "csv", "--jobs", "2", "--out", "out"],
        cwd=tmp_path,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    process.stderr.readline()
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    output, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors
    assert process.returncode in (0, 130)
    written = list((tmp_path / "out").iterdir())
    assert written
    for path in written:
        same(recording, read_recording(path), 1e-6)
    assert 1 < len(output.splitlines()) <= len(written) + 1


def test_a_disk_that_fills_up(tmp_path):
    process = processes.run(
        [sys.executable, "-m", "edgepose", "convert", str(REAL), "--to", "csv", "--out", str(tmp_path)],
        text=True,
        capture_output=True,
        check=False,
        preexec_fn=limits.limit(resource.RLIMIT_FSIZE, 50_000),
    )
    assert process.returncode == 1
    assert (
        f"failed: cannot write recording to {tmp_path / 'six-sites-3s.csv'}: File too large" in process.stderr
    )
    assert list(tmp_path.iterdir()) == []


def test_a_fault_of_the_program_costs_one_file(tmp_path):
    """There is no writer of that ending, which only the command line checks."""
    result = convert(Job(REAL, tmp_path / "a.xyz"))
    assert result.problem == f"{REAL}: cannot be converted, please report it: KeyError('xyz')"


def test_outputs_touch_no_other_file(command, tmp_path):
    """Names of files on the way to their own are nobody's."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    for name in ("a.npz", "a.new.npz"):
        shutil.copy(REAL, folder / name)
    (out / "b.new.csv").write_text("precious")
    os.umask(umask := os.umask(0))
    result = command("convert", folder, REAL, "--to", "csv", "--out", out, "--jobs", 2)
    assert result.returncode == 0, result.stdout
    assert sorted(path.name for path in out.iterdir()) == [
        *("a.csv", "a.new.csv", "b.new.csv", "six-sites-3s.csv")
    ]
    assert (out / "b.new.csv").read_text() == "precious"
    same(read_recording(out / "a.csv"), read_recording(out / "a.new.csv"))
    assert (out / "a.csv").stat().st_mode & 0o777 == 0o666 & ~umask


def test_a_bar_on_a_terminal(tmp_path):
    words = ["convert", REAL, "--to", "npz", "--out", tmp_path]
    code, said = on_a_terminal([sys.executable, "-m", "edgepose", *words], stdout=subprocess.DEVNULL)
    assert code == 0
    assert b"Converting" in said
    assert b"1/1" in said


# --- the plan -----------------------------------------------------------------------------------------------


def test_patterns_folders_and_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a/x.csv", "a/b/y.BIN", "a/b/z.txt", "c.npz"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    out = Path("out")
    assert plan([Path("a"), Path("c.npz")], "csv", out) == [
        Job(Path("a/b/y.BIN"), out / "b" / "y.csv"),
        Job(Path("a/x.csv"), out / "x.csv"),
        Job(Path("c.npz"), out / "c.csv"),
    ]
    assert plan([Path("*.npz"), Path("a/**/*.BIN")], "npz", out) == [
        Job(Path("c.npz"), out / "c.npz"),
        Job(Path("a/b/y.BIN"), out / "y.npz"),
    ]
    for name in ("out/c.csv", "a/out/x.csv"):
        Path(name).parent.mkdir()
        Path(name).touch()
    Path("a/again").symlink_to(tmp_path)
    # What an earlier conversion wrote is no input.
    assert [str(job.target) for job in plan([Path()], "csv", out)] == [
        *("out/a/b/y.csv", "out/a/out/x.csv", "out/a/x.csv", "out/c.csv")
    ]
    assert plan([tmp_path / "*.npz", Path("c.npz").absolute()], "npz", out) == [
        Job(tmp_path / "c.npz", out / "c.npz")
    ]


def test_a_folder_leaves_no_recording_out(command, tmp_path):
    """Packed logs of a bus, and what lies beside an x-io session."""
    folder = tmp_path / "in"
    written = xio_session(folder / "mix", [f"{name} (UDP)" for name in PLACEMENTS])
    (folder / "mix" / "more").mkdir()
    for path in (folder / "mix" / "a.npz", folder / "mix" / "more" / "b.npz"):
        shutil.copy(REAL, path)
    with can.Logger(tmp_path / "bus.log") as log:
        for packet in packets():
            for number, data in native_can.encode(packet):
                log(can.Message(packet.t_us * 1e-6 + 1e9, number, False, data=data, channel="can0"))
    (folder / "bus.log.gz").write_bytes(gzip.compress((tmp_path / "bus.log").read_bytes()))
    (folder / "notes.txt.gz").write_bytes(gzip.compress(b"notes"))
    result = command("convert", folder, "--to", "csv", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stdout
    assert {name: row[0] for name, row in table(result).items()} == {
        "mix": "600", "a.npz": "1800", "b.npz": "1800", "bus.log.gz": "300"
    }  # fmt: skip
    assert len(list(iter_samples(read_recording(tmp_path / "out" / "mix.csv")))) == len(written)


def test_a_named_pipe_is_refused(command, tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    result = command("convert", tmp_path / "a.csv", "--to", "npz", "--out", tmp_path / "out")
    assert result.returncode == 1
    assert result.stderr.startswith(f"edgepose: {tmp_path / 'a.csv'}: not a regular file; give its content")


def test_names_that_are_no_text_and_a_pipe(command, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    names = [b"na\xefme.bin", "n\u00e4.bin".encode(), b"new\nline.bin"]
    for name in names:
        (folder / os.fsdecode(name)).write_bytes(b"".join(map(encode, packets())))
    os.mkfifo(folder / "pipe.csv")  # nobody writes to it
    for to in ("csv", "npz"):
        result = command("convert", folder, "--to", to, "--out", tmp_path / to)
        assert result.returncode == 0, result.stderr
        shown = [line.split("/")[-1] for line in result.stdout.splitlines()[1:]]
        assert [line[:12].rstrip() for line in sorted(shown)] == ["na?me.bin", "new?line.bin", "n\u00e4.bin"]
        written = sorted(os.fsencode(path.name) for path in (tmp_path / to).iterdir())
        assert written == sorted(name.replace(b"bin", to.encode()) for name in names)
        for path in (tmp_path / to).iterdir():
            assert read_recording(path).metadata["source"].encode()


def test_no_place_to_write_and_no_standard_input(command, tmp_path):
    (tmp_path / "a.csv").touch()
    result = command("convert", REAL, "--to", "csv", "--out", tmp_path / "a.csv" / "b")
    assert result.returncode == 1
    folder = re.escape(str(tmp_path / "a.csv" / "b"))
    assert re.search(rf"failed: cannot make the folder {folder}: .*; choose another folder\n", result.stderr)
    words = [sys.executable, "-m", "edgepose", "convert", "-", "--to", "csv", "--out", str(tmp_path / "o")]
    closed = ["sh", "-c", 'exec "$@" <&-', "sh", *words]
    result = processes.run(closed, text=True, capture_output=True, check=False)
    assert result.returncode == 1
    assert result.stderr == "edgepose: -: there is no standard input; name a file\n"


@pytest.mark.parametrize(
    ("inputs", "out", "says"),
    [
        (["nothing.csv"], "out", "nothing.csv: no such file or folder"),
        (["no*.csv"], "out", "no*.csv: no file matches this pattern"),
        (["empty"], "out", "empty: no recording in this folder; names end in .csv, .npz, .bin"),
        (["a.csv", "a.npz"], "out", "a.csv and a.npz would both become a; give them to separate commands"),
        (["a.csv"], ".", "a.csv would be written over an input; choose another --out"),
        (["a.npz", "b/../a.csv"], "b/..", "give them to separate commands"),
    ],
)
def test_impossible_plans(tmp_path, monkeypatch, inputs, out, says):
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "b"):
        Path(name).mkdir()
    for name in ("a.csv", "a.npz"):
        Path(name).touch()
    with pytest.raises(EdgeposeError) as info:
        plan([Path(name) for name in inputs], "csv", Path(out))
    assert says in str(info.value)


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("REAL --to fbx --out o", 2, "unknown format 'fbx'"),
        ("REAL --to npz,joints=53 --out o", 2, "possible are joints=24|52|55"),
        ("REAL --to npz,52 --out o", 2, "write options as npz,OPTION=VALUE"),
        ("--to csv --out o", 2, "IN"),
        ("REAL --to csv --out o --protocol nonsense", 2, "unknown protocol 'nonsense'"),
        ("REAL --to csv --out o --jobs 0", 2, "--jobs"),
        ("REAL --to csv --out o --sensors nowhere.toml", 1, "nowhere.toml: cannot read it"),
        ("nowhere.csv --to csv --out o", 1, "no such file or folder"),
        ("note.md --to csv --out o", 1, "unknown kind of file"),
        ("noise.bin --to csv --out o", 1, "no known packet in 5000 bytes"),
        ("REAL --to csv --out note.md", 2, "--out"),
    ],
)
def test_wrong_use(command, tmp_path, words, code, says):
    (tmp_path / "note.md").write_text("x")
    (tmp_path / "noise.bin").write_bytes(bytes(5000))
    result = command("convert", *words.replace("REAL", str(REAL)).split(), cwd=tmp_path)
    assert result.returncode == code
    assert says in result.stderr + result.stdout
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "o").exists()


def test_it_does_not_import_torch(tmp_path):
    words = ["convert", str(REAL), "--to", "csv", "--out", str(tmp_path)]
    code = (
        f"import sys; from edgepose.cli import cli; cli.main({words!r}, standalone_mode=False)\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


# --- the page about it --------------------------------------------------------------------------------------


def documented(command: str) -> list[list[str]]:
    lines = [line.strip() for line in DOCS.read_text().splitlines()]
    return [shlex.split(line)[2:] for line in lines if line.startswith(f"edgepose {command} ")]


@pytest.mark.parametrize("name", ["record", "convert"])
def test_documented_commands_are_understood(name):
    command = cli.get_command(click.Context(cli), name)
    assert len(documented(name)) >= 3
    for words in documented(name):
        command.make_context(name, list(words))


def test_documented_conversions_work(command, tmp_path):
    (tmp_path / "session").mkdir()
    for file in ("walk.npz", "session/1.npz"):
        shutil.copy(REAL, tmp_path / file)
    write_csv(tmp_path / "walk.part.csv", read_recording(REAL))
    (tmp_path / "session" / "2.bin").write_bytes(b"".join(map(encode, packets())))
    xio_session(tmp_path / "xio", list(PLACEMENTS))
    for words in documented("convert"):
        result = command("convert", *words, cwd=tmp_path)
        assert result.returncode == 0, (words, result.stdout, result.stderr)


def test_files_that_systems_leave_in_folders(tmp_path):
    folder = tmp_path / "take"
    (folder / ".Trash").mkdir(parents=True)
    for name in ("walk.csv", "._walk.csv", ".Trash/old.csv", "Thumbs.db"):
        (folder / name).write_bytes(b"\0\5\26\7")
    for source in (folder, folder / "*.*"):
        assert [job.source.name for job in plan([source], "npz", tmp_path / "out")] == ["walk.csv"]
