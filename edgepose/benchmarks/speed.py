"""Speed of each pipeline step on this machine, and of the networks compared with torch's own LSTM.

Simulated sensors, one process, one core. Costs are processor time, which other programs disturb least;
percentiles are wall-clock time, which is what a wearer waits for.
"""

from __future__ import annotations

import gc
import platform
import socket
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from edgepose.benchmarks.simulated import SENSOR_HZ, calibration, packet
from edgepose.calibration import apply_calibration
from edgepose.calibration.rezero import HeadingRezero
from edgepose.errors import EdgeposeError
from edgepose.imu import ImuFrame, ImuSample
from edgepose.inference import archive, loading
from edgepose.inference.engine import Engine, StreamEngine, WindowEngine
from edgepose.inference.features import INPUTS
from edgepose.inference.quantisation import PRECISIONS
from edgepose.orientation import OrientationEstimator
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.pipeline.place_stage import PlaceStage
from edgepose.pipeline.run import run
from edgepose.pipeline.wearer_pipeline import WearerPipeline, pose_frame
from edgepose.placements import PLACEMENTS
from edgepose.sinks.csv import CsvSink
from edgepose.sinks.udp import UdpSink, encode_binary, encode_json
from edgepose.skeleton import default_body
from edgepose.sources import Batch
from firmware_protocols.registry import PROTOCOLS, Decoder

RATE = 60.0
BUDGET_US = 1e6 / RATE

_SECONDS = 10
_ROUNDS = 7
_FRAMES = {"stream": 100, "window": 20}
"""Frames per round; results are medians over rounds."""

_DIP_OUTPUTS = 150
"""Means of 15 rotation matrices and 5 accelerations; there are as many deviations (DIP appendix B)."""

NUMPY = "f32, numpy"
"""The network in numpy among the precisions of the network in torch."""

Item = TypeVar("Item")
Result = TypeVar("Result")


# --- simulated sensors --------------------------------------------------------------------------------------


def _chunks() -> list[bytes]:
    """Return the bytes of six sensors on one line, one chunk per 1/60 s."""
    chunks = [b""] * (int(RATE) * _SECONDS + 1)
    for number in range(SENSOR_HZ * _SECONDS):
        time_s = number / SENSOR_HZ
        chunks[int(time_s * RATE)] += b"".join(packet(i, number, time_s) for i in range(len(PLACEMENTS)))
    return chunks


def _decode(decoder: Decoder, chunk: bytes) -> list[ImuSample]:
    return [
        ImuSample(sensor, 1e-6 * (time_us or 0), quat, acc, gyr, mag)
        for sensor, time_us, quat, acc, gyr, mag, _ in decoder.feed(chunk)
    ]


# --- steps --------------------------------------------------------------------------------------------------


def _timed(step: Callable[[Item], Result], items: Iterable[Item]) -> tuple[list[Result], float]:
    """Run a step on each item; return the results and the total processor time, microseconds."""
    items = list(items)
    started = time.process_time()
    results = [step(item) for item in items]
    return results, 1e6 * (time.process_time() - started)


def step_costs(engine: Engine, folder: Path) -> dict[str, float]:
    """Measure the processor time of every step per frame, microseconds, with sensors at 100 Hz.

    Args:
        engine: runs the network.
        folder: for the CSV output.
    """
    decoder, clock = PROTOCOLS["native"].decoder(), FrameSynchronizer(RATE)
    headings, orienter = HeadingRezero(calibration()), OrientationEstimator("kalman")
    place = PlaceStage(default_body())

    def to_frames(samples: list[ImuSample]) -> list[ImuFrame]:
        clock.push(samples, samples[-1].time_s)
        return clock.frames(samples[-1].time_s)

    def calibrated(frame: ImuFrame) -> tuple[ImuFrame, Any, Any]:
        found = headings.calibration_for(frame)
        assert found is not None, "without hold_first there is always one"
        return frame, *apply_calibration(found, frame.orientation, frame.force)

    costs = {}
    samples, costs["decode"] = _timed(lambda chunk: _decode(decoder, chunk), _chunks())
    samples = [batch for batch in samples if batch]
    _, costs["filter, where sensors send none"] = _timed(orienter.orient, samples)
    batches, costs["frames"] = _timed(to_frames, samples)
    bodies, costs["calibration"] = _timed(calibrated, [frame for frames in batches for frame in frames])
    batches_of_poses, costs["network"] = _timed(lambda body: engine.push(*body), bodies)
    outputs = [output for batch in batches_of_poses for output in batch]
    poses, costs["place"] = _timed(lambda output: place.add_to(pose_frame(output), output), outputs)
    _, costs["UDP binary, not yet sent"] = _timed(encode_binary, poses)
    _, costs["UDP JSON, not yet sent"] = _timed(encode_json, poses)
    with CsvSink(folder / "poses.csv") as sink:
        _, costs["CSV"] = _timed(sink.write, poses)
    return {name: cost / len(bodies) for name, cost in costs.items()}


