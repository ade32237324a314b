"""Decoding of one line's data to samples with placements, for live lines and for their logs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.placements import SENSORS
from edgepose.sources import Device, SourceCounters
from edgepose.sources.protocol_detection import Chunk, Detector, decode, refused_by
from firmware_protocols.base import Decoder, DeviceInfo, Protocol
from firmware_protocols.sample import Sample

_log = logging.getLogger(__name__)

LISTEN_S = 1.0
"""Time after which a line's protocol is decided on weak evidence, seconds."""

LISTEN_BYTES = 1 << 16
"""Amount of data with the same effect, for captures without times."""

MOST_UNKNOWN = 16
"""Number of ids without a placement that are named: a sender can make up any number of them."""

PlacementById = Mapping[int | None, int]
"""Index into SENSORS by device id on the line; the key None is the only device, whatever its id."""

Clock = Callable[[int, int | None, float], float]
"""Time of a measurement, seconds, from placement index, device time in us and arrival in seconds."""


class LineDecoder:
    """Protocol detection, decoder, clock, counters and the map from ids to placements of one line.

    Attributes:
        name: port, bus or file, for messages.
        protocol: the line's protocol; None until it is known.
        first_s: arrival of the first chunk.
        amount: bytes or frames received so far.
        untimed: samples left out because neither they nor their arrival have a time.
    """

    def __init__(
        self,
        name: str,
        protocols: Sequence[Protocol],
        placements: Callable[[Protocol], PlacementById],
        clock: Callable[[int], Clock],
        placement_owner: dict[int, str],
        quiet: bool = False,
    ) -> None:
        """Create the decoder.

        Args:
            name: port, bus or file, for messages.
            protocols: protocols that the line may use.
            placements: returns the line's map of ids, once the protocol is known.
            clock: makes the line's clock, given the value at which device times wrap, microseconds.
            placement_owner: name of the line that sends each placement's samples; shared by all lines.
            quiet: count packets of ids without a placement, without a warning.
        """
        self.name = name
        self.protocol: Protocol | None = None
        self.first_s: float | None = None
        self.amount = 0
        self.untimed = 0
        self._arrival_s = 0.0
        self._detector: Detector | None = Detector(name, protocols)
        self._make_placements = placements
        self._make_clock = clock
        self._placement_owner = placement_owner
        self._quiet = quiet
        self._decoder: Decoder | None = None
        self._clock: Clock | None = None
        self._placements: PlacementById = {}
        self._known: dict[int, int] = {}  # placement by id, for the ids seen so far
        self._unknown: dict[int, int] = {}  # packets by id
        self._more_unknown = 0  # packets of more ids than are named
        if len(protocols) == 1:
            self._set_protocol(protocols[0], self._detector.decoders[0])

    @property
    def counters(self) -> SourceCounters:
        """Counts of the packets received so far."""
        if self._decoder is None:
            return SourceCounters()
        c = self._decoder.counters
        unknown = sum(self._unknown.values()) + self._more_unknown
        return SourceCounters(c.packets - unknown, c.lost, c.bad, unknown)

    @property
    def devices(self) -> dict[int, Device]:
        """Devices that have sent samples, by placement."""
        protocol = "" if self.protocol is None else self.protocol.name
        return {placement: Device(protocol, self.name, sensor) for sensor, placement in self._known.items()}

    @property
    def refused(self) -> str | None:
        """Input that could be understood but not used, and what to do; None if there is none."""
        if self._detector is not None:
            return self._detector.refused
        assert self.protocol is not None
        assert self._decoder is not None
        return refused_by(self.protocol, self._decoder)

    @property
    def unknown_ids(self) -> list[int]:
        """Sensor ids seen that belong to no placement."""
        return sorted(self._unknown)

    @property
    def unknown(self) -> str | None:
        """Text about packets that belong to no placement, if all are such; None if there are none."""
        if not self._unknown:
            return None
        ids = ", ".join(map(str, self.unknown_ids))
        return (
            f"packets come only from sensor ids {ids}; set the ids to {self.ids}, "
            "or assign them to placements with --sensors"
        )

    @property
    def ids(self) -> str:
        """The ids that belong to placements, for a message."""
        return format_ids(sorted(sensor for sensor in self._placements if sensor is not None))

    def feed(self, chunk: Chunk, arrival_s: float) -> list[ImuSample]:
        """Return the samples completed by a chunk.

        Args:
            chunk: bytes or frames.
            arrival_s: time at which they came, seconds; NaN if unknown.

        Raises:
            EdgeposeError: formats fit equally well; the sensors' placements are unknown; or a device's
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
        """Return the samples still held back at the end of a log."""
        result = [] if self._detector is None else self._decide(True)
        if self._decoder is not None:
            result += self._take(self._decoder.flush(), self._arrival_s)
        return result

    def _decide(self, now: bool) -> list[ImuSample]:
        assert self._detector is not None
        found = self._detector.best(now)
        if found is None:
            return []
        protocol, decoder, decoded = found
        self._set_protocol(protocol, decoder)
        _log.info("%s: protocol %s", self.name, protocol.name)
        return [sample for arrival_s, samples in decoded for sample in self._take(samples, arrival_s)]

    def _set_protocol(self, protocol: Protocol, decoder: Decoder) -> None:
        self.protocol, self._decoder = protocol, decoder
        self._detector = None
        self._placements = self._make_placements(protocol)
        self._clock = self._make_clock(decoder.WRAP_US)

    def _take(self, samples: Sequence[Sample], arrival_s: float) -> list[ImuSample]:
        assert self._clock is not None
        assert self._decoder is not None
        result = []
        for sensor, time_us, quat, acc, gyr, mag, _ in samples:
            placement = self._known.get(sensor)
            if placement is None:
                placement = self._find_placement(sensor)
                if placement is None:
                    continue
            time_s = self._clock(placement, time_us, arrival_s)
            if time_s != time_s:
                self.untimed += 1
                continue
            result.append(ImuSample(placement, time_s, quat, acc, gyr, mag))
        if self._decoder.infos:
            self._check_frames(self._decoder.infos)
        return result

    def _find_placement(self, sensor: int) -> int | None:
        """Return the placement of an id not seen before; None, and count the packet, if it has none."""
        placement = self._placements.get(sensor)
        # On a line with a single device, the first id seen is that device's.
        if placement is None and not self._known:
            placement = self._placements.get(None)
        if placement is None:
            if sensor not in self._unknown and len(self._unknown) < MOST_UNKNOWN:
                if not self._quiet:
                    _log.warning(
                        "%s: ignoring packets of sensor id %d; expected ids are %s",
                        self.name,
                        sensor,
                        self.ids,
                    )
                self._unknown[sensor] = 0
            if sensor in self._unknown:
                self._unknown[sensor] += 1
            else:
                self._more_unknown += 1
            return None
        other = self._placement_owner.setdefault(placement, self.name)
        if other != self.name:
            raise EdgeposeError(
                f"{other} and {self.name} both have a sensor for {SENSORS[placement]}, id {sensor}; "
                "give each sensor its own id, or assign sensors to placements with --sensors"
            )
        self._known[sensor] = placement
        return placement

    def _check_frames(self, infos: Mapping[int, DeviceInfo]) -> None:
        for sensor, info in infos.items():
            if info.frame == "NED":
                raise EdgeposeError(
                    f"{self.name}: sensor id {sensor} sends its orientation in a frame with Z down (NED); "
                    "set its firmware to a frame with Z up (ENU)"
                )


def format_ids(ids: Sequence[int]) -> str:
    """Format ids for a message: "0 to 5", or one by one."""
    if len(ids) > 2 and list(ids) == list(range(ids[0], ids[0] + len(ids))):
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids)) or "any, from a single sensor"
