"""Solver for whole recordings: in overlapping chunks, one after the other or several in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.errors import EdgeposeError
from edgepose.sip.energy import Problem, Weights, second_difference
from edgepose.sip.kinematics import SensorPoints
from edgepose.sip.levenberg_marquardt import SIP_EVALUATIONS, Minimum, inertial_poser, orientation_poser
from edgepose.sip.measurements import Measurements
from edgepose.sip.network_prior import NetworkPrior
from edgepose.sip.parameterisation import PoseParameterisation, coordinates, parameters_of
from edgepose.utils.jobs import run_in_order

Array = NDArray[np.float64]

CHUNK = 900
"""Frames solved at once: 15 s at 60 Hz."""

OVERLAP = 60
"""Frames that neighbouring chunks share. Near its ends a chunk lacks the frames beyond, so the poses are
blended from one chunk to the next over this length."""

Method = Literal["sip", "sop"]


class Settings(NamedTuple):
    """Settings of the solver.

    Attributes:
        method: "sip" or "sop".
        rig: parameters of a pose, and their prior.
        body: positions of the sensors on it.
        weights: of the energy's terms.
        evaluations: largest number of evaluations of SIP's cost.
        network: poses that a network expects at all frames: SIP's start, and its prior instead of the rig's.
    """

    method: Method
    rig: PoseParameterisation
    body: SensorPoints
    weights: Weights
    evaluations: int = SIP_EVALUATIONS
    network: NetworkPrior | None = None


class Solution(NamedTuple):
    """Poses of consecutive frames, and their residuals.

    Attributes:
        rotations: (T, 24, 3, 3) local rotations, joint 0 against the body frame T.
        costs: (T, 4) weighted cost of the terms, as in `edgepose.sip.energy.Costs`.
        orientation_residual: (T, N) angle between each sensor's estimated and measured orientation, rad.
        acceleration_residual: (T, N) length of each residual, m/s^2; 0 where none was measured.
        acceleration: (T, 3) of the pelvis in T, m/s^2; NaN where no sensor measured any.
        evaluations: number of cost evaluations.
    """

    rotations: Array
    costs: Array
    orientation_residual: Array
    acceleration_residual: Array
    acceleration: Array
    evaluations: int


OnProgress = Callable[[int, int, int, float], None]
"""Called with chunk (from 1), number of chunks, cost evaluations in it so far and cost per frame."""


def chunks(frames: int) -> list[slice]:
    """Return the chunks of a recording, of equal length except for rounding."""
    count = max(1, -(-(frames - OVERLAP) // (CHUNK - OVERLAP)))
    edges = np.linspace(0, max(frames - OVERLAP, 0), count + 1).astype(int)
    return [slice(a, min(b + OVERLAP, frames)) for a, b in pairwise(edges.tolist())]


def solve(
    measurements: Measurements,
    settings: Settings,
    jobs: int = 1,
    on_progress: OnProgress = lambda chunk, count, evaluations, cost: None,
) -> Iterator[Solution]:
    """Solve a recording and yield solutions of consecutive frames.

    Args:
        measurements: of all frames.
        settings: of the solver.
        jobs: number of chunks solved in parallel, each in its own process.
        on_progress: called after each evaluation; with more than one job, only after each chunk.

    Raises:
        EdgeposeError: there is no frame, or a process was killed.
    """
    if not len(measurements.time_s):
        raise EdgeposeError("the recording has no frame in which all sensors report")
    parts = chunks(len(measurements.time_s))
    problems = [_problem(measurements, part, settings) for part in parts]
    overlap: Solution | None = None  # end of a chunk, blended with the start of the next one
    for number, solution in enumerate(_solutions(problems, settings, jobs, on_progress), start=1):
        if overlap is not None:
            solution = _crossfade(overlap, solution)
        last = number == len(parts)
        stop = None if last else parts[number].start - parts[number - 1].start
        yield _rows(solution, slice(0, stop))
        overlap = None if last else _rows(solution, slice(stop, None))


def _solutions(
    problems: list[Problem], settings: Settings, jobs: int, on_progress: OnProgress
) -> Iterator[Solution]:
    """Yield the solutions of whole chunks, in order."""
    count = len(problems)
    work = partial(solve_chunk, method=settings.method, evaluations=settings.evaluations)
    if jobs == 1 or count == 1:
        for number, problem in enumerate(problems, start=1):
            yield work(problem, on_step=partial(on_progress, number, count))
        return
    for number, solution in enumerate(run_in_order(work, problems, jobs), start=1):
        on_progress(number, count, solution.evaluations, float(solution.costs.sum(axis=1).mean()))
        yield solution


def solve_chunk(
    problem: Problem,
    method: Method,
    evaluations: int = SIP_EVALUATIONS,
    on_step: Callable[[int, float], None] = lambda count, cost: None,
) -> Solution:
    """Solve all frames of a problem: SIP from the network's poses, or SOP and then SIP from its result."""
    done = 0
    if problem.network is None or method == "sop":
        minimum = orientation_poser(problem, on_step)
        start, done = minimum.parameters, minimum.evaluations
    else:
        start = parameters_of(problem.rig, problem.network.rotations)
    if method == "sip":
        minimum = inertial_poser(problem, start, evaluations, lambda count, cost: on_step(done + count, cost))
        done += minimum.evaluations
    return _solution(problem, minimum, done)


def _problem(measurements: Measurements, part: slice, settings: Settings) -> Problem:
    valid = measurements.valid[part].astype(float)
    valid[[0, -1]] = 0.0
    return Problem(
        settings.rig,
        settings.body,
        measurements.orientation[part],
        measurements.acceleration[part],
        valid,
        measurements.rate,
        settings.weights,
        None if settings.network is None else settings.network.part(part),
    )


def _solution(problem: Problem, minimum: Minimum, evaluations: int) -> Solution:
    evaluation, valid = minimum.evaluation, problem.valid[..., None]
    unexplained = problem.acceleration - second_difference(evaluation.states.position, problem.rate)
    with np.errstate(invalid="ignore"):
        acceleration = (valid * unexplained).sum(axis=1) / valid.sum(axis=1)
    return Solution(
        rot.rotvec_to_matrix(coordinates(problem.rig, minimum.parameters)),
        np.stack(evaluation.costs, axis=1),
        np.linalg.norm(evaluation.orientation_residual, axis=-1),
        np.linalg.norm(evaluation.acceleration_residual, axis=-1),
        acceleration,
        evaluations,
    )


def _rows(solution: Solution, rows: slice) -> Solution:
    columns = {name: getattr(solution, name)[rows] for name in Solution._fields if name != "evaluations"}
    return solution._replace(**columns)


def _crossfade(before: Solution, after: Solution) -> Solution:
    """Return `after` with its first frames blended with those of `before`, which are of the same instants."""
    frames = len(before.rotations)
    share = (np.arange(frames) + 0.5) / frames
    share = share * share * (3.0 - 2.0 * share)
    first, last = (rot.matrix_to_quat(s.rotations[:frames]) for s in (before, after))
    between = rot.quat_to_matrix(rot.slerp(first, last, share[:, None]))
    # Everything else comes from the nearer chunk: the ends of a chunk have no acceleration.
    middle = frames // 2
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(before, name)[:middle], getattr(after, name)[middle:]])
        for name in ("costs", "orientation_residual", "acceleration_residual", "acceleration")
    }
    rotations = np.concatenate([between, after.rotations[frames:]])
    return after._replace(rotations=rotations, **columns)
