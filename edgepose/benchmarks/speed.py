"""How long each step of the walk takes on this machine, and how fast the networks are against torch's own.

Made-up sensors, one process, one core. Costs are processor time, which other programs disturb least; the
percentiles are times of the clock, what a wearer waits for.
"""

from __future__ import annotations

import gc
import json
import os
import platform
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from math import cos, sin
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from edgepose.calibration import GRAVITY, Calibration, apply_calibration
from edgepose.calibration.rezero import HeadingRezero
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuFrame, ImuSample
from edgepose.inference import archive
from edgepose.inference.engine import Engine, StreamEngine, WindowEngine
from edgepose.inference.features import INPUTS
from edgepose.inference.quantisation import PRECISIONS, quantise_weights
from edgepose.orientation import OrientationEstimator
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.pipeline.run import run
from edgepose.pipeline.wearer_pipeline import WearerPipeline, pose_frame
from edgepose.placements import PLACEMENTS
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.udp import UdpSink, encode_binary, encode_json
from edgepose.sources import Batch
from firmware_protocols.registry import PROTOCOLS, Decoder
from firmware_protocols.sample import Sample

RATE = 60.0
BUDGET_US = 1e6 / RATE

_SENSOR_HZ = 100
_SECONDS = 10
_PACED_S = 5
_ROUNDS = 7
_FRAMES = {"stream": 100, "window": 20}
"""Frames a round; medians over rounds are told."""

_DIP_OUTPUTS = 150
"""Means of 15 rotation matrices and 5 accelerations; as many deviations (DIP appendix B)."""

Item = TypeVar("Item")
Result = TypeVar("Result")


# --- made-up sensors ----------------------------------------------------------------------------------------


def _chunks() -> list[bytes]:
    """What six sensors send on one line, a chunk each 1/60 s."""
    encode = PROTOCOLS["native"].encode
    chunks = [b""] * (int(RATE) * _SECONDS + 1)
    for seq in range(_SENSOR_HZ * _SECONDS):
        time_s = seq / _SENSOR_HZ
        half = 0.3 * sin(2.0 * time_s)
        turn = (cos(half), 0.6 * sin(half), 0.0, 0.8 * sin(half))
        for sensor in range(len(PLACEMENTS)):
            force, rate, field = (
                (0.1 * sensor, 0.2, GRAVITY),
                (0.36 * cos(2.0 * time_s), 0.0, 0.0),
                (20.0, 0.0, -40.0),
            )
            chunks[int(time_s * RATE)] += encode(
                Sample(sensor, 1_000_000 + int(1e6 * time_s), turn, force, rate, field), seq
            )
    return chunks


def _decode(decoder: Decoder, chunk: bytes) -> list[ImuSample]:
    return [
        ImuSample(sensor, 1e-6 * (time_us or 0), quat, acc, gyr, mag)
        for sensor, time_us, quat, acc, gyr, mag, _ in decoder.feed(chunk)
    ]


def _calibration() -> Calibration:
    """All sensors on their bones as in the T-pose."""
    none = np.tile([1.0, 0.0, 0.0, 0.0], (len(PLACEMENTS), 1))
    up = np.array([0.5, -0.5, -0.5, -0.5])  # T's Y is I's Z
    zero = np.zeros(len(PLACEMENTS))
    return Calibration(up, zero, none, zero, "t-pose", "heading:0", "", {})


# --- steps --------------------------------------------------------------------------------------------------


def _each(step: Callable[[Item], Result], items: Iterable[Item]) -> tuple[list[Result], float]:
    """What a step makes of some items, and microseconds of processor time it took in all."""
    items = list(items)
    started = time.process_time()
    results = [step(item) for item in items]
    return results, 1e6 * (time.process_time() - started)


