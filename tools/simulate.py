"""Plays an IMU recording or a motion-capture clip as devices in real time, in any wire format.

\b
    simulate.py recording.npz                         play native packets, then rest
    simulate.py recording.npz --stand                 rest at the first sample until a line arrives on stdin
    simulate.py walk.bvh --protocol xsens             six ptys with one device each
    simulate.py walk.bvh --protocol native-can        CAN frames of a slcan adapter on a pty
    simulate.py walk.bvh --protocol native-can --can socketcan:can0
    simulate.py walk.bvh --udp 127.0.0.1:9000         native packets in datagrams, from one sender
    simulate.py walk.bvh --protocol slimevr --udp 127.0.0.1:6969    six SlimeVR trackers
    simulate.py walk.bvh --protocol ximu3 --tcp 127.0.0.1    six devices with a TCP server each
    simulate.py walk.bvh --protocol dot --ble         six Bluetooth sensors on a simulated BlueZ
    simulate.py walk.bvh --exercises --mounting 7 --raw 6    sensors without a filter at random angles

Prints `port NAME[,NAME...]` for use with --port (or `can NAME` for --can, `listen ADDRESS` for --listen,
`connect ADDRESS[,ADDRESS...]` for --connect; `ble ADDRESS,...` for --ble, and `bus ADDRESS`, which edgepose
needs in the environment variable DBUS_SYSTEM_BUS_ADDRESS), `senders ADDRESS,...` if there are several,
`started UNIX_TIME` and `ended UNIX_TIME`. Before a clip, the wearer stands straight for 6 s. Sensors have
the noise of a data sheet; with --ideal only while they rest before and after the recording. Ends at Ctrl-C,
or when standard input closes and the recording, if it has started, is over.
"""

from __future__ import annotations

import os
import random
import re
import select
import signal
import sys
import time
import tty
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import can
import click
import numpy as np
from simulate_network import DatagramLine, TcpServer, network_line

from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.npz import write_npz
from edgepose.formats.recordings.registry import read_recording
from edgepose.imu import Recording, SensorData
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.skeleton import default_body
from edgepose.utils.sockets import parse_host_and_port
from firmware_protocols.registry import PROTOCOLS, Frame
from firmware_protocols.registry import Protocol as Format
from firmware_protocols.rotation import rotate_back
from firmware_protocols.sample import Sample

CLIP_RATE, CLIP_HOLD_S = 100.0, 6.0
ANSWER_BITS_S = 115_200
"""Simulated speed of a line on which devices are polled, because a pty transfers answers at once."""

FIELD_UT = (0.0, 20.0, -40.0)
"""Magnetic field in the inertial frame, for formats that require one."""

NOISE_ACC, NOISE_GYR, NOISE_QUAT = 0.005, 0.0005, 0.0001
"""Noise of a sensor per axis, m/s^2, rad/s and rad: a good chip's data sheet at a bandwidth of 25 Hz."""

GRAVITY = (0.0, 0.0, 9.81)


class Faults(NamedTuple):
    """Simulated faults; the fields are the command's flags."""

    loss: float = 0.0
    corrupt: float = 0.0
    jitter_ms: float = 0.0
    drift_ppm: float = 0.0
    kill: tuple[tuple[int, float, float], ...] = ()
    duplicate_id: bool = False


# --- input --------------------------------------------------------------------------------------------------


class Rig(NamedTuple):
    """The simulated sensors; the fields are the command's flags.

    Attributes:
        exercises: whether the exercises of `edgepose calibrate --heading-reset motion` precede a clip.
        mounting: seed of the mounting angles for a clip; None aligns the sensors with the bones.
        raw: number of axes, 6 or 9, of chips without a filter; None for ideal sensors with orientation.
        seed: seed of the chips' errors.
    """

    exercises: bool = False
    mounting: int | None = None
    raw: int | None = None
    seed: int = 0


IDEAL = Rig()
"""Ideal sensors with orientation, aligned with the bones."""


def read_input(path: Path, rig: Rig = IDEAL) -> Recording:
    """Read a recording, or simulate sensors on the body of a motion-capture clip.

    Raises:
        EdgeposeError: the file is neither, or the clip has jumps.
    """
    recording = simulate_clip(path, rig) if is_motion(path) else read_recording(path)
    if rig.raw is None:
        return recording
    from edgepose_export.synthesis.imu_errors import BMI270, raw

    sensors = {}
    for i, (name, data) in enumerate(recording.sensors.items()):
        try:
            sensors[name] = raw(data, BMI270, rig.seed + i, magnetometer=rig.raw == 9)
        except ValueError as error:
            raise EdgeposeError(f"{path}: {name}: {error}") from None
    return recording._replace(sensors=sensors)


