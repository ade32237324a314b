"""Poses at other times than those of a file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgepose.pose import LONGEST_GAP_S, PoseSequence
from edgepose.rotations import Array, matrix_to_quat, quat_to_matrix, slerp


def interpolate(poses: PoseSequence, before: NDArray[np.int64], share: Array) -> PoseSequence:
    """Return poses between those of a sequence: rotations by slerp, all other numbers linearly.

    Frame numbers are rounded; the status is that of the pose before.

    Args:
        poses: T poses.
        before: (N,) indices of poses.
        share: (N,) share of the way to the pose after it, from 0 to less than 1.
    """
    after = np.minimum(before + 1, len(poses.frames) - 1)
    quats = matrix_to_quat(poses.rotations)
    between = share > 0.0
    rotations = poses.rotations[before].copy()
    rotations[between] = quat_to_matrix(
        slerp(quats[before[between]], quats[after[between]], share[between, None])
    )

    def linear(values: NDArray[Any], share: Array) -> Array:
        return np.asarray(values[before] + share * (values[after] - values[before]))

    translation, contacts = poses.translation, poses.contacts
    return PoseSequence(
        np.round(linear(poses.frames, share)).astype(np.int64),
        linear(poses.time_s, share),
        rotations,
        None if translation is None else linear(translation, share[:, None]),
        [poses.held[i] for i in before],
        [poses.warming_up[i] for i in before],
        poses.about,
        None if contacts is None else linear(contacts, share[:, None]).astype(np.float32),
    )


def resample(poses: PoseSequence, rate: float) -> PoseSequence:
    """Return poses at another rate, numbered from 0, without extrapolation; each part begins with its own.

    Args:
        poses: poses whose frame numbers have equal steps; parts lie more than `LONGEST_GAP_S` apart.
        rate: poses per second.
    """
    step = poses.rate / rate
    gaps = np.diff(poses.time_s) > max(LONGEST_GAP_S, 1.5 / poses.rate)
    starts = np.concatenate([[0], np.flatnonzero(gaps) + 1])
    lasts = np.concatenate([starts[1:], [len(poses.frames)]]) - 1
    places = np.concatenate(
        [
            np.minimum(start + step * np.arange(int((last - start) / step + 1e-6) + 1), last)
            for start, last in zip(starts.tolist(), lasts.tolist(), strict=True)
        ]
    )
    nearest = np.round(places).astype(np.int64)
    places = np.where(np.abs(places - nearest) < 1e-6, nearest, places)
    before = places.astype(np.int64)
    found = interpolate(poses, before, places - before)
    return found._replace(
        frames=np.arange(len(places)),
        held=[poses.held[i] for i in nearest],
        warming_up=[poses.warming_up[i] for i in nearest],
        contacts=None if poses.contacts is None else poses.contacts[nearest],
    )
