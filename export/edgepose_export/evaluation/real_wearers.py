"""Accuracy of models on recordings of two real wearers, whose sensors run through the pipeline of `run`.

The walker wears 17 sensors. Six are a model's inputs; those on thighs, upper arms and breastbone, calibrated
in the same N-pose, are the truth. The sitter wears six sensors. What is known of the other bones is what the
wearer did: stand, sit on a chair, stand up, walk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose import rotations as rot
from edgepose.analysis.metrics import Metric, aligned, jitter, measure
from edgepose.calibration import Calibration, calibrate, check_hold, hold_from_recording, trim
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.registry import read_recording, read_sensors
from edgepose.inference.model import Model
from edgepose.pipeline.wearer_pipeline import WearerPipeline
from edgepose.placements import SITES
from edgepose.sip.measurements import mounts_from_hold, orientation_at
from edgepose.skeleton import default_body, global_rotations
from edgepose.sources import open_source
from edgepose_export.evaluation import baselines
from edgepose_export.evaluation.evaluate import Table
from edgepose_export.training.dataset import RATE, Take

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[3] / "tests" / "data" / "real"
"""Folder of the recordings in a source tree."""

FILES = ("mtw-walk.npz", "mtw-walk-reference.npz", "six-sites.npz")
"""The walker's six sensors, the walker's other sensors, the sitter's six sensors."""

Progress = Callable[[list[Path]], Iterable[Path]]

Span = tuple[float, float]
"""Start and end on a recording's clock, seconds."""

Method = Callable[[Take], Array]
"""A function that returns local poses (T, 24, 3, 3) for a wearer's calibrated sensors."""

TRIVIAL: Mapping[str, Method] = {
    "nearest sensor": baselines.following,
    "interpolated": baselines.interpolated_from_straight,
    "straight pose": baselines.straight,
}
"""Methods that need no network, by name; see `LEGEND`."""

LEGEND = """\
mean ± deviation; count: frames, of Hz strides. Rows without a network:
nearest sensor: thighs are oriented like shanks, upper arms like forearms, the
    back like the pelvis
interpolated: bones between two sensors are halfway from one to the other, with
    the offsets of the N-pose
straight pose: the body stays in the N-pose and turns with the pelvis"""


class _Recording(NamedTuple):
    """Times in a wearer's recording, by its own clock.

    Attributes:
        hold: of the N-pose for the calibration.
        facing: body frame in this pose. The walker's is the direction in which the legs swing.
        parts: to measure, by name.
    """

    hold: Span
    facing: str
    parts: Mapping[str, Span]


WALKER = _Recording(
    (0.5, 4.0),
    "heading:28",
    {"N-pose, start": (0.5, 4.0), "walking and turning": (6.0, 18.0), "N-pose, end": (18.5, 21.0)},
)

SITTER = _Recording(
    (40.0, 44.0),
    "heading:0",
    {"standing": (40.0, 44.0), "sitting": (53.0, 60.0), "after 20 s": (73.0, 79.0), "up again": (84.0, 94.0)},
)

STRAIGHT_WALK: Span = (97.0, 113.0)
"""Time at which the sitter walks straight ahead."""

TRUE_BONES: Mapping[str, Sequence[str]] = {
    "thighs": ("left_upper_leg", "right_upper_leg"),
    "upper arms": ("left_upper_arm", "right_upper_arm"),
    "back": ("chest",),
}
"""The walker's sensors that are the truth, by column of the tables."""


class Wearer(NamedTuple):
    """A wearer's calibrated sensors at the frames of a run.

    Attributes:
        time_s: (T,) on the recording's clock, seconds.
        take: the six sensors; there is no true pose.
        truth: (T, 3, 3) orientations in the body frame of further bones, by name of the sensor.
    """

    time_s: Array
    take: Take
    truth: Mapping[str, Array]

    def during(self, span: Span) -> NDArray[np.bool_]:
        """Return a mask (T,) of the frames in a time."""
        return (self.time_s >= span[0]) & (self.time_s < span[1])


# --- recordings ---------------------------------------------------------------------------------------------


