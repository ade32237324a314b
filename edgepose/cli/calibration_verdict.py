"""Verdict on a calibration: its table, what to do about a bad one, and the next command."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edgepose.calibration import Calibration, mounting
from edgepose.cli.calibration_session import Measured
from edgepose.config import SourceConfig
from edgepose.rotations import Array

DAMAGED = "a part of the recording was left out, see the warnings"
"""Problem of a calibration from the good part of a damaged recording."""

GOOD_RESIDUAL_DEG, GOOD_HEADING_DEG = 1.0, 15.0


class Judgement(NamedTuple):
    """A word of at most five letters, and a sentence with what to do."""

    word: str
    text: str


def judge(result: Calibration, measured: Measured, warnings: Sequence[str]) -> Judgement:
    """Judge a calibration by its residuals, the errors of its headings and the warnings about it."""
    problems = []
    names = measured.summary.names
    if swaying := _over(names, measured.summary.spread_deg, GOOD_RESIDUAL_DEG):
        problems.append(f"{swaying} swayed: stand with your back against a wall, and calibrate again")
    if measured.reset is not None and (loose := _over(names, measured.reset.error_deg, GOOD_HEADING_DEG)):
        problems.append(f"the heading of {loose} is uncertain: repeat, with movements straight ahead")
    if warnings:
        problems.append("see the warnings" if len(warnings) > 1 else f"warning: {warnings[0]}")
    if not problems:
        return Judgement("GOOD", "The calibration is good.")
    return Judgement("FAIR", f"The calibration can be used, but {'; '.join(problems)}.")


def _over(names: Sequence[str], angle_deg: Array, limit_deg: float) -> str:
    angles = zip(names, angle_deg, strict=True)
    return ", ".join(f"{name} ({angle:.1f} deg)" for name, angle in angles if angle > limit_deg)


def next_command(source: SourceConfig, out: str) -> str:
    """Return the command that uses the calibration."""
    words = ["edgepose", "run"]
    for flag in ("file", "port", "baud", "can", "bitrate", "listen", "connect", "ble", "hid", "sensors"):
        value = getattr(source, flag)
        words += [] if value is None else [f"--{flag}", str(value)]
    words += [] if source.protocol == "auto" else ["--protocol", source.protocol]
    words += [f"--{flag}" for flag in ("fd", "realtime") if getattr(source, flag)]
    words += ["--calibration", out, *(["--view"] if source.live else ["--csv", "poses.csv"])]
    return shlex.join(words)


def table(result: Calibration, measured: Measured) -> str:
    """Return a row for each sensor, at most 79 columns wide."""
    summary, reset = measured.summary, measured.reset
    lines = ["sensor          samples  residual  m/s^2 heading its error  sits"]
    for i, (name, sits) in enumerate(mounting(result).items()):
        force = float(np.linalg.norm(summary.force[i]))
        heading = "-" if reset is None else f"{math.degrees(reset.offset[i]):.1f}"
        error = "-" if reset is None else f"{reset.error_deg[i]:.1f}"
        lines.append(
            f"{name:16}{summary.samples[i]:7d}{summary.spread_deg[i]:10.2f}"
            f"{'-' if math.isnan(force) else f'{force:.2f}':>7}{heading:>8}{error:>10}  {sits}"
        )
    return "\n".join(lines)


def values(
    source: SourceConfig, out: str, measured: Measured, result: Calibration, warnings: Sequence[str]
) -> dict[str, Any]:
    """Return a calibration for scripts; docs/reference/scripts.md describes the keys."""
    summary, reset = measured.summary, measured.reset
    judgement = judge(result, measured, warnings)
    nothing = np.full(len(summary.names), math.nan)
    return {
        "source": source.name,
        "out": out,
        "result": "damaged" if measured.damaged else "ok",
        "problem": DAMAGED if measured.damaged else None,
        "verdict": judgement.word,
        "advice": judgement.text,
        "hold_from_s": measured.from_s,
        "warnings": list(warnings),
        "sensors": [
            {
                "placement": name,
                "samples": summary.samples[i],
                "residual_deg": summary.spread_deg[i],
                "force_m_s2": np.linalg.norm(summary.force[i]),
                "heading_deg": math.nan if reset is None else math.degrees(reset.offset[i]),
                "heading_error_deg": (nothing if reset is None else reset.error_deg)[i],
                "mounting": mounted,
            }
            for i, (name, mounted) in enumerate(mounting(result).items())
        ],
    }


def values_of_failed(source: Path, out: Path, problem: str, warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Return the same keys for a recording that gave no calibration."""
    unknown = dict.fromkeys(("verdict", "advice", "hold_from_s"))
    about = {"source": source, "out": out, "result": "failed", "problem": problem}
    return {**about, **unknown, "warnings": list(warnings), "sensors": []}
