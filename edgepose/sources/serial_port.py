"""Live samples from a serial port."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from types import TracebackType

import serial
from serial.tools import list_ports

from edgepose.clock import DeviceClock
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.sources import POLL_S, Batch, Counters
from edgepose.sources.native_stream import NativeStream

SILENCE_S = 5.0
"""How long a port may say nothing at the start."""

BACKLOG_S = 0.5
"""Longest time to throw away what has waited, seconds; a port that is never empty is read from then on."""

NOISE_S = 3.0
"""How long bytes may come at the start without one usable packet in them."""


class SerialSource:
    """Native packets from one serial port, which nobody else may open meanwhile."""

    def __init__(self, port: str, baud: int) -> None:
        """Nothing is opened yet.

        Args:
            port: name as the system knows it.
            baud: speed, bit/s.
        """
        self._port = port
        self._baud = baud
        self._serial: serial.Serial | None = None
        self._stream = NativeStream(port)
        self._clocks = [DeviceClock() for _ in PLACEMENTS]
        self._arrival_s = 0.0
        self._unix_s = 0.0  # Unix time at 0 of the monotonic clock

    @property
    def counters(self) -> Counters:
        """What has come in so far."""
        return self._stream.counters

    @property
    def damage(self) -> str | None:
        """Always None: trouble on a port is raised."""
        return None

    def __enter__(self) -> SerialSource:
        """Open the port.

        Raises:
            EdgeposeError: it is not there, in use, or not allowed.
        """
        try:
            self._serial = serial.Serial(self._port, self._baud, timeout=POLL_S, exclusive=True)
        except (OSError, ValueError) as error:
            raise EdgeposeError(f"{self._port}: {self._opening_problem(error)}") from None
        self._unix_s = time.time() - time.monotonic()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        if self._serial is not None:
            self._serial.close()

    def __iter__(self) -> Iterator[Batch]:
        """Batches as they come, without end.

        Raises:
            EdgeposeError: nothing usable comes at the start, or the port disappears.
        """
        assert self._serial is not None, "the source has not been entered"
        start_s = self._now()
        first_s: float | None = None
        # What has waited since the port was opened is of unknown age, and full buffers have lost parts of it.
        while self._read()[0] and self._waiting() and self._now() - start_s < BACKLOG_S:
            pass
        while True:
            data, gone = self._read()
            now_s = self._now()
            self._arrival_s = now_s
            yield now_s, self._stream.feed(data, self._host_time)
            if gone:
                raise EdgeposeError(
                    f"{self._port}: the port disappeared after {self.counters.packets} packets; "
                    "check cable and power, then start again"
                )
            if data and first_s is None:
                first_s = now_s
            if first_s is None and now_s - start_s > SILENCE_S:
                raise EdgeposeError(
                    f"{self._port}: nothing came for {SILENCE_S:g} s; "
                    "check --port and that the device is on and sending"
                )
            if first_s is not None and now_s - first_s > NOISE_S and not self.counters.packets:
                raise EdgeposeError(f"{self._port}: {self._noise_problem()}")

    def _read(self) -> tuple[bytes, bool]:
        """What is there, waiting a little for the first byte, and whether the port has gone."""
        assert self._serial is not None
        data = b""
        try:
            data = self._serial.read(1)
            data += self._serial.read(self._serial.in_waiting)
        except OSError:
            return data, True
        return data, False

    def _waiting(self) -> int:
        try:
            return int(self._serial.in_waiting) if self._serial else 0
        except OSError:  # gone; the next read tells
            return 0

    def _host_time(self, sensor: int, t_us: int) -> float:
        return self._clocks[sensor].host_time(t_us, self._arrival_s)

    def _now(self) -> float:
        return self._unix_s + time.monotonic()

    def _noise_problem(self) -> str:
        if self._stream.unknown_ids:
            ids = ", ".join(map(str, self._stream.unknown_ids))
            return f"packets come only of sensor ids {ids}; give the sensors the ids 0 to 5"
        return (
            f"{self._stream.byte_count} bytes in {NOISE_S:g} s and not one valid packet; "
            f"check --baud (now {self._baud}) and --protocol"
        )

    def _opening_problem(self, error: OSError | ValueError) -> str:
        code = getattr(error, "errno", None)
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            ports = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
            return f"no such port; ports here: {ports}"
        if code in (errno.EACCES, errno.EPERM):
            return (
                "no permission to open it; add yourself to the group dialout "
                "(sudo usermod -aG dialout $USER) and log in again"
            )
        if code in (errno.EAGAIN, errno.EBUSY):
            return "the port is in use by another program; close that first"
        return f"cannot open it as a serial port: {str(error).splitlines()[0]}"
