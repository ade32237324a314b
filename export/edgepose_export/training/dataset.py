"""Synthetic recordings as takes and tensors for training and evaluation."""

from __future__ import annotations

from collections import Counter
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgepose import rotations as rot
from edgepose.calibration import GRAVITY
from edgepose.errors import EdgeposeError
from edgepose.formats.recordings.base import MAX_VALUE
from edgepose.placements import BONES, PLACEMENTS
from edgepose.pose import CONTACTS
from edgepose.skeleton import PARENTS, global_rotations
from edgepose.utils.safe_npz import BROKEN, open_npz
from edgepose.utils.similar_names import choices
from edgepose_export.synthesis.contacts import PLACE
from edgepose_export.synthesis.virtual_imus import INERTIAL_FROM_BODY
from edgepose_export.training.sources import GROUPS, HELD_OUT, OWN, RULES, VALIDATION, part_of

SEATED = ".seated"
"""End of the names of takes with legs made by `edgepose_export.synthesis.sitting` or `floor`."""

RESTS = ".rests"
"""End of the names of takes with rests made by `edgepose_export.synthesis.rests`."""

PARTS = (*HELD_OUT, *VALIDATION, *GROUPS)
"""Parts, and groups of parts, that models are measured on."""

RATE = 60.0
"""Frames per second of all networks."""


class Take(NamedTuple):
    """One synthetic recording.

    Attributes:
        name: path below the folder of the takes, without suffix.
        orientation: (T, 6, 3, 3) float32 bone orientations R_TB.
        acceleration: (T, 6, 3) float32 accelerations in T without gravity, m/s^2.
        pose: (T, 24, 3, 3) float32 true local rotations.
        license: licence of the motion that the take was made from.
        place: (T, 10) float32 contacts and velocity, see `Batch`; None if they are unknown.
        source: name of its source, see `sources.SOURCES`.
        actor: key of its actor, see `sources.TakeInfo`.
        translation: (T, 3) float32 true position of the pelvis, metres, if it is known.
    """

    name: str
    orientation: NDArray[np.float32]
    acceleration: NDArray[np.float32]
    pose: NDArray[np.float32]
    license: str
    place: NDArray[np.float32] | None = None
    source: str = OWN
    actor: str = OWN
    translation: NDArray[np.float32] | None = None

    @property
    def place_or_nan(self) -> NDArray[np.float32]:
        """Contacts and velocity (T, 10), all NaN if they are unknown."""
        if self.place is None:
            return np.full((len(self.pose), PLACE), np.nan, np.float32)
        return self.place


def take_name(path: Path, root: Path | None = None) -> str:
    """Return the name of a take: its path below a folder without suffix, or else the file's name."""
    return (path.relative_to(root) if root else Path(path.name)).with_suffix("").as_posix()


def read_take(path: Path, root: Path | None = None) -> Take:
    """Read a recording that `edgepose synthesize` wrote, with sensors aligned with the bones.

    Args:
        path: the file.
        root: the folder of the takes, below which a take's path is its name.

    Raises:
        EdgeposeError: the file is of another kind.
    """
    try:
        with open_npz(path) as data:
            quats = np.stack([data[f"{name}_quat"] for name in PLACEMENTS], axis=1)
            force = np.stack([data[f"{name}_acc"] for name in PLACEMENTS], axis=1)
            poses = data["poses"].reshape(-1, 24, 3)
            rate = float(data["mocap_framerate"])
            license_note, source = str(data["license"]), str(data["source"])
            actor = str(data["actor"]) if "actor" in data else source
            place = _place(data)
            translation = data.get("trans")
        if not len(poses) == len(quats) == len(force) == (len(poses) if place is None else len(place)):
            raise ValueError("sensors and poses differ in length")
        _check_numbers(quats, force, poses)
        if translation is not None:
            _check_translation(translation, len(poses))
    except (OSError, *BROKEN) as error:
        raise EdgeposeError(
            f"{path}: not a recording with true poses ({error}); make it with edgepose synthesize"
        ) from error
    if rate != RATE:
        raise EdgeposeError(
            f"{path}: has {rate:g} frames per second; make it again with edgepose synthesize --rate 60"
        )
    inertial = rot.quat_to_matrix(quats)
    orientation = INERTIAL_FROM_BODY.T @ inertial
    local = rot.rotvec_to_matrix(poses)
    bones = global_rotations(local[0])[list(BONES)]
    if not (rot.geodesic_angle(orientation[0], bones) < 0.01).all():
        raise EdgeposeError(
            f"{path}: the sensors are not aligned with the bones; use edgepose synthesize without --mounting"
        )
    force_inertial = np.einsum("tsij,tsj->tsi", inertial, force.astype(float))
    # In a run a frame holds the mean since the previous frame, see `FrameSynchronizer`.
    force_inertial[1:] = 0.5 * (force_inertial[1:] + force_inertial[:-1])
    acceleration = (force_inertial - [0.0, 0.0, GRAVITY]) @ INERTIAL_FROM_BODY
    return Take(
        take_name(path, root),
        orientation.astype(np.float32),
        acceleration.astype(np.float32),
        local.astype(np.float32),
        license_note,
        place,
        source=source,
        actor=actor,
        translation=None if translation is None else translation.astype(np.float32),
    )


