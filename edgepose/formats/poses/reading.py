"""Reading poses back from files: CSV and BVH as edgepose writes them, NPZ with the keys of AMASS, and DIP's
pickles with true poses.

Files are hostile until checked: what comes out is finite, in order and made of rotations.
"""

from __future__ import annotations

import csv
import sys
from array import array
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import EdgeposeError
from edgepose.formats.bvh import FRAME_TIMES, salvage_bvh, tidy_rate
from edgepose.formats.joint_tree import LARGEST, JointTree
from edgepose.formats.poses.csv_columns import FORMS, pose_columns
from edgepose.formats.recordings import dip_imu
from edgepose.placements import PLACEMENTS
from edgepose.pose import PoseFrame, format_status, parse_status
from edgepose.rotations import (
    Z_UP_TO_T,
    euler_to_matrix,
    nearest_rotation,
    quat_to_matrix,
    rotvec_to_matrix,
)
from edgepose.skeleton import JOINTS, PARENTS, standing_place
from edgepose.utils.safe_npz import BROKEN, check_size, member_names, open_npz

Array = NDArray[np.float64]

MAX_LINE = 16_384
"""Characters; a true row has less than 4000, and a file without line breaks must not fill the memory."""

BLOCK = 4096
"""Poses that are read from a CSV file at a time."""

LARGEST_TIME = 1e12
"""Seconds, and numbers of frames, beyond this are taken for damage."""

_POSE_BYTES = 8 * 9 * len(JOINTS)  # that a pose takes
_HEADER = b"frame,time_s,status,"
_SAME_PLACE_M = 1e-5  # BVH has four decimals of a centimetre


class Poses(NamedTuple):
    """Poses of one file.

    Attributes:
        frames: (T,) numbers of the frames, rising.
        time_s: (T,) on the source's clock, seconds.
        rotations: (T, 24, 3, 3) local rotations, joint 0 against T.
        translation: (T, 3) place of the pelvis in T, metres, if the file has it.
        held: T sets, see `PoseFrame`.
        warming_up: T, see `PoseFrame`.
    """

    frames: NDArray[np.int64]
    time_s: Array
    rotations: Array
    translation: Array | None
    held: list[frozenset[str]]
    warming_up: list[bool]

    @property
    def status(self) -> list[str]:
        """T texts, see `format_status`."""
        return [format_status(*state) for state in zip(self.held, self.warming_up, strict=True)]

    @property
    def frame_time(self) -> float:
        """Seconds from a frame to the next; 1/60 where there is but one."""
        steps = np.diff(self.frames)
        # The median, because time leaps where all sensors were silent for long.
        return float(np.median(np.diff(self.time_s) / steps)) if len(steps) else 1.0 / 60.0

    @property
    def rate(self) -> float:
        """Frames per second; 60 where there is but one frame."""
        return tidy_rate(self.frame_time)

    def pose_frames(self) -> Iterator[PoseFrame]:
        """The poses one by one, as a sink takes them; files hold no standard deviations of joints here."""
        unknown = np.full(len(JOINTS), np.nan, np.float32)
        for i, (frame, time_s) in enumerate(zip(self.frames.tolist(), self.time_s.tolist(), strict=True)):
            where = None if self.translation is None else self.translation[i]
            state = self.held[i], self.warming_up[i]
            yield PoseFrame(frame, time_s, self.rotations[i], unknown, where, *state)


def read_poses(path: str | Path) -> Poses:
    """Poses of a .npz file with the keys of AMASS, a .bvh file with SMPL's joints, a .pkl of DIP's with true
    poses, or of a CSV file, whatever its ending.

    Args:
        path: file to read; "-" is CSV on standard input.

    Raises:
        EdgeposeError: no such file, or not a file of poses.
    """
    poses, problem = _read(Path(path))
    if problem is not None:
        raise EdgeposeError(problem)
    return poses


def salvage_poses(path: Path) -> tuple[Poses, str | None]:
    """The poses before the first bad one, and one line on what is bad; see `read_poses`.

    Raises:
        EdgeposeError: there is none.
    """
    poses, problem = _read(path)
    return poses, problem and f"{problem}; {len(poses.frames)} poses are taken"


def _read(path: Path) -> tuple[Poses, str | None]:
    """The poses before the first bad one, and what is wrong with the file."""
    poses, problem = _READERS.get(path.suffix.lower(), _read_csv_file)(path)
    if not FRAME_TIMES[0] < poses.frame_time < FRAME_TIMES[1]:
        raise EdgeposeError(f"{path}: {poses.frame_time:g} s from pose to pose is not possible")
    return poses, problem


