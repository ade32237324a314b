"""`edgepose record` as its users run it, live on ptys with native packets, and what it writes read back."""

from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import iter_samples, recording_from_samples
from edgepose.formats.recordings.raw_capture import read_capture, times_path
from edgepose.formats.recordings.registry import read_recording, salvage_recording
from edgepose.imu import ImuSample
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.record import CAN_LOGS, Output, open_output, record
from edgepose.sources import open_source
from firmware_protocols import native_can
from firmware_protocols.native import encode
from firmware_protocols.native_packet import Packet
from tests.support import limits
from tests.support.ports import Port, Sender
from tests.support.processes import end, start
from tests.support.terminals import on_a_terminal

REAL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"


class Rig(Sender):
    """Six devices that send their rows of a recording about 100 times a second; one packet in 21 is lost."""

    def __init__(self) -> None:
        (self.line,) = ports = (Port(),)
        super().__init__(*ports)
        self.port = self.line.name
        self.silent: set[int] = set()
        self._rows = list(iter_samples(read_recording(REAL)))

    def send(self, k: int) -> None:
        at = 6 * k % len(self._rows)
        packets = [
            Packet(row.sensor, k + k // 20, int(self.elapsed_s * 1e6), row.quat, row.acc, row.gyr)
            for row in self._rows[at : at + 6]
            if row.sensor not in self.silent
        ]
        self.line.write(b"".join(map(encode, packets)))


def until(process: subprocess.Popen[str], file: Path, size: int) -> None:
    """Wait until a file has grown to a size."""
    while not file.exists() or file.stat().st_size < size:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)


def good(recording) -> int:
    """Number of samples, after checks that every recording must pass."""
    rows = list(iter_samples(recording))
    assert {row.sensor for row in rows} == set(range(6))
    for data in recording.sensors.values():
        assert (np.diff(data.time_s) > 0).all()
        np.testing.assert_allclose(np.linalg.norm(data.quat, axis=1), 1.0)
        assert np.isfinite(data.acc).all()
        assert np.isfinite(data.gyr).all()
    return len(rows)


def everything(**options: object) -> list[ImuSample]:
    with open_source(**options) as source:
        return [sample for batch in source for sample in batch.samples]


def same(a, b, tolerance: float = 1e-6) -> None:
    """Two recordings hold the same; a is of double precision, b may be of single."""
    assert list(a.sensors) == list(b.sensors)
    for x, y in zip(a.sensors.values(), b.sensors.values(), strict=True):
        np.testing.assert_allclose(x.time_s, y.time_s, rtol=0, atol=tolerance)
        for p, q in zip(x[1:], y[1:], strict=True):
            assert (p is None) == (q is None)
            if p is not None:
                np.testing.assert_allclose(p, q, rtol=1e-6, atol=1e-6)


# --- live ---------------------------------------------------------------------------------------------------


def test_seconds_progress_and_counts(tmp_path):
    file = tmp_path / "walk.csv"
    with Rig() as rig:
        words = [file, "--port", rig.port, "--protocol", "native", "--seconds", 1.5]
        code, text = on_a_terminal([sys.executable, "-m", "edgepose", "record", *words])
    assert code == 0, text
    said = text.decode()
    recording = read_recording(file)
    count = good(recording)
    assert recording.metadata["source"] == rig.port
    assert recording.metadata["program"].startswith("edgepose ")
    span = max(d.time_s[-1] for d in recording.sensors.values()) - recording.sensors["head"].time_s[0]
    assert span > 1.3
    assert re.search(r"\r\d s, \d+ \d+ \d+ \d+ \d+ \d+, \d+ a second, \d+ lost", said)
    assert f"samples  {count} in " in said
    assert re.search(r"sensors  \d+ left_forearm, .*\d+\s+pelvis", said, re.DOTALL)
    lost = re.search(rf"packets  {count} good, (\d+) lost, ", said)
    assert int(lost[1]) > 0
    assert int(lost[1]) % 6 == 0


@pytest.mark.parametrize(
    ("name", "number"),
    [("walk.csv", signal.SIGTERM), ("walk.npz", signal.SIGINT), ("walk.bin", signal.SIGINT)],
)
def test_a_stop_leaves_a_whole_file(tmp_path, name, number):
    file = tmp_path / name
    growing = tmp_path / "walk.part.csv" if name == "walk.npz" else file
    with Rig() as rig:
        process = start("record", file, "--port", rig.port, "--protocol", "native")
        until(process, growing, 3000)
        process.send_signal(number)
        code, errors = end(process)
    assert code == 0, errors
    rows = everything(file=file)
    assert good(recording_from_samples(rows)) == len(rows)
    assert f"samples  {len(rows)} in " in errors
    assert {path.name for path in tmp_path.iterdir()} == {name} | (
        {f"{name}.times"} if "bin" in name else set()
    )