def read_walker(folder: Path, rate: float = RATE) -> Wearer:
    """Read the walker's sensors, calibrated, with the true orientations of thighs, upper arms and back.

    Raises:
        EdgeposeError: a recording is missing or cannot be read, or lacks a sensor or the N-pose.
    """
    calibration, wearer = calibrated(folder / FILES[0], WALKER, rate)
    path = folder / FILES[1]
    further = read_sensors(path, tuple(SITES))
    names = [name for bones in TRUE_BONES.values() for name in bones]
    missing = [name for name in names if name not in further.sensors]
    if missing or further.damage:
        problem = f"no samples of {', '.join(missing)}" if missing else further.damage
        raise EdgeposeError(f"{path}: {problem}; the truth needs {', '.join(names)}")
    truth = {}
    for name, mount in mounts_from_hold(further, calibration, names, *WALKER.hold).items():
        data = further.sensors[name]
        assert data.quat is not None, "mounts_from_hold has found orientations"
        r_is = rot.quat_to_matrix(orientation_at(data.time_s, data.quat, wearer.time_s))
        truth[name] = mount.body_from_inertial @ r_is @ rot.transpose(mount.bone_from_sensor)
    return wearer._replace(truth=truth)


def read_sitter(folder: Path, rate: float = RATE) -> Wearer:
    """Read the sitter's sensors, calibrated.

    Raises:
        EdgeposeError: the recording is missing or cannot be read, or lacks a sensor or the N-pose.
    """
    return calibrated(folder / FILES[2], SITTER, rate)[1]


def calibrated(path: Path, about: _Recording, rate: float) -> tuple[Calibration, Wearer]:
    """Calibrate a recording as `edgepose calibrate` does, and run it up to the network as `run` does."""
    recording = read_recording(path)
    last_s = min(float(data.time_s[-1]) for data in recording.sensors.values())
    end_s = max(start for start, _ in about.parts.values())
    if last_s < end_s:
        raise EdgeposeError(f"{path}: ends at {last_s:.1f} s; the parts to measure go on after {end_s:g} s")
    hold = check_hold(trim(hold_from_recording(recording), *about.hold), "use the original file")
    calibration = calibrate(hold, pose="straight", body_frame=about.facing, created="")
    pipeline = WearerPipeline(calibration, rate, [])
    with open_source(file=path) as source:
        inputs = [each for batch in source for each in pipeline.process(batch)]
    inputs += pipeline.flush()
    bones, acceleration = (np.stack(column) for column in ([e[1] for e in inputs], [e[2] for e in inputs]))
    no_pose = np.empty((0, 24, 3, 3), np.float32)
    take = Take(path.stem, bones, acceleration, no_pose, "")
    return calibration, Wearer(np.array([each[0].time_s for each in inputs]), take, {})


# --- measures -----------------------------------------------------------------------------------------------


def measure_models(
    models: Mapping[str, Model], folder: Path | None = None, progress: Progress = iter
) -> dict[str, Table]:
    """Measure models, and the trivial methods beside them, on both wearers.

    Args:
        models: models by the name of their rows.
        folder: of the recordings; None is `FOLDER`.
        progress: wraps the list of recordings.

    Returns:
        Measures by title of the table, row and column. Deviations are those over frames; those of strides are
        over strides.

    Raises:
        EdgeposeError: a recording is missing or cannot be used; a model is for another rate than `RATE`.
    """
    folder = folder or FOLDER
    check_folder(folder)
    others = [name for name, model in models.items() if model.rate_hz != RATE]
    if others:
        raise EdgeposeError(f"{', '.join(others)}: not for {RATE:g} Hz, at which real wearers are measured")
    methods: dict[str, Method] = {name: _method(model) for name, model in models.items()} | TRIVIAL
    tables: dict[str, Table] = {}
    for path in progress([folder / FILES[0], folder / FILES[2]]):
        tables |= (_walker_tables if path.name == FILES[0] else _sitter_tables)(folder, methods)
    return tables


def has_recordings(folder: Path = FOLDER) -> bool:
    """Return whether all recordings are in a folder."""
    return all((folder / name).is_file() for name in FILES)


def check_folder(folder: Path) -> None:
    """Raise EdgeposeError unless all recordings are in a folder."""
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise EdgeposeError(
            f"{folder}: has no {', '.join(missing)}; the recordings of real wearers are in tests/data/real "
            "of the source tree: give that folder with --data"
        )


def _method(model: Model) -> Method:
    return lambda take: model.poses(take.orientation, take.acceleration).astype(float)