def _joined(blocks: list[Poses]) -> Poses:
    translations = [block.translation for block in blocks if block.translation is not None]
    return Poses(
        np.concatenate([block.frames for block in blocks]),
        np.concatenate([block.time_s for block in blocks]),
        np.concatenate([block.rotations for block in blocks]),
        np.concatenate(translations) if translations else None,
        [names for block in blocks for names in block.held],
        [warm for block in blocks for warm in block.warming_up],
    )


def is_poses(path: Path) -> bool:
    """Whether a file seems to hold poses and not a recording of sensors; "-" is standard input."""
    if path.suffix.lower() == ".bvh":
        return True
    try:
        if str(path) == "-":
            return _starts_as_poses(cast(BufferedReader, sys.stdin.buffer).peek(32))
        if path.suffix.lower() == ".npz":
            names = member_names(path)
            return "poses.npy" in names and not _is_recording(names)
        with path.open("rb") as file:
            return _starts_as_poses(file.read(32))
    except (OSError, *BROKEN):
        return False


def _starts_as_poses(start: bytes) -> bool:
    # Of a pipe only a few bytes may have come; recordings start with other ones.
    start = start.removeprefix(b"\xef\xbb\xbf")[: len(_HEADER)]
    return start != b"" and _HEADER.startswith(start)


def _absurd(values: NDArray[Any], most: float = LARGEST) -> NDArray[np.bool_]:
    """Which of the numbers are NaN, or too large to be true."""
    return ~(np.abs(values.astype(np.float64)) <= most)


# --- CSV ----------------------------------------------------------------------------------------------------


def _read_csv_file(path: Path) -> tuple[Poses, str | None]:
    blocks: list[Poses] = []
    problem = None
    try:
        blocks.extend(read_blocks(path))  # one by one: what has come before an error stays
    except EdgeposeError as error:
        if not blocks:
            raise
        problem = str(error)
    return _joined(blocks), problem


def read_blocks(path: str | Path) -> Iterator[Poses]:
    """Poses of a CSV file in blocks of up to `BLOCK`, at least one, in any of the representations, which
    is found from its header; "-" is standard input.

    Raises:
        EdgeposeError: no such file, or not a file of poses; names the row, counted from 1 for the header.
            All poses before that have come.
    """
    if str(path) == "-":
        yield from _read_csv(sys.stdin, "standard input")
        return
    try:
        # A byte that is no text spoils its row, not the block that is read with it.
        with Path(path).open(encoding="utf-8-sig", errors="replace", newline="") as file:
            yield from _read_csv(file, str(path))
    except OSError as error:
        raise EdgeposeError(f"cannot read poses from {path}: {error.strerror or error}") from error


class _BadRowError(EdgeposeError):
    """A row that is no pose; `row` is its number, counted from 1 for the header."""

    def __init__(self, name: str, row: int, problem: str) -> None:
        super().__init__(f"{name}, row {row}: {problem}")
        self.row = row


def _read_csv(file: TextIO, name: str) -> Iterator[Poses]:
    rows = csv.reader(_lines(file))
    first = 2
    last: tuple[int, float] | None = None
    try:
        form, std, moves = _recognise(next(rows, []), name)
        columns = len(pose_columns(form, std, moves))
        while block := list(islice(rows, BLOCK)):
            read = partial(_block, first=first, last=last, columns=columns, form=form, moves=moves, name=name)
            poses, error = _good(block, first, read)
            if poses is not None:
                first, last = first + len(poses.frames), (int(poses.frames[-1]), float(poses.time_s[-1]))
                yield poses
            if error is not None:
                raise error
    except csv.Error as error:
        raise EdgeposeError(f"{name}, row {rows.line_num + 1}: {error}") from error
    except UnicodeDecodeError as error:
        raise EdgeposeError(f"{name} is not a text file: byte {error.start} is not UTF-8") from error
    if last is None:
        raise EdgeposeError(f"{name} has no poses, only a header")


def _good(
    rows: list[list[str]], first: int, read: Callable[[list[list[str]]], Poses]
) -> tuple[Poses | None, EdgeposeError | None]:
    """The poses before the first bad row, and what is wrong with that; the first row has number `first`."""
    problem = None
    while rows:
        try:
            return read(rows), problem
        except _BadRowError as error:
            problem, rows = error, rows[: error.row - first]
    return None, problem


