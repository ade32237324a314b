"""Errors of cheap sensors that are worn over clothes: swing, slip, heading drift, wandering tilt, biases.

Orientations are R_TB (B, T, 6, 3, 3), accelerations are in T (B, T, 6, 3), m/s^2 without gravity. `worse`
(B,) is a factor on the errors of each sequence; zero leaves it as it is.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgepose.calibration import GRAVITY
from edgepose.placements import PLACEMENTS
from edgepose_export.networks.normalisation import rotations_of
from edgepose_export.training.dataset import RATE

WALKING = 6.0
"""Accelerations of a walker's sensors, m/s^2 rms, at which a sensor swings by its given size."""

SWING_HZ = (3.0, 10.0)
"""Natural frequencies of sensors on clothes and soft tissue."""

SWING_DAMPING = (0.15, 0.5)

SWING_LIMIT_DEG = 15.0
"""Straps do not let a sensor swing further, however hard the heel strikes."""

SWING_LEVER = 0.03
"""Greatest distance of a sensor from the point about which it swings, metres."""

SLIPPING = 0.3
"""Share of sensors that slip."""

SLIP_S = (0.05, 4.0)
"""Shortest and longest slips: from a jolt to creeping down."""

ACROSS = 0.4
"""Slips about the axes across a segment, as a share of those about its length."""

SINCE_CALIBRATION_MIN = 2.0
"""Mean time since the wearer was calibrated, minutes, in which headings have drifted (exponential)."""

MOST_DRIFT_DEG = 30.0
"""By then a wearer has calibrated again."""

TILT_S = 10.0
"""Seconds in which a sensor's tilt error wanders by as much as it deviates from the start."""

_KNOTS_S = 0.5  # random walks are linear between two knots
_LENGTHWISE = [0 if name.endswith("forearm") else 1 for name in PLACEMENTS]


def swing(orientation: Tensor, acceleration: Tensor, sizes: Tensor, generator: torch.Generator) -> Tensor:
    """Return the rotation vectors (B, T, 6, 3) of sensors that lag behind their accelerated bones, and the
    accelerations (B, T, 6, 3) of the sensors relative to the bones, both in the bones' frames.

    A sensor is a damped pendulum: a mass at the end of a short lever that stands off the bone in a random
    direction.

    Args:
        orientation: see the module.
        acceleration: see the module.
        sizes: (B, 6) rms angle of each sensor when walking, radians.
        generator: source of the random numbers.
    """
    shape, frames = (len(orientation), 1, len(PLACEMENTS), 1), orientation.shape[1]
    direction = torch.nn.functional.normalize(torch.randn(*shape[:-1], 3, generator=generator), dim=-1)
    share, damping = torch.rand(2, *shape, generator=generator)
    natural = SWING_HZ[0] * (SWING_HZ[1] / SWING_HZ[0]) ** share
    damping = SWING_DAMPING[0] + (SWING_DAMPING[1] - SWING_DAMPING[0]) * damping
    gain = sizes[:, None, :, None] / WALKING
    in_bone = (orientation.mT @ acceleration.unsqueeze(-1)).squeeze(-1)
    torque = torch.linalg.cross(in_bone, direction.expand_as(in_bone))
    padded = frames + int(RATE)  # room for the last swings, which would come round to the first frames
    hz = torch.fft.rfftfreq(padded, 1.0 / RATE)[:, None, None]
    response = natural**2 / torch.complex(natural**2 - hz**2, 2.0 * damping * natural * hz)
    angle = (
        gain * torch.fft.irfft(torch.fft.rfft(torque, padded, dim=1) * response, padded, dim=1)[:, :frames]
    )
    size = angle.norm(dim=-1, keepdim=True)
    limit = math.radians(SWING_LIMIT_DEG)
    angle = angle * (limit * torch.tanh(size / limit) / size.clamp_min(1e-9))
    # A pendulum's static angle is acceleration / (lever * natural frequency^2).
    lever = (1.0 / (gain * (2.0 * math.pi * natural).square()).clamp_min(1e-9)).clamp_max(SWING_LEVER)
    second = torch.zeros_like(angle)
    second[:, 1:-1] = (angle[:, 2:] + angle[:, :-2] - 2.0 * angle[:, 1:-1]) * RATE**2
    second[:, 1:] = 0.5 * (second[:, 1:] + second[:, :-1])  # as in `dataset.read_take`
    return angle, torch.linalg.cross(second, (lever * direction).expand_as(second))


