"""Accuracy of a wearer's path: takes with true positions, run through `edgepose.place` as in a run.

Errors are distances between the true path of the pelvis and the estimated one over the same time. As `run`
does, everything is estimated on the default body and frame by frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from edgepose.analysis.metrics import Metric, aligned, measure
from edgepose.place import PlaceTracker
from edgepose.pose import CONTACTS
from edgepose.rotations import yaw_of_matrix
from edgepose.skeleton import JOINTS, default_body, forward_kinematics
from edgepose_export.training.dataset import RATE, Take

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

SECONDS = (2.0, 5.0, 10.0)
"""Times after which the error is measured."""

METRES = (1.0, 3.0, 5.0, 7.0)
"""Distances over which the error is measured."""

EVERY = 10
"""Frames from the start of a measured time or distance to the next."""

KIND_S = 2.0
"""Length of the parts that each have one kind of motion, seconds."""

KINDS = ("in place", "forwards", "backwards", "sideways", "turning", "running", "jumping")
"""Kinds of motion: slower than 0.2 m/s; three by the direction of the pelvis; through more than 90 degrees;
faster than 2 m/s; in the air for more than 15 % of the time."""

FRAMES = 256
"""Frames that run together."""

ANKLES = [JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]
KNEES = [JOINTS.index("left_knee"), JOINTS.index("right_knee")]

Row = dict[str, Array]
"""Errors by column, see `LEGEND`."""


class Path(NamedTuple):
    """A wearer's path.

    Attributes:
        name: name of the take.
        true: (T, 3) true positions of the pelvis, metres.
        estimates: (T, 3) estimated positions by row of the tables.
        errors: errors by row of the tables.
        kinds: error over times of `KIND_S`, cm, by kind of motion, see `kind_of`; only of the row `BOTH`.
    """

    name: str
    true: Array
    estimates: Mapping[str, Array]
    errors: Mapping[str, Row]
    kinds: Row


def _with(contacts: bool, velocity: bool) -> Callable[[Singles], Singles | None]:
    def changed(place: Singles) -> Singles | None:
        if not (contacts or velocity):
            return None
        return place * np.repeat([contacts, velocity], [len(CONTACTS), 3]).astype(np.float32)

    return changed


ROWS: Mapping[str, Callable[[Singles], Singles | None]] = {
    "no heads": _with(contacts=False, velocity=False),
    "velocity": _with(contacts=False, velocity=True),
    "contacts": _with(contacts=True, velocity=False),
    "both": _with(contacts=True, velocity=True),
}
"""What the tracker is given of the network's output (T, 10), by row of the tables."""

BOTH = "both"
"""The row of a run."""

TRUTH = "truth"
"""The row of the true path; its feet, too, roll and slide while they are in contact."""

LEGEND = """\
means; count: measured times, distances, frames, takes
2 s, ...: error after this time, cm; 1 m, ...: error over this distance, %
height: error of the height against the first second, cm; at end: in the last
slide: movement of a sole in a contact with the ground, cm per second of contact
no heads: the lower foot stands still; velocity: the network's velocity alone;
    contacts: its contacts alone; both: as in a run; truth: the true motion"""


def streamed(module: torch.jit.ScriptModule, take: Take, future: int) -> tuple[Singles, Singles]:
    """Return local poses (T, 24, 3, 3) and places (T, 10) for every frame of a take, streamed as in a run."""
    orientation, acceleration = torch.from_numpy(take.orientation), torch.from_numpy(take.acceleration)
    poses, places = [], []
    with torch.inference_mode():
        state = module.start(1, future)
        for part in zip(orientation[None].split(FRAMES, 1), acceleration[None].split(FRAMES, 1), strict=True):
            pose, _, place, state = module.stream_many_place(*part, state)
            poses.append(pose)
            places.append(place)
        pose, _, place = module.drain_place(state)
    return torch.cat([*poses, pose], 1)[0].numpy(), torch.cat([*places, place], 1)[0].numpy()


def tracked(time_s: Array, poses: Singles, places: Iterable[Singles | None]) -> Array:
    """Return the positions (T, 3) of the pelvis in poses (T, 24, 3, 3), on the default body."""
    tracker = PlaceTracker(default_body())
    frames = zip(time_s.tolist(), poses, places, strict=True)
    return np.array([tracker.update(*frame).translation for frame in frames])


def estimates(
    poses: Singles, place: Singles, time_s: Array | None = None, only: str | None = None
) -> dict[str, Array]:
    """Return the positions (T, 3) of the pelvis by row of the tables, of all rows or of one."""
    times = np.arange(len(poses)) / RATE if time_s is None else time_s
    inputs = {name: change(place) for name, change in ROWS.items() if only in (name, None)}
    return {
        name: tracked(times, poses, [None] * len(poses) if given is None else given)
        for name, given in inputs.items()
    }


def measured(
    module: torch.jit.ScriptModule, metadata: Mapping[str, Any], takes: Iterable[Take]
) -> Iterator[Path]:
    """Yield the paths of some takes; those without true contacts or positions are left out."""
    for take in takes:
        if take.place is None or take.translation is None:
            continue
        poses, place = streamed(module, take, metadata["future"])
        paths, true = estimates(poses, place), take.translation.astype(float)
        planted = take.place[:, :2] > 0.5
        rows = {name: errors(path, true, soles(poses), planted) for name, path in paths.items()}
        rows[TRUTH] = errors(true, true, soles(take.pose), planted)
        yield Path(take.name, true, paths, rows, _errors_by_kind(paths[BOTH], true, take))


