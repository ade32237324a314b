"""Decoding of a socket's datagrams: one decoder for each sender."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from edgepose.errors import EdgeposeError
from edgepose.imu import ImuSample
from edgepose.sources import Device, SourceCounters, sum_counters
from edgepose.sources.line_decoder import Clock, LineDecoder, PlacementById
from edgepose.sources.protocol_detection import Datagram, Detector
from firmware_protocols.base import Protocol

_log = logging.getLogger(__name__)

MOST_SENDERS = 64
"""Number of senders that are decoded; those without a usable packet make room for new ones."""

MOST_NAMED = 16
"""Number of other senders that are named in warnings."""

UNDECIDED_S = 3.0
"""Time after which a sender whose protocol is not clear is listened to afresh, seconds."""

SenderPlacements = Callable[[str], Callable[[Protocol], PlacementById] | None]
"""Map of ids to placements for a sender's address, see `LineDecoder`; None if it is not a sensor's."""


class SenderDecoders:
    """The decoders of all senders of one socket; it stands in for the `LineDecoder` of other lines.

    Anybody can send to a socket. A sender that cannot be used is named once and costs only itself: nothing
    that it sends ends the run, and the memory for senders is bounded.

    Attributes:
        name: the socket's address, for messages.
        first_s: arrival of the first datagram.
        amount: datagrams received so far.
    """

    def __init__(
        self,
        name: str,
        protocols: Sequence[Protocol],
        placements: SenderPlacements,
        clock: Callable[[int], Clock],
        placement_owner: dict[int, str],
    ) -> None:
        """Start without senders; the arguments are those of `LineDecoder`, placements for each sender.

        Raises:
            ConfigError: a package for the only protocol is missing.
        """
        Detector(name, protocols)  # imports what decoders need now, not when the first datagram comes
        self.name = name
        self.first_s: float | None = None
        self.amount = 0
        self._protocols = protocols
        self._placements = placements
        self._clock = clock
        self._placement_owner = placement_owner
        self._decoders: dict[str, LineDecoder] = {}
        self._turned_away: dict[str, str] = {}  # reason by sender
        self._unnamed = False  # there are more of these than are named
        self._strangers = 0  # forgotten senders of ids without a placement
        self._bad = 0
        self._ignored = 0
        self._forgotten = SourceCounters()

    @property
    def protocol(self) -> Protocol | None:
        """The protocol that the line was given or a sender was found to use; None if unknown."""
        if len(self._protocols) == 1:
            return self._protocols[0]
        return next((each.protocol for each in self._decoders.values() if each.protocol), None)

    @property
    def counters(self) -> SourceCounters:
        """Counts of the packets received so far; datagrams of senders that are not used are unknown."""
        own = SourceCounters(bad=self._bad, unknown=self._ignored)
        return sum_counters([own, self._forgotten, *(each.counters for each in self._decoders.values())])

    @property
    def devices(self) -> dict[int, Device]:
        """Devices that have sent samples, by placement."""
        return {
            placement: device
            for decoder in self._decoders.values()
            for placement, device in decoder.devices.items()
        }

    @property
    def refused(self) -> str | None:
        """Input that could be understood but not used, and what to do; None if there is none."""
        for sender, decoder in self._decoders.items():
            if decoder.refused is not None:
                return f"from {sender}: {decoder.refused}"
        return None

    @property
    def unknown(self) -> str | None:
        """Text about packets that belong to no placement, if all are such; None if there are none."""
        for sender, decoder in self._decoders.items():
            if decoder.unknown is not None:
                return f"from {sender}: {decoder.unknown}"
        if not self._turned_away:
            return None
        senders = ", ".join(self._turned_away) + (" and others" if self._unnamed else "")
        return f"datagrams come only from {senders}: {next(iter(self._turned_away.values()))}"

    def feed(self, chunk: Sequence[Datagram], arrival_s: float) -> list[ImuSample]:
        """Return the samples completed by datagrams that came at a time, seconds."""
        self.amount += len(chunk)
        if self.first_s is None:
            self.first_s = arrival_s
        samples: list[ImuSample] = []
        for datagram in chunk:
            if not datagram.data:  # empty, or too long
                self._bad += 1
                continue
            sender = datagram.sender
            decoder = self._decoders.get(sender) or self._new_decoder(sender, arrival_s)
            if decoder is None:
                self._ignored += 1
            else:
                try:
                    samples += decoder.feed([datagram], arrival_s)
                except EdgeposeError as error:
                    self._turn_away(sender, str(error))
                if decoder.protocol is None and _is_old(decoder, arrival_s):
                    self._forget(sender)
        return samples

    def _new_decoder(self, sender: str, arrival_s: float) -> LineDecoder | None:
        """Return the decoder of a sender without one; None, and name it once, if it cannot be used.

        New decoders are costly. A flood of senders therefore gets few of them, and none of those in use.
        """
        if sender in self._turned_away:
            return None
        placements = self._placements(sender)
        if placements is None:
            self._turn_away(sender, "it is not in the sensor map")
            return None
        if len(self._decoders) >= MOST_SENDERS:
            useless = [
                s for s, d in self._decoders.items() if not d.counters.packets and _is_old(d, arrival_s)
            ]
            if not useless:
                return None
            self._forget(useless[0])
        name = f"{self.name} from {sender}"
        quiet = self._strangers > MOST_NAMED
        try:
            decoder = LineDecoder(
                name, self._protocols, placements, self._clock, self._placement_owner, quiet
            )
        except EdgeposeError as error:
            self._turn_away(sender, str(error))
            return None
        self._decoders[sender] = decoder
        return decoder

    def _turn_away(self, sender: str, reason: str) -> None:
        self._forget(sender)
        if len(self._turned_away) < MOST_NAMED:
            self._turned_away[sender] = reason
            _log.warning("%s: ignoring datagrams from %s: %s", self.name, sender, reason)
        else:
            self._stop_naming()

    def _stop_naming(self) -> None:
        if not self._unnamed:
            self._unnamed = True
            _log.warning("%s: ignoring datagrams from more senders, without naming them", self.name)

    def _forget(self, sender: str) -> None:
        """Drop a sender's decoder, keep its counts, and free its placements."""
        decoder = self._decoders.pop(sender, None)
        if decoder is not None:
            if decoder.unknown_ids:
                self._strangers += 1
                if self._strangers > MOST_NAMED:
                    self._stop_naming()
            self._forgotten = sum_counters([self._forgotten, decoder.counters])
            self._bad += decoder.amount if decoder.protocol is None else 0
            for placement in decoder.devices:
                if self._placement_owner.get(placement) == decoder.name:
                    del self._placement_owner[placement]


def _is_old(decoder: LineDecoder, now_s: float) -> bool:
    """Return whether a decoder has had time enough to find its protocol."""
    return decoder.first_s is None or now_s - decoder.first_s > UNDECIDED_S