def _walker_tables(folder: Path, methods: Mapping[str, Method]) -> dict[str, Table]:
    wearer = read_walker(folder)
    poses = {name: method(wearer.take) for name, method in methods.items()}
    return {
        f"walker, {part}: error, deg; jitter, km/s^3": {
            name: walker_columns(wearer, local, span) for name, local in poses.items()
        }
        for part, span in WALKER.parts.items()
    }


def _sitter_tables(folder: Path, methods: Mapping[str, Method]) -> dict[str, Table]:
    wearer = read_sitter(folder)
    poses = {name: method(wearer.take) for name, method in methods.items()}
    return {
        "sitter: thighs from vertical, deg": {
            f"{name}, {side}": thigh_columns(wearer, local, joint)
            for name, local in poses.items()
            for side, joint in (("left", 1), ("right", 2))
        },
        "sitter: strides of the thighs, Hz; jitter, km/s^3": {
            name: gait_columns(wearer, local) for name, local in poses.items()
        },
    }


def walker_columns(wearer: Wearer, local: Array, span: Span) -> dict[str, Metric]:
    """Return angles to the true bones, deg, and jitter, km/s^3, of poses (T, 24, 3, 3) in a part."""
    frames = wearer.during(span)
    bones = global_rotations(local[frames])
    errors = {
        name: np.degrees(rot.geodesic_angle(bones[:, SITES[name]], truth[frames]))
        for name, truth in wearer.truth.items()
    }
    columns = {key: np.mean([errors[name] for name in names], 0) for key, names in TRUE_BONES.items()}
    columns["mean of 5"] = np.mean(list(errors.values()), 0)
    columns["jitter"] = jitter(local[frames], default_body().offsets, RATE)
    return {key: measure(values) for key, values in columns.items()}


def thigh_columns(wearer: Wearer, local: Array, joint: int) -> dict[str, Metric]:
    """Return the angle from vertical, deg, of a thigh in poses (T, 24, 3, 3), by part."""
    up = global_rotations(local)[:, joint, :, 1]
    tilt = np.degrees(np.arctan2(np.hypot(up[:, 0], up[:, 2]), up[:, 1]))
    return {part: measure(tilt[wearer.during(span)]) for part, span in SITTER.parts.items()}


def gait_columns(wearer: Wearer, local: Array) -> dict[str, Metric]:
    """Return the thighs' strides per second on the straight walk, and jitter in some parts, km/s^3."""
    walk = wearer.during(STRAIGHT_WALK)
    bones = global_rotations(local[walk])
    columns = {
        f"{side}, Hz": measure(_strides(bones[:, joint, :, 1])) for side, joint in (("left", 1), ("right", 2))
    }
    times = {
        "standing": SITTER.parts["standing"],
        "sitting": SITTER.parts["after 20 s"],
        "walking": STRAIGHT_WALK,
    }
    offsets = default_body().offsets
    for name, span in times.items():
        columns[name] = measure(jitter(local[wearer.during(span)], offsets, RATE))
    return columns


def _strides(axis: Array) -> Array:
    """Return the strides per second (N,) of a bone's axis (T, 3) that swings, from peak to peak."""
    from scipy.signal import find_peaks

    level = axis[:, [0, 2]] - axis[:, [0, 2]].mean(0)
    swing = level @ np.linalg.svd(level, full_matrices=False)[2][0]
    peaks, _ = find_peaks(swing, prominence=swing.std(), distance=round(0.5 * RATE))
    return RATE / np.diff(peaks)


# --- output -------------------------------------------------------------------------------------------------


def format_table(title: str, table: Table) -> str:
    """Format a table with "mean ± deviation" in each cell and the numbers of values in the last row."""
    return "\n".join([title, *aligned(cells(title, table))])


def cells(title: str, table: Mapping[str, Mapping[str, Sequence[float]]]) -> list[list[str]]:
    """Return the cells of a table of this title: a head, a row for each method, and the numbers of values.

    Args:
        title: as `measure_models` names it.
        table: mean, deviation and number of values by row and column.
    """
    head = list(next(iter(table.values())))
    digits = [2 if name == "jitter" or "Hz" in title else 1 for name in head]
    return [
        ["", *head],
        *(
            [name, *(f"{v[0]:.{d}f} ± {v[1]:.{d}f}" for v, d in zip(row.values(), digits, strict=True))]
            for name, row in table.items()
        ),
        ["count", *(str(int(values[2])) for values in next(iter(table.values())).values())],
    ]
