"""Plays an IMU recording as six devices on a serial port (a pty), in real time, as native packets.

\b
    python tools/simulate.py recording.npz           # plays at once, then stands at the last sample
    python tools/simulate.py recording.npz --stand   # stands at the first sample until a line comes on stdin

Prints `port NAME`, `started UNIX_TIME` and `ended UNIX_TIME`. Ends when standard input closes, though not
in the middle of the recording, or at Ctrl-C.
"""

from __future__ import annotations

import os
import select
import sys
import time
import tty
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.recording import Recording, read_recording
from firmware_protocols.native import Packet, encode

TICK_S = 0.001
"""Longest sleep between two looks at the clock, seconds."""


def packet_maker(recording: Recording, sensor: int) -> Callable[[int, int, int], bytes]:
    """A function of (row, sequence number, device time in us) that gives a sensor's packet on the wire."""
    data = recording.sensors[PLACEMENTS[sensor]]
    if data.quat is None or data.acc is None:
        raise EdgeposeError(f"{PLACEMENTS[sensor]}: the recording lacks orientation or acceleration")
    columns = [
        [None] * len(data.time_s) if rows is None else [v if v[0] == v[0] else None for v in rows.tolist()]
        for rows in (data.quat, data.acc, data.gyr)
    ]

    def make(row: int, seq: int, t_us: int) -> bytes:
        quat, acc, gyr = (column[row] for column in columns)
        return encode(Packet(sensor, seq & 0xFFFF, t_us & 0xFFFFFFFF, quat, acc, gyr))

    return make


def common_times(recording: Recording) -> NDArray[np.float64]:
    """Times that all six sensors share."""
    times = recording.sensors[PLACEMENTS[0]].time_s
    for name, data in recording.sensors.items():
        if not np.array_equal(data.time_s, times):
            raise EdgeposeError(
                f"{name}: its times differ from those of {PLACEMENTS[0]}; the simulator plays sensors that "
                "sample at the same instants"
            )
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise EdgeposeError("the recording needs two instants or more, each later than the one before")
    return times


def line_came() -> bool | None:
    """True if standard input has a line, None at its end, False if there is nothing yet."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return False
    return True if sys.stdin.readline() else None


def play(recording: Recording, stand: bool) -> None:
    """Sends samples until standard input closes."""
    times = common_times(recording)
    makers = [packet_maker(recording, sensor) for sensor in range(len(PLACEMENTS))]
    period = float(np.median(np.diff(times)))
    rows = len(times)
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)  # bytes that nobody reads are lost, as on a real line
    print("port", os.ttyname(slave), flush=True)
    start = time.monotonic()
    unix = time.time() - start
    first = None if stand else 0  # sample number at which the recording's first row is due
    ended = False
    for number in range(sys.maxsize):
        due = start + number * period
        while (wait := due - time.monotonic()) > 0:
            time.sleep(min(wait, TICK_S))
        if number % 5 == 0 or ended:
            came = line_came()
            if came is None and (ended or first is None):
                return
            if came and first is None:
                first = number
        if first == number:
            print(f"started {unix + due:.6f}", flush=True)
        row = 0 if first is None else min(number - first, rows - 1)
        if first is not None and number - first == rows - 1:
            ended = True
            print(f"ended {unix + due:.6f}", flush=True)
        t_us = round(number * period * 1e6)
        try:
            for make in makers:
                os.write(master, make(row, number, t_us))
        except BlockingIOError:
            pass


@click.command(help=__doc__)
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--stand", is_flag=True, help="Repeat the first sample until a line comes on standard input.")
def main(recording: Path, stand: bool) -> None:
    """The command line."""
    try:
        play(read_recording(recording), stand)
    except EdgeposeError as error:
        raise click.ClickException(str(error)) from error
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