def simulate_clip(path: Path, rig: Rig) -> Recording:
    """Simulate ideal sensors on the body of a clip; the wearer stands straight first."""
    from edgepose_export.mocap import pieces, read_motion, resample, scaled_to
    from edgepose_export.mocap.zeroing import Evidence, find_zero
    from edgepose_export.synthesis.heading_routine import with_exercises
    from edgepose_export.synthesis.virtual_imus import (
        random_mounting,
        recording_arrays,
        virtual_imus,
        with_hold,
    )

    takes = pieces(read_motion(path))
    if len(takes) != 1:
        raise EdgeposeError(
            f"{path}: has jumps; make recordings of its {len(takes)} parts with edgepose synthesize"
        )
    zero = find_zero(Evidence.of(takes[0]))
    body = default_body()
    motion = zero.applied(resample(scaled_to(takes[0], body.leg_length_m), CLIP_RATE))
    motion = (with_exercises if rig.exercises else with_hold)(motion, CLIP_HOLD_S)
    mounting = None if rig.mounting is None else random_mounting(rig.mounting)
    arrays = recording_arrays(motion, virtual_imus(motion, body, mounting, zero.back), path.name)
    sensors = {
        name: SensorData(
            arrays["t"], *(arrays[f"{name}_{key}"].astype(float) for key in ("quat", "acc", "gyr"))
        )
        for name in PLACEMENTS
    }
    return Recording(sensors, {"source": path.name})


def is_motion(path: Path) -> bool:
    """Return whether a file is motion capture, which in .npz files means poses and no sensors."""
    if path.suffix.lower() != ".npz":
        return path.suffix.lower() in (".bvh", ".amc")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return "poses" in arrays.files and f"{PLACEMENTS[0]}_acc" not in arrays.files
    except (OSError, ValueError):
        return False  # the reader of recordings reports the error


def rows_of(data: SensorData) -> list[Sample]:
    """Return a sensor's rows without id and time."""
    columns = [
        [None] * len(data.time_s)
        if rows is None
        else [tuple(v) if v[0] == v[0] else None for v in rows.tolist()]
        for rows in data[1:]
    ]
    return [Sample(0, None, *quantities) for quantities in zip(*columns, strict=True)]


def with_field(sample: Sample) -> Sample:
    """Add a magnetic field to a sample if its orientation is known."""
    if sample.mag is not None or sample.quat is None:
        return sample
    return sample._replace(mag=rotate_back(sample.quat, FIELD_UT))


def at_rest(sample: Sample) -> Sample:
    """Return a sample of a sensor that stays where a sample was taken; without orientation, the sample."""
    if sample.quat is None:
        return sample
    return sample._replace(
        acc=None if sample.acc is None else rotate_back(sample.quat, GRAVITY),
        gyr=None if sample.gyr is None else (0.0, 0.0, 0.0),
    )


def with_noise(sample: Sample, rng: random.Random) -> Sample:
    """Return a sample with the noise of a sensor."""

    def noisy(vector: Any, deviation: float) -> Any:
        return None if vector is None else tuple(v + rng.gauss(0.0, deviation) for v in vector)

    quat = noisy(sample.quat, NOISE_QUAT / 2.0)  # half angles
    if quat is not None:
        norm = sum(v * v for v in quat) ** 0.5
        quat = tuple(v / norm for v in quat)
    return sample._replace(quat=quat, acc=noisy(sample.acc, NOISE_ACC), gyr=noisy(sample.gyr, NOISE_GYR))


# --- lines --------------------------------------------------------------------------------------------------


class Line(Protocol):
    """A line that packets are sent over.

    Attributes:
        name: its name for users.
        master: file to watch for what the other side sends; None if it sends nothing.
    """

    name: str
    master: int | None

    def send(self, wire: Any) -> None:
        """Send a packet, or lose it if no one reads the line."""

    def receive(self) -> bytes:
        """Return what the other side has sent."""

    def close(self) -> None:
        """Release the line."""


