"""`edgepose run`: the main job."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from edgepose.cli.conflicts import check_all_files
from edgepose.cli.options.wearer import rig_options
from edgepose.cli.terminal.keys import Keys
from edgepose.cli.terminal.messages import end_status, has_terminal, say, status
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.errors import EdgeposeError
from edgepose.inference.quantisation import CHOICES, quantise_weights

if TYPE_CHECKING:
    import torch

    from edgepose.config import WearerConfig
    from edgepose.inference.engine import Engine, MultiWearerEngine
    from edgepose.pipeline.build import OpenWearer
    from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline


@rig_options
@click.command(short_help="Turn sensor data into poses.")
@click.option(
    "--model",
    default="birnn",
    show_default=True,
    help="Shipped model (see `edgepose models`) or an archive's path.",
)
@click.option(
    "--trust", is_flag=True, help="Load --model although its sum is not known: you vouch for the code in it."
)
@click.option(
    "--online",
    type=click.Choice(["stream", "window"]),
    default="stream",
    show_default=True,
    help="How a bidirectional model runs: with its forward state carried on, or anew over a window for each "
    "frame, as in the paper (dearer). A unidirectional one always carries its state.",
)
@click.option(
    "--past",
    type=click.IntRange(0, 600),
    help="Frames before the present one that a window holds  [default: the model's]",
)
@click.option(
    "--future",
    type=click.IntRange(0, 120),
    help="Frames after the present one that a bidirectional model waits for; each adds 1/60 s of latency  "
    "[default: the model's]",
)
@click.option(
    "--precision",
    type=click.Choice(CHOICES),
    default="auto",
    show_default=True,
    help="Numbers that the model's weights are kept in: fewer bytes run faster. auto is fp16 on "
    "x86-64 and on ARM processors with asimdfhm, else f32 (Raspberry Pi); int8 is the fastest on x86-64 "
    "alone, about 0.2 deg from f32.",
)
def run(
    rigs: list[WearerConfig],
    model: str,
    trust: bool,
    online: str,
    past: int | None,
    future: int | None,
    precision: str,
) -> None:
    """Turn packets or a recording into poses until the source ends or Ctrl-C.

    On a live source, r or Enter on the terminal (or a message to --control) re-zeroes the headings: stand in
    the calibration pose once more.

    \b
    Examples:
      edgepose run --port /dev/ttyUSB0 --calibration calib.json --csv poses.csv --udp 127.0.0.1:9000
      edgepose run --port COM3 --calibration calib.json --model rnn --udp 10.0.0.5:9000,format=binary
      edgepose run --can socketcan:can0 --protocol hipnuc-canopen --calibration calib.json --csv poses.csv
      edgepose run --sensors rig.toml --calibration calib.json --udp 127.0.0.1:9000
      edgepose run --port /dev/ttyUSB0 --filter kalman --calibration calib.json --csv poses.csv
      edgepose run --file walk.csv --calibration calib.json --csv - | head
      edgepose run --rig anna.toml --rig ben.toml --model rnn
    """
    from edgepose.inference import archive
    from edgepose.pipeline.build import OpenWearer, load_wearer_calibration
    from edgepose.pipeline.remote_control import key_requests

    path = archive.find_archive(model)
    check_all_files(rigs, path)
    live, several = rigs[0].source.live, len(rigs) > 1
    if other := [rig.name for rig in rigs if rig.source.live != live]:
        raise click.UsageError(
            f"{rigs[0].name} and {other[0]}: beside sensors that send, a recording needs  realtime = true"
        )

    calibrations = [load_wearer_calibration(rig, say) for rig in rigs]
    info = archive.read_info(path)
    kind, rate = info.metadata["kind"], float(info.metadata["rate_hz"])
    past = info.metadata["past"] if past is None else past
    future = info.metadata["future"] if future is None else future
    windows = kind != "rnn" and online == "window"
    if kind == "rnn" and future:
        raise click.UsageError(f"{model} is unidirectional: --future must be 0")
    if several and windows:
        raise click.UsageError("--online window runs one wearer; use --online stream for several")
    with ExitStack() as stack:
        # Sources are opened before the model is loaded: a wrong port is told at once.
        keys = Keys()
        opened = [
            OpenWearer(stack, rig, calibration, by_key, not several, say)
            for rig, calibration, by_key in zip(
                rigs, calibrations, key_requests(len(rigs), keys.pressed), strict=True
            )
        ]
        if live:
            stack.enter_context(keys)
        module = archive.load(info, trust)
        precision = quantise_weights(module, info, precision, say)
        engine = _engine(module, past, future, rigs, windows, precision)
        stop = stack.enter_context(StopSignal())
        for rig in opened:
            rig.open_outputs(stack, rate, lambda: stop.asked)
        whose = f"{len(rigs)} wearers with " if several else ""
        hint = ", r re-zeroes headings" if keys.listening else ""
        say(
            f"running {whose}{model} ({kind}, {'window' if windows else 'stream'}) in {precision}; "
            f"Ctrl-C ends the run{hint}"
        )
        pipelines = _run_all(opened, engine, rate, live, stop)
    end_status()
    reports = [rig.report(pipeline, rate, future) for rig, pipeline in zip(opened, pipelines, strict=True)]
    failed = {rig.name: error for rig, error in zip(rigs, reports, strict=True) if error is not None}
    if several and failed:
        told = "; ".join(f"{name}: {error}" for name, error in failed.items())
        raise EdgeposeError(f"{len(failed)} of {len(rigs)} wearers failed: {told}") from next(
            iter(failed.values())
        )
    for error in failed.values():
        raise error


def _engine(
    module: torch.jit.ScriptModule,
    past: int,
    future: int,
    rigs: list[WearerConfig],
    windows: bool,
    precision: str,
) -> Engine | MultiWearerEngine:
    """What makes poses of these wearers' frames."""
    from edgepose.inference.engine import MultiWearerEngine, StreamEngine, WindowEngine

    # What int8 weights are multiplied with is scaled with all that is computed at once.
    apart = precision == "int8"
    if len(rigs) > 1:
        return MultiWearerEngine(module, past, future, len(rigs), apart)
    if windows:
        return WindowEngine(module, past, future)
    # Of a recording nobody waits for single poses.
    source = rigs[0].source
    recorded = not source.live and source.file is not None and source.file.is_file()
    many = recorded and not apart and hasattr(module, "stream_many")
    return StreamEngine(module, past, future, TOGETHER if many else 1)