def test_standard_output(tmp_path):
    with Rig() as rig:
        process = start("record", "-", "--port", rig.port, "--seconds", 0.5, stdout=subprocess.PIPE)
        text, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    (tmp_path / "walk.csv").write_text(text)
    assert good(read_recording(tmp_path / "walk.csv")) > 100


def test_a_sensor_that_is_silent_is_told(tmp_path):
    with Rig() as rig:
        rig.silent = {4}
        process = start("record", tmp_path / "walk.npz", "--port", rig.port, "--seconds", 0.5)
        code, errors = end(process)
    assert code == 0
    assert (
        "warning: nothing arrived from head; check power, link and id, or calibrate with --without head"
        in errors
    )
    assert "head" not in salvage_recording(tmp_path / "walk.npz").sensors


def test_a_recording_of_a_file(command, tmp_path):
    result = command("record", tmp_path / "walk.csv", "--file", REAL, "--seconds", 2)
    assert result.returncode == 0, result.stderr
    recording = read_recording(tmp_path / "walk.csv")
    assert good(recording) == pytest.approx(1200, abs=12)
    result = command("record", tmp_path / "walk.npz", "--file", tmp_path / "walk.csv")
    assert result.returncode == 0, result.stderr
    same(recording, read_recording(tmp_path / "walk.npz"))


