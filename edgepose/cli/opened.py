"""A wearer of `edgepose run` from the opening of lines and files to what there is to say at the end."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from edgepose.cli.options.source import Orientations
from edgepose.cli.options.wearer import RigFlags
from edgepose.cli.rezero_requests import Wishes
from edgepose.cli.terminal.messages import say
from edgepose.errors import EdgeposeError, named
from edgepose.pipeline.rig_comparison import other_devices
from edgepose.placements import PLACEMENTS

if TYPE_CHECKING:
    from edgepose.calibration import Calibration
    from edgepose.pipeline.run import RunSummary, Walk
    from edgepose.sinks import Sink


class OpenRig:
    """A wearer whose source is open.

    Attributes:
        source: where the samples come from.
        say: says things of the wearer on stderr.
    """

    def __init__(
        self,
        stack: ExitStack,
        flags: RigFlags,
        calibration: Calibration,
        by_key: Callable[[], list[float]],
        waits: bool,
    ) -> None:
        """Opens the source.

        Args:
            stack: closes what is opened.
            flags: the wearer's.
            calibration: the wearer's, see `calibration_of`.
            by_key: wishes to re-zero that come by key.
            waits: see `edgepose.sources.open_source`.

        Raises:
            EdgeposeError: the source cannot be opened, or a filter or address is not to be had here.
        """
        self.say = voice(flags.name)
        self._flags, self._calibration = flags, calibration
        with named(flags.name):
            self.source = stack.enter_context(flags.source.open(waits=waits))
            self._wishes = Wishes(stack, flags.control, by_key)
            self._orient = Orientations(flags.filter, magnetometer=calibration.north)
        self._sinks: list[Sink] = []

    def open_outputs(self, stack: ExitStack, rate: float, stopped: Callable[[], bool]) -> None:
        """Opens the outputs.

        Args:
            stack: closes them.
            rate: poses a second.
            stopped: whether the run is to end, see `OutputFlags.open`.

        Raises:
            EdgeposeError: one cannot be written to.
        """
        with named(self._flags.name):
            self._sinks = self._flags.outputs.open(stack, rate, stopped)

    def walk(self, rate: float, several: bool, on_pose: Callable[[RunSummary], None]) -> Walk:
        """From samples to the outputs.

        Args:
            rate: frames a second.
            several: live wearers share their ticks: their poses can be compared, and steps of the network are
                full.
            on_pose: called after each pose.
        """
        from edgepose.calibration.misfit import Misfits
        from edgepose.calibration.rezero import Headings
        from edgepose.pipeline.frame_synchronizer import FrameClock
        from edgepose.pipeline.run import Walk

        source = self._flags.source
        headings = Headings(
            self._calibration,
            hold_first=source.live and _begins_anew(self._calibration),
            requests=self._wishes.poll,
            tell=self.say,
        )
        return Walk(
            FrameClock(rate, grid=several and source.file is None),
            headings,
            self._sinks,
            self._orient,
            self.say if source.live else lambda text: None,
            on_pose,
            Misfits(self._calibration, self._other_devices),
            self.say,
        )

    def _other_devices(self) -> str | None:
        return other_devices(self._calibration, self.source.devices)

    def report(self, walk: Walk, rate: float, future: int) -> EdgeposeError | None:
        """Says the counts of a finished walk; gives what went wrong, if anything did."""
        summary, counts = walk.summary, self.source.counters
        speed = summary.poses / summary.seconds if summary.seconds else 0.0
        self.say(
            f"poses    {summary.poses} in {summary.seconds:.1f} s, {speed:.1f} a second; "
            f"{summary.filling} while the window was filling"
        )
        self.say(
            f"packets  {counts.packets} good, {counts.lost} lost, {counts.bad} bad; "
            f"{walk.clock.dropped} samples too late or twice"
        )
        if walk.clock.restarts:
            self.say(
                f"clock    began anew {walk.clock.restarts} times, "
                "after all sensors were silent for a minute or more"
            )
        if summary.held:
            worst = sorted(zip(summary.held_by_sensor, PLACEMENTS, strict=True), reverse=True)
            self.say("held     " + ", ".join(f"{name} in {count} frames" for count, name in worst if count))
        if summary.latencies_s and self._flags.source.live:
            self.say(_latency(summary, rate, future))
        remarks = (self._orient.remarks(), self._flags.outputs.remarks(self._sinks), self._wishes.remarks())
        for line in (line for lines in remarks for line in lines):
            self.say(line)
        if summary.error is None and self.source.damage:
            return EdgeposeError(self.source.damage)
        return summary.error


def _latency(summary: RunSummary, rate: float, future: int) -> str:
    import numpy as np

    p50, p99, most = np.percentile(np.array(summary.latencies_s) * 1e3, [50, 99, 100])
    ahead = f" plus {future} frames of look-ahead, {future / rate * 1e3:.0f} ms" if future else ""
    return (
        f"latency  {p50:.1f} ms median, {p99:.1f} ms p99, {most:.1f} ms max "
        f"from last packet to pose sent{ahead}"
    )


def calibration_of(rig: RigFlags) -> Calibration:
    """The calibration that a wearer's flags name.

    Raises:
        EdgeposeError: it cannot be read, or orientations are not made as they were for it.
    """
    from edgepose.calibration import load_calibration

    calibration = load_calibration(rig.calibration)
    with named(rig.name):
        _check_filter(calibration, rig)
    return calibration


def _check_filter(calibration: Calibration, rig: RigFlags) -> None:
    """Raises EdgeposeError unless orientations are made as they were for the calibration.

    Not a warning: another filter has other headings, and all poses would be wrong without looking so.
    """
    if rig.filter != calibration.filter:
        raise EdgeposeError(
            f"the calibration was made with --filter {calibration.filter}, and this run has --filter "
            f"{rig.filter}: headings would differ; use the same one, or calibrate again"
        )
    if rig.no_mag and rig.filter != "none" and calibration.north:
        raise EdgeposeError(
            "the calibration was made with magnetometers: leave --no-mag out, or calibrate again with it"
        )
    made_from = calibration.metadata.get("source")
    if not rig.source.live and _begins_anew(calibration) and made_from != rig.source.name:
        voice(rig.name)(
            f"warning: the calibration was made from {made_from}, and headings of a filter without "
            "magnetometers begin anew in each recording: calibrate from this one"
        )


def _begins_anew(calibration: Calibration) -> bool:
    """Whether a filter without a north has begun anew since the calibration."""
    return calibration.filter != "none" and not calibration.north


def voice(name: str) -> Callable[[str], None]:
    """Says things of a wearer on stderr; one without a name needs none."""
    return lambda text: say(f"{name}: {text}" if name else text)
