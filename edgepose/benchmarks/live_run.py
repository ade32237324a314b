"""Cost of a live run of the whole program at the pace of its sensors, which is what users pay.

At full speed, code and data stay in the processor's caches. At 60 frames a second other programs run in
between, and a pose costs several times as much.
"""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from edgepose.benchmarks.simulated import SENSOR_HZ, calibration, packet
from edgepose.calibration import save
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS

START_S = 60.0
"""Longest time until the first pose, seconds."""

SETTLE_S = 1.0
"""Time after the first pose that is not measured, seconds."""

MEASURED_S = 5.0
"""Length of the measurement, seconds."""

_GAP_S = 1.0 / (SENSOR_HZ * len(PLACEMENTS))
"""Time from packet to packet, seconds: the sensors measure one after the other."""


class LiveCost(NamedTuple):
    """Cost of `edgepose run` with six sensors at 100 Hz on one serial line, poses sent as datagrams.

    Attributes:
        us: processor time per pose, microseconds.
        waits: number of times per pose that it waits, and is woken up.
        p50_ms: median time from the last packet until the pose was sent, as the run's own summary says.
        p99_ms: 99th percentile of it.
        poses: number of measured poses.
    """

    us: float
    waits: float
    p50_ms: float
    p99_ms: float
    poses: int


def live_cost(model: Path, seconds: float = MEASURED_S) -> LiveCost | None:
    """Measure a live run with a model; None on systems that do not show the processor time of others.

    Raises:
        EdgeposeError: the run fails.
    """
    if not sys.platform.startswith("linux"):
        return None
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        save(calibration(), folder / "calib.json")
        line = stack.enter_context(SensorLine())
        receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        words = ["--port", line.port, "--protocol", "native", "--calibration", str(folder / "calib.json")]
        address = f"127.0.0.1:{receiver.getsockname()[1]},format=binary"
        command = [sys.executable, "-m", "edgepose", "run", *words, "--udp", address, "--model", str(model)]
        # Its messages are short, so the pipe never fills.
        run = stack.enter_context(subprocess.Popen([*command, "--trust"], stderr=subprocess.PIPE))
        stack.callback(run.kill)
        _send_until_first_pose(line, receiver, run)
        line.send(SETTLE_S, receiver)
        before_s, waits_before = _processor_s(run.pid), _waits(run.pid)
        poses = line.send(seconds, receiver)
        us = 1e6 * (_processor_s(run.pid) - before_s) / max(poses, 1)
        waits = (_waits(run.pid) - waits_before) / max(poses, 1)
        run.send_signal(signal.SIGTERM)
        _, messages = run.communicate()
    latency = re.search(rb"latency +([0-9.]+) ms median, ([0-9.]+) ms p99", messages)
    if latency is None or not poses:
        raise EdgeposeError(f"a live run failed: {messages.decode()[-200:].strip()}")
    return LiveCost(us, waits, float(latency[1]), float(latency[2]), poses)


def _send_until_first_pose(line: SensorLine, receiver: socket.socket, run: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + START_S
    while not line.send(0.1, receiver):
        if run.poll() is not None or time.monotonic() > end_s:
            assert run.stderr is not None
            run.kill()
            raise EdgeposeError(f"no poses of a live run: {run.stderr.read().decode()[-200:].strip()}")


class SensorLine:
    """A pseudo terminal with six sensors that send in turn."""

    def __init__(self) -> None:
        """Open the terminal; its name is `port`."""
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._start_s = time.monotonic()
        self._sent = 0

    def __enter__(self) -> SensorLine:
        """Return the line."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the terminal."""
        os.close(self._master)
        os.close(self._slave)

    def send(self, seconds: float, receiver: socket.socket) -> int:
        """Send for some time; return the number of poses received meanwhile."""
        poses = 0
        end_s = time.monotonic() + seconds
        while (now_s := time.monotonic()) < end_s:
            due_s = self._start_s + self._sent * _GAP_S
            if due_s <= now_s:
                row, sensor = divmod(self._sent, len(PLACEMENTS))
                # As on a real line, what nobody reads is lost.
                with suppress(BlockingIOError):
                    os.write(self._master, packet(sensor, row, self._sent * _GAP_S))
                self._sent += 1
            elif select.select([receiver], [], [], due_s - now_s)[0]:
                poses += len(receiver.recv(2048)) > 0
        return poses


def _processor_s(process: int) -> float:
    """Return the processor time of a process so far, seconds."""
    # Linux's number for the clock of another process, as clock_getcpuclockid(3) returns it.
    return time.clock_gettime(~process << 3 | 2)


def _waits(process: int) -> int:
    """Return how often the threads of a process have waited so far."""
    total = 0
    for status in Path(f"/proc/{process}/task").glob("*/status"):
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        total += int(fields["voluntary_ctxt_switches"])
    return total