def test_it_does_not_import_torch(tmp_path):
    code = (
        "import sys; from edgepose.cli import cli\n"
        f"cli.main(['record', {str(tmp_path / 'a.npz')!r}, '--file', {str(REAL)!r}], standalone_mode=False)\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


# --- equality -----------------------------------------------------------------------------------------------


def two_outputs(first: Output, second: Output) -> Output:
    """Samples to the first, what comes on the line to the second."""
    return Output(
        first.files + second.files,
        first.samples,
        second.raw,
        lambda: (first.finish(), second.finish()),
    )


def test_a_recording_made_from_a_file_keeps_what_the_file_says_of_itself(command, tmp_path):
    """Its start is the recording's own, not that of the copy; without one none is made up."""
    about = {"started": "2024-05-06T07:08:09+00:00", "source": "/dev/ttyUSB7", "wearer": "anna"}
    with Rig() as rig, open_source(port=rig.port) as source:
        record(source, open_output(str(tmp_path / "walk.bin"), about), 0.5)
    copies = {
        "0.csv": ("record", tmp_path / "0.csv", "--file", tmp_path / "walk.bin"),
        "1.npz": ("record", tmp_path / "1.npz", "--file", tmp_path / "0.csv"),
        "walk.csv": ("convert", tmp_path / "walk.bin", "--to", "csv", "--out", tmp_path),
    }
    for name, words in copies.items():
        assert command(*words).returncode == 0
        assert about.items() <= read_recording(tmp_path / name).metadata.items(), words
    times_path(tmp_path / "walk.bin").unlink()
    assert command("record", tmp_path / "2.csv", "--file", tmp_path / "walk.bin").returncode == 0
    found = read_recording(tmp_path / "2.csv").metadata
    assert "started" not in found
    assert found["source"] == str(tmp_path / "walk.bin")


@pytest.mark.parametrize(("protocol", "seconds"), [("auto", 1.5), ("native", 0.7)])
def test_a_capture_decoded_again_equals_the_samples(tmp_path, protocol, seconds):
    live: list[ImuSample] = []
    with Rig() as rig, open_source(port=rig.port, protocol=protocol) as source:
        output = two_outputs(
            open_output(str(tmp_path / "walk.csv"), {}), open_output(str(tmp_path / "walk.bin"), {"a": "b"})
        )
        keep = output.samples
        output = output._replace(samples=lambda batch: (live.extend(batch), keep(batch)))
        summary = record(source, output, seconds)
    assert summary.error is None
    written = read_recording(tmp_path / "walk.csv")
    again = everything(file=tmp_path / "walk.bin", protocol=protocol)
    assert good(written) == sum(summary.samples) == len(live)
    # What a stream holds back at the end comes out of a file only.
    same(recording_from_samples(again[: len(live)]), recording_from_samples(live), 0.0)
    same(recording_from_samples(live), written)
    # Frames are those of the live samples, too.
    frames = []
    for rows in (live, iter_samples(written), again[: len(live)]):
        clock = FrameSynchronizer()
        clock.push(rows, 0.0)
        frames.append(clock.flush())
    assert len(frames[0]) == len(frames[1]) == len(frames[2]) > 20
    for a, b, c in zip(*frames, strict=True):
        assert a.time_s == pytest.approx(b.time_s, abs=2e-6)
        np.testing.assert_allclose(a.orientation, b.orientation, atol=1e-4)
        np.testing.assert_allclose(a.force, b.force, atol=1e-2)
        np.testing.assert_array_equal(a.orientation, c.orientation)


def test_times_of_a_capture(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(b"abcdefgh")
    assert list(read_capture(file)) == [(None, b"abcdefgh")]
    times = times_path(file)
    assert times.name == "a.bin.times"
    times.write_text("# a: b\ntime_s,end\n1.5,2\n2.0,2\n2.5,6\n")
    assert list(read_capture(file)) == [(1.5, b"ab"), (2.5, b"cdef"), (2.5, b"gh")]
    times.write_text("time_s,end\n1.5,2\n2.5,60\n3.5,70\n4.0")  # bytes that never came to the disk
    assert list(read_capture(file)) == [(1.5, b"ab"), (2.5, b"cdefgh")]
    for bad in ("1.5,2\n1.0,3\n", "1.5,2\n1.6,1\n", "x,2\n", "1.5\n", "nan,1\n", "1.5,2,3\n"):
        times.write_text(bad)
        with pytest.raises(EdgeposeError, match=r"a\.bin\.times: row \d is damaged"):
            list(read_capture(file))


@pytest.mark.parametrize("ending", CAN_LOGS)
@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_can_logs(tmp_path, ending, fd):
    channel = f"{ending}-{fd}".strip(".")
    packets = [
        Packet(row.sensor, i // 6, int(row.time_s * 1e6), row.quat, row.acc, row.gyr)
        for i, row in enumerate(list(iter_samples(read_recording(REAL)))[:300])
    ]
    live: list[ImuSample] = []
    file = tmp_path / f"walk{ending}"
    with (
        can.Bus(channel, "virtual") as bus,
        open_source(can=f"virtual:{channel}", protocol="native-can", fd=fd) as source,
    ):
        output = open_output(str(file), {})
        output = output._replace(samples=live.extend)

        def send() -> None:
            time.sleep(0.2)  # what waits when a bus is opened is thrown away
            for packet in packets:
                frames = native_can.encode_fd(packet) if fd else native_can.encode(packet)
                for number, data in [frames] if isinstance(frames, tuple) else frames:
                    bus.send(
                        can.Message(arbitration_id=number, data=data, is_fd=fd, is_extended_id=number > 0x7FF)
                    )

        sender = threading.Thread(target=send)
        sender.start()
        summary = record(source, output, stopped=lambda: len(live) == len(packets))
        sender.join()
    assert summary.error is None
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    again = everything(file=file, protocol="native-can")
    assert len(again) == len(live)
    assert [s[2:] for s in again] == [s[2:] for s in live]
    shift = again[0].time_s - live[0].time_s if ending == ".asc" else 0.0  # .asc has times since its start
    np.testing.assert_allclose([s.time_s - shift for s in again], [s.time_s for s in live], atol=2e-3)


# --- power cuts and other ends ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["walk.csv", "walk.npz", "walk.bin"])
def test_kill_in_the_middle(command, tmp_path, name):
    file = tmp_path / name
    growing = tmp_path / "walk.part.csv" if name == "walk.npz" else file
    with Rig() as rig:
        process = start("record", file, "--port", rig.port, "--protocol", "native")
        until(process, growing, 3000)
        seen = growing.stat().st_size
        process.kill()
        process.communicate(timeout=120)
        assert growing.stat().st_size >= seen
        if name == "walk.npz":
            assert not file.exists()
            result = command("record", file, "--port", rig.port)
            assert result.returncode == 1
            assert (
                f"edgepose: {growing} is left from a recording that was cut short; convert it with"
                in result.stderr
            )
            recover = re.search(r"edgepose (convert \S+ --to npz --out )DIR", result.stderr)[1].split()
            result = command(*recover, tmp_path / "saved")
            assert result.returncode == 0, result.stderr
            assert good(read_recording(tmp_path / "saved" / "walk.part.npz")) > 20
            result = command("record", file, "--port", rig.port, "--overwrite", "--seconds", 0.3)
            assert result.returncode == 0, result.stderr
            assert not growing.exists()
            assert good(read_recording(file)) > 20
            return
    rows = everything(file=file)
    assert good(recording_from_samples(rows)) == len(rows) > 20


def test_a_port_that_is_unplugged(tmp_path):
    file = tmp_path / "walk.csv"
    with Rig() as rig:
        process = start("record", file, "--port", rig.port, "--protocol", "native")
        until(process, file, 3000)
        rig.unplug()
        size = file.stat().st_size
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)  # it waits for the port to come back
        code, errors = end(process)
    assert f"samples  {good(read_recording(file))} in " in errors
    assert file.stat().st_size >= size
    assert code == 0


@pytest.mark.parametrize("name", ["walk.csv", "walk.npz"])
def test_a_disk_that_fills_up(tmp_path, name):
    file = tmp_path / name
    limit = 50_000
    process = start(
        *("record", file, "--file", REAL),
        preexec_fn=limits.limit(resource.RLIMIT_FSIZE, limit),
    )
    code, errors = end(process)
    assert code == 1
    assert "edgepose: cannot write samples to " in errors.splitlines()[-1]
    assert "samples  " in errors
    assert 100 < good(read_recording(file)) < 1800
    assert salvage_recording(file).damage is None
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_disk_that_is_full(command, tmp_path):
    (tmp_path / "walk.csv").symlink_to("/dev/full")
    result = command("record", tmp_path / "walk.csv", "--file", REAL)
    assert result.returncode == 1
    assert result.stderr == (
        f"edgepose: cannot write samples to {tmp_path / 'walk.csv'}: the disk is full; "
        "rows written before are complete\n"
    )


def test_no_room_for_the_whole_file_leaves_its_journal(tmp_path):
    with open_source(file=REAL) as source:
        output = open_output(str(tmp_path / "walk.npz"), {})
        # No file can be put where a folder is.
        (tmp_path / "walk.npz").mkdir()
        summary = record(source, output)
    assert f"the complete recording is in {tmp_path / 'walk.part.csv'}" in str(summary.error)
    assert good(read_recording(tmp_path / "walk.part.csv")) == 1800
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk.npz", "walk.part.csv"]


def test_nothing_came(tmp_path, monkeypatch):
    monkeypatch.setattr("edgepose.sources.line_checks.SILENCE_S", 0.2)
    for name in ("walk.csv", "walk.npz", "walk.bin"):
        with Rig() as rig:
            rig.silent = set(range(6))
            with open_source(port=rig.port) as source:
                summary = record(source, open_output(str(tmp_path / name), {}))
        assert "no data for" in str(summary.error)
    assert list(tmp_path.iterdir()) == []


# --- wrong use ----------------------------------------------------------------------------------------------


def test_nothing_is_overwritten_unasked(command, tmp_path):
    for name in ("walk.csv", "walk.npz", "walk.bin", "walk.blf"):
        file = tmp_path / name
        file.write_text("precious")
        line = ("--can", "virtual:x") if name == "walk.blf" else ("--port", "/dev/ttyNOWHERE7")
        result = command("record", file, *line)
        assert result.returncode == 1
        assert f"edgepose: {file} already exists; choose another name or give --overwrite" in result.stderr
        assert file.read_text() == "precious"
    result = command("record", tmp_path / "walk.csv", "--port", "/dev/ttyNOWHERE7", "--overwrite")
    assert "no such port" in result.stderr
    assert (tmp_path / "walk.csv").read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ("walk.csv", 2, "give one source"),
        ("walk.txt --file REAL", 1, "unknown kind of recording; names end in .csv or .npz"),
        ("walk.bin --file REAL", 2, "stores the bytes of one line"),
        ("walk.bin --port a,b", 2, "stores the bytes of one line"),
        ("walk.blf --port a", 2, "stores the frames of a CAN bus"),
        ("walk.csv --file REAL --seconds 0", 2, "--seconds"),
        ("nowhere/walk.csv --file REAL", 1, "its folder does not exist, create it first"),
        ("walk.csv --port /dev/ttyNOWHERE7", 1, "no such port"),
    ],
)
def test_wrong_use(command, tmp_path, words, code, says):
    result = command("record", *words.replace("REAL", str(REAL)).split(), cwd=tmp_path)
    assert result.returncode == code
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []
