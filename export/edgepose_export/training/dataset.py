"""Synthetic recordings as takes and tensors for training and evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
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
from edgepose.skeleton import PARENTS, forward_kinematics
from edgepose.utils.safe_npz import BROKEN, open_npz
from edgepose_export.synthesis.contacts import CONTACTS, PLACE
from edgepose_export.synthesis.virtual_imus import INERTIAL_FROM_BODY
from edgepose_export.training.splits import HELD_OUT, SPLITS, part_of

SEATED = ".seated"
"""End of the names of takes with legs made by `edgepose_export.synthesis.sitting`."""

RATE = 60.0
"""Frames per second of all networks."""


class Take(NamedTuple):
    """One synthetic recording.

    Attributes:
        name: file name without folder and extension.
        orientation: (T, 6, 3, 3) float32 bone orientations R_TB.
        acceleration: (T, 6, 3) float32 accelerations in T without gravity, m/s^2.
        pose: (T, 24, 3, 3) float32 true local rotations.
        license: licence of the motion that the take was made from.
        place: (T, 10) float32 contacts and velocity, see `Batch`; None if they are unknown.
    """

    name: str
    orientation: NDArray[np.float32]
    acceleration: NDArray[np.float32]
    pose: NDArray[np.float32]
    license: str
    place: NDArray[np.float32] | None = None

    @property
    def place_or_nan(self) -> NDArray[np.float32]:
        """Contacts and velocity (T, 10), all NaN if they are unknown."""
        if self.place is None:
            return np.full((len(self.pose), PLACE), np.nan, np.float32)
        return self.place


def read_take(path: Path) -> Take:
    """Read a recording that `edgepose synthesize` wrote, with sensors aligned with the bones.

    Raises:
        EdgeposeError: the file is of another kind.
    """
    try:
        with open_npz(path) as data:
            quats = np.stack([data[f"{name}_quat"] for name in PLACEMENTS], axis=1)
            force = np.stack([data[f"{name}_acc"] for name in PLACEMENTS], axis=1)
            poses = data["poses"].reshape(-1, 24, 3)
            rate, license_note = float(data["mocap_framerate"]), str(data["license"])
            place = _place(data)
        if not len(poses) == len(quats) == len(force) == (len(poses) if place is None else len(place)):
            raise ValueError("sensors and poses differ in length")
        _check_numbers(quats, force, poses)
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
    bones = forward_kinematics(local[0], np.zeros((24, 3)))[0][list(BONES)]
    if not (rot.geodesic_angle(orientation[0], bones) < 0.01).all():
        raise EdgeposeError(
            f"{path}: the sensors are not aligned with the bones; use edgepose synthesize without --mounting"
        )
    force_inertial = np.einsum("tsij,tsj->tsi", inertial, force.astype(float))
    # In a run a frame holds the mean since the previous frame, see `FrameSynchronizer`.
    force_inertial[1:] = 0.5 * (force_inertial[1:] + force_inertial[:-1])
    acceleration = (force_inertial - [0.0, 0.0, GRAVITY]) @ INERTIAL_FROM_BODY
    return Take(
        path.stem,
        orientation.astype(np.float32),
        acceleration.astype(np.float32),
        local.astype(np.float32),
        license_note,
        place,
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


def _check_numbers(quats: NDArray[Any], force: NDArray[Any], poses: NDArray[Any]) -> None:
    """Raise ValueError unless quaternions, forces and rotation vectors are possible."""
    for name, array in (("a quaternion", quats), ("an acceleration", force), ("a pose", poses)):
        if array.dtype.kind not in "fiu" or not (np.abs(array) < MAX_VALUE).all():
            raise ValueError(f"{name} is not finite, or absurd")
    if not len(poses) or not (np.abs(np.linalg.norm(quats.astype(float), axis=-1) - 1.0) < 0.01).all():
        raise ValueError("no frames, or a quaternion is not of unit length")


def take_paths(folder: Path, part: str) -> list[Path]:
    """Return the files of one part of the split below a folder, sorted by name; the part "all" is every take.

    If no name belongs to the validation part, as with a user's own recordings, every tenth take for training
    is used for it.

    Raises:
        EdgeposeError: there is no such file.
    """
    takes = sorted(folder.rglob("*.npz"), key=lambda path: path.stem)
    paths = [path for path in takes if part in ("all", part_of(path.stem))]
    if part in ("train", "validation") and all(part_of(path.stem) != "validation" for path in takes):
        own = [path for path in takes if part_of(path.stem) == "train"]
        if len(own) > 1:
            paths = [path for i, path in enumerate(own) if bool(i % 10) == (part == "train")]
    if paths:
        return paths
    if not takes:
        raise EdgeposeError(f"{folder}: no recordings; make them with edgepose synthesize --out {folder}")
    counts = Counter(part_of(path.stem) for path in takes)
    raise EdgeposeError(
        f"{folder}: no recording of the part {part!r}: the names of recordings decide their part (see "
        f"{SPLITS}), and those here belong to {', '.join(f'{name} ({counts[name]})' for name in counts)}"
    )


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

    They are the held-out parts; if there is none, as with a user's own recordings, the validation part.

    Raises:
        EdgeposeError: the folder has neither.
    """
    found = {part_of(path.stem) for path in folder.rglob("*.npz")}
    present = [part for part in HELD_OUT if part in found]
    lacking = [part for part in HELD_OUT if part not in found]
    if not present:
        take_paths(folder, "validation")
        present = ["validation"]
    return present, lacking


class Batch(NamedTuple):
    """Sequences for training.

    Attributes:
        orientation: (B, T, 6, 3, 3) R_TB.
        acceleration: (B, T, 6, 3) in T, m/s^2.
        relative: (B, T, 24, 3, 3) true global rotations in the root's frame.
        place: (B, T, 10) contacts, 0 or 1, of the joints `contacts.CONTACTS`, then the velocity of the pelvis
            in its level frame, m/s; NaN where they are unknown.
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
    """

    orientation: Tensor
    acceleration: Tensor
    relative: Tensor
    starts: Tensor
    names: list[str]
    licenses: list[str]
    place: Tensor

    def at(self, index: Tensor) -> Batch:
        """Return the sequences of some frames (B, T)."""
        parts = self.orientation, self.acceleration, self.relative, self.place
        return Batch(*(part[index] for part in parts))

    @property
    def free(self) -> list[bool]:
        """Whether each take is CMU's, free for all use."""
        return [text.startswith("CMU") for text in self.licenses]

    @property
    def seated(self) -> list[bool]:
        """Whether each take's legs were made by `edgepose_export.synthesis.sitting`."""
        return [name.endswith(SEATED) for name in self.names]


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
    )


def root_relative_pose(local: Tensor) -> Tensor:
    """Convert local rotations (..., 24, 3, 3) to global ones in the root's frame."""
    result = [torch.eye(3, dtype=local.dtype).expand((*local.shape[:-3], 3, 3))]
    for joint in range(1, 24):
        result.append(result[PARENTS[joint]] @ local[..., joint, :, :])
    return torch.stack(result, dim=-3)


def describe(licenses: Iterable[str], takes: int, frames: int) -> dict[str, Any]:
    """Return the description of the training motion for an archive's card."""
    licenses = sorted(set(licenses))
    return {
        "summary": " and ".join(text.split(",")[0].split(" (")[0] for text in licenses),
        "licenses": licenses,
        "takes": takes,
        "hours": frames / RATE / 3600.0,
    }