_TOO_LONG = "the line is too long for a file of poses"


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            yield _TOO_LONG  # a bad row, and the rows before it stay good
            return
        yield line


def _recognise(header: list[str], name: str) -> tuple[str, bool, bool]:
    """Representation, whether there are standard deviations and translation, as a header announces them."""
    for form in FORMS:
        for std in (False, True):
            for moves in (False, True):
                if header == pose_columns(form, std, moves):
                    return form, std, moves
    if any("\ufffd" in column for column in header):
        raise EdgeposeError(f"{name} is not a text file")
    raise EdgeposeError(
        f"{name} is not a file of poses: its first line must be 'frame,time_s,status,pelvis_...' and name "
        "the 24 joints in SMPL order"
    )


def _block(
    rows: list[list[str]],
    first: int,
    last: tuple[int, float] | None,
    columns: int,
    form: str,
    moves: bool,
    name: str,
) -> Poses:
    """Poses of rows of which the first has number `first`, after the frame and time `last`."""
    frame_before, time_before = last or (None, -np.inf)
    frames, times, numbers = array("q"), array("d"), array("d")
    held, warming_up = list[frozenset[str]](), list[bool]()
    for number, row in enumerate(rows, start=first):
        if row == [_TOO_LONG]:
            raise _BadRowError(name, number, _TOO_LONG)
        if len(row) != columns:
            raise _BadRowError(name, number, f"{len(row)} columns, the header has {columns}")
        try:
            frame = int(row[0])
            times.append(float(row[1]))
            numbers.extend(map(float, row[3:]))
            frames.append(frame)
        except (ValueError, OverflowError) as error:
            raise _BadRowError(name, number, str(error)) from error
        if frame_before is not None and frame <= frame_before:
            raise _BadRowError(name, number, f"frame {frame} comes after frame {frame_before}")
        if times[-1] <= time_before:
            raise _BadRowError(name, number, f"time {row[1]} s is not after that of the row before")
        if not row[2].isprintable() or "," in row[2] or '"' in row[2]:
            raise _BadRowError(name, number, "the status has a comma, a quote or a line break in it")
        names, warm = parse_status(row[2])
        held.append(names)
        warming_up.append(warm)
        frame_before, time_before = frame, times[-1]
    values = np.frombuffer(numbers).reshape(len(frames), -1)
    seconds = np.frombuffer(times)
    numbered = np.frombuffer(frames, np.int64)
    bad = _absurd(seconds, LARGEST_TIME) | _absurd(numbered, LARGEST_TIME) | _absurd(values).any(axis=1)
    if bad.any():
        what = "a number is infinite or not a number, or far too large"
        raise _BadRowError(name, int(bad.argmax()) + first, what)
    width = len(FORMS[form])
    rotations, off = _rotations(
        form, values[:, : len(JOINTS) * width].reshape(len(frames), len(JOINTS), width)
    )
    if (off > 1e-3).any():
        at, joint = np.argwhere(off > 1e-3)[0].tolist()
        raise _BadRowError(name, at + first, f"the numbers of {JOINTS[joint]} are not a rotation")
    where = values[:, -3:] if moves else None
    return Poses(numbered, seconds, rotations, where, held, warming_up)


def _rotations(form: str, values: Array) -> tuple[Array, Array]:
    """Rotation matrices (T, 24, 3, 3) of the numbers (T, 24, n) of one representation, and how far (T, 24)
    these are from any rotation's.
    """
    none = np.zeros(values.shape[:2])
    if form == "axis-angle":
        return rotvec_to_matrix(values), none
    if form == "euler":
        return euler_to_matrix(values, "zxy"), none
    if form == "quat":
        norms = np.linalg.norm(values, axis=-1, keepdims=True)
        return quat_to_matrix(values / np.where(norms > 0.0, norms, 1.0)), np.abs(norms[..., 0] - 1.0)
    matrices = values.reshape(*values.shape[:-1], 3, 3)
    # Six written digits leave a matrix a little off a rotation; anything further is not one.
    nearest = nearest_rotation(matrices)
    return nearest, np.abs(matrices - nearest).max(axis=(-2, -1))


# --- NPZ ----------------------------------------------------------------------------------------------------


