"""Poses as NPZ with the keys of AMASS; docs/reference/outputs.md describes the arrays."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import FileFormatError
from edgepose.formats.joint_tree import LARGEST
from edgepose.formats.poses.base import LARGEST_TIME, PoseFormat, all_new, is_absurd
from edgepose.placements import PLACEMENTS
from edgepose.pose import CONTACTS, PoseSequence, held_sensors
from edgepose.rotations import Z_UP_TO_T, matrix_to_rotvec, rotvec_to_matrix
from edgepose.skeleton import JOINTS
from edgepose.utils.safe_npz import BROKEN, check_size, member_names, open_npz

Array = NDArray[np.float64]

BETAS = 16
"""Shape coefficients of SMPL; all are zero, the average body."""

PELVIS_OFFSETS = {
    "smpl": (0.0, -0.22, 0.03),
    "smplh": (0.0, -0.22, 0.03),
    "smplx": (0.0, -0.35, 0.01),
}
"""Position of the pelvis of the average body of each model, metres, to the nearest centimetre.

SMPL's models put the pelvis at `trans` plus this, along the axes of the file's world, because `trans` moves
the origin of the model, which lies above the pelvis of the T-pose, while the root rotation turns the body
about its pelvis. Other bodies differ by a few centimetres, which only the licensed models know.
"""

JOINT_COUNTS = {24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}
"""Numbers of joints that can be written, and the body models that have them; fingers and face are at rest."""

ABOUT = ("model", "calibration", "source", "date", "edgepose", "without")
"""Keys of the facts about the origin of the poses."""

_LONGEST_ABOUT = 10_000  # characters

_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
"""Names of the frame rate; the first is SMPL-H's, the second SMPL-X's."""

_PARTS = ("root_orient", "pose_body")
"""Arrays that hold the first 22 joints in files without `poses`."""

_OURS = ("pelvis_offset", "time_s", "frame", "held", "filling", "contacts", "about")
"""Arrays that only edgepose writes."""

_WANTED = ("poses", *_PARTS, "trans", "surface_model_type", *_RATES, *_OURS)
"""Arrays that are read."""

_BODY = 22
"""Joints that all three models share, in the same order."""

_POSE_BYTES = 8 * 9 * len(JOINTS)  # memory for a pose


# --- reading ------------------------------------------------------------------------------------------------


def read_npz(path: Path) -> tuple[PoseSequence, None]:
    """Read the poses of an AMASS file, in its world with Z up, or the true poses of a recording, in T.

    Frames, times and status are included if edgepose wrote the file. From SMPL-H and SMPL-X the 22 joints of
    the body are taken; hands stay at rest.
    """
    arrays, in_t = _load(path)
    _join_parts(arrays)
    if "poses" not in arrays or arrays["poses"].ndim != 2 or not len(arrays["poses"]):
        raise FileFormatError(f"{path}: no poses in it; it needs an array 'poses' (frames, 72)")
    count, width = arrays["poses"].shape
    if width < 66 or width % 3:
        raise FileFormatError(f"{path}: 'poses' must be (frames, 72), it is {arrays['poses'].shape}")
    check_size(path, count * _POSE_BYTES)
    joints = len(JOINTS) if width == 72 else _BODY
    vectors = _numbers(path, arrays, "poses", (count, width))[:, : 3 * joints].reshape(count, joints, 3)
    rotations = np.broadcast_to(np.eye(3), (count, len(JOINTS), 3, 3)).copy()
    rotations[:, :joints] = rotvec_to_matrix(vectors)
    translation = _pelvis(path, arrays, count, None if in_t else width)
    if not in_t:
        rotations[:, 0] = Z_UP_TO_T @ rotations[:, 0]
        translation = None if translation is None else translation @ Z_UP_TO_T.T
    frames, time_s = _clock(path, arrays, count)
    states = _states(path, arrays, count)
    contacts = _contacts(path, arrays, count)
    return PoseSequence(frames, time_s, rotations, translation, *states, _about(arrays), contacts), None


def _pelvis(path: Path, arrays: Mapping[str, NDArray[Any]], count: int, width: int | None) -> Array | None:
    """Return the positions of the pelvis (T, 3) in the file's world, metres; None if they are unknown.

    Args:
        path: of the file, for messages.
        arrays: its arrays.
        count: T.
        width: columns of `poses`; None if `trans` is the position of the pelvis.
    """
    if "trans" not in arrays:
        return None
    trans = _numbers(path, arrays, "trans", (count, 3))
    if not trans.any():  # AMASS requires the array even if the translation is unknown
        return None
    if "pelvis_offset" in arrays:
        return trans + _numbers(path, arrays, "pelvis_offset", (3,))
    if width is None or {"frame", "filling"} <= arrays.keys():  # edgepose's, before it wrote `pelvis_offset`
        return trans
    model = str(arrays.get("surface_model_type", "smplx" if width == 3 * 55 else "smpl"))
    return trans + PELVIS_OFFSETS["smplx" if model.startswith("smplx") else "smpl"]


def _contacts(path: Path, arrays: Mapping[str, NDArray[Any]], count: int) -> NDArray[np.float32] | None:
    """Return the probabilities of contact (T, 7); None if they are unknown."""
    if "contacts" not in arrays:
        return None
    contacts = _numbers(path, arrays, "contacts", (count, len(CONTACTS)))
    if ((contacts < 0.0) | (contacts > 1.0)).any():
        raise FileFormatError(f"{path}: a number in 'contacts' is not a probability from 0 to 1")
    return contacts.astype(np.float32)


def _join_parts(arrays: dict[str, NDArray[Any]]) -> None:
    """Add the array `poses` if the root and the body are arrays of their own, as in some SMPL-X files."""
    parts = [arrays.pop(key, None) for key in _PARTS]
    if "poses" not in arrays and all(part is not None and part.ndim == 2 for part in parts):
        root, body = (np.asarray(part) for part in parts)
        if len(root) == len(body) and root.shape[1] == 3:
            arrays["poses"] = np.concatenate([root, body[:, :63]], axis=1)


def _load(path: Path) -> tuple[dict[str, NDArray[Any]], bool]:
    """Load the relevant arrays of a file, and whether it is a recording with true poses in T."""
    try:
        names = member_names(path)
        with open_npz(path) as archive:
            return {key: archive[key] for key in _WANTED if f"{key}.npy" in names}, _is_recording(names)
    except OSError as error:
        raise FileFormatError(f"cannot read poses from {path}: {error.strerror or error}") from error
    except BROKEN as error:
        reason = " ".join(str(error).split())
        raise FileFormatError(f"{path}: not a complete NPZ file ({reason}); copy it again") from None


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], key: str, shape: tuple[int, ...]) -> Array:
    """Return an array of `shape` as numbers, checked to be finite and plausible."""
    values = arrays[key]
    if values.dtype.kind not in "fiub" or values.shape != shape:
        raise FileFormatError(f"{path}: {key!r} is {values.dtype} {values.shape}, not numbers {shape}")
    numbers = values.astype(np.float64)
    bad = is_absurd(numbers, LARGEST_TIME if key in ("time_s", "frame") else LARGEST)
    if bad.any():
        where = f" of frame {np.argwhere(bad)[0][0]}" if shape else ""
        raise FileFormatError(f"{path}: a number in {key!r}{where} is not finite, or far too large")
    return numbers


def _clock(path: Path, arrays: Mapping[str, NDArray[Any]], count: int) -> tuple[NDArray[np.int64], Array]:
    """Return frames (T,) and times (T,): as stored, or counted from 0 at the file's rate."""
    frames = np.arange(count)
    if "frame" in arrays:
        frames = _numbers(path, arrays, "frame", (count,)).astype(np.int64)
        if (np.diff(frames) <= 0).any():
            raise FileFormatError(f"{path}: the numbers in 'frame' do not increase")
    if "time_s" in arrays:
        times = _numbers(path, arrays, "time_s", (count,))
        if (np.diff(times) <= 0).any():
            raise FileFormatError(f"{path}: the times in 'time_s' do not increase")
        return frames, times
    key = next((key for key in _RATES if key in arrays and arrays[key].size == 1), None)
    if key is None:
        raise FileFormatError(f"{path}: needs one number 'mocap_framerate', frames per second")
    rate = float(_numbers(path, {key: arrays[key].reshape(())}, key, ()))
    if not 1e-2 < rate < 1e5:
        raise FileFormatError(f"{path}: a frame rate of {rate:g} Hz is not possible")
    return frames, np.arange(count) / rate


