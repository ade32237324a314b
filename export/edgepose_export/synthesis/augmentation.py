"""Data augmentation for robustness to real wearers."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.pose import CONTACTS
from edgepose.skeleton import JOINTS
from edgepose_export.networks.normalisation import rotations_of, turn_about_y
from edgepose_export.synthesis.contacts import PLACE
from edgepose_export.synthesis.loose_wear import biased, drifted, worn_loosely
from edgepose_export.synthesis.straight_arms import with_straight_arms
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
        aligned: share of sequences whose sensors have no errors but noise and scale of the accelerations, so
            that a network trusts sensors that agree with each other.
        pelvis_pitch_deg: standard deviation of a rotation of the pelvis, bone and sensor, about its own X
            axis. It imitates actors whose trunk leans differently relative to the pelvis. `Trainer` does not
            apply it to sequences with synthetic sitting, since the pelvis pitch is what tells sitting from
            standing.
        silent: share of sequences in which one sensor is silent for some time. In an eighth of them that time
            lies before or after the sequence.
        posture: factor on `posture_variation.DEVIATIONS`, the variation of how wearers hold their joints.
        stature: relative standard deviation of the wearers' statures, from 1.45 to 2.0 m.
        proportions: factor on the variation of segments' lengths and of where sensors sit on them, see
            `body_shapes`.
        straight_arms: how far, at most, from arms at ease to straight arms wearers are calibrated, see
            `straight_arms`.
        swing_deg: rms angle by which sensors swing on clothing when walking; impacts swing them further, and
            tight straps less.
        slip_deg: standard deviation of slips about the length of a segment; three of ten sensors slip.
        drift_deg: standard deviation of the rates at which sensors' headings drift away from the pelvis
            sensor's, degrees per minute, for two minutes on average since the calibration.
        tilt_walk_deg: standard deviation of the errors of sensors' tilts, which wander and leak gravity into
            the accelerations.
        acceleration_bias: standard deviation of the accelerations' biases, which wander slowly, m/s^2.
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
    stature: float = 0.0
    proportions: float = 0.0
    straight_arms: float = 0.0
    swing_deg: float = 0.0
    slip_deg: float = 0.0
    drift_deg: float = 0.0
    tilt_walk_deg: float = 0.0
    acceleration_bias: float = 0.0


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

    The true poses change only by mirroring, by the pelvis pitch and by the zero of the arms, contacts and
    velocity only by mirroring.
    `posture`, `stature` and `proportions` are not applied here, because they need the frames around the
    sequences; see `vary_bodies`.
    """
    size = len(batch.orientation)
    if sizes.mirror:
        chosen = torch.rand(size, generator=generator) < sizes.mirror
        batch = _mirror_some(batch, chosen)
    if sizes.pelvis_pitch_deg:
        batch = _pitch_pelvis(batch, sizes.pelvis_pitch_deg, generator)
    if sizes.straight_arms:
        batch = with_straight_arms(batch, sizes.straight_arms, generator)
    disturbed = torch.ones(size)
    if sizes.aligned:
        disturbed = (torch.rand(size, generator=generator) >= sizes.aligned).float()
    seen = _misplaced(*batch[:2], sizes, disturbed, generator)
    orientation, acceleration = _with_chip_errors(*seen, sizes, disturbed, generator)
    if sizes.silent:
        orientation, acceleration = _drop_some(orientation, acceleration, sizes.silent, generator)
    return batch._replace(orientation=orientation, acceleration=acceleration)


def _pitch_pelvis(batch: Batch, size_deg: float, generator: torch.Generator) -> Batch:
    """Return sequences in which the pelvis, bone and sensor, is rotated about its own X axis."""
    orientation, relative = batch.orientation.clone(), batch.relative.clone()
    pitch = torch.zeros(len(orientation), 1, 3)
    pitch[..., 0] = torch.deg2rad(size_deg * torch.randn(len(orientation), 1, generator=generator))
    rotation = rotations_of(pitch)
    orientation[:, :, ROOT] = orientation[:, :, ROOT] @ rotation
    relative[:, :, 1:] = rotation.mT.unsqueeze(2) @ relative[:, :, 1:]
    return batch._replace(orientation=orientation, relative=relative)


def _misplaced(
    orientation: Tensor,
    acceleration: Tensor,
    sizes: Augmentation,
    disturbed: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return the measurements of sensors that are misaligned, swing and slip, where `disturbed` (B,) is 1."""
    if sizes.misalignment_deg:
        shape = (len(orientation), 1, len(PLACEMENTS), 3)
        angles = (
            sizes.misalignment_deg * torch.randn(shape, generator=generator) * disturbed[:, None, None, None]
        )
        orientation = orientation @ rotations_of(torch.deg2rad(angles))
    if sizes.swing_deg or sizes.slip_deg:
        return worn_loosely(orientation, acceleration, sizes.swing_deg, sizes.slip_deg, disturbed, generator)
    return orientation, acceleration


def _with_chip_errors(
    orientation: Tensor,
    acceleration: Tensor,
    sizes: Augmentation,
    disturbed: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return the measurements of imprecise chips; only noise and scale where `disturbed` (B,) is 0."""
    size = len(orientation)
    if sizes.acceleration_bias:
        acceleration = biased(orientation, acceleration, sizes.acceleration_bias, disturbed, generator)
    if sizes.heading_deg:
        vertical = torch.zeros(size, 1, len(PLACEMENTS), 3)
        angles = torch.randn(size, 1, len(PLACEMENTS) - 1, generator=generator) * disturbed[:, None, None]
        vertical[..., :-1, 1] = torch.deg2rad(sizes.heading_deg * angles)
        rotation = rotations_of(vertical)
        orientation = rotation @ orientation
        acceleration = (rotation @ acceleration.unsqueeze(-1)).squeeze(-1)
    if sizes.drift_deg or sizes.tilt_walk_deg:
        orientation, acceleration = drifted(
            orientation, acceleration, sizes.drift_deg, sizes.tilt_walk_deg, disturbed, generator
        )
    if sizes.acceleration_scale:
        scale = torch.randn(size, 1, len(PLACEMENTS), 1, generator=generator)
        acceleration = acceleration * (1.0 + sizes.acceleration_scale * scale)
    if sizes.acceleration_noise:
        noise = torch.randn(acceleration.shape, generator=generator)
        acceleration = acceleration + sizes.acceleration_noise * noise
    return orientation, acceleration


def _drop_some(
    orientation: Tensor, acceleration: Tensor, share: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return copies of sequences of which a share has one silent sensor for some time."""
    size, frames = orientation.shape[:2]
    orientation, acceleration = orientation.clone(), acceleration.clone()
    # The silence may begin before the sequence, or last longer than it.
    first, end = (
        (frames * (2.0 * torch.rand(size, 2, generator=generator) - 0.5)).long().sort().values.unbind(1)
    )
    which = torch.randint(len(PLACEMENTS), (size,), generator=generator)
    which[torch.rand(size, generator=generator) >= share] = -1
    for sensor in range(len(PLACEMENTS)):
        rows = which == sensor
        orientation[rows], acceleration[rows] = drop_sensor(
            orientation[rows], acceleration[rows], sensor, first[rows].clamp(1, frames), end[rows]
        )
    return orientation, acceleration