def slip(sizes: Tensor, frames: int, generator: torch.Generator) -> Tensor:
    """Return the rotation vectors (B, frames, 6, 3) of sensors of which some slip, at once or slowly.

    Args:
        sizes: (B, 6) standard deviation of a slip about the length of the segment, radians.
        frames: frames per sequence.
        generator: source of the random numbers.
    """
    shape = (len(sizes), len(PLACEMENTS))
    axes = torch.full((len(PLACEMENTS), 3), ACROSS)
    axes[range(len(PLACEMENTS)), _LENGTHWISE] = 1.0
    slips = torch.rand(shape, generator=generator) < SLIPPING
    angle = torch.randn(*shape, 3, generator=generator) * axes * (sizes * slips)[..., None]
    start, share = torch.rand(2, *shape, generator=generator)
    seconds = SLIP_S[0] * (SLIP_S[1] / SLIP_S[0]) ** share
    # Some have slipped before the sequence begins.
    first = (1.25 * start - 0.25) * frames
    course = ((torch.arange(frames)[:, None] - first[:, None]) / (RATE * seconds[:, None])).clamp(0.0, 1.0)
    course = course * course * (3.0 - 2.0 * course)
    return course[..., None] * angle[:, None]


def worn_loosely(
    orientation: Tensor,
    acceleration: Tensor,
    swing_deg: float,
    slip_deg: float,
    worse: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return the measurements of sensors that swing and slip on their segments."""
    error = torch.zeros(())
    if swing_deg:
        # Some straps sit tightly, some loosely.
        looseness = torch.randn(len(worse), len(PLACEMENTS), generator=generator).abs()
        angle, extra = swing(
            orientation, acceleration, math.radians(swing_deg) * looseness * worse[:, None], generator
        )
        acceleration = acceleration + (orientation @ extra.unsqueeze(-1)).squeeze(-1)
        error = error + angle
    if slip_deg:
        sizes = math.radians(slip_deg) * worse[:, None].expand(-1, len(PLACEMENTS))
        error = error + slip(sizes, orientation.shape[1], generator)
    return orientation @ rotations_of(error), acceleration


def random_walk(shape: tuple[int, ...], frames: int, generator: torch.Generator) -> Tensor:
    """Return random walks (shape[0], frames, *shape[1:]) from 0, with deviations of 1 after a second."""
    at = torch.arange(frames) / (RATE * _KNOTS_S)
    low = at.long()
    steps = torch.randn(shape[0], int(low[-1]) + 2, *shape[1:], generator=generator) * _KNOTS_S**0.5
    steps[:, 0] = 0.0
    knots = steps.cumsum(1)
    share = (at - low).view(-1, *[1] * (len(shape) - 1))
    return torch.lerp(knots[:, low], knots[:, low + 1], share)


def drifted(
    orientation: Tensor,
    acceleration: Tensor,
    drift_deg: float,
    tilt_walk_deg: float,
    worse: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return the measurements of sensors whose fused orientations are wrong.

    Headings drift away from the pelvis sensor's at a rate of `drift_deg` per minute, and wander. Tilts wander
    by `tilt_walk_deg`, and gravity leaks into the accelerations.
    """
    size, frames = len(orientation), orientation.shape[1]
    error = torch.zeros(size, frames, len(PLACEMENTS), 3)
    if drift_deg:
        rate, before = torch.randn(2, size, 1, len(PLACEMENTS) - 1, generator=generator)
        minutes = -SINCE_CALIBRATION_MIN * torch.rand(size, 1, 1, generator=generator).clamp_min(1e-6).log()
        walked = random_walk((size, len(PLACEMENTS) - 1), frames, generator) / 60.0**0.5
        since = minutes + torch.arange(frames)[:, None] / (60.0 * RATE)
        heading = drift_deg * (rate * since + before * minutes.sqrt() + walked)
        error[..., :-1, 1] = heading.clamp(-MOST_DRIFT_DEG, MOST_DRIFT_DEG)
    if tilt_walk_deg:
        start = torch.randn(size, 1, len(PLACEMENTS), 2, generator=generator)
        walked = random_walk((size, len(PLACEMENTS), 2), frames, generator) / TILT_S**0.5
        error[..., 0::2] = tilt_walk_deg * (start + walked)
    rotation = rotations_of(torch.deg2rad(error) * worse[:, None, None, None])
    gravity = torch.tensor([0.0, GRAVITY, 0.0])
    force = (rotation @ (acceleration + gravity).unsqueeze(-1)).squeeze(-1)
    return rotation @ orientation, force - gravity


def biased(
    orientation: Tensor, acceleration: Tensor, bias: float, worse: Tensor, generator: torch.Generator
) -> Tensor:
    """Return the accelerations (B, T, 6, 3) of sensors with biases of a deviation `bias`, m/s^2.

    They double in a minute, as a random walk.
    """
    shape = (len(orientation), len(PLACEMENTS), 3)
    start = torch.randn(len(orientation), 1, len(PLACEMENTS), 3, generator=generator)
    error = start + random_walk(shape, orientation.shape[1], generator) / 60.0**0.5
    error = bias * error * worse[:, None, None, None]
    return acceleration + (orientation @ error.unsqueeze(-1)).squeeze(-1)
