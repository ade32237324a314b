"""Checks of live lines: nothing usable at the start, clocks that restart, devices that share an id."""

from __future__ import annotations

import logging

from edgepose.errors import DeviceError
from edgepose.placements import SENSORS
from edgepose.sources.line_reader import LineReader
from edgepose.utils import fault_messages as messages

_log = logging.getLogger(__name__)

SILENCE_S = 5.0
"""Longest time without any data at the start, seconds."""

NOISE_S = 3.0
"""Longest time with data but no usable packet at the start, seconds; SILENCE_S for sockets."""

REFUSED_S = 1.0
"""The same with packets that could be understood, but not used."""


def check_start(line: LineReader, now_s: float, start_s: float) -> None:
    """Check that usable packets come from a line, and mark it once they do.

    Args:
        line: the line to check.
        now_s: present time on the source's clock, seconds.
        start_s: time at which the source was started, seconds.

    Raises:
        DeviceError: no data, or no usable packet, for too long since the start.
    """
    decoder, spec = line.decoder, line.spec
    if decoder.first_s is None:
        if now_s - start_s > SILENCE_S and line.transport is not None:
            raise DeviceError(f"{spec.name}: no data for {SILENCE_S:g} s; check {spec.check[0]}")
        return
    passed_s = now_s - decoder.first_s
    if decoder.counters.packets:
        line.start_checked = True
        return
    # Anybody can send to a socket: a stranger's datagrams leave the sensors no less time than silence.
    refused_s, noise_s = (REFUSED_S, NOISE_S) if spec.senders is None else (SILENCE_S, SILENCE_S)
    if passed_s > refused_s and decoder.refused is not None and decoder.unknown is None:
        raise DeviceError(f"{spec.name}: {decoder.refused}")
    if passed_s > noise_s:
        if decoder.unknown is not None:
            raise DeviceError(f"{spec.name}: {decoder.unknown}")
        kind = "" if decoder.protocol is None else f"{decoder.protocol.name} "
        raise DeviceError(
            f"{spec.name}: {decoder.amount} {spec.unit} in {noise_s:g} s but no valid {kind}packet; "
            f"check {spec.check[1]}"
        )


def warn_about_refused(line: LineReader) -> None:
    """Log a warning, once, if a line has input that could be understood but not used."""
    refused = None if line.refused_reported else line.decoder.refused
    if refused is not None:
        line.refused_reported = True
        _log.warning("%s: %s", line.spec.name, refused)


def warn_about_clock_resets(line: LineReader) -> None:
    """Log a warning for each device clock that was reset since the last call, about a second ago.

    Two devices with one id look like a single clock that jumps back and forth; that is reported once.
    """
    for placement, clock in line.clocks.items():
        before = line.clock_resets.get(placement, 0)
        if clock.resets - before >= messages.JUMPS_OF_TWO and not line.duplicate_ids:
            line.duplicate_ids = True
            _log.warning("%s: %s: %s", line.spec.name, SENSORS[placement], messages.two_devices())
        elif clock.resets > before:
            _log.warning(
                "%s: %s: %s: calibrate again",
                line.spec.name,
                SENSORS[placement],
                messages.clock_restarted(),
            )
        line.clock_resets[placement] = clock.resets
