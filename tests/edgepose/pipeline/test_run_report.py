"""Tests of the report of a run."""

from __future__ import annotations

from collections import Counter

from edgepose.pipeline.run_report import RunReport
from edgepose.pipeline.wearer_pipeline import RunSummary


def test_silent_sensors_are_listed_by_their_counts_and_then_in_the_usual_order() -> None:
    counts = Counter({"left_foot": 4, "pelvis": 4, "head": 9, "left_forearm": 4})
    report = RunReport(
        wearer="",
        source="walk.csv",
        calibration="calib.json",
        outputs=[],
        summary=RunSummary(poses=20, held=9, held_by_sensor=counts),
    )
    assert (
        "held     head in 9 frames, left_forearm in 4 frames, pelvis in 4 frames, left_foot in 4 frames"
        in report.lines()
    )
