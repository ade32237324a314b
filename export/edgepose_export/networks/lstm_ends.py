"""The layers of an archive before and after the recurrent ones: from calibrated frames to features, and from
recurrent outputs to poses.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose.inference.features import nearest_rotation
from edgepose.inference.rotation_rows import rotation_rows
from edgepose_export.networks.lstm_frames import SeenFromRoot, input_weights
from edgepose_export.networks.packed_linear import PackedLinear
from edgepose_export.networks.shape import SIGMA_FLOOR, PoseDecoder, PoseNetwork

TINY = 1e-12
"""Smallest length that a vector is divided by."""


class NormalisationAndDecoding(nn.Module):
    """The layers before and after the recurrent ones, which both archives share.

    N frames are those of one wearer or several, one after the other.
    """

    def __init__(
        self, network: PoseNetwork, input_mean: Tensor, input_std: Tensor, decoder: PoseDecoder
    ) -> None:
        """Copy the network's dense layers and fold in the statistics of its inputs (60 in the paper)."""
        super().__init__()
        shape = network.shape
        self.frames = SeenFromRoot(shape.normalisation)
        self.tiny = TINY
        self.register_buffer("floor", torch.tensor(SIGMA_FLOOR))
        self.smoothing = shape.smoothing
        self.local, self.joints = decoder.local, decoder.joints
        self.size = shape.pose_outputs
        dense = network.dense.weight.detach() / input_std
        self.dense = PackedLinear(
            input_weights(dense, shape.normalisation, shape.acceleration),
            network.dense.bias.detach() - dense @ input_mean,
        )
        # The acceleration part of the outputs is needed in training only.
        mean, deviation = network.mean, network.deviation
        weights = [mean.weight[: self.size] * decoder.target_std[:, None], deviation.weight[: self.size]]
        biases = [mean.bias[: self.size] * decoder.target_std + decoder.target_mean]
        biases.append(deviation.bias[: self.size])
        if not self.local:  # the first columns of all rotations, then the second ones
            order = torch.arange(self.size).view(self.joints, 2, 3).transpose(0, 1).flatten()
            weights[0], biases[0] = weights[0][order], biases[0][order]
        self.parts = [self.size, self.size]
        if shape.place:
            weights.append(network.place.weight)
            biases.append(network.place.bias)
            self.parts.append(len(network.place.weight))
        self.heads = PackedLinear(torch.cat(weights), torch.cat(biases))
        self.register_buffer("variances", decoder.variances)
        self.register_buffer("source", decoder.source)
        child, above = rotation_rows(shape.joints, decoder.passed)
        self.register_buffer("child", torch.tensor(child))
        self.register_buffer("above", torch.tensor(above))

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first hidden layer (N, hidden) of frames, and the frames as `pose` needs them.

        Args:
            orientation: (N, 6, 3, 3).
            acceleration: (N, 6, 3).
        """
        seen, inputs = self.frames(orientation, acceleration)
        return self.dense(inputs).relu_(), seen

    @torch.jit.export
    def start(self, batch: int) -> list[Tensor]:
        """Return the initial state of the low-pass: the last outputs (B, vectors, 3) of its two stages."""
        return [torch.zeros(batch, self.size // 3, 3), torch.zeros(batch, self.size // 3, 3)]

    @torch.jit.export
    def pose(
        self, seen: Tensor, hidden: Tensor, lowpass: list[Tensor], frames: int, count: int
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return rotations (B, count, 24, 3, 3) and deviations (B, count, 24) of each wearer's last frames.

        Also return the outputs (B, count, 10) of the head for the place, or (B, count, 0) without one, and
        the new state of the low-pass.

        Args:
            seen: (N, 9, 3, 3) frames, from `forward`.
            hidden: (N, hidden) recurrent outputs of these frames.
            lowpass: state of the low-pass.
            frames: number of frames per wearer.
            count: number of frames to return.
        """
        numbers = self.heads(hidden).split_with_sizes(self.parts, 1)
        pose, deviation = numbers[0], numbers[1]
        place = numbers[2] if len(numbers) > 2 else numbers[1].narrow(1, 0, 0)
        if self.smoothing > 0.0:
            pose, lowpass = self.smoothed(pose, seen.select(1, 8), lowpass, frames)
        if count < frames:
            pose, deviation = last(pose, frames, count), last(deviation, frames, count)
            seen, place = last(seen, frames, count), last(place, frames, count)
        rotations = self.rotations(seen, pose).view(-1, count, 24, 3, 3)
        std = self.deviations(deviation).view(-1, count, 24)
        return rotations, std, place.view(rotations.shape[0], count, place.shape[1]), lowpass

    def smoothed(
        self, pose: Tensor, root: Tensor, lowpass: list[Tensor], frames: int
    ) -> tuple[Tensor, list[Tensor]]:
        """Apply the low-pass to numbers (N, pose outputs) in the level frame of roots (N, 3, 3).

        Also return the new state. The state starts at zero without correction: the first outputs are too
        small, but only their directions matter for rotations.
        """
        level = self.frames.level(root)
        vectors = torch.bmm(pose.view(-1, self.size // 3, 3), level.transpose(1, 2))
        first, second = lowpass[0], lowpass[1]
        if frames == 1:
            first = torch.lerp(vectors, first, self.smoothing)
            second = torch.lerp(first, second, self.smoothing)
            vectors = second
        else:
            outputs: list[Tensor] = []
            for row in vectors.unflatten(0, (-1, frames)).unbind(1):
                first = torch.lerp(row, first, self.smoothing)
                second = torch.lerp(first, second, self.smoothing)
                outputs.append(second)
            vectors = torch.stack(outputs, dim=1).flatten(0, 1)
        return torch.bmm(vectors, level), [first, second]

    def deviations(self, deviation: Tensor) -> Tensor:
        """Return standard deviations (N, 24), radians, from outputs (N, pose outputs)."""
        deviation = nn.functional.softplus(deviation).add_(self.floor)
        return torch.mm(deviation.mul_(deviation), self.variances).sqrt_()

    def rotations(self, seen: Tensor, pose: Tensor) -> Tensor:
        """Return local rotations (N, 24, 3, 3) of frames from numbers (N, pose outputs)."""
        identity = self.frames.identity.expand(seen.shape[0], 1, 3, 3)
        if self.local:
            rotations = nearest_rotation(pose.reshape(-1, self.joints, 3, 3))
            local = torch.cat([identity, rotations], dim=1).index_select(1, self.source)
            return torch.cat([seen[:, 8:], local[:, 1:]], dim=1)
        # Transposed, as in `seen`: the rows of each matrix are its rotation's columns.
        first, second = pose.view(-1, 2, self.joints, 3).unbind(1)
        third = torch.linalg.cross(first, second)
        axes = torch.cat([first, torch.linalg.cross(third, first), third], dim=2)
        axes = axes.view(-1, self.joints, 3, 3)
        length = torch.linalg.vector_norm(axes, dim=3, keepdim=True).clamp_min_(self.tiny)
        known = torch.cat([seen, axes.div_(length), identity], dim=1)
        above, child = known.index_select(1, self.above), known.index_select(1, self.child)
        local = torch.bmm(above.view(-1, 3, 3), child.view(-1, 3, 3).transpose(1, 2))
        return local.view(-1, 24, 3, 3)


def last(x: Tensor, frames: int, count: int) -> Tensor:
    """Return the last `count` of each wearer's `frames` frames (N, ...)."""
    return x.unflatten(0, (-1, frames))[:, frames - count :].flatten(0, 1)