class Pty:
    """A pseudo terminal that takes whole packets only; as on a real line, unread packets are lost."""

    def __init__(self, slcan: bool = False) -> None:
        """Open a pseudo terminal; with `slcan`, packets are CAN frames in the text form of an adapter."""
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self._slave)
        self._slcan = slcan
        self._rest = b""

    def send(self, wire: Any) -> None:
        """Send a packet, unless an earlier one is still waiting."""
        self._write()
        if not self._rest:
            self._rest = b"".join(map(slcan_line, wire)) if self._slcan else wire
            self._write()

    def _write(self) -> None:
        try:
            while self._rest:
                self._rest = self._rest[os.write(self.master, self._rest) :]
        except BlockingIOError:
            pass

    def receive(self) -> bytes:
        """Return requests to a device, or commands to an adapter."""
        try:
            return os.read(self.master, 4096)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close both ends."""
        os.close(self.master)
        os.close(self._slave)


class Bus:
    """A bus of python-can."""

    def __init__(self, name: str, bitrate: int) -> None:
        """Open the bus INTERFACE:CHANNEL.

        Raises:
            EdgeposeError: the bus cannot be opened.
        """
        interface, _, channel = name.partition(":")
        self.name = name
        self.master = None
        try:
            self._bus = can.Bus(
                channel=channel, interface=interface, bitrate=bitrate, receive_own_messages=False
            )
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise EdgeposeError(f"{name}: cannot be opened: {error}") from None

    def send(self, wire: Sequence[Frame]) -> None:
        """Send the frames of a sample; lose the rest if the bus is full."""
        for can_id, data, extended, fd in wire:
            try:
                self._bus.send(
                    can.Message(arbitration_id=can_id, data=data, is_extended_id=extended, is_fd=fd)
                )
            except can.CanOperationError:
                return

    def receive(self) -> bytes:
        """Return nothing: devices on the bus are not polled."""
        return b""

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


def slcan_line(frame: Frame) -> bytes:
    """Format a frame as slcan adapters do, CAN FD as the newer ones do."""
    can_id, data, extended, fd = frame
    kind = ("d" if fd else "t").upper() if extended else ("d" if fd else "t")
    lengths = (*range(9), 12, 16, 20, 24, 32, 48, 64)
    return (
        f"{kind}{can_id:0{8 if extended else 3}X}{lengths.index(len(data)):X}{data.hex().upper()}\r".encode()
    )


class Target(NamedTuple):
    """Where packets go; the fields are the command's flags. Without any, to ptys."""

    bus: str | None = None
    udp: tuple[str, int] | None = None
    tcp: str | None = None
    ble: bool = False


def open_lines(wire_format: Format, target: Target, sensors: int) -> list[Line]:
    """Open one line for all sensors, or one for each."""
    if target.bus is not None:
        return [Bus(target.bus, wire_format.default_bitrate)]
    if wire_format.transport == "can":
        return [Pty(slcan=True)]
    count = sensors if wire_format.single_device else 1
    if target.ble:
        # Imported only here: dbus-fast comes with edgepose[ble].
        from simulated_bluez import dot_lines

        return [*dot_lines(count)]
    if target.tcp is not None:
        return [TcpServer(target.tcp) for _ in range(count)]
    if target.udp is not None:
        sender = network_line(*target.udp, wire_format.name)
        return [sender(number if count > 1 else None) for number in range(count)]
    return [Pty() for _ in range(count)]


def print_lines(wire_format: Format, target: Target, lines: list[Line]) -> None:
    """Print the names of the lines, as flags of edgepose want them."""
    names = ",".join(line.name for line in lines)
    if target.udp is not None:
        print("listen", lines[0].name, flush=True)
        if len(lines) > 1:
            print(
                "senders",
                ",".join(line.sender for line in lines if isinstance(line, DatagramLine)),
                flush=True,
            )
    elif target.ble:
        print("ble", names, flush=True)
        print("bus", lines[0].bus, flush=True)
    elif target.tcp is not None:
        print("connect", names, flush=True)
    elif wire_format.transport == "bytes":
        print("port", names, flush=True)
    else:
        print("can", names if target.bus else f"slcan:{names}", flush=True)


# --- playing ------------------------------------------------------------------------------------------------


