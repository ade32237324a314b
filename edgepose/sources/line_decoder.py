"""What comes over one line, to samples of placements: the same for live lines and for logs of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import PLACEMENTS
from edgepose.sources import Device, SourceCounters
from edgepose.sources.protocol_detection import Chunk, Detector, decode
from firmware_protocols.base import Decoder, DeviceInfo, Protocol
from firmware_protocols.sample import Sample

_log = logging.getLogger(__name__)

LISTEN_S = 1.0
"""How long a line is listened to before what it speaks is decided on weak evidence, seconds."""

LISTEN_BYTES = 1 << 16
"""The same for captures, which have no times."""

PlacementById = Mapping[int | None, int]
"""Index into PLACEMENTS by the device's id on the line; None stands for the only device, whatever its id."""

Clock = Callable[[int, int | None, float], float]
"""Time of a measurement, seconds, of sensor, device time in microseconds, and arrival in seconds."""


class LineDecoder:
    """Detection, decoder, clocks, counters and the map from ids to placements of one line.

    Attributes:
        name: port, bus or file, for messages.
        protocol: what the line speaks, None until that is known.
        first_s: arrival of the first chunk.
        amount: bytes or frames that came.
    """

    def __init__(
        self,
        name: str,
        protocols: Sequence[Protocol],
        places: Callable[[Protocol], PlacementById],
        clock: Callable[[int], Clock],
        placement_owner: dict[int, str],
    ) -> None:
        """Start with nothing seen.

        Args:
            name: port, bus or file, for messages.
            protocols: what the line may speak.
            places: the line's map of ids, once the protocol is known.
            clock: makes the line's clock, given where the devices' times wrap, microseconds.
            placement_owner: placements that have come, with the name of their line; shared by all lines.
        """
        self.name = name
        self.protocol: Protocol | None = None
        self.first_s: float | None = None
        self.amount = 0
        self._arrival_s = 0.0
        self._detector: Detector | None = Detector(name, protocols)
        self._places_of = places
        self._clock_of = clock
        self._placement_owner = placement_owner
        self._decoder: Decoder | None = None
        self._clock: Clock | None = None
        self._places: PlacementById = {}
        self._known: dict[int, int] = {}  # placement by id, of those that have come
        self._unknown: dict[int, int] = {}  # packets by id
        if len(protocols) == 1:
            self._settle(protocols[0], self._detector.decoders[0])

    @property
    def counters(self) -> SourceCounters:
        """What has come in so far."""
        if self._decoder is None:
            return SourceCounters()
        c = self._decoder.counters
        unknown = sum(self._unknown.values())
        return SourceCounters(c.packets - unknown, c.lost, c.bad, unknown)

    @property
    def devices(self) -> dict[int, Device]:
        """What has sent samples, by placement."""
        spoken = "" if self.protocol is None else self.protocol.name
        return {place: Device(spoken, self.name, sensor) for sensor, place in self._known.items()}

    @property
    def unknown_ids(self) -> list[int]:
        """Sensor ids seen that belong to no placement."""
        return sorted(self._unknown)

    @property
    def ids(self) -> str:
        """The ids that belong to placements, for a message."""
        return format_ids(sorted(sensor for sensor in self._places if sensor is not None))

    def feed(self, chunk: Chunk, arrival_s: float) -> list[ImuSample]:
        """Samples completed by what comes next.

        Args:
            chunk: bytes or frames.
            arrival_s: when they came, seconds; NaN if nobody knows.

        Raises:
            EdgeposeError: formats fit equally well; it is not known where the sensors sit; or a device's
                inertial frame points down.
        """
        self.amount += len(chunk)
        self._arrival_s = arrival_s
        if self.first_s is None:
            self.first_s = arrival_s
        if self._detector is None:
            assert self._decoder is not None
            return self._take(decode(self._decoder, chunk), arrival_s)
        self._detector.feed(chunk, arrival_s)
        return self._decide(arrival_s - self.first_s >= LISTEN_S or self.amount >= LISTEN_BYTES)

    def finish(self) -> list[ImuSample]:
        """What is held back at the end of a log."""
        result = [] if self._detector is None else self._decide(True)
        if self._decoder is not None:
            result += self._take(self._decoder.flush(), self._arrival_s)
        return result

    def _decide(self, now: bool) -> list[ImuSample]:
        assert self._detector is not None
        found = self._detector.best(now)
        if found is None:
            return []
        protocol, decoder, heard = found
        self._settle(protocol, decoder)
        _log.info("%s: protocol %s", self.name, protocol.name)
        return [sample for arrival_s, samples in heard for sample in self._take(samples, arrival_s)]

    def _settle(self, protocol: Protocol, decoder: Decoder) -> None:
        self.protocol, self._decoder = protocol, decoder
        self._detector = None
        self._places = self._places_of(protocol)
        self._clock = self._clock_of(decoder.WRAP_US)

    def _take(self, samples: Sequence[Sample], arrival_s: float) -> list[ImuSample]:
        assert self._clock is not None
        assert self._decoder is not None
        result = []
        for sensor, time_us, quat, acc, gyr, mag, _ in samples:
            place = self._known.get(sensor)
            if place is None:
                place = self._find(sensor)
                if place is None:
                    continue
            result.append(ImuSample(place, self._clock(place, time_us, arrival_s), quat, acc, gyr, mag))
        if self._decoder.infos:
            self._check_frames(self._decoder.infos)
        return result

    def _find(self, sensor: int) -> int | None:
        """Placement of a sensor that has not come before, or that has none."""
        place = self._places.get(sensor)
        # Of a line with one device, the first id that comes is its.
        if place is None and not self._known:
            place = self._places.get(None)
        if place is None:
            if sensor not in self._unknown:
                _log.warning(
                    "%s: packets of sensor id %d are left out; ids are %s", self.name, sensor, self.ids
                )
            self._unknown[sensor] = self._unknown.get(sensor, 0) + 1
            return None
        other = self._placement_owner.setdefault(place, self.name)
        if other != self.name:
            raise EdgeposeError(
                f"{other} and {self.name} both have a sensor for {PLACEMENTS[place]}, id {sensor}; "
                "give each sensor an id of its own, or say with --sensors which is where"
            )
        self._known[sensor] = place
        return place

    def _check_frames(self, infos: Mapping[int, DeviceInfo]) -> None:
        for sensor, info in infos.items():
            if info.frame == "NED":
                raise EdgeposeError(
                    f"{self.name}: sensor id {sensor} sends its orientation in a frame with Z down (NED); "
                    "set its firmware to a frame with Z up (ENU)"
                )


def format_ids(ids: Sequence[int]) -> str:
    """Ids for a message: "0 to 5", or one by one."""
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[0] + len(ids))):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids)) or "any, of one sensor"