def step_costs(engine: Engine, folder: Path) -> dict[str, float]:
    """Microseconds of processor time a frame of every step, sensors at 100 Hz.

    Args:
        engine: makes the poses.
        folder: to write into.
    """
    decoder, clock = PROTOCOLS["native"].decoder(), FrameSynchronizer(RATE)
    headings, orienter = HeadingRezero(_calibration()), OrientationEstimator("kalman")

    def to_frames(samples: list[ImuSample]) -> list[ImuFrame]:
        clock.push(samples, samples[-1].time_s)
        return clock.frames(samples[-1].time_s)

    def calibrated(frame: ImuFrame) -> tuple[ImuFrame, Any, Any]:
        calibration = headings.calibration_for(frame)
        assert calibration is not None, "the headings are known"
        return frame, *apply_calibration(calibration, frame.orientation, frame.force)

    costs = {}
    samples, costs["decode"] = _each(lambda chunk: _decode(decoder, chunk), _chunks())
    samples = [some for some in samples if some]
    _, costs["filter, where sensors send none"] = _each(orienter.orient, samples)
    made, costs["frames"] = _each(to_frames, samples)
    bodies, costs["calibration"] = _each(calibrated, [frame for frames in made for frame in frames])
    outputs, costs["network"] = _each(lambda body: engine.push(*body), bodies)
    poses = [pose_frame(output) for some in outputs for output in some]
    _, costs["UDP binary, not yet sent"] = _each(encode_binary, poses)
    _, costs["UDP JSON, not yet sent"] = _each(encode_json, poses)
    with CsvSink(folder / "poses.csv") as sink:
        _, costs["CSV"] = _each(sink.write, poses)
    return {name: cost / len(bodies) for name, cost in costs.items()}


class Latency(NamedTuple):
    """From the arrival of a frame's packets to its pose's being sent, milliseconds.

    Attributes:
        p50_ms: median.
        p99_ms: 99 of 100 are shorter.
        max_ms: the longest.
        frames: how many were measured.
        per_s: frames a second.
    """

    p50_ms: float
    p99_ms: float
    max_ms: float
    frames: int
    per_s: float


def whole_walk(engine: Engine, paced: bool) -> Latency:
    """Runs packets to datagrams through all steps, at full speed or at 60 frames a second."""
    decoder = PROTOCOLS["native"].decoder()
    chunks = _chunks()[: int(RATE) * _PACED_S] if paced else _chunks()

    def source() -> Iterator[Batch]:
        started = time.perf_counter()
        for k, chunk in enumerate(chunks):
            if paced:
                time.sleep(max(0.0, started + k / RATE - time.perf_counter()))
            arrived = time.perf_counter()
            samples = _decode(decoder, chunk)
            now_s = samples[-1].time_s if samples else 0.0
            yield Batch(now_s, samples, backlog_s=time.perf_counter() - arrived)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        with UdpSink("127.0.0.1", listener.getsockname()[1], "binary") as sink:
            summary = run(
                WearerPipeline(FrameSynchronizer(RATE), HeadingRezero(_calibration()), [sink]),
                source(),
                engine,
            )
    if summary.error:
        raise summary.error
    p50, p99, most = np.percentile(np.array(summary.latencies_s) * 1e3, [50, 99, 100])
    return Latency(p50, p99, most, summary.poses, summary.poses / summary.seconds)


# --- networks -----------------------------------------------------------------------------------------------


class Speed(NamedTuple):
    """One way of running a model.

    Attributes:
        model: its name.
        mode: "stream", "window", or "reference": `torch.nn.LSTM` of the same size in torch's defaults, a
            window of past, present and future for each frame or, of a unidirectional model, a step; network
            alone, without what comes before and after it.
        precision: of the weights.
        us: processor time a frame, microseconds.
        p50_us: of the clock.
        p99_us: of the clock.
        max_us: of the clock.
        times: how many times faster than the reference, rounds compared one by one.
    """

    model: str
    mode: str
    precision: str
    us: float
    p50_us: float
    p99_us: float
    max_us: float
    times: float