class Sensor:
    """A simulated device: its samples and their times."""

    def __init__(
        self, index: int, data: SensorData, start_s: float, noisy: bool, encode: Callable[[Sample, int], Any]
    ) -> None:
        """Start at the first row.

        Args:
            index: its placement.
            data: its samples.
            start_s: time of the recording's first sample.
            noisy: add noise in motion, too.
            encode: makes packets.
        """
        self._noisy = noisy
        self.index = index
        self.rows = rows_of(data)
        self.times = (data.time_s - start_s).tolist()
        if len(self.times) < 2 or not (np.diff(data.time_s) > 0).all():
            raise EdgeposeError(f"{SENSORS[index]}: needs at least two samples with increasing times")
        self.period = float(np.median(np.diff(data.time_s)))
        self.row = 0
        self.count = 0
        self.due = 0.0
        self.wire: Any = None
        self._encode = encode
        self._add_field = False
        self._rests = True
        self._rng = random.Random(index)

    def prepare(self, wire_format: Format, sensor_id: int) -> None:
        """Set the sensor's id, and check that the format can represent the first sample.

        Raises:
            EdgeposeError: the format cannot represent it.
        """
        self.rows = [row._replace(sensor=sensor_id) for row in self.rows]
        try:
            for self._add_field in (False, True):
                try:
                    wire_format.encoder()(self._sample(0), 0)
                    return
                except ValueError:
                    if self._add_field:
                        raise
        except ValueError as error:
            raise EdgeposeError(
                f"{SENSORS[self.index]}: {wire_format.name} cannot represent its samples: {error}"
            ) from None

    def _sample(self, t_us: int) -> Sample:
        sample = self.rows[self.row]._replace(time_us=t_us)
        if self._rests and self.row:
            sample = at_rest(sample)
        if self._rests or self._noisy:
            sample = with_noise(sample, self._rng)
        return with_field(sample) if self._add_field else sample

    def measure(self, t_us: int) -> None:
        """Make the packet of the current row, if the format can represent it."""
        try:
            self.wire = self._encode(self._sample(t_us), self.count)
        except ValueError:
            self.wire = None
        self.count += 1

    def step(self, played_s: float | None) -> None:
        """Go to the next row; `played_s` is the time at which the recording started, None before that."""
        self._rests = played_s is None or self.row + 1 == len(self.rows)
        if self._rests:
            self.due += self.period
        else:
            self.row += 1
            self.due = played_s + self.times[self.row]


