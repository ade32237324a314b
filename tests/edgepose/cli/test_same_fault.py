"""One fault of a sensor has one message, in every command, live and from a file."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from edgepose.formats.recordings.base import iter_samples
from edgepose.formats.recordings.csv import write_csv
from edgepose.formats.recordings.raw_capture import times_header, times_path, times_row
from edgepose.formats.recordings.registry import read_recording
from edgepose.rotations import quat_multiply
from firmware_protocols.registry import PROTOCOLS
from firmware_protocols.sample import Sample
from tests.support.ports import Port, Sender
from tests.support.processes import start

STILL = Path(__file__).parents[2] / "data" / "imu" / "six-sites-3s.npz"
HEAD = 4
PACKET_US = 10_000

Tick = list[Sample]


def ticks() -> list[Tick]:
    """Samples of six sensors on a wearer who stands, a tick after another."""
    samples = list(iter_samples(read_recording(STILL)))
    each = [[s for s in samples if s.sensor == sensor] for sensor in range(6)]
    return [
        [Sample(s.sensor, None, *(tuple(map(float, v)) for v in (s.quat, s.acc, s.gyr))) for s in row]
        for row in zip(*each, strict=True)
    ]


def of_all(change: Callable[[Sample], Sample]) -> Callable[[Tick, int], Tick]:
    return lambda tick, k: [change(sample) for sample in tick]


def of_head(change: Callable[[Sample, int], Sample]) -> Callable[[Tick, int], Tick]:
    return lambda tick, k: [change(s, k) if s.sensor == HEAD else s for s in tick]


def second_head(tick: Tick, k: int) -> Tick:
    turned = tuple(map(float, quat_multiply((0.6, 0.0, 0.0, 0.8), tick[HEAD].quat)))
    return [*tick, tick[HEAD]._replace(quat=turned)]


def as_xyzw(sample: Sample) -> Sample:
    w, x, y, z = sample.quat
    return sample._replace(quat=(x, y, z, w))


class Fault(NamedTuple):
    """What devices do wrong, what every command says, and how calibrate and check end.

    Attributes:
        change: changes the samples of the tick k; times are set before.
        says: pattern that is in what a command writes.
        codes: exit codes of check, calibrate and run; None if any will do.
        protocol: that the devices speak.
    """

    change: Callable[[Tick, int], Tick]
    says: str
    codes: tuple[int | None, int, int] = (3, 1, 0)
    protocol: str = "native"


FAULTS = {
    "two devices with one id": Fault(
        second_head, r"head: two devices, 10[67] deg apart, send under its id: give each an id of its own"
    ),
    "quaternions x, y, z, w": Fault(
        of_all(as_xyzw),
        # check says it once for all sensors, with the range.
        r"(left_forearm|all six sensors): orientation and gravity disagree by (\d+ to )?17\d deg at rest: "
        r"looks like x, y, z, w: the quaternion must be w, x, y, z",
    ),
    "data in g": Fault(
        of_head(lambda s, k: s._replace(acc=tuple(a / 9.81 for a in s.acc))),
        r"head: it reads [01](\.\d+)? at rest, which is in g: send m/s², 9.81 at rest",
        codes=(3, 0, 0),
    ),
    "no gravity": Fault(
        of_head(lambda s, k: s._replace(acc=(0.01 * (k % 3), 0.0, 0.0))),
        r"head: it reads 0.01 m/s² at rest, so gravity is already removed: "
        r"send the acceleration as measured \(specific force\)",
    ),
    "a restarted device": Fault(
        of_head(lambda s, k: s._replace(time_us=s.time_us % 1_000_000)),
        r"head: its clock restarted( \d+ times)?; its heading may differ after that",
        codes=(3, 0, 0),
    ),
    "no common north": Fault(
        of_all(lambda s: s),
        r"sensors of haritorax have no common heading: "
        r"calibrate with --heading-reset steps, motion, live or mounting",
        codes=(None, 1, 0),  # the times of packets without a time depend on this machine
        protocol="haritorax",
    ),
}


class Wire:
    """Packets of all ticks of a fault."""

    def __init__(self, fault: Fault) -> None:
        self._fault, self._ticks = fault, ticks()
        self._encode: Any = PROTOCOLS[fault.protocol].encoder()
        self._counts = [0] * 6

    def packets(self, k: int, time_us: int) -> bytes:
        """Packets of the tick k, measured at a time on the devices' clock."""
        tick = [s._replace(time_us=time_us) for s in self._ticks[k % len(self._ticks)]]
        data = b""
        for sample in self._fault.change(tick, k):
            data += self._encode(sample, self._counts[sample.sensor])
            self._counts[sample.sensor] += 1
        return data