def _states(
    path: Path, arrays: Mapping[str, NDArray[Any]], count: int
) -> tuple[list[frozenset[str]], list[bool]]:
    """Return `held` and `warming_up` of the poses."""
    if "held" not in arrays or "filling" not in arrays:
        return all_new(count)
    held = _numbers(path, arrays, "held", (count, len(PLACEMENTS))) != 0
    filling = _numbers(path, arrays, "filling", (count,)) != 0
    bits = np.arange(len(PLACEMENTS))
    masks = (held @ (1 << bits)).tolist()
    sets = {mask: frozenset(PLACEMENTS[i] for i in bits if mask >> i & 1) for mask in set(masks)}
    return [sets[mask] for mask in masks], filling.tolist()


def _about(arrays: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    """Return the facts about the origin of the poses; empty if they are not in edgepose's form."""
    with suppress(KeyError, ValueError, RecursionError):
        found = json.loads(str(arrays["about"])[:_LONGEST_ABOUT])
        if isinstance(found, dict):
            return {key: str(found[key]) for key in ABOUT if key in found}
    return {}


def holds_poses(path: Path) -> bool:
    """Return whether an archive has poses and is not a recording of sensors with true poses."""
    try:
        names = member_names(path)
    except (OSError, *BROKEN):
        return False
    some = "poses.npy" in names or {f"{part}.npy" for part in _PARTS} <= names
    return some and not _is_recording(names)


def _is_recording(names: set[str]) -> bool:
    """Return whether an archive with these members is a recording of sensors, perhaps with true poses."""
    return any(f"{placement}_quat.npy" in names for placement in PLACEMENTS)


# --- writing ------------------------------------------------------------------------------------------------


def write_npz(
    path: Path,
    blocks: Iterable[PoseSequence],
    count: int,
    rate: float,
    joints: int = 24,
    about: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Write poses, keeping only a part of them in memory.

    Args:
        path: file to write.
        blocks: the poses, in order.
        count: total number of poses.
        rate: frames per second.
        joints: a key of `JOINT_COUNTS`.
        about: see `PoseSequence`.

    Raises:
        OSError: the file cannot be written.
    """
    frames, times, held, filling, positions, contacts = [], [], [], [], [], []
    model = JOINT_COUNTS[joints].replace("-", "").lower()
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open("poses.npy", "w", force_zip64=True) as member:
            header = {"descr": "<f4", "fortran_order": False, "shape": (count, 3 * joints)}
            np.lib.format.write_array_header_1_0(member, header)
            for block in blocks:
                member.write(_vectors(block, joints).tobytes())
                frames.append(block.frames)
                times.append(block.time_s)
                held.append(held_sensors(block.held))
                filling.append(np.array(block.warming_up, bool))
                positions.append(_trans(block, model))
                contacts += [] if block.contacts is None else [block.contacts]
        arrays: dict[str, NDArray[Any]] = {
            "trans": np.concatenate(positions),
            "betas": np.zeros(BETAS),
            "gender": np.array("neutral"),
            "mocap_framerate": np.array(float(rate)),
            "mocap_frame_rate": np.array(float(rate)),
            "surface_model_type": np.array(model),
            "pelvis_offset": np.array(PELVIS_OFFSETS[model]),
            "frame": np.concatenate(frames),
            "time_s": np.concatenate(times),
            "held": np.concatenate(held),
            "filling": np.concatenate(filling),
            "about": np.array(json.dumps(dict(about))),
        }
        if contacts:
            arrays["contacts"] = np.concatenate(contacts)
        for key, values in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def _vectors(block: PoseSequence, joints: int) -> NDArray[np.float32]:
    """Return axis-angle vectors (T, 3 * joints), the pelvis relative to AMASS's world with Z up."""
    rotations = block.rotations.copy()
    rotations[:, 0] = Z_UP_TO_T.T @ rotations[:, 0]
    vectors = matrix_to_rotvec(rotations)
    if joints == len(JOINTS):
        return vectors.reshape(len(rotations), -1).astype("<f4")
    result = np.zeros((len(rotations), joints, 3), "<f4")
    result[:, :_BODY] = vectors[:, :_BODY]
    return result.reshape(len(rotations), -1)


def _trans(block: PoseSequence, model: str) -> NDArray[np.float32]:
    """Return `trans` (T, 3) of a model, see `PELVIS_OFFSETS`; zeros if the translation is unknown."""
    if block.translation is None:
        return np.zeros((len(block.frames), 3), "<f4")
    return (block.translation @ Z_UP_TO_T - PELVIS_OFFSETS[model]).astype("<f4")


FORMAT = PoseFormat((".npz",), read_npz, holds_poses)