class Player:
    """Sender of the packets of all sensors, until standard input closes."""

    def __init__(self, sensors: list[Sensor], lines: list[Line], wire_format: Format, faults: Faults) -> None:
        """Prepare the queues of the lines and the sensors' clocks."""
        self._sensors, self._lines, self._faults = sensors, lines, faults
        self._rng = random.Random(0)
        self._queues: list[deque[tuple[float, Any]]] = [deque() for _ in lines]
        self._requests: dict[bytes, Sensor] = {}
        if wire_format.request is not None:
            ids = [sensor.rows[0].sensor for sensor in sensors]
            self._requests = {wire_format.request(i)[0]: s for i, s in zip(ids, sensors, strict=True)}
        self._received = [b"" for _ in lines]
        # The rates of the clocks are evenly spaced.
        last = max(1, len(sensors) - 1)
        self._clocks = [1.0 + faults.drift_ppm * 1e-6 * (2.0 * i / last - 1.0) for i in range(len(sensors))]
        self._start = 0.0
        self._played_s: float | None = None

    def play(self, stand: bool) -> None:
        """Run to the end; with `stand`, the recording starts when a line arrives on standard input."""
        self._start = time.monotonic()
        unix = time.time() - self._start
        for sensor in self._sensors:
            sensor.due = self._start
        watched = [sys.stdin]
        started, announced, ended = not stand, False, False
        while True:
            if started and self._played_s is None:
                self._played_s = min(sensor.due for sensor in self._sensors)
                for sensor in self._sensors:
                    sensor.due = self._played_s + sensor.times[0]
            if self._played_s is not None and not announced:
                print(f"started {unix + self._played_s:.6f}", flush=True)
                announced = True
            line = self._wait(watched)
            if line == "":
                watched = []
                if not started:
                    return
            started = started or bool(line)
            for sensor in self._sensors:
                if sensor.due <= time.monotonic():
                    self._measure(sensor)
                    sensor.step(self._played_s)
            if not ended and self._played_s is not None and self._at_end():
                ended = True
                end_s = self._played_s + max(sensor.times[-1] for sensor in self._sensors)
                print(f"ended {unix + end_s:.6f}", flush=True)
            self._release()
            if ended and not watched:
                return

    def _at_end(self) -> bool:
        """Return whether all last rows have been measured."""
        return all(
            sensor.row + 1 == len(sensor.rows) and sensor.due > (self._played_s or 0.0) + sensor.times[-1]
            for sensor in self._sensors
        )

    def _wait(self, watched: list[Any]) -> str | None:
        """Wait until something is due or arrives; return a line of standard input, "" at its end, or None."""
        dues = [sensor.due for sensor in self._sensors] + [queue[0][0] for queue in self._queues if queue]
        files = {line.master: i for i, line in enumerate(self._lines) if line.master is not None}
        timeout = max(0.0, min(dues) - time.monotonic())
        ready, _, _ = select.select([*watched, *files], [], [], timeout)
        for file in ready:
            if file in files:
                self._answer(files[file])
        return sys.stdin.readline() if sys.stdin in ready else None

    def _measure(self, sensor: Sensor) -> None:
        number = self._sensors.index(sensor)
        t_us = round((sensor.due - self._start) * self._clocks[number] * 1e6)
        sensor.measure(t_us)
        if not self._requests:
            self._queue(sensor, number if len(self._lines) > 1 else 0, sensor.due)

    def _answer(self, line: int) -> None:
        received = self._received[line] + self._lines[line].receive()
        for request, sensor in self._requests.items():
            if request in received:
                received = received.replace(request, b"")
                if sensor.wire is not None:
                    bits = 10 * (len(request) + len(sensor.wire))
                    self._queue(sensor, line, time.monotonic() + bits / ANSWER_BITS_S)
        self._received[line] = received[-64:]

    def _queue(self, sensor: Sensor, line: int, due: float) -> None:
        """Queue a packet for its line, subject to the faults."""
        faults, wire = self._faults, sensor.wire
        played = -1.0 if self._played_s is None else due - self._played_s
        killed = any(i == sensor.index and begin <= played < end for i, begin, end in faults.kill)
        if wire is None or killed or self._rng.random() < faults.loss:
            return
        if self._rng.random() < faults.corrupt:
            wire = bytearray(wire)
            wire[self._rng.randrange(len(wire))] ^= 1 << self._rng.randrange(8)
        queue = self._queues[line]
        release = due + self._rng.random() * faults.jitter_ms * 1e-3
        # Packets on a line stay in order.
        queue.append((max(release, queue[-1][0]) if queue else release, wire))

    def _release(self) -> None:
        now = time.monotonic()
        for queue, line in zip(self._queues, self._lines, strict=True):
            while queue and queue[0][0] <= now:
                line.send(queue.popleft()[1])


# --- the command --------------------------------------------------------------------------------------------


def parse_kill(ctx: click.Context, param: click.Parameter, values: Sequence[str]) -> tuple[Any, ...]:
    """Return sensor number, begin and end of each --kill."""
    result = []
    for value in values:
        match = re.fullmatch(r"(\w+)@(\d+(?:\.\d+)?)\.\.(\d+(?:\.\d+)?)?", value)
        if match is None or match[1] not in SENSORS:
            raise click.BadParameter(
                f"{value!r} is not SENSOR@T..T, where SENSOR is one of {', '.join(SENSORS)}"
            )
        result.append((SENSORS.index(match[1]), float(match[2]), float(match[3] or "inf")))
    return tuple(result)


def parse_udp(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, int] | None:
    """Return host and port of --udp."""
    try:
        return None if value is None else parse_host_and_port(value)
    except EdgeposeError as error:
        raise click.BadParameter(str(error)) from None


def simulate(
    recording: Recording, wire_format: Format, target: Target, stand: bool, noisy: bool, faults: Faults
) -> None:
    """Open the lines and play the recording on them."""
    start_s = min(float(data.time_s[0]) for data in recording.sensors.values())
    count = len(recording.sensors)
    # Sensors besides the six have the ids after theirs.
    ids = [0] * count if wire_format.single_device else [*wire_format.ids][:count]
    ids += range(max(ids) + 1, max(ids) + 1 + count - len(ids))
    if faults.duplicate_id:
        ids[1] = ids[0]
    encoders = [wire_format.encoder() for _ in range(count if wire_format.single_device else 1)]
    sensors = []
    for i, (name, data) in enumerate(recording.sensors.items()):
        sensor = Sensor(SENSORS.index(name), data, start_s, noisy, encoders[i % len(encoders)])
        sensor.prepare(wire_format, ids[i])
        sensors.append(sensor)
    lines = open_lines(wire_format, target, count)
    print_lines(wire_format, target, lines)
    try:
        Player(sensors, lines, wire_format, faults).play(stand)
    finally:
        for line in lines:
            line.close()


