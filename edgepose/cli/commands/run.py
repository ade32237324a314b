"""`edgepose run`: turn sensor data into poses."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from edgepose.cli.conflicts import check_all_files, check_all_live
from edgepose.cli.options.gathered import usage_errors
from edgepose.cli.options.inputs import check_jobs
from edgepose.cli.options.json_result import check_standard_output, json_option, show_json
from edgepose.cli.options.network import network_options
from edgepose.cli.options.wearer import wearer_options
from edgepose.cli.terminal.keys import Keys
from edgepose.cli.terminal.messages import end_status, has_terminal, printable, say, status, warnings_to
from edgepose.cli.terminal.stop_signal import StopSignal
from edgepose.pipeline.network import Network, NetworkConfig

if TYPE_CHECKING:
    from edgepose.config import WearerConfig
    from edgepose.pipeline.build import OpenWearer
    from edgepose.pipeline.run_report import RunReport
    from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline

BEHIND_S = 1.0
"""Delay of the poses from which on the user is warned, seconds."""

MESSAGES = 1000
"""Messages kept for --json, the newest ones: a run may last for weeks."""


@wearer_options
@click.command()
@network_options
@click.option(
    "--jobs",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of processes for the recordings IN, each of which runs one at a time.",
)
@json_option
def run(
    wearers: list[WearerConfig], inputs: tuple[Path, ...], settings: NetworkConfig, jobs: int, as_json: bool
) -> None:
    """Turn packets or a recording into poses until the source ends or Ctrl-C.

    IN are recordings to run one after the other, without a source: files, patterns and folders. Outputs to
    files then name folders, and --calibration a file for all or a folder with one for each.

    During a live run, press r or Enter on the terminal (or send a message to --control) and stand in the
    calibration pose once more to re-zero the headings. Press o to put the wearer back at the origin of the
    room, on the ground.

    Flags of outputs may be given several times, such as --udp for two receivers. An output that fails ends
    alone, unless it is the only one.

    \b
    Examples:
      edgepose run --port /dev/ttyUSB0 --calibration calib.json --csv poses.csv
      edgepose run --port COM3 --calibration c.json --udp pc:9000 --udp pi:9000
      edgepose run --can socketcan:can0 --calibration calib.json --npz walk.npz
      edgepose run --sensors rig.toml --calibration calib.json --model rnn --view
      edgepose run --port COM3 --filter kalman --calibration calib.json --view
      edgepose run --file walk.csv --calibration calib.json --csv - | head
      edgepose run --rig anna.toml --rig ben.toml --model rnn
      edgepose run takes/ --calibration calibrations --csv poses --jobs 2
    """
    check_jobs(jobs, inputs)
    if as_json:
        for wearer in wearers:
            check_standard_output(wearer.outputs)
    with usage_errors():
        network = Network.read(settings, len(wearers))
    if inputs:
        from edgepose.cli.run_recordings import run_recordings

        run_recordings(inputs, wearers[0], network, jobs, as_json)
        return
    check_all_files(wearers, network.info.path)
    check_all_live(wearers)

    from edgepose.pipeline.run_wearers import raise_failures, report_wearers

    messages: deque[str] = deque(maxlen=MESSAGES)
    opened, pipelines = _run(wearers, network, messages)
    heard = list(messages)
    reports = report_wearers(opened, pipelines, network)
    if as_json:
        _show_json(network, reports, heard)
    raise_failures(reports)


def _run(
    wearers: list[WearerConfig], network: Network, messages: deque[str]
) -> tuple[list[OpenWearer], list[WearerPipeline]]:
    """Run all wearers until their sources end or the user stops them.

    Args:
        wearers: one or several.
        network: their network, not loaded yet.
        messages: gets everything that is said to the user.
    """
    from edgepose.pipeline.run_wearers import open_wearers, run_wearers

    live = wearers[0].source.live

    def notify(text: str) -> None:
        messages.append(printable(text))
        say(text)

    with ExitStack() as stack:
        stack.enter_context(warnings_to(messages.append, hidden=False))
        # Sources are opened before the model is loaded, so that a wrong port is reported at once.
        keys = Keys()
        opened = open_wearers(stack, wearers, keys.pressed, notify)
        if live:
            stack.enter_context(keys)
        ready = network.load(all(wearer.no_place for wearer in wearers), notify)
        engine = ready.engine_for_all(wearers)
        stop = stack.enter_context(StopSignal())
        for each in opened:
            each.open_outputs(stack, network, lambda: stop.asked)
        say(_headline(network, ready.precision, wearers, keys.listening))
        pipelines = run_wearers(opened, engine, network, live, lambda: stop.asked, _progress(network, notify))
    end_status()
    return opened, pipelines


def _show_json(network: Network, reports: Sequence[RunReport], messages: list[str]) -> None:
    runs = [report.values() for report in reports]
    show_json("run", {**network.values(), "messages": messages, "planned": len(runs), "runs": runs})


def _headline(network: Network, precision: str, wearers: list[WearerConfig], has_keys: bool) -> str:
    count = f"{len(wearers)} wearers with " if len(wearers) > 1 else ""
    mode = "window" if network.windowed else "stream"
    hint = ", r re-zeroes headings" if has_keys else ""
    if has_keys and not all(wearer.no_place for wearer in wearers):
        hint += ", o goes back to the origin"
    return (
        f"running {count}{network.config.model} ({network.kind}, {mode}) in {precision}; "
        f"Ctrl-C ends the run{hint}"
    )


def _progress(network: Network, notify: Callable[[str], None]) -> Callable[[RunSummary], None]:
    """Return a callback that updates one line on a terminal; elsewhere it writes a line every 10 s.

    Args:
        network: the network that runs.
        notify: called with one message if this machine does not keep up.
    """
    every_s = 1.0 if has_terminal() else 10.0
    shown_s, poses, warned = time.monotonic(), 0, False

    def show(summary: RunSummary) -> None:
        nonlocal shown_s, poses, warned
        now_s = time.monotonic()
        if summary.backlog_s > BEHIND_S and not warned:
            warned = True
            notify(
                f"this machine does not keep up: poses are {summary.backlog_s:.1f} s late; "
                f"{''.join(f'use {flag}, or ' for flag in network.faster)}end other programs"
            )
        if now_s - shown_s >= every_s:
            rate = (summary.poses - poses) / (now_s - shown_s)
            shown_s, poses = now_s, summary.poses
            line = f"{poses} poses, {rate:.0f} a second, {summary.held} with a held sensor"
            if summary.corrections_deg is not None:
                line += f", headings corrected up to {max(map(abs, summary.corrections_deg)):.0f} deg"
            status(line)

    return show
