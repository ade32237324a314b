"""Data augmentation for robustness to real wearers."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.skeleton import JOINTS
from edgepose_export.networks.normalisation import rotations_of, turn_about_y
from edgepose_export.synthesis.contacts import CONTACTS, PLACE
from edgepose_export.training.dataset import Batch


def _mirror_indices(names: tuple[str, ...]) -> list[int]:
    other = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in names]
    return [
        names.index("_".join([other[side], rest])) if side in other else i
        for i, (side, _, rest) in enumerate(sides)
    ]


SENSOR_MIRROR = _mirror_indices(PLACEMENTS)
JOINT_MIRROR = _mirror_indices(JOINTS)
PLACE_MIRROR = [*_mirror_indices(CONTACTS), *range(len(CONTACTS), PLACE)]


class Augmentation(NamedTuple):
    """Strengths of the disturbances. They are drawn once per sequence unless stated otherwise.

    Attributes:
        mirror: share of sequences in which left and right are swapped.
        misalignment_deg: standard deviation of each sensor's misalignment with its bone, per component of a
            rotation vector (as from an inexact calibration pose).
        heading_deg: standard deviation of each sensor's heading relative to the pelvis sensor.
        acceleration_noise: standard deviation of white noise on the accelerations of each frame, m/s^2.
        acceleration_scale: standard deviation of each sensor's scale error.
        aligned: share of sequences without misalignment and heading errors, so that a network trusts sensors
            that agree with each other.
        pelvis_pitch_deg: standard deviation of a rotation of the pelvis, bone and sensor, about its own X
            axis. It imitates actors whose trunk leans differently relative to the pelvis. `Trainer` does not
            apply it to sequences with synthetic sitting, since the pelvis pitch is what tells sitting from
            standing.
        silent: share of sequences in which one sensor is silent for some time. In an eighth of them that time
            lies before or after the sequence.
        posture: factor on `posture_variation.DEVIATIONS`, the variation of how wearers hold their joints.
    """

    mirror: float = 0.5
    misalignment_deg: float = 0.0
    heading_deg: float = 0.0
    acceleration_noise: float = 0.0
    acceleration_scale: float = 0.0
    aligned: float = 0.0
    pelvis_pitch_deg: float = 0.0
    silent: float = 0.0
    posture: float = 0.0


def mirror(orientation: Tensor, acceleration: Tensor, relative: Tensor, place: Tensor) -> Batch:
    """Swap left and right of sequences, see `Batch`, by a reflection in the plane X = 0 of T."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    signs = flip[:, None] * flip
    return Batch(
        orientation[..., SENSOR_MIRROR, :, :] * signs,
        acceleration[..., SENSOR_MIRROR, :] * flip,
        relative[..., JOINT_MIRROR, :, :] * signs,
        place[..., PLACE_MIRROR] * torch.cat([torch.ones(len(CONTACTS)), flip]),
    )


def _mirror_some(batch: Batch, chosen: Tensor) -> Batch:
    """Return a copy of sequences in which those chosen (B,) are mirrored."""
    result = Batch(*(part.clone() for part in batch))
    for part, mirrored in zip(result, mirror(*(part[chosen] for part in batch)), strict=True):
        part[chosen] = mirrored
    return result


