"""Bytes of native packets to samples, the same for a serial port and a capture of one."""

from __future__ import annotations

import logging
from collections.abc import Callable

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import Counters
from firmware_protocols.native import Decoder

_log = logging.getLogger(__name__)


class NativeStream:
    """Decoder, counters and the map from sensor ids (0 to 5, in the order of PLACEMENTS) to placements."""

    def __init__(self, name: str) -> None:
        """Start with nothing seen; name is the port or file, for messages."""
        self._name = name
        self._decoder = Decoder()
        self._unknown: dict[int, int] = {}  # packets by id

    @property
    def counters(self) -> Counters:
        """What has come in so far."""
        c = self._decoder.counters
        unknown = sum(self._unknown.values())
        return Counters(c.packets - unknown, c.lost, c.bad, unknown)

    @property
    def byte_count(self) -> int:
        """Bytes fed so far."""
        return self._decoder.counters.bytes

    @property
    def unknown_ids(self) -> list[int]:
        """Sensor ids seen that belong to no placement."""
        return sorted(self._unknown)

    def feed(self, data: bytes, clock: Callable[[int, int], float]) -> list[ImuSample]:
        """Samples completed by the next bytes.

        Args:
            data: the bytes.
            clock: time of a measurement, seconds, from sensor and device time in microseconds.

        Raises:
            EdgeposeError: a device says that its inertial frame points down.
        """
        result = []
        for sample in self._decoder.feed(data):
            sensor = sample.sensor
            if sensor < len(PLACEMENTS):
                assert sample.time_us is not None  # native packets always have one
                time_s = clock(sensor, sample.time_us)
                result.append(ImuSample(sensor, time_s, sample.quat, sample.acc, sample.gyr, sample.mag))
                continue
            if sensor not in self._unknown:
                _log.warning("%s: packets of sensor id %d are left out; ids are 0 to 5", self._name, sensor)
            self._unknown[sensor] = self._unknown.get(sensor, 0) + 1
        for sensor, info in self._decoder.infos.items():
            if info.frame == "NED":
                raise EdgeposeError(
                    f"{self._name}: sensor id {sensor} sends its orientation in a frame with Z down (NED); "
                    "set its firmware to a frame with Z up (ENU)"
                )
        return result
