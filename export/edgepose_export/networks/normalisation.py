"""Network inputs from sensor data: DIP's normalisation by the root, and the two others of its appendix C.

All functions are scriptable and take any leading dimensions. `orientation` is (..., 6, 3, 3), bones R_TB in
the order of PLACEMENTS, the root last; `acceleration` is (..., 6, 3), m/s^2 in T without gravity.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from edgepose.inference.features import root_relative

SCHEMES = ("root", "tilt", "heading", "sequence")
"""Relative to the root of each frame (DIP 4.3); the same plus the root's own tilt and acceleration; relative
to the root's heading only; relative to the root of the first frame.
"""


def heading_of(root: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) about the vertical, Y, that take Z to where roots (..., 3, 3) face."""
    forward = nn.functional.normalize(root[..., 0::2, 2], dim=-1)
    s, c = forward[..., 0], forward[..., 1]
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c], dim=-1).unflatten(-1, (3, 3))


def rotations_of(vectors: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    angle = vectors.norm(dim=-1, keepdim=True).unsqueeze(-1)
    zero = torch.zeros_like(vectors[..., 0])
    x, y, z = vectors.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    sine, versine = torch.sinc(angle / math.pi), 0.5 * torch.sinc(angle / (2.0 * math.pi)).square()
    return torch.eye(3) + sine * skew + versine * (skew @ skew)


def turn_about_y(r: Tensor) -> Tensor:
    """Return the angle (...), radians, of the twist of rotations (..., 3, 3) about Y (swing-twist split).

    `heading_of` is undefined when a wearer bends until the pelvis faces the floor; this angle only when the
    pelvis is upside down.
    """
    return torch.atan2(r[..., 0, 2] - r[..., 2, 0], r[..., 0, 0] + r[..., 2, 2])


def tilt_of(root: Tensor) -> Tensor:
    """Return roots (..., 3, 3) without their rotation about Y, so relative to their own level frame."""
    angle = turn_about_y(root).unsqueeze(-1)
    s, c = angle.sin(), angle.cos()
    x, z = root[..., 0, :], root[..., 2, :]
    return torch.stack([c * x - s * z, root[..., 1, :], s * x + c * z], dim=-2)


def relative_to(reference: Tensor, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Return orientations and accelerations in the frames of reference rotations (..., 3, 3)."""
    back = reference.transpose(-1, -2).unsqueeze(-3)
    return torch.matmul(back, orientation), torch.matmul(back, acceleration.unsqueeze(-1)).squeeze(-1)


def seen_from_first(orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Return sequences (..., T, 6, 3, 3) and (..., T, 6, 3) in the frame of their first root."""
    return relative_to(orientation[..., :1, -1, :, :], orientation, acceleration)


def network_inputs(orientation: Tensor, acceleration: Tensor, scheme: str, with_acceleration: bool) -> Tensor:
    """Return row-major rotation matrices, then accelerations relative to the root's; not yet z-scored.

    Scheme "root" has the five sensors other than the root, 60 numbers (DIP 4.3). "tilt" inserts, between the
    rotations and the accelerations, the direction of up and the root's own acceleration, both in the root's
    frame; 66 numbers. The others have all six sensors, 72 numbers; the first acceleration, the root's, is
    always zero. For "sequence" the arguments must be as `seen_from_first` returns them. Without accelerations
    (DIP appendix D) 45, 48 or 54 numbers remain.
    """
    if scheme == "root" or scheme == "tilt":
        rotations, differences = root_relative(orientation, acceleration)
    else:
        if scheme == "heading":
            orientation, acceleration = relative_to(
                heading_of(orientation[..., -1, :, :]), orientation, acceleration
            )
        rotations = orientation
        differences = (acceleration - acceleration[..., -1:, :]).roll(1, -2)
    numbers = [rotations.flatten(-3)]
    if scheme == "tilt":
        root = orientation[..., -1, :, :]
        numbers.append(root[..., 1, :])  # T's vertical, Y, in the root's frame
        if with_acceleration:
            own = torch.matmul(root.transpose(-1, -2), acceleration[..., -1, :].unsqueeze(-1))
            numbers.append(own.squeeze(-1))
    if with_acceleration:
        numbers.append(differences.flatten(-2))
    return torch.cat(numbers, dim=-1)


class Inputs(nn.Module):
    """The part of an archive that turns calibrated frames into z-scored network inputs."""

    def __init__(self, scheme: str, with_acceleration: bool, mean: Tensor, std: Tensor) -> None:
        """Store mean and standard deviation of each input over the training set."""
        super().__init__()
        self.scheme, self.with_acceleration = scheme, with_acceleration
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, orientation: Tensor, acceleration: Tensor) -> Tensor:
        """Return the inputs (..., numbers)."""
        x = network_inputs(orientation, acceleration, self.scheme, self.with_acceleration)
        return (x - self.mean) / self.std


class FirstFrameNormaliser(nn.Module):
    """Wrapper of an archive that makes its inputs relative to the root of the first frame.

    That is the first frame of a window, or of a stream. The methods are those of the archive.
    """

    def __init__(self, archive: nn.Module) -> None:
        """Wrap an archive whose inputs have the scheme "sequence"."""
        super().__init__()
        self.archive = archive

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        rotations, std = self.archive(*seen_from_first(orientation, acceleration))
        return _turned(rotations, orientation[:, :1, -1]), std

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """See `edgepose_export.networks.packed_linear.PackedLinear.pack`."""
        self.archive.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window."""
        seen = seen_from_first(orientation, acceleration)
        rotations, std = self.archive.window(seen[0], seen[1], index)
        return _turned(rotations, orientation[:, 0, -1]), std

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the archive's state before the first frame, with a place for the first root, still empty."""
        state: list[Tensor] = self.archive.start(batch, future)
        return state + [torch.zeros(batch, 0, 3, 3)]  # noqa: RUF005 - TorchScript has no starred lists

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process one frame, see `BirnnArchive.stream`."""
        return self.stream_many(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process several frames (B, T, ...), see `BirnnArchive.stream_many`."""
        first = state[-1] if state[-1].shape[1] else orientation[:, :1, -1]
        seen = relative_to(first, orientation, acceleration)
        rotations, std, rest = self.archive.stream_many(seen[0], seen[1], state[:-1])
        return _turned(rotations, first), std, rest + [first]  # noqa: RUF005

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the poses of all frames that still wait when a stream ends."""
        rotations, std = self.archive.drain(state[:-1])
        if state[-1].shape[1]:
            rotations = _turned(rotations, state[-1])
        return rotations, std


def _turned(rotations: Tensor, reference: Tensor) -> Tensor:
    """Return local poses (..., 24, 3, 3) with the root relative to T instead of references (..., 3, 3)."""
    root = torch.matmul(reference, rotations[..., 0, :, :]).unsqueeze(-3)
    return torch.cat([root, rotations[..., 1:, :, :]], dim=-3)