def drop_sensor(
    orientation: Tensor, acceleration: Tensor, sensor: int, first: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """Return sequences in which a sensor is silent and its bone is extrapolated as in `pipeline.dropout`.

    Args:
        orientation: (B, T, 6, 3, 3) in T.
        acceleration: (B, T, 6, 3) in T.
        sensor: index of the silent sensor, the same in all sequences.
        first: (B,) first silent frame, 1 or later.
        end: (B,) first frame that is measured again.
    """
    frame = torch.arange(orientation.shape[1])
    silent = ((frame >= first[:, None]) & (frame < end[:, None]))[..., None]
    before = first[:, None] - 1
    sequence = torch.arange(len(orientation))[:, None]
    lower_legs = [i for i, name in enumerate(PLACEMENTS) if name.endswith("lower_leg")]
    if sensor == ROOT or sensor in lower_legs:
        leading = lower_legs if sensor == ROOT else [ROOT]
        angle = _heading_changes(orientation[:, :, leading]).mean(-1)
        vertical = torch.zeros(*angle.shape, 3)
        vertical[..., 1] = angle - angle[sequence, before]
        rotation = rotations_of(vertical)
    else:
        root = orientation[:, :, ROOT]
        rotation = root @ root[sequence, before].mT
    orientation, acceleration = orientation.clone(), acceleration.clone()
    extrapolated = rotation @ orientation[sequence, before, sensor]
    orientation[:, :, sensor] = torch.where(silent[..., None], extrapolated, orientation[:, :, sensor])
    substitute = 0.0 if sensor == ROOT else acceleration[:, :, ROOT]
    acceleration[:, :, sensor] = torch.where(silent, substitute, acceleration[:, :, sensor])
    return orientation, acceleration


def _heading_changes(orientation: Tensor) -> Tensor:
    """Return the unwrapped heading (B, T, N) of (B, T, N, 3, 3) relative to the first frame, radians."""
    step = turn_about_y(orientation).diff(dim=1)
    step = torch.remainder(step + torch.pi, 2.0 * torch.pi) - torch.pi
    return nn.functional.pad(step.cumsum(1), (0, 0, 1, 0))


def augment(batch: Batch, sizes: Augmentation, generator: torch.Generator) -> Batch:
    """Return disturbed copies of sequences.

    The true poses change only by mirroring and by the pelvis pitch, contacts and velocity only by mirroring.
    `posture` is not applied here, because it needs the frames around the sequences; see `vary_postures`.
    """
    size = len(batch.orientation)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    if sizes.mirror:
        chosen = torch.rand(size, generator=generator) < sizes.mirror
        batch = _mirror_some(batch, chosen)
    orientation, acceleration, relative, place = batch
    if sizes.pelvis_pitch_deg:
        pitch = torch.zeros(size, 1, 3)
        pitch[..., 0] = torch.deg2rad(sizes.pelvis_pitch_deg * normal(size, 1))
        rotation = rotations_of(pitch)
        orientation, relative = orientation.clone(), relative.clone()
        orientation[:, :, ROOT] = orientation[:, :, ROOT] @ rotation
        relative[:, :, 1:] = rotation.mT.unsqueeze(2) @ relative[:, :, 1:]
    misaligned = (
        (torch.rand(size, generator=generator) >= sizes.aligned).float()
        if sizes.aligned
        else torch.ones(size)
    )
    if sizes.misalignment_deg:
        angles = sizes.misalignment_deg * normal(size, 1, 6, 3) * misaligned[:, None, None, None]
        error = rotations_of(torch.deg2rad(angles))
        orientation = orientation @ error
    if sizes.heading_deg:
        vertical = torch.zeros(size, 1, 6, 3)
        vertical[..., :-1, 1] = torch.deg2rad(
            sizes.heading_deg * normal(size, 1, 5) * misaligned[:, None, None]
        )
        rotation = rotations_of(vertical)
        orientation = rotation @ orientation
        acceleration = (rotation @ acceleration.unsqueeze(-1)).squeeze(-1)
    if sizes.acceleration_scale:
        acceleration = acceleration * (1.0 + sizes.acceleration_scale * normal(size, 1, 6, 1))
    if sizes.acceleration_noise:
        acceleration = acceleration + sizes.acceleration_noise * normal(*acceleration.shape)
    if sizes.silent:
        orientation, acceleration = orientation.clone(), acceleration.clone()
        frames = orientation.shape[1]
        # The silence may begin before the sequence, or last longer than it.
        first, end = (
            (frames * (2.0 * torch.rand(size, 2, generator=generator) - 0.5)).long().sort().values.unbind(1)
        )
        which = torch.randint(len(PLACEMENTS), (size,), generator=generator)
        which[torch.rand(size, generator=generator) >= sizes.silent] = -1
        for sensor in range(len(PLACEMENTS)):
            rows = which == sensor
            orientation[rows], acceleration[rows] = drop_sensor(
                orientation[rows], acceleration[rows], sensor, first[rows].clamp(1, frames), end[rows]
            )
    return Batch(orientation, acceleration, relative, place)