def soles(poses: Singles) -> Array:
    """Return the points (T, 2, 3) of the default body's soles below the ankles, relative to the pelvis."""
    offsets = default_body().offsets
    rotations, joints = forward_kinematics(poses.astype(float), offsets)
    below = np.array([0.0, offsets[JOINTS.index("left_foot")][1], 0.0])
    points: Array = joints[:, ANKLES] - joints[:, :1] + rotations[:, KNEES] @ below
    return points


def errors(path: Array, true: Array, feet: Array, planted: NDArray[np.bool_]) -> Row:
    """Return the errors of a path.

    Args:
        path: (T, 3) estimated positions of the pelvis, metres.
        true: (T, 3) true ones.
        feet: (T, 2, 3) soles relative to the pelvis.
        planted: (T, 2) whether they truly are in contact with the ground.
    """
    row = {f"{seconds:g} s": 100.0 * _after(path, true, seconds) for seconds in SECONDS}
    row |= {f"{metres:g} m": 100.0 * _over(path, true, metres) for metres in METRES}
    height = path[:, 1] - true[:, 1]
    second = round(RATE)
    height -= np.median(height[:second])
    row["height"] = 100.0 * np.abs(height)
    row["at end"] = 100.0 * np.abs(np.median(height[-second:], keepdims=True))
    row["slide"] = 100.0 * _slides(path[:, None] + feet, planted)
    return row


def _slides(feet: Array, planted: NDArray[np.bool_]) -> Array:
    """Return how far feet (T, 2, 3) move in a contact, per second of it, m/s: one number for each frame."""
    slides = []
    for side in (0, 1):
        edges = np.flatnonzero(np.diff(np.pad(planted[:, side].astype(int), 1)))
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            if end - first > 1:
                moved = np.linalg.norm((feet[end - 1, side] - feet[first, side])[[0, 2]])
                slides.append(np.full(end - first, moved * RATE / (end - 1 - first)))
    return np.concatenate([np.empty(0), *slides])


def _after(path: Array, true: Array, seconds: float) -> Array:
    """Return the errors after a time, metres."""
    frames = round(seconds * RATE)
    start = np.arange(0, max(0, len(true) - frames), EVERY)
    return _distance(path, true, start, start + frames)


def _over(path: Array, true: Array, metres: float) -> Array:
    """Return the errors over a distance on the ground, as shares of it."""
    steps = np.linalg.norm(np.diff(true[:, [0, 2]], axis=0), axis=1)
    gone = np.concatenate([[0.0], np.cumsum(steps)])
    start = np.arange(0, len(true), EVERY)
    end = np.searchsorted(gone, gone[start] + metres)
    inside = end < len(true)
    return _distance(path, true, start[inside], end[inside]) / metres


def _distance(path: Array, true: Array, start: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    error = path - true
    distance: Array = np.linalg.norm(error[end] - error[start], axis=1)
    return distance


def _errors_by_kind(path: Array, true: Array, take: Take) -> Row:
    """Return the errors of a path after `KIND_S`, cm, by kind of motion."""
    assert take.place is not None, "takes without labels are not measured"
    frames = round(KIND_S * RATE)
    start = np.arange(0, max(0, len(true) - frames), EVERY)
    values = 100.0 * _distance(path, true, start, start + frames)
    kinds = np.array([kind_of(take, slice(first, first + frames)) for first in start])
    return {kind: values[kinds == kind] for kind in KINDS if (kinds == kind).any()}


def kind_of(take: Take, span: slice) -> str:
    """Return the kind of motion, one of `KINDS`, in a part of a take of `KIND_S`, by its true motion."""
    assert take.place is not None, "takes without labels are not measured"
    assert take.translation is not None, "takes without labels are not measured"
    distance = np.linalg.norm(np.diff(take.translation[span][:, [0, 2]], axis=0), axis=1).sum()
    across, _, ahead = take.place[span, len(CONTACTS) :].mean(axis=0)
    airborne = 1.0 - take.place[span, :4].max(axis=1).mean()
    heading = np.unwrap(yaw_of_matrix(take.pose[span, 0]))
    if distance > 2.0 * KIND_S:
        return "running"
    if airborne > 0.15:
        return "jumping"
    if distance < 0.2 * KIND_S:
        return "in place"
    if np.ptp(heading) > np.pi / 2.0:
        return "turning"
    if abs(across) > abs(ahead):
        return "sideways"
    return "forwards" if ahead > 0.0 else "backwards"


def summarise(paths: Iterable[Mapping[str, Row]]) -> dict[str, dict[str, Metric]]:
    """Return means, deviations and numbers of the errors of several paths, by row and column."""
    joined: dict[str, dict[str, list[Array]]] = {}
    for rows in paths:
        for name, row in rows.items():
            for key, values in row.items():
                joined.setdefault(name, {}).setdefault(key, []).append(values)
    return {
        name: {key: measure(np.concatenate(values)) for key, values in row.items()}
        for name, row in joined.items()
    }


def format_table(title: str, table: Mapping[str, Mapping[str, Metric]]) -> str:
    """Format means with one line per row; the last line has the numbers of values."""
    keys = list(next(iter(table.values())))
    head = ["", *keys]
    rows = [
        [name, *(f"{row[key].mean:.1f}" if row[key].frames else "-" for key in keys)]
        for name, row in table.items()
    ]
    counts = ["count", *(str(next(iter(table.values()))[key].frames) for key in keys)]
    return "\n".join([title, *aligned([head, *rows, counts])])
