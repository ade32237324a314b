"""A package that adds a wire format and an output to edgepose; its pyproject.toml registers both.

pip install ./examples/plugin
edgepose check --port /dev/ttyUSB0 --protocol example-lines
edgepose run ... --sink example-count=count.txt
"""

from __future__ import annotations

import math

from edgepose import PoseFrame, Sink
from edgepose.sinks.base import SinkContext
from edgepose.sinks.output_files import check_output
from edgepose.utils.durable_files import write_whole
from firmware_protocols.base import Decoder, Protocol
from firmware_protocols.sample import Counters, Sample


class ExampleDecoder(Decoder):
    """Decoder for lines `E,id,time_us,qw,qx,qy,qz,ax,ay,az`."""

    WRAP_US = 1 << 32

    def __init__(self) -> None:
        """Create the decoder."""
        self.counters = Counters()
        self._rest = b""

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples of the complete lines; invalid lines count as bad."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-1000:]  # noise without line breaks must not fill the memory
        samples = [sample for line in lines if (sample := _parse(line)) is not None]
        self.counters.packets += len(samples)
        self.counters.bad += len(lines) - len(samples)
        return samples


def _parse(line: bytes) -> Sample | None:
    try:
        kind, sensor, time_us, *numbers = line.decode("ascii").strip().split(",")
        qw, qx, qy, qz, ax, ay, az = map(float, numbers)
        good = kind == "E" and math.isclose(math.hypot(qw, qx, qy, qz), 1.0, abs_tol=0.01)
        return Sample(int(sensor), int(time_us), (qw, qx, qy, qz), (ax, ay, az)) if good else None
    except ValueError:
        return None


PROTOCOL = Protocol(
    name="example-lines",
    transport="bytes",
    default_bitrate=115200,
    description="lines of the example plug-in",
    decoder=ExampleDecoder,
    encoder=None,
    ids=range(6),
)


class CountSink(Sink):
    """Writes the number of poses to a file at the end; after a failure, or without poses, nothing."""

    def __init__(self, path: str, overwrite: bool) -> None:
        """Count from zero; raise EdgeposeError if the file cannot be written or must not be replaced."""
        check_output(path, "the count", (".txt",), overwrite)
        self._path, self._overwrite = path, overwrite
        self._count, self._closed = 0, False

    def write(self, pose: PoseFrame) -> None:
        """Count a pose."""
        self._count += 1

    def close(self) -> None:
        """Write the count; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        if self._count:
            write_whole(self._path, f"{self._count}\n", "the count", overwrite=self._overwrite)

    def discard(self) -> None:
        """Close without writing."""
        self._closed = True


def open_count(target: str, context: SinkContext) -> Sink:
    """Open a `CountSink`: the entry point for `--sink example-count=FILE`."""
    return CountSink(target, context.overwrite)
