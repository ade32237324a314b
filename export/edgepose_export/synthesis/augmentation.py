"""What training does to a batch so that a network bears a real wearer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.placements import PLACEMENTS, ROOT
from edgepose.skeleton import JOINTS
from edgepose_export.networks.normalisation import rotations_of, turn_about_y
from edgepose_export.synthesis.posture_variation import Batch


def _swapped(names: tuple[str, ...]) -> list[int]:
    other = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in names]
    return [
        names.index("_".join([other[side], rest])) if side in other else i
        for i, (side, _, rest) in enumerate(sides)
    ]


SENSOR_MIRROR = _swapped(PLACEMENTS)
JOINT_MIRROR = _swapped(JOINTS)


class Augmentation(NamedTuple):
    """Sizes of the disturbances; one draw a sequence unless said.

    Attributes:
        mirror: share of sequences whose left and right are exchanged.
        misalignment_deg: deviation of each sensor's error against its bone, a rotation vector's each
            component (a calibration pose that was not quite the pose).
        heading_deg: deviation of each sensor's heading against the pelvis sensor.
        acceleration_noise: deviation of white noise on each frame's accelerations, m/s^2.
        acceleration_scale: deviation of each sensor's scale error.
        aligned: share of sequences without misalignment and heading errors, so that a network trusts sensors
            that agree with each other.
        pelvis_pitch_deg: deviation of a turn of the pelvis about its own X axis, of bone and sensor alike: as
            if another actor's skeleton, in whom the trunk leans otherwise against the pelvis, did the same.
            `Trainer` leaves sequences with made sitting alone, which the pelvis' pitch tells from standing.
        silent: share of sequences in which one sensor is silent for a while, unless that ends before the
            sequence begins or begins after it (an eighth of them).
        posture: factor on `postures.DEVIATIONS`, by which wearers hold their joints otherwise.
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


def mirror(orientation: Tensor, acceleration: Tensor, relative: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Left and right exchanged by a reflection in the plane X = 0 of T; shapes (..., 6, 3, 3), (..., 6, 3),
    (..., 24, 3, 3).
    """
    flip = torch.tensor([-1.0, 1.0, 1.0])
    signs = flip[:, None] * flip
    return (
        orientation[..., SENSOR_MIRROR, :, :] * signs,
        acceleration[..., SENSOR_MIRROR, :] * flip,
        relative[..., JOINT_MIRROR, :, :] * signs,
    )


def drop_sensor(
    orientation: Tensor, acceleration: Tensor, sensor: int, first: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """Sequences (B, T, 6, 3, 3), (B, T, 6, 3) with a silent sensor, whose bone `pipeline.dropout` moves on.

    Args:
        orientation: in T.
        acceleration: in T.
        sensor: which one, for all sequences.
        first: (B,) first silent frame, 1 or later.
        end: (B,) first frame that is measured again.
    """
    frame = torch.arange(orientation.shape[1])
    gone = ((frame >= first[:, None]) & (frame < end[:, None]))[..., None]
    before = first[:, None] - 1
    sequence = torch.arange(len(orientation))[:, None]
    lower_legs = [i for i, name in enumerate(PLACEMENTS) if name.endswith("lower_leg")]
    if sensor == ROOT or sensor in lower_legs:
        leading = lower_legs if sensor == ROOT else [ROOT]
        angle = _turns(orientation[:, :, leading]).mean(-1)
        about = torch.zeros(*angle.shape, 3)
        about[..., 1] = angle - angle[sequence, before]
        turn = rotations_of(about)
    else:
        root = orientation[:, :, ROOT]
        turn = root @ root[sequence, before].mT
    orientation, acceleration = orientation.clone(), acceleration.clone()
    going = turn @ orientation[sequence, before, sensor]
    orientation[:, :, sensor] = torch.where(gone[..., None], going, orientation[:, :, sensor])
    rest = 0.0 if sensor == ROOT else acceleration[:, :, ROOT]
    acceleration[:, :, sensor] = torch.where(gone, rest, acceleration[:, :, sensor])
    return orientation, acceleration


def _turns(orientation: Tensor) -> Tensor:
    """Heading (B, T, N) of (B, T, N, 3, 3) since their first frame, radians, whole turns counted."""
    step = turn_about_y(orientation).diff(dim=1)
    step = torch.remainder(step + torch.pi, 2.0 * torch.pi) - torch.pi
    return nn.functional.pad(step.cumsum(1), (0, 0, 1, 0))


def augment(batch: Batch, how: Augmentation, generator: torch.Generator) -> Batch:
    """Disturbed copies of sequences; their true poses are mirrored and get other pelvises only. All but
    `posture`, which needs the frames around them.
    """
    orientation, acceleration, relative = batch
    size = len(orientation)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    if how.mirror:
        chosen = torch.rand(size, generator=generator) < how.mirror
        mirrored = mirror(orientation[chosen], acceleration[chosen], relative[chosen])
        orientation, acceleration, relative = orientation.clone(), acceleration.clone(), relative.clone()
        orientation[chosen], acceleration[chosen], relative[chosen] = mirrored
    if how.pelvis_pitch_deg:
        pitch = torch.zeros(size, 1, 3)
        pitch[..., 0] = torch.deg2rad(how.pelvis_pitch_deg * normal(size, 1))
        turn = rotations_of(pitch)
        orientation, relative = orientation.clone(), relative.clone()
        orientation[:, :, ROOT] = orientation[:, :, ROOT] @ turn
        relative[:, :, 1:] = turn.mT.unsqueeze(2) @ relative[:, :, 1:]
    turned = (
        (torch.rand(size, generator=generator) >= how.aligned).float() if how.aligned else torch.ones(size)
    )
    if how.misalignment_deg:
        angles = how.misalignment_deg * normal(size, 1, 6, 3) * turned[:, None, None, None]
        error = rotations_of(torch.deg2rad(angles))
        orientation = orientation @ error
    if how.heading_deg:
        vertical = torch.zeros(size, 1, 6, 3)
        vertical[..., :-1, 1] = torch.deg2rad(how.heading_deg * normal(size, 1, 5) * turned[:, None, None])
        turn = rotations_of(vertical)
        orientation = turn @ orientation
        acceleration = (turn @ acceleration.unsqueeze(-1)).squeeze(-1)
    if how.acceleration_scale:
        acceleration = acceleration * (1.0 + how.acceleration_scale * normal(size, 1, 6, 1))
    if how.acceleration_noise:
        acceleration = acceleration + how.acceleration_noise * normal(*acceleration.shape)
    if how.silent:
        orientation, acceleration = orientation.clone(), acceleration.clone()
        frames = orientation.shape[1]
        # Some are silent before the sequence begins or longer than it lasts.
        first, end = (
            (frames * (2.0 * torch.rand(size, 2, generator=generator) - 0.5)).long().sort().values.unbind(1)
        )
        which = torch.randint(len(PLACEMENTS), (size,), generator=generator)
        which[torch.rand(size, generator=generator) >= how.silent] = -1
        for sensor in range(len(PLACEMENTS)):
            its = which == sensor
            orientation[its], acceleration[its] = drop_sensor(
                orientation[its], acceleration[its], sensor, first[its].clamp(1, frames), end[its]
            )
    return orientation, acceleration, relative