def _run_all(
    opened: list[OpenWearer], engine: Engine | MultiWearerEngine, rate: float, live: bool, stop: StopSignal
) -> list[WearerPipeline]:
    """The wearers' pipelines, to their ends."""
    from edgepose.inference.engine import MultiWearerEngine
    from edgepose.pipeline.multi_wearer import POLL_S, Wearer, run_together
    from edgepose.pipeline.run import run as run_alone

    progress, nothing = _progress(), lambda summary: None
    several = isinstance(engine, MultiWearerEngine)
    pipelines = [rig.pipeline(rate, several, nothing if several else progress) for rig in opened]
    # What is alive now stays: going through all of it once in a while would hold up a frame by 0.1 s.
    gc.collect()
    gc.freeze()
    if isinstance(engine, MultiWearerEngine):
        wearers = [
            Wearer(rig.source, pipeline, rig.notify) for rig, pipeline in zip(opened, pipelines, strict=True)
        ]
        run_together(wearers, engine, POLL_S if live else 0.0, lambda: stop.asked, progress)
    else:
        run_alone(pipelines[0], opened[0].source, engine, lambda: stop.asked)
        pipelines[0].close()
    return pipelines


TOGETHER = 64
"""Frames of a recording that are computed at once."""

BEHIND_S = 1.0
"""A run that is further behind its sensors says so, seconds."""


def _progress() -> Callable[[RunSummary], None]:
    """A callback that keeps one line on a terminal up to date; elsewhere it writes a line now and then."""
    every_s = 1.0 if has_terminal() else 10.0
    shown_s, poses, told = time.monotonic(), 0, False

    def show(summary: RunSummary) -> None:
        nonlocal shown_s, poses, told
        now_s = time.monotonic()
        if summary.backlog_s > BEHIND_S and not told:
            told = True
            say(
                f"this machine does not keep up: poses are "
                f"{summary.backlog_s:.1f} s late; use --model rnn, --online stream, or end other programs"
            )
        if now_s - shown_s >= every_s:
            rate = (summary.poses - poses) / (now_s - shown_s)
            shown_s, poses = now_s, summary.poses
            status(f"{poses} poses, {rate:.0f} a second, {summary.held} with a held sensor")

    return show
