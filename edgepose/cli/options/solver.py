"""Flags for the solver of `edgepose solve`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from edgepose.cli.options.float_range import FloatRange
from edgepose.cli.options.gathered import gathered
from edgepose.cli.options.recording_time import RecordingTime, RecordingTimeType

if TYPE_CHECKING:
    from edgepose.sip.solve import Method

STATISTICS = "default"
"""Name of the shipped statistical prior."""


def _weights(ctx: click.Context, param: click.Parameter, value: str) -> dict[str, float]:
    from edgepose.sip.energy import Weights

    weights: dict[str, float] = {}
    for part in value.split(",") if value else ():
        name, _, number = part.strip().partition("=")
        try:
            weight = float(number)
        except ValueError:
            weight = -1.0
        if name not in Weights._fields or not 0.0 <= weight < 1e6:
            raise click.BadParameter(
                f"{part!r} is not NAME=NUMBER with one of {', '.join(Weights._fields)} and a number from 0 on"
            )
        weights[name] = weight
    return weights


@dataclass(frozen=True, kw_only=True)
class SolverFlags:
    """How poses are found; the fields are flags of `edgepose solve`."""

    method: Method
    weights: dict[str, float]
    prior: str | None
    hold_from: RecordingTime | None
    rate: float
    evaluations: int
    jobs: int

    @property
    def statistics(self) -> bool:
        """Whether --prior names a statistical prior."""
        return self.prior is not None and (self.prior == STATISTICS or self.prior.endswith(".npz"))


def solver_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the solver's flags except --method; the command gets them as `solver: SolverFlags`."""
    flags = [
        click.option(
            "--weights",
            callback=_weights,
            default="",
            metavar="NAME=NUMBER[,...]",
            help="Weights of the energy's terms.  "
            "[default: ori=1, acc=0.02, anthro=1, mahal=0.0003, limits=0.1; acc=0.05, mahal=0.003 with "
            "a statistical prior]",
        ),
        click.option(
            "--prior",
            metavar="MODEL|default|FILE.npz",
            help="Prior over poses. MODEL: the poses of a network, shipped or an archive, for the six "
            "sensors. default: the mean and covariance of all poses. FILE.npz: those of your own motion "
            "capture, from `edgepose learn-prior`.  [default: birnn with the six sensors, else default]",
        ),
        click.option(
            "--hold-from",
            type=RecordingTimeType(),
            metavar="[+]SECONDS",
            help="Start of a hold of the calibration's pose on the clock of IN, seconds; with a plus sign, "
            "since its start. Required with sensors other than the six.  "
            "[default: as calibrated, if from this file]",
        ),
        click.option(
            "--rate",
            type=FloatRange(10, 240),
            default=60.0,
            show_default=True,
            help="Poses per second.",
        ),
        click.option(
            "--evaluations",
            type=click.IntRange(2, 1000),
            default=30,
            show_default=True,
            help="Maximum number of cost evaluations of sip per chunk of 15 s.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(1),
            default=1,
            show_default=True,
            help="Number of processes, each of which solves one chunk at a time.",
        ),
    ]
    return gathered(command, flags, "solver", SolverFlags)