def _is_recording(names: set[str]) -> bool:
    """Whether an archive with these members is a recording of sensors, which may hold true poses besides."""
    return any(f"{placement}_quat.npy" in names for placement in PLACEMENTS)


def _read_npz(path: Path) -> tuple[Poses, None]:
    """Poses of an AMASS file, in its world with Z up, or the true poses of a recording, which are in T.

    Frames, times and status are there if edgepose has written the file. Of SMPL-H and SMPL-X the body's 22
    joints are taken, hands stay at rest.
    """
    arrays, in_t = _load(path)
    if "poses" not in arrays or arrays["poses"].ndim != 2 or not len(arrays["poses"]):
        raise EdgeposeError(f"{path}: no poses in it; it needs an array 'poses' (frames, 72)")
    count, width = arrays["poses"].shape
    if width < 66 or width % 3:
        raise EdgeposeError(f"{path}: 'poses' must be (frames, 72), it is {arrays['poses'].shape}")
    check_size(path, count * _POSE_BYTES)
    joints = len(JOINTS) if width == 72 else 22
    vectors = _numbers(path, arrays, "poses", (count, width))[:, : 3 * joints].reshape(count, joints, 3)
    rotations = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
    rotations[:, :joints] = rotvec_to_matrix(vectors)
    translation = _numbers(path, arrays, "trans", (count, 3)) if "trans" in arrays else None
    if translation is not None and not translation.any():
        translation = None  # AMASS wants the array where nothing is known, too
    if not in_t:
        rotations[:, 0] = Z_UP_TO_T @ rotations[:, 0]
        translation = None if translation is None else translation @ Z_UP_TO_T.T
    frames, time_s = _clock(path, arrays, count)
    return Poses(frames, time_s, rotations, translation, *_states(path, arrays, count)), None


def _load(path: Path) -> tuple[dict[str, NDArray[Any]], bool]:
    """The arrays of a file that matter, and whether it is a recording with true poses in T."""
    wanted = ("poses", "trans", "mocap_framerate", "mocap_frame_rate", "time_s", "frame", "held", "filling")
    try:
        names = member_names(path)
        with open_npz(path) as archive:
            return {key: archive[key] for key in wanted if f"{key}.npy" in names}, _is_recording(names)
    except OSError as error:
        raise EdgeposeError(f"cannot read poses from {path}: {error.strerror or error}") from error
    except BROKEN as error:
        reason = " ".join(str(error).split())
        raise EdgeposeError(f"{path}: not a whole NPZ file ({reason}); copy it again") from None


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...]) -> Array:
    """An array as numbers, finite and not absurd."""
    values = arrays[key]
    if values.dtype.kind not in "fiub" or values.shape != shape:
        raise EdgeposeError(f"{path}: {key!r} is {values.dtype} {values.shape} and not numbers {shape}")
    numbers = values.astype(np.float64)
    bad = _absurd(numbers, LARGEST_TIME if key in ("time_s", "frame") else LARGEST)
    if bad.any():
        where = f" of frame {np.argwhere(bad)[0][0]}" if shape else ""
        raise EdgeposeError(f"{path}: a number in {key!r}{where} is not finite, or far too large")
    return numbers


def _clock(path: Path, arrays: Mapping[str, NDArray[Any]], count: int) -> tuple[NDArray[np.int64], Array]:
    """Frames (T,) and times (T,): as written, else counted from 0 at the file's rate."""
    frames = np.arange(count)
    if "frame" in arrays:
        frames = _numbers(path, arrays, "frame", (count,)).astype(np.int64)
        if (np.diff(frames) <= 0).any():
            raise EdgeposeError(f"{path}: the numbers in 'frame' do not rise")
    if "time_s" in arrays:
        times = _numbers(path, arrays, "time_s", (count,))
        if (np.diff(times) <= 0).any():
            raise EdgeposeError(f"{path}: the times in 'time_s' do not rise")
        return frames, times
    key = "mocap_framerate" if "mocap_framerate" in arrays else "mocap_frame_rate"
    if key not in arrays or arrays[key].size != 1:
        raise EdgeposeError(f"{path}: needs one number 'mocap_framerate', frames per second")
    rate = float(_numbers(path, {key: arrays[key].reshape(())}, key, ()))
    if not 1e-2 < rate < 1e5:
        raise EdgeposeError(f"{path}: a frame rate of {rate:g} Hz is not possible")
    return frames, np.arange(count) / rate