def _place(data: Any) -> NDArray[np.float32] | None:
    """Return contacts and velocity (T, 10) of a recording; None for those of versions that had none."""
    if "contact" not in data or "velocity" not in data:
        return None
    contact, velocity = data["contact"], data["velocity"]
    whole = contact.shape[1:] == (len(CONTACTS),) and contact.dtype.kind in "iub"
    if not (whole and np.isin(contact, (0, 1)).all()):
        raise ValueError("contacts are not 0 or 1")
    numbers = velocity.dtype.kind == "f" and (np.abs(velocity) < MAX_VALUE).all()
    if velocity.shape != (len(contact), 3) or not numbers:
        raise ValueError("a velocity is not finite, or absurd")
    return np.concatenate([contact, velocity], axis=1).astype(np.float32)


def _check_translation(translation: NDArray[Any], frames: int) -> None:
    """Raise ValueError unless positions are possible, one for each frame."""
    if translation.shape != (frames, 3) or translation.dtype.kind not in "fiu":
        raise ValueError("positions and poses differ in length")
    if not (np.abs(translation) < MAX_VALUE).all():
        raise ValueError("a position is not finite, or absurd")


def _check_numbers(quats: NDArray[Any], force: NDArray[Any], poses: NDArray[Any]) -> None:
    """Raise ValueError unless quaternions, forces and rotation vectors are possible."""
    for name, array in (("a quaternion", quats), ("an acceleration", force), ("a pose", poses)):
        if array.dtype.kind not in "fiu" or not (np.abs(array) < MAX_VALUE).all():
            raise ValueError(f"{name} is not finite, or absurd")
    if not len(poses) or not (np.abs(np.linalg.norm(quats.astype(float), axis=-1) - 1.0) < 0.01).all():
        raise ValueError("no frames, or a quaternion is not of unit length")


def take_paths(folder: Path, part: str) -> list[Path]:
    """Return the files of a part, or of a group of parts, below a folder, sorted by name.

    The part "all" is every take. If no name belongs to the validation parts, as with a user's own recordings,
    every tenth of the motions for training is used for validation.

    Raises:
        EdgeposeError: there is no such part or file.
    """
    check_part(part)
    takes = parts_of(folder)
    wanted = GROUPS.get(part, (part,))
    paths = [path for path, found in takes.items() if part == "all" or found in wanted]
    if part in ("train", "validation") and not set(VALIDATION) & set(takes.values()):
        chosen = _every_tenth([path for path, found in takes.items() if found == "train"])
        if chosen:
            paths = [path for path, found in takes.items() if found == "train"]
            paths = [path for path in paths if (path in chosen) == (part == "validation")]
    if paths:
        return paths
    if not takes:
        raise EdgeposeError(f"{folder}: no recordings; make them with edgepose synthesize --out {folder}")
    counts = Counter(takes.values())
    raise EdgeposeError(
        f"{folder}: no recording of the part {part!r}: the names of recordings decide their part (see "
        f"{RULES}), and those here belong to {', '.join(f'{name} ({counts[name]})' for name in counts)}"
    )


def check_part(part: str) -> None:
    """Raise EdgeposeError unless there is a part, or group of parts, of that name."""
    names = (*PARTS, "train", "all")
    if part not in names:
        raise EdgeposeError(f"{part}: no such part; {choices(part, names, 'the parts are')}")


def parts_of(folder: Path) -> dict[Path, str]:
    """Return the part of each recording below a folder, sorted by name."""
    paths = {take_name(path, folder): path for path in folder.rglob("*.npz")}
    return {paths[name]: part_of(name) for name in sorted(paths)}