class _Reference(nn.Module):
    """The papers' network as everybody writes it."""

    def __init__(self, hidden: int, both: bool) -> None:
        super().__init__()
        self.dense = nn.Linear(INPUTS, hidden)
        self.lstm = nn.LSTM(hidden, hidden, num_layers=2, batch_first=True, bidirectional=both)
        self.heads = nn.Linear(hidden * (2 if both else 1), 2 * _DIP_OUTPUTS)

    def forward(self, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        x, state = self.lstm(torch.relu(self.dense(x)), state)
        return self.heads(x), state


def _reference(about: dict[str, Any]) -> Callable[[], object]:
    both = about["kind"] == "birnn"
    module = _Reference(about["hidden"], both)
    x = torch.randn(1, about["past"] + 1 + about["future"] if both else 1, INPUTS)
    carried: list[Any] = [None]

    def step() -> None:
        torch.backends.mkldnn.enabled = True  # type: ignore[assignment]  # torch's default
        with torch.inference_mode():
            _, state = module(x, carried[0])
        torch.backends.mkldnn.enabled = False  # type: ignore[assignment]  # as `archive.load` sets it
        if not both:
            carried[0] = state

    for _ in range(5):
        step()
    return step


def load_engine(info: archive.ArchiveInfo, trust: bool, precision: str, mode: str = "stream") -> Engine:
    """A model ready to run in its default past and future, with what is alive put aside as `run` does."""
    module = archive.load(info, trust)
    quantise_weights(module, info, precision)
    kind = StreamEngine if mode == "stream" else WindowEngine
    engine = kind(module, info.metadata["past"], info.metadata["future"])
    gc.collect()
    gc.freeze()
    return engine


def model_speeds(info: archive.ArchiveInfo, trust: bool) -> list[Speed]:
    """Speeds of a model in all its modes and precisions that this machine has; the reference comes first."""
    about = info.metadata
    stored = str(about.get("precision", "f32"))
    ways: dict[tuple[str, str], Callable[[], object]] = {}
    if about["kind"] in ("birnn", "rnn"):
        ways["reference", "f32"] = _reference(about)
    orientation, acceleration = np.tile(np.eye(3), (len(PLACEMENTS), 1, 1)), np.zeros((len(PLACEMENTS), 3))
    for mode in ("stream", "window") if about["kind"] == "birnn" else ("stream",):
        for precision in PRECISIONS if stored == "f32" else (stored,):
            try:
                engine = load_engine(info, trust, precision, mode)
            except EdgeposeError:
                if precision == stored:
                    raise
                continue  # not on this machine, or not in this kind of network
            for _ in range(about["past"] + about["future"]):
                engine.push(None, orientation, acceleration)
            ways[mode, precision] = partial(engine.push, None, orientation, acceleration)
    costs: dict[tuple[str, str], list[float]] = {way: [] for way in ways}
    clocks: dict[tuple[str, str], list[float]] = {way: [] for way in ways}
    for _ in range(_ROUNDS):
        for way, step in ways.items():
            frames = _FRAMES["stream" if way[0] == "stream" else "window"]
            started = time.process_time()
            for _ in range(frames):
                began = time.perf_counter()
                step()
                clocks[way].append(1e6 * (time.perf_counter() - began))
            costs[way].append(1e6 * (time.process_time() - started) / frames)
    base = next(iter(costs.values()))
    rows = []
    for way, own in costs.items():
        times = statistics.median(one / other for one, other in zip(base, own, strict=True))
        p50, p99, most = np.percentile(clocks[way], [50, 99, 100])
        rows.append(Speed(info.path.stem, *way, statistics.median(own), p50, p99, most, times))
    return rows


# --- start --------------------------------------------------------------------------------------------------


class Start(NamedTuple):
    """What a fresh process takes until a model is ready to run.

    Attributes:
        imports_s: importing edgepose's steps with numpy and torch, seconds.
        load_s: loading, packing and warming up the model, seconds.
        memory_mb: resident then, megabytes; None where the system does not tell.
    """

    imports_s: float
    load_s: float
    memory_mb: float | None


_FRESH = """
import json, sys, time
started = time.perf_counter()
from edgepose.benchmarks import speed
imported = time.perf_counter()
engine = speed.load_engine(speed.archive.read_info(speed.Path(sys.argv[1])), True, "auto")
print(json.dumps([imported - started, time.perf_counter() - imported, speed.memory_mb()]))
"""


def start_up(info: archive.ArchiveInfo, trust: bool) -> Start:
    """Starts a process that loads a model.

    Raises:
        EdgeposeError: the model is not trusted, or the process fails.
    """
    if not (info.trusted or trust):
        archive.load(info)  # says why not
    words = [sys.executable, "-c", _FRESH, str(info.path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise EdgeposeError(f"{info.path}: a fresh process cannot load it: {done.stderr.strip()[-200:]}")
    return Start(*json.loads(done.stdout))


def memory_mb() -> float | None:
    """Resident memory of this process, megabytes, where /proc tells."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def machine() -> dict[str, str]:
    """What the figures were made on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    python = ".".join(map(str, sys.version_info[:3]))
    return {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "python": python,
        "torch": torch.__version__,
    }
