"""Report on one wearer's finished run, as lines for people and as values for scripts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from edgepose.config import WearerConfig
from edgepose.errors import EdgeposeError
from edgepose.pipeline.wearer_pipeline import RunSummary
from edgepose.placements import PLACEMENTS, SENSORS
from edgepose.sinks.registry import described
from edgepose.sources import SourceCounters


class Latency(NamedTuple):
    """Times from the last packet to the pose sent, and the network's look-ahead, milliseconds."""

    median: float
    p99: float
    max: float
    look_ahead: float


def latency(summary: RunSummary, look_ahead_s: float) -> Latency | None:
    """Return the latencies of a run; None without poses."""
    if not summary.latencies_s:
        return None
    median, p99, most = np.percentile(np.array(summary.latencies_s) * 1e3, [50, 99, 100])
    return Latency(float(median), float(p99), float(most), look_ahead_s * 1e3)


def known_before(config: WearerConfig) -> dict[str, Any]:
    """Return the fields of a report that are known before the run."""
    return {
        "wearer": config.name,
        "source": config.source.name,
        "calibration": str(config.calibration),
        "outputs": described(config.outputs.targets),
    }


@dataclass(frozen=True, kw_only=True)
class RunReport:
    """Counts of one wearer's finished run.

    Attributes:
        wearer: name of the wearer; empty for a single one.
        source: name of the source.
        calibration: file of the calibration.
        outputs: kind and target of each output.
        summary: counts of poses.
        packets: counts of the source.
        late: samples that came too late or twice.
        skipped: poses that were too old for live outputs.
        restarts: restarts of the clock after a silence of all sensors.
        latency: of a live run; None for others.
        look_ahead_frames: the network's look-ahead.
        notes: lines of filter, outputs and remote control.
        error: the error that ended the run, or the damage of the source; None if nothing was lost.
    """

    wearer: str
    source: str
    calibration: str
    outputs: Sequence[Mapping[str, str]]
    summary: RunSummary = field(default_factory=RunSummary)
    packets: SourceCounters = field(default_factory=SourceCounters)
    late: int = 0
    skipped: int = 0
    restarts: int = 0
    latency: Latency | None = None
    look_ahead_frames: int = 0
    notes: tuple[str, ...] = ()
    error: EdgeposeError | None = None

    @classmethod
    def of_failed(cls, config: WearerConfig, error: EdgeposeError) -> RunReport:
        """Return the report on a run that did not begin."""
        return cls(**known_before(config), error=error)

    @property
    def result(self) -> str:
        """The outcome in a word: "ok", "damaged" if a part was lost, "failed" if there are no poses."""
        if self.error is None:
            return "ok"
        return "damaged" if self.summary.poses else "failed"

    def lines(self) -> list[str]:
        """Return the report for people."""
        summary, counts = self.summary, self.packets
        speed = summary.poses / summary.seconds if summary.seconds else 0.0
        lines = [
            f"poses    {summary.poses} in {summary.seconds:.1f} s, {speed:.1f} per second; "
            f"{summary.warming_up} while the window was filling",
            f"packets  {counts.packets} good, {counts.lost} lost, {counts.bad} bad; "
            f"{self.late} samples too late or duplicate",
        ]
        if self.skipped:
            lines.append(f"skipped  {self.skipped} poses at live outputs: they came too late")
        if self.restarts:
            lines.append(
                f"clock    restarted {self.restarts} times, "
                "after all sensors were silent for a minute or more"
            )
        if summary.held:
            counted = dict.fromkeys(SENSORS, 0) | summary.held_by_sensor
            worst = sorted(counted.items(), key=lambda item: -item[1])  # equal counts in the usual order
            named = ", ".join(f"{name} in {count} frames" for name, count in worst if count)
            lines.append(f"held     {named}")
        for slip in summary.slips:
            lines.append(f"slipped  {slip.placement} by about {slip.angle_deg:.0f} deg")
        if summary.distance_m is not None:
            lines.append(f"distance {summary.distance_m:.1f} m walked")
        if summary.corrections_deg is not None and any(summary.corrections_deg):
            angles = zip(PLACEMENTS, summary.corrections_deg, strict=True)
            # Those of sensors that the rig lacks are 0.
            named = ", ".join(f"{name} {angle:+.1f}" for name, angle in angles if angle)
            lines.append(f"drift    {named} deg corrected")
        if self.latency is not None:
            ahead = self.latency.look_ahead
            lines.append(
                f"latency  {self.latency.median:.1f} ms median, {self.latency.p99:.1f} ms p99, "
                f"{self.latency.max:.1f} ms max from last packet to pose sent"
                + (f" plus {self.look_ahead_frames} frames of look-ahead, {ahead:.0f} ms" if ahead else "")
            )
        return [*lines, *self.notes]

    def values(self) -> Mapping[str, Any]:
        """Return the report for scripts; docs/reference/scripts.md describes the keys."""
        summary = self.summary
        return {
            "wearer": self.wearer,
            "source": self.source,
            "calibration": self.calibration,
            "outputs": self.outputs,
            "result": self.result,
            "problem": None if self.error is None else str(self.error),
            "poses": summary.poses,
            "seconds": summary.seconds,
            "warming_up": summary.warming_up,
            "held": summary.held,
            "held_by_sensor": dict.fromkeys(PLACEMENTS, 0) | summary.held_by_sensor,
            "packets": self.packets._asdict(),
            "late": self.late,
            "skipped": self.skipped,
            "restarts": self.restarts,
            "slips": [{"placement": slip.placement, "angle_deg": slip.angle_deg} for slip in summary.slips],
            "way_m": summary.distance_m,
            "corrections_deg": None
            if summary.corrections_deg is None
            else dict(zip(PLACEMENTS, summary.corrections_deg, strict=True)),
            "latency_ms": None if self.latency is None else self.latency._asdict(),
            "notes": list(self.notes),
        }