def _every_tenth(paths: list[Path]) -> set[Path]:
    """Return the files of every tenth motion; all pieces and versions of a motion go together.

    If all are of one motion, return every tenth file, and nothing if there is only one.
    """
    motions = {path: path.name.split(".")[0] for path in paths}
    if len(set(motions.values())) < 2:
        return set(paths[::10]) if len(paths) > 1 else set()
    chosen = set(sorted(set(motions.values()))[::10])
    return {path for path in paths if motions[path] in chosen}


def training_paths(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files of takes to train on, and of takes for validation, see `take_paths`.

    Raises:
        EdgeposeError: there are fewer than two takes, or none to train on.
    """
    paths = take_paths(folder, "train")
    try:
        return paths, take_paths(folder, "validation")
    except EdgeposeError:
        raise EdgeposeError(
            f"{folder}: one recording is not enough: another is needed for validation"
        ) from None


def measured_parts(folder: Path) -> tuple[list[str], list[str]]:
    """Return the parts of a folder to measure models on, and those that it lacks.

    They are the held-out parts, and the group "sports" if there are several of it; if there is none, as with
    a user's own recordings, the validation parts together.

    Raises:
        EdgeposeError: the folder has neither.
    """
    found = set(parts_of(folder).values())
    present = [part for part in HELD_OUT if part in found]
    lacking = [part for part in HELD_OUT if part not in found]
    if not present:
        take_paths(folder, "validation")
        present = ["validation"]
    if len(set(present) & set(GROUPS["sports"])) > 1:
        present.append("sports")
    return present, lacking


class Batch(NamedTuple):
    """Sequences for training.

    Attributes:
        orientation: (B, T, 6, 3, 3) R_TB.
        acceleration: (B, T, 6, 3) in T, m/s^2.
        relative: (B, T, 24, 3, 3) true global rotations in the root's frame.
        place: (B, T, 10) contacts, 0 or 1, of the joints `edgepose.pose.CONTACTS`, then the velocity of the
            pelvis in its level frame, m/s; NaN where they are unknown.
    """

    orientation: Tensor
    acceleration: Tensor
    relative: Tensor
    place: Tensor


class PackedTakes(NamedTuple):
    """Takes joined one after the other, as tensors.

    Attributes:
        orientation: (N, 6, 3, 3) R_TB.
        acceleration: (N, 6, 3) in T, m/s^2.
        relative: (N, 24, 3, 3) true global rotations in the root's frame.
        starts: first frame of each take, and N as the last entry.
        names: names of the takes.
        licenses: licence of each take's motion.
        place: (N, 10) contacts and velocity, see `Batch`.
        sources: name of each take's source.
    """

    orientation: Tensor
    acceleration: Tensor
    relative: Tensor
    starts: Tensor
    names: list[str]
    licenses: list[str]
    place: Tensor
    sources: list[str]

    def at(self, index: Tensor) -> Batch:
        """Return the sequences of some frames (B, T)."""
        parts = self.orientation, self.acceleration, self.relative, self.place
        return Batch(*(part[index] for part in parts))

    @property
    def made(self) -> list[str]:
        """How each take's motion was made: `SEATED`, `RESTS`, or "" as captured."""
        return [next((kind for kind in (SEATED, RESTS) if name.endswith(kind)), "") for name in self.names]


def tape(takes: list[Take]) -> PackedTakes:
    """Join takes; without any, the tape is empty."""
    lengths = [len(take.pose) for take in takes]
    return PackedTakes(
        torch.cat([torch.zeros(0, 6, 3, 3), *(torch.from_numpy(take.orientation) for take in takes)]),
        torch.cat([torch.zeros(0, 6, 3), *(torch.from_numpy(take.acceleration) for take in takes)]),
        torch.cat(
            [torch.zeros(0, 24, 3, 3), *(root_relative_pose(torch.from_numpy(take.pose)) for take in takes)]
        ),
        torch.tensor([0, *accumulate(lengths)]),
        [take.name for take in takes],
        [take.license for take in takes],
        torch.cat([torch.zeros(0, PLACE), *(torch.from_numpy(take.place_or_nan) for take in takes)]),
        [take.source for take in takes],
    )


def root_relative_pose(local: Tensor) -> Tensor:
    """Convert local rotations (..., 24, 3, 3) to global ones in the root's frame."""
    result = [torch.eye(3, dtype=local.dtype).expand((*local.shape[:-3], 3, 3))]
    for joint in range(1, 24):
        result.append(result[PARENTS[joint]] @ local[..., joint, :, :])
    return torch.stack(result, dim=-3)