@click.command(help=__doc__)
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--stand", is_flag=True, help="Repeat the first sample until a line arrives on standard input.")
@click.option("--protocol", type=click.Choice(list(PROTOCOLS)), default="native", show_default=True)
@click.option(
    "--can", "bus", metavar="INTERFACE:CHANNEL", help="Send CAN frames here  [default: slcan on a pty]"
)
@click.option(
    "--udp",
    metavar="HOST:PORT",
    callback=parse_udp,
    help="Send datagrams here, several senders from 127.0.0.11 on.",
)
@click.option("--tcp", metavar="HOST", help="Be a TCP server at this address for each line.")
@click.option("--ble", is_flag=True, help="Be Movella DOT sensors on a simulated BlueZ; for --protocol dot.")
@click.option("--loss", type=click.FloatRange(0, 1), default=0.0, help="Share of packets that are lost.")
@click.option(
    "--corrupt", type=click.FloatRange(0, 1), default=0.0, help="Share of packets with a wrong bit."
)
@click.option(
    "--jitter",
    type=click.FloatRange(0),
    default=0.0,
    metavar="MS",
    help="Delay packets at random by up to this time.",
)
@click.option("--drift", type=float, default=0.0, metavar="PPM", help="Let the clocks drift by -PPM to PPM.")
@click.option(
    "--kill",
    multiple=True,
    callback=parse_kill,
    metavar="SENSOR@T..T",
    help="Silence a sensor between two times, seconds since `started`.",
)
@click.option(
    "--exercises", is_flag=True, help="Precede a clip by the exercises of calibrate --heading-reset motion."
)
@click.option(
    "--mounting",
    type=int,
    metavar="SEED",
    help="Mount the sensors of a clip at random angles.",
)
@click.option(
    "--raw",
    type=click.Choice(["6", "9"]),
    help="No orientations, only rates and forces of a BMI270 with noise and bias; 9 adds a magnetometer.",
)
@click.option("--ideal", is_flag=True, help="Add no noise while the recording is played.")
@click.option("--seed", type=int, default=0, help="Seed of the errors of --raw.")
@click.option(
    "--write",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write an .npz file and send nothing.",
)
@click.option("--duplicate-id", is_flag=True, help="Give the second sensor the id of the first.")
def main(
    recording: Path,
    stand: bool,
    protocol: str,
    bus: str | None,
    udp: tuple[str, int] | None,
    tcp: str | None,
    ble: bool,
    loss: float,
    corrupt: float,
    jitter: float,
    drift: float,
    kill: tuple[tuple[int, float, float], ...],
    exercises: bool,
    mounting: int | None,
    raw: str | None,
    ideal: bool,
    seed: int,
    write: Path | None,
    duplicate_id: bool,
) -> None:
    """Run the command line."""
    wire_format = PROTOCOLS[protocol]
    if bus is not None and wire_format.transport != "can":
        raise click.UsageError(f"{protocol} is not a CAN protocol")
    if (udp or tcp) and wire_format.transport == "can":
        raise click.UsageError(f"{protocol} is a CAN protocol")
    if udp and tcp:
        raise click.UsageError("give --udp or --tcp, not both")
    if ble and (protocol != "dot" or udp or tcp):
        raise click.UsageError("--ble is for --protocol dot, without --udp and --tcp")
    if wire_format.transport in ("udp", "hid") and not udp and not ble:
        raise click.UsageError(f"{protocol} needs --udp HOST:PORT")
    if corrupt and wire_format.transport == "can":
        raise click.UsageError("CAN controllers drop frames with wrong bits; use --loss")
    if duplicate_id and wire_format.single_device:
        raise click.UsageError(f"{protocol} has one sensor per line, so ids cannot clash")
    # Shells start background programs with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        played = read_input(recording, Rig(exercises, mounting, None if raw is None else int(raw), seed))
        if write is not None:
            write_npz(write, played)
            return
        noisy = not ideal and raw is None  # chips without a filter have their own noise
        faults = Faults(loss, corrupt, jitter, drift, kill, duplicate_id)
        simulate(played, wire_format, Target(bus, udp, tcp, ble), stand, noisy, faults)
    except EdgeposeError as error:
        raise click.ClickException(str(error)) from error
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