class Rigs(Sender):
    """Three rigs with one fault, each on a line of its own."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(Port(), Port(), Port())
        self._wire = Wire(fault)

    def send(self, k: int) -> None:
        data = self._wire.packets(k, round(1e6 * self.elapsed_s))
        for port in self.ports:
            port.write(data)


@pytest.fixture(params=FAULTS)
def fault(request: pytest.FixtureRequest) -> Fault:
    return FAULTS[request.param]


@pytest.fixture(scope="module")
def calibration(command: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Calibration of the wearer without any fault."""
    path = tmp_path_factory.mktemp("calibration") / "calib.json"
    result = command("calibrate", "--file", STILL, "--hold", 1, "--out", path)
    assert result.returncode == 0, result.stderr
    return path


def commands(sources: list[list[object]], calibration: Path, out: Path, live: bool) -> list[list[object]]:
    """Check, calibrate and run with their sources."""
    check, calibrate, run = sources
    if live:
        check, calibrate = [*check, "--seconds", 3.5], [*calibrate, "--countdown", 2]
    return [
        ["check", *check],
        ["calibrate", *calibrate, "--hold", 1, "--out", out / "c.json"],
        ["run", *run, "--calibration", calibration, "--model", "rnn", "--csv", out / "poses.csv"],
    ]


def judge(fault: Fault, lines: list[list[object]], live: bool) -> None:
    processes = [start(*line, stdout=-1, stdin=-3) for line in lines]
    outputs = [""] * len(processes)
    seen = [threading.Event() for _ in processes]

    def read(i: int, stream: Any) -> None:
        for text in stream:
            outputs[i] += text
            if re.search(fault.says, outputs[i]):
                seen[i].set()
        seen[i].set()

    readers = [
        threading.Thread(target=read, args=(i, stream))
        for i, process in enumerate(processes)
        for stream in (process.stdout, process.stderr)
    ]
    for reader in readers:
        reader.start()
    try:
        if live:
            seen[2].wait(60)
            processes[2].send_signal(signal.SIGINT)
        codes = tuple(process.wait(120) for process in processes)
    finally:
        for process in processes:
            process.kill()
        for reader in readers:
            reader.join()
        for process in processes:
            process.stdout.close()
            process.stderr.close()
    for output in outputs:
        assert re.search(fault.says, output), output
        assert "Traceback" not in output
    for code, wanted, output in zip(codes, fault.codes, outputs, strict=True):
        assert wanted is None or code == wanted, output


def test_from_a_file(fault: Fault, calibration: Path, tmp_path: Path) -> None:
    wire, file = Wire(fault), tmp_path / "rig.bin"
    pieces = [wire.packets(k, PACKET_US * k) for k in range(300)]
    file.write_bytes(b"".join(pieces))
    if fault.protocol != "native":  # its packets have no time
        ends = accumulate(map(len, pieces))
        rows = [times_row(1_700_000_000 + k / 100, end) for k, end in enumerate(ends)]
        times_path(file).write_text(times_header({}) + "".join(rows))
    source = ["--file", file, "--protocol", fault.protocol]
    judge(fault, commands([source] * 3, calibration, tmp_path, live=False), live=False)


def test_live(fault: Fault, calibration: Path, tmp_path: Path) -> None:
    with Rigs(fault) as rigs:
        sources = [["--port", port.name, "--protocol", fault.protocol] for port in rigs.ports]
        judge(fault, commands(sources, calibration, tmp_path, live=True), live=True)


def test_rows_that_are_no_measurements(
    command: Callable[..., Any], calibration: Path, tmp_path: Path
) -> None:
    """The same words and the same exit code in all commands."""
    file = tmp_path / "nan.csv"
    write_csv(file, read_recording(STILL))
    lines = file.read_text().splitlines(keepends=True)
    spoilt = next(i for i, line in enumerate(lines) if i > 1000 and ",head," in line)
    cells = lines[spoilt].split(",")
    lines[spoilt] = ",".join([*cells[:2], "nan", *cells[3:]])
    file.write_text("".join(lines))
    says = f"nan.csv: 1 bad rows left out, the first: row {spoilt + 1} (head) has a number that is NaN"
    words = commands([["--file", file]] * 3, calibration, tmp_path, live=False)
    for line in words:
        result = command(*line)
        assert says in result.stdout + result.stderr
        assert result.returncode == 1, result.stderr