def _all_new(count: int) -> tuple[list[frozenset[str]], list[bool]]:
    """`held` and `warming_up` of poses of which nothing is known to be missing."""
    return [frozenset()] * count, [False] * count


def _states(
    path: Path, arrays: Mapping[str, NDArray[Any]], count: int
) -> tuple[list[frozenset[str]], list[bool]]:
    """`held` and `warming_up` of T poses."""
    if "held" not in arrays or "filling" not in arrays:
        return _all_new(count)
    held = _numbers(path, arrays, "held", (count, len(PLACEMENTS))) != 0
    filling = _numbers(path, arrays, "filling", (count,)) != 0
    places = np.arange(len(PLACEMENTS))
    masks = (held @ (1 << places)).tolist()
    sets = {mask: frozenset(PLACEMENTS[i] for i in places if mask >> i & 1) for mask in set(masks)}
    return [sets[mask] for mask in masks], filling.tolist()


# --- other files --------------------------------------------------------------------------------------------


_LIMBS = {
    "left_knee": (0, -1, 0),
    "right_knee": (0, -1, 0),
    "left_elbow": (1, 0, 0),
    "right_elbow": (-1, 0, 0),
}
"""Joints at the far ends of limbs, and where the limbs point in the T-pose."""


def _read_bvh(path: Path) -> tuple[Poses, str | None]:
    """Poses of a BVH file with SMPL's joints, whose world has the axes of T."""
    tree, problem = salvage_bvh(path)
    places = _smpl_joints(path, tree)
    count = len(tree.rotations)
    rotations = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
    metres = _metres(tree.offsets[places["left_ankle"]])
    offsets = np.zeros((len(JOINTS), 3))
    for joint, name in enumerate(JOINTS):
        if name in places:
            rotations[:, joint] = tree.rotations[:, places[name]]
            offsets[joint] = metres * tree.offsets[places[name]]
    translation = metres * tree.positions[:, 0]
    # Where `BvhSink` puts those of whom it knows no place.
    known = np.abs(translation - standing_place(offsets)).max() > _SAME_PLACE_M
    times = np.arange(count) / tree.rate
    place = translation if known else None
    poses = Poses(np.arange(count), times, rotations, place, *_all_new(count))
    return poses, problem


def _smpl_joints(path: Path, tree: JointTree) -> dict[str, int]:
    """Places in a tree of SMPL's joints by name; only hands may be missing, and case does not matter.

    Raises:
        EdgeposeError: it has other joints, or they turn from another pose than the T-pose.
    """
    places = {name.lower(): place for place, name in enumerate(tree.names)}
    missing = [name for name in JOINTS[:22] if name not in places]
    if missing:
        more = " ..." if len(missing) > 3 else ""
        raise EdgeposeError(f"{path}: its joints are not SMPL's: no {', '.join(missing[:3])}{more}")
    for joint, parent in enumerate(PARENTS):
        if (place := places.get(JOINTS[joint])) is not None:
            wanted = -1 if parent < 0 else places[JOINTS[parent]]
            if tree.parents[place] != wanted:
                raise EdgeposeError(f"{path}: its joint {JOINTS[joint]} does not hang where SMPL's does")
    for name, direction in _LIMBS.items():
        offset = tree.offsets[places[name]]
        if not offset @ direction > 0.7 * np.linalg.norm(offset):
            raise EdgeposeError(
                f"{path}: where all angles are zero, its {name} is not where a T-pose has it (Y up, facing Z)"
            )
    return places


def _metres(shank: Array) -> float:
    """Metres in the unit of a shank (3,): BVH names none, and m, cm and mm are common."""
    length = max(float(np.linalg.norm(shank)), 1e-9)
    return min((1.0, 0.01, 0.001), key=lambda metres: abs(np.log(length * metres / 0.4)))


def _read_dip(path: Path) -> tuple[Poses, None]:
    """True poses of DIP-IMU or of DIP's TotalCapture."""
    rotations = dip_imu.read_true_pose(path)
    count = len(rotations)
    frames = np.arange(count)
    return Poses(frames, frames / dip_imu.RATE, rotations, None, *_all_new(count)), None


_READERS: dict[str, Callable[[Path], tuple[Poses, str | None]]] = {
    ".npz": _read_npz,
    ".bvh": _read_bvh,
    ".pkl": _read_dip,
}
"""Readers by ending, of poses and what is wrong with a file; all others are CSV."""
