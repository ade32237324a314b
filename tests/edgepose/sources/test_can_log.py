"""Logs of CAN buses as other programs, other settings and accidents leave them."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path

import can
import numpy as np
import pytest

from edgepose.errors import EdgeposeError
from edgepose.formats.ledger import Ledger
from edgepose.sources import open_source
from edgepose.sources.can_log import read_log, write_log
from edgepose.sources.replay import CAN_LOGS
from firmware_protocols import native_can
from firmware_protocols.sample import Sample

FRAMES, SENSORS = 300, 6
START_S = 1_700_000_000.0


def messages() -> list[can.Message]:
    """Frames of six devices, 100 samples a second each."""
    protocol = native_can.PROTOCOL
    encode = protocol.encoder()
    result = []
    for k in range(FRAMES):
        for i, sensor in enumerate(protocol.ids):
            sample = Sample(sensor, 10_000 * k, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            for j, (can_id, data, extended, _) in enumerate(encode(sample, k)):
                time_s = START_S + 0.01 * k + 0.001 * i + 0.0001 * j
                result.append(can.Message(time_s, can_id, extended, data=data, channel="can0"))
    return result


def lines_of(sent: list[can.Message]) -> list[str]:
    """As candump -l writes them."""
    return [f"({m.timestamp:.6f}) can0 {m.arbitration_id:03X}#{m.data.hex().upper()}\n" for m in sent]


def shown(sent: list[can.Message]) -> list[str]:
    """As candump -ta shows them."""
    return [
        f" ({m.timestamp:.6f})  can0  {m.arbitration_id:03X}   [{m.dlc}]  {m.data.hex(' ').upper()}\n"
        for m in sent
    ]


def deltas(lines: list[str]) -> list[str]:
    """As candump -td writes or shows the times: since the line before."""
    times = [float(line[line.index("(") + 1 : line.index(")")]) for line in lines]
    steps = np.diff(times, prepend=times[0])
    return [f" ({step:010.6f}){line[line.index(')') + 1 :]}" for step, line in zip(steps, lines, strict=True)]


def dates(lines: list[str]) -> list[str]:
    """As candump -tA shows the times."""
    result = []
    for line in lines:
        stamp = line[line.index("(") + 1 : line.index(")")]
        date = datetime.fromtimestamp(float(stamp), timezone.utc)
        result.append(line.replace(stamp, f"{date:%Y-%m-%d %H:%M:%S.%f}"))
    return result


def from_zero(lines: list[str]) -> list[str]:
    """As candump -tz shows the times; lines of a second bus come a little late."""
    result = []
    for i, line in enumerate(lines):
        stamp = float(line[line.index("(") + 1 : line.index(")")]) - START_S
        result.append(f" ({stamp:010.6f}){line[line.index(')') + 1 :]}")
        if i % 3 == 0:
            result.append(f" ({max(0.0, stamp - 5e-5):010.6f})  can1  123   [1]  00\n")
    return result


def with_direction(lines: list[str]) -> list[str]:
    """As candump -x shows them."""
    return [line.replace("can0", "can0  RX - -") for line in lines]


def asc(sent: list[can.Message], relative: bool) -> list[str]:
    """As Vector's tools write them, with the events that they add."""
    form = "relative" if relative else "absolute"
    head = [
        "date Tue Nov 14 10:13:20.000 pm 2023\n",
        f"base hex  timestamps {form}\n",
        "internal events logged\n",
    ]
    lines = ["Begin Triggerblock Tue Nov 14 10:13:20.000 pm 2023\n", "   0.000000 Start of measurement\n"]
    last = 0.0
    for i, m in enumerate(sent):
        now = m.timestamp - START_S
        if i % 40 == 20:  # an event between two frames has a time, too
            time_s = now - 1e-4 - last if relative else now - 1e-4
            lines.append(f"{time_s:11.6f} 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n")
            last = now - 1e-4
        time_s = now - last if relative else now
        lines.append(
            f"{time_s:11.6f} 1  {m.arbitration_id:X}             Rx   d {m.dlc} {m.data.hex(' ').upper()}\n"
        )
        last = now
    return [*head, *lines, "End TriggerBlock\n"]


def read(path: Path) -> tuple[dict[int, list[float]], str | None]:
    """Times of the samples by placement, and what is wrong with the file."""
    times: dict[int, list[float]] = {}
    with open_source(file=path, protocol="native-can") as source:
        for batch in source:
            for sample in batch.samples:
                times.setdefault(sample.sensor, []).append(sample.time_s)
        return times, source.damage


def check_whole(times: dict[int, list[float]], missing: int = 0) -> None:
    assert sorted(times) == list(range(SENSORS))
    for each in times.values():
        assert FRAMES - missing <= len(each) <= FRAMES
        steps = np.diff(each)
        assert np.median(steps) == pytest.approx(0.01, abs=2e-4)
        assert each[-1] - each[0] == pytest.approx(0.01 * (FRAMES - 1), abs=0.03)


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("a.log", lines_of),
        ("a.log.gz", lines_of),
        ("a.log", shown),
        ("a.log", lambda sent: deltas(lines_of(sent))),
        ("a.log.gz", lambda sent: deltas(shown(sent))),
        ("a.log", lambda sent: dates(shown(sent))),
        ("a.log", lambda sent: from_zero(shown(sent))),
        ("a.log", lambda sent: with_direction(shown(sent))),
        ("a.log", lambda sent: with_direction(dates(shown(sent)))),
        ("a.asc", lambda sent: asc(sent, False)),
        ("a.asc", lambda sent: asc(sent, True)),
        ("a.asc.gz", lambda sent: asc(sent, True)),
    ],
)
def test_every_form_of_a_log(tmp_path, name, form: Callable[[list[can.Message]], list[str]]):
    text = "".join(form(messages()))
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    times, damage = read(path)
    assert damage is None
    check_whole(times)


