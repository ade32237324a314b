"""Setup of one wearer's run, from opening the source to the closing summary."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime
from functools import partial
from math import inf
from typing import TYPE_CHECKING

import edgepose
from edgepose.calibration import load_calibration
from edgepose.calibration.misfit import MisfitDetector
from edgepose.calibration.rezero import HeadingRezero
from edgepose.config import WearerConfig
from edgepose.diagnostics.rig_monitor import RigMonitor
from edgepose.errors import FileFormatError, prefix_errors
from edgepose.pipeline.calibrated_settings import age_days, check_settings, with_calibrated_settings
from edgepose.pipeline.frame_synchronizer import FrameSynchronizer
from edgepose.pipeline.network import Network
from edgepose.pipeline.place_stage import PlaceStage
from edgepose.pipeline.pose_resampler import PoseResampler
from edgepose.pipeline.remote_control import Request, Requests
from edgepose.pipeline.rig_comparison import changes, missing_heading_reset, missing_quantities, unlike_six
from edgepose.pipeline.run_report import RunReport, known_before, latency
from edgepose.pipeline.wearer_pipeline import RunSummary, WearerPipeline, orientation_stage
from edgepose.sinks.open import open_outputs
from edgepose.sources import open_source
from edgepose.sources.live import unix_now
from edgepose.sources.sensor_map import read_map

if TYPE_CHECKING:
    from edgepose.calibration import Calibration
    from edgepose.sinks.base import Sink

Notify = Callable[[str], None]
"""Shows a line to the user."""


class OpenWearer:
    """A wearer whose source is open.

    Attributes:
        source: the wearer's open source.
        notify: reports something about the wearer.
    """

    def __init__(
        self,
        stack: ExitStack,
        config: WearerConfig,
        calibration: Calibration,
        by_key: Callable[[], list[Request]],
        blocking: bool,
        notify: Notify,
    ) -> None:
        """Open the source.

        Args:
            stack: closes the source and the control socket.
            config: the wearer's configuration, see `load_wearer`.
            calibration: the wearer's calibration, see `load_wearer`.
            by_key: returns the requests from the keyboard.
            blocking: see `edgepose.sources.open_source`.
            notify: called with each line for the user.

        Raises:
            EdgeposeError: the source cannot be opened, or the filter or control address is not available.
        """
        self.notify = _with_name(config.name, notify)
        self._clock: FrameSynchronizer | None = None
        self._config, self._calibration = config, calibration
        with prefix_errors(config.name):
            sensors = config.source.sensors
            self._sensor_map = None if sensors is None else read_map(sensors)
            without = calibration.without
            self.source = stack.enter_context(
                open_source(
                    **config.source.arguments(),
                    blocking=blocking,
                    wanted=self._next_ready_s,
                    without=without,
                )
            )
            self._requests = Requests(stack, config.control, by_key)
            self._orient = orientation_stage(calibration)
        self._sinks: list[Sink] = []

    def open_outputs(self, stack: ExitStack, network: Network, stopped: Callable[[], bool]) -> None:
        """Open the outputs.

        Args:
            stack: closes them.
            network: the network that makes the poses.
            stopped: whether the run is to end, see `SinkContext`.

        Raises:
            EdgeposeError: an output cannot be written to.
        """
        with prefix_errors(self._config.name):
            about = {
                "model": network.config.model,
                "calibration": str(self._config.calibration),
                "source": self._config.source.name,
                "date": datetime.now().astimezone().isoformat(" ", "minutes"),
                "edgepose": edgepose.__version__,
                **({"without": ", ".join(lacking)} if (lacking := self._calibration.without) else {}),
            }
            self._sinks = open_outputs(
                *(stack, self._config.outputs, self._config.outputs.rate or network.rate_hz, stopped),
                translation=not self._config.no_place,
                contacts=not self._config.no_place and network.has_place,
                wearer=self._config.name,
                about=about,
                clock=unix_now if self._config.source.file is None else None,
                paced=self._config.source.live,
                press=self._requests.press if self._config.source.live else None,
            )

    def pipeline(
        self,
        rate: float,
        future: int,
        several: bool,
        on_pose: Callable[[RunSummary], None],
        phase: float = 0.0,
        wearers: int = 1,
    ) -> WearerPipeline:
        """Build the pipeline from samples to outputs.

        Args:
            rate: frames per second.
            future: the network's look-ahead, frames.
            several: align the ticks of live wearers, so that their poses can be compared and batched.
            on_pose: called after each pose.
            phase: see `RigMonitor`.
            wearers: number of wearers of this run.
        """
        source, outputs = self._config.source, self._config.outputs
        headings = HeadingRezero(
            self._calibration,
            hold_first=source.live and _restarts_with_filter(self._calibration),
            requests=self._rezero_requests,
            notify=self.notify,
        )
        place = None
        if not self._config.no_place:
            poll = partial(self._requests.poll, "origin")
            place = PlaceStage(outputs.body, poll, self.notify, self._calibration.without)
        pipeline = WearerPipeline(
            self._calibration,
            rate,
            self._sinks,
            grid=several and source.file is None,
            orient=self._orient,
            headings=headings,
            drift_correction=not self._config.no_drift_correction,
            notify=self.notify if source.live else lambda text: None,
            on_pose=on_pose,
            misfits=MisfitDetector(self._calibration, self._differences),
            rig=RigMonitor(self._calibration.names, phase, wearers if source.live else 1),
            warn=self.notify,
            look_ahead_s=future / rate if source.live else None,
            place=place,
            resampler=None if outputs.rate is None else PoseResampler(outputs.rate, rate),
        )
        self._clock = pipeline.clock
        return pipeline

    def _next_ready_s(self) -> float:
        return -inf if self._clock is None else self._clock.next_ready_s()

    def _rezero_requests(self) -> list[float]:
        if self._config.no_place and self._requests.poll("origin"):
            self.notify("reset of the place ignored: this run has --no-place")
        return self._requests.poll("rezero")

    def _differences(self) -> list[str]:
        devices = self.source.devices
        return [
            *changes(self._calibration, devices, self._sensor_map),
            *missing_heading_reset(self._calibration, devices),
            *missing_quantities(self._calibration, [], self._orient.without_field),
        ]

    def report(self, pipeline: WearerPipeline, rate: float, future: int) -> RunReport:
        """Return the report on a finished pipeline, with the error that ended it, if any."""
        config, summary = self._config, pipeline.summary
        notes = [
            *self._orient.summary_lines(),
            *(line for sink in self._sinks for line in sink.summary_lines()),
        ]
        if config.outputs.rate is not None:
            notes.insert(0, f"rate     written at {config.outputs.rate:g} poses per second")
        damage = FileFormatError(self.source.damage) if self.source.damage else None
        return RunReport(
            **known_before(config),
            summary=summary,
            packets=self.source.counters,
            late=pipeline.clock.dropped,
            skipped=pipeline.skipped,
            restarts=pipeline.clock.restarts,
            latency=latency(summary, future / rate) if config.source.live else None,
            look_ahead_frames=future,
            notes=(*notes, *self._requests.summary_lines()),
            error=summary.error or damage,
        )


def load_wearer(config: WearerConfig, notify: Notify) -> tuple[WearerConfig, Calibration]:
    """Load a wearer's calibration; return it, and the configuration with the settings that it knows.

    Raises:
        EdgeposeError: it cannot be read, or was made with another orientation filter than the run's.
    """
    calibration = load_calibration(config.calibration)
    with prefix_errors(config.name):
        lines = check_settings(calibration, config.filter, config.no_mag, config.outputs.height)
    made_from = calibration.metadata.get("source")
    if not config.source.live and _restarts_with_filter(calibration) and made_from != config.source.name:
        lines.append(
            f"the calibration was made from {made_from}, and headings of a filter without magnetometers "
            "start from scratch in each recording: calibrate from this one"
        )
    for line in lines:
        _with_name(config.name, notify)(f"warning: {line}")
    if (rig := unlike_six(calibration)) is not None:
        _with_name(config.name, notify)(rig)
    if config.source.live and (days := age_days(calibration)) >= 1:
        _with_name(config.name, notify)(
            f"the calibration is {days} day{'s' if days > 1 else ''} old: calibrate again if a sensor was "
            "taken off since"
        )
    return with_calibrated_settings(config, calibration), calibration


def _restarts_with_filter(calibration: Calibration) -> bool:
    """Whether headings start from scratch in each run: a filter runs here, without magnetometers."""
    return calibration.filter != "none" and not calibration.north


def _with_name(name: str, notify: Notify) -> Notify:
    """Prefix reports with the wearer's name, if there is one."""
    return lambda text: notify(f"{name}: {text}" if name else text)
