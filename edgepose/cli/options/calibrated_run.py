"""Flags of `edgepose check` for the calibration, and the settings of the run that is planned with it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from edgepose.cli.options.body import HEIGHT
from edgepose.cli.options.gathered import add_flags
from edgepose.imu import FILTERS

if TYPE_CHECKING:
    from edgepose.calibration import Calibration


class CalibratedRun(NamedTuple):
    """A calibration and its differences to the settings of the planned run.

    Attributes:
        calibration: of the wearer.
        differences: one line each.
    """

    calibration: Calibration
    differences: list[str]


_FLAGS = [
    click.option(
        "--calibration",
        type=click.Path(path_type=Path, dir_okay=False),
        help="Calibration of a wearer who stands in its pose: headings, placements, devices and mountings "
        "are compared with it.",
    ),
    click.option(
        "--filter",
        type=click.Choice(FILTERS),
        help="Filter of the planned run, to compare with --calibration.",
    ),
    click.option("--no-mag", is_flag=True, help="The planned run does not use magnetometers."),
    click.option("--height", "height_m", type=HEIGHT, help="The wearer's height in the planned run, metres."),
]


def calibration_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags; the command gets them as `calibrated: CalibratedRun | None`."""

    @functools.wraps(command)
    def with_calibration(
        *, calibration: Path | None, filter: str | None, no_mag: bool, height_m: float | None, **values: Any
    ) -> Any:
        from edgepose.calibration import load_calibration
        from edgepose.pipeline.calibrated_settings import check_settings

        if calibration is None:
            if filter is not None or no_mag or height_m is not None:
                raise click.UsageError("--filter, --no-mag and --height are compared with a --calibration")
            return command(calibrated=None, **values)
        loaded = load_calibration(calibration)
        differences = check_settings(loaded, filter, no_mag, height_m)
        return command(calibrated=CalibratedRun(loaded, differences), **values)

    return add_flags(with_calibration, _FLAGS)