@pytest.mark.parametrize("back_s", [1.5, 7200.0])
@pytest.mark.parametrize("form", [lines_of, lambda sent: asc(sent, False)])
def test_a_clock_that_is_set_back(tmp_path, back_s, form):
    sent = messages()
    for message in sent[len(sent) // 2 :]:
        message.timestamp -= back_s if form is lines_of else 1.2
    path = tmp_path / ("a.log" if form is lines_of else "a.asc")
    path.write_text("".join(form(sent)))
    times, damage = read(path)
    shown_s = f"{back_s if form is lines_of else 1.2:.1f}"
    assert damage.startswith(f"{path}: its clock was set back by {shown_s} s on the way; the times after")
    check_whole(times)


BAD = {
    "half a line": "(1700000001.5000) can0 4\n",
    "zeros": "\0" * 10_000 + "\n",
    "two pieces": "\0" * 8191 + "\n",
    "no number": "(17000000xx.500000) can0 400#00\n",
    "not UTF-8": "(\ufffd) \ufffd\n",
    "empty data": "(1700000001.5) can0\n",
    "no date": " (2023-14-01 22:13:21.500000)  can0  400   [1]  00\n",
    "an odd digit": "(1700000001.5) can0 400#0\n",
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_line_costs_only_itself(tmp_path, name):
    lines = lines_of(messages())
    lines.insert(1000, BAD[name])
    path = tmp_path / "a.log"
    path.write_text("".join(lines))
    times, damage = read(path)
    check_whole(times)
    if name != "an odd digit":  # which is a frame of no sensor
        assert damage == f"{path}: 1 bad lines left out, the first: line 1001 is not a frame"


@pytest.mark.parametrize("length", range(1, 45))
def test_a_line_that_another_logger_continues(tmp_path, length):
    """The first frame of the second logger is whole; half a frame is none, even if it looks like one."""
    lines = lines_of(messages())
    lines[1001] = lines[1001][:length]
    path = tmp_path / "a.log"
    path.write_text("".join(lines))
    times, damage = read(path)
    check_whole(times, missing=1)
    assert sum(map(len, times.values())) == SENSORS * FRAMES - 1
    assert damage.startswith(f"{path}: 1 bad lines left out, the first: line 1002 is not a frame")


def test_a_packed_log_far_larger_than_its_file(tmp_path):
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress(bytes(1 << 20)) * 257)
    with pytest.raises(EdgeposeError, match=r"a\.log\.gz: unpacks to 256 MB; the limits are"):
        read(path)


@pytest.mark.parametrize(
    "bad", ["   1.555000 1  4x0             Rx   d 8 00\n", "   1.555000 1  400  Rx   d 8 00 zz\n"]
)
def test_a_bad_line_of_an_asc_log(tmp_path, bad):
    lines = asc(messages(), False)
    lines.insert(1000, bad)
    path = tmp_path / "a.asc"
    path.write_text("".join(lines))
    times, damage = read(path)
    check_whole(times)
    assert damage.startswith(f"{path}: 1 bad lines left out, the first: line 1001 is not a")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n", "logs of BUSMASTER cannot be read: save it as"),
        ("  can0  400   [8]  E2 03 20 00 5F 00 00 00\n", "without times: log with candump -l"),
        ("what\nis\nthis\n", "not a log of frames .*3 bad lines left out, the first: line 1 is not a frame"),
    ],
)
def test_what_is_not_a_log(tmp_path, text, says):
    path = tmp_path / "a.log"
    path.write_text(text)
    with pytest.raises(EdgeposeError, match=says):
        read(path)


def test_zeros_at_the_end_of_a_log(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(lines_of(messages())) + "\0" * 8192)
    times, damage = read(path)
    check_whole(times)
    assert damage == f"{path}: 1 bad lines left out, the first: line 5401 is not a frame"


def test_markers_with_the_ending_of_a_trace(tmp_path):
    path = tmp_path / "walk.trc"
    path.write_text("PathFileType\t4\t(X/Y/Z)\twalk.trc\nDataRate\tCameraRate\n100\t100\n")
    with pytest.raises(EdgeposeError, match=r"walk\.trc: it holds the positions of markers"):
        read(path)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("walk.csv.gz", "packed with gzip; unpack it first"),
        ("walk.mat", "a file of MATLAB; write its samples as .csv or .npz"),
        ("walk.MTB", "export it as text, one file a sensor, and give the folder"),
    ],
)
def test_files_of_other_programs(tmp_path, name, says):
    path = tmp_path / name
    path.write_bytes(gzip.compress(b"time_s,sensor\n"))
    with pytest.raises(EdgeposeError, match=says):
        open_source(file=path)


@pytest.mark.parametrize("ending", [ending for ending in CAN_LOGS if ending != ".mf4"])
def test_logs_are_written_whole(tmp_path, ending):
    """python-can's writer of .db has a thread, and drops what that has not written when it is closed."""
    path, sent = tmp_path / f"walk{ending}", messages()
    write_log(path, sent)
    written = [message for _, _, found in read_log(path, Ledger(str(path), "line")) for message in found]
    assert [(m.arbitration_id, bytes(m.data)) for m in written] == [
        (m.arbitration_id, bytes(m.data)) for m in sent
    ]