class Latency(NamedTuple):
    """Time from the arrival of a frame's packets until its pose is sent, milliseconds.

    Attributes:
        p50_ms: median.
        p99_ms: 99th percentile.
        max_ms: longest.
        frames: number of measured frames.
        per_s: frames a second.
    """

    p50_ms: float
    p99_ms: float
    max_ms: float
    frames: int
    per_s: float


def whole_walk(engine: Engine) -> Latency:
    """Run packets through all steps to datagrams at full speed."""
    decoder = PROTOCOLS["native"].decoder()

    def source() -> Iterator[Batch]:
        for chunk in _chunks():
            arrived = time.perf_counter()
            samples = _decode(decoder, chunk)
            now_s = samples[-1].time_s if samples else 0.0
            yield Batch(now_s, samples, backlog_s=time.perf_counter() - arrived)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        with UdpSink("127.0.0.1", listener.getsockname()[1], "binary") as sink:
            summary = run(
                WearerPipeline(calibration(), RATE, [sink], place=PlaceStage(default_body())),
                source(),
                engine,
            )
    if summary.error:
        raise summary.error
    p50, p99, most = np.percentile(np.array(summary.latencies_s) * 1e3, [50, 99, 100])
    return Latency(p50, p99, most, summary.poses, summary.poses / summary.seconds)


# --- networks -----------------------------------------------------------------------------------------------


class Speed(NamedTuple):
    """Speed of a model in one mode and precision.

    Attributes:
        model: its name.
        mode: "stream", "window", or "reference": a `torch.nn.LSTM` of the same size with torch's defaults.
            The reference runs the network only, without pre- and postprocessing: for each frame over a window
            of past, present and future, or one step if the model is unidirectional.
        precision: of the weights; `NUMPY` is f32 without torch.
        us: processor time per frame, microseconds.
        p50_us: median wall-clock time.
        p99_us: 99th percentile of the wall-clock time.
        max_us: longest wall-clock time.
        times: speed relative to the reference, median over pairs of rounds.
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
    """The papers' network in its usual torch implementation."""

    def __init__(self, hidden: int, both: bool) -> None:
        super().__init__()
        self.dense = nn.Linear(INPUTS, hidden)
        self.lstm = nn.LSTM(hidden, hidden, num_layers=2, batch_first=True, bidirectional=both)
        self.heads = nn.Linear(hidden * (2 if both else 1), 2 * _DIP_OUTPUTS)

    def forward(self, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        x, state = self.lstm(torch.relu(self.dense(x)), state)
        return self.heads(x), state


def _reference(about: dict[str, Any]) -> Callable[[], object]:
    both = archive.is_windowed(about)
    module = _Reference(about["hidden"], both)
    x = torch.randn(1, about["past"] + 1 + about["future"] if both else 1, INPUTS)
    carried: list[Any] = [None]  # state of a unidirectional network

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
    """Load a model with its default past and future, and freeze the garbage collector as `run` does.

    Args:
        info: the archive.
        trust: load it although its checksum is unknown.
        precision: of the weights, or `NUMPY`.
        mode: "stream" or "window".
    """
    runtime, precision = ("numpy", "f32") if precision == NUMPY else ("torch", precision)
    module = loading.load(info, trust, runtime, precision).module
    kind = StreamEngine if mode == "stream" else WindowEngine
    place = archive.has_place(info.metadata)
    engine = kind(module, info.metadata["past"], info.metadata["future"], place=place)
    gc.collect()
    gc.freeze()
    return engine


def model_speeds(info: archive.ArchiveInfo, trust: bool) -> list[Speed]:
    """Measure a model in all its modes and all precisions of this machine; the reference comes first."""
    about = info.metadata
    stored = str(about.get("precision", "f32"))
    ways: dict[tuple[str, str], Callable[[], object]] = {}
    if about["kind"] in ("birnn", "rnn"):
        ways["reference", "f32"] = _reference(about)
    orientation, acceleration = np.tile(np.eye(3), (len(PLACEMENTS), 1, 1)), np.zeros((len(PLACEMENTS), 3))
    for mode in ("stream", "window") if archive.is_windowed(about) else ("stream",):
        for precision in (*PRECISIONS, NUMPY) if stored == "f32" else (stored,):
            try:
                engine = load_engine(info, trust, precision, mode)
            except EdgeposeError:
                if precision == stored:
                    raise
                continue  # not supported by this machine, by this kind of network, or by an old archive
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
                step_started = time.perf_counter()
                step()
                clocks[way].append(1e6 * (time.perf_counter() - step_started))
            costs[way].append(1e6 * (time.process_time() - started) / frames)
    base = next(iter(costs.values()))
    rows = []
    for way, cost in costs.items():
        times = statistics.median(reference / us for reference, us in zip(base, cost, strict=True))
        p50, p99, most = np.percentile(clocks[way], [50, 99, 100])
        rows.append(Speed(info.path.stem, *way, statistics.median(cost), p50, p99, most, times))
    return rows


# --- machine -----------------------------------------------------------------------------------------------


def machine() -> dict[str, str]:
    """Describe the machine: processor, Python and torch versions."""
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
