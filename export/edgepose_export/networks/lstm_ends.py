"""The layers of an archive before and after the recurrent ones: from calibrated frames to features, and from
recurrent outputs to poses.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose_export.networks.normalisation import network_inputs, tilt_of
from edgepose_export.networks.packed_linear import PackedLinear
from edgepose_export.networks.shape import SIGMA_FLOOR, PoseDecoder, PoseNetwork, turned


class NormalisationAndDecoding(nn.Module):
    """The layers before and after the recurrent ones, which both archives share."""

    def __init__(
        self, network: PoseNetwork, input_mean: Tensor, input_std: Tensor, decoder: PoseDecoder
    ) -> None:
        """Copy the network's dense layers and fold in the statistics of its inputs (60 in the paper)."""
        super().__init__()
        shape = network.shape
        self.scheme, self.with_acceleration = shape.normalisation, shape.acceleration
        self.decoder = decoder
        self.floor = SIGMA_FLOOR
        self.smoothing = shape.smoothing
        dense = network.dense.weight.detach() / input_std
        self.dense = PackedLinear(dense, network.dense.bias.detach() - dense @ input_mean)
        # The acceleration part of the outputs is needed in training only.
        size = shape.pose_outputs
        mean, deviation = network.mean, network.deviation
        weights = [mean.weight[:size] * decoder.target_std[:, None], deviation.weight[:size]]
        biases = [mean.bias[:size] * decoder.target_std + decoder.target_mean, deviation.bias[:size]]
        self.heads = PackedLinear(torch.cat(weights), torch.cat(biases))

    def forward(self, orientation: Tensor, acceleration: Tensor) -> Tensor:
        """Return the first hidden layer (..., hidden) of calibrated frames."""
        x = network_inputs(orientation, acceleration, self.scheme, self.with_acceleration)
        return torch.relu(self.dense(x))

    @torch.jit.export
    def start(self, batch: int) -> Tensor:
        """Return the initial state of the low-pass: the last outputs (B, 2, pose outputs) of its stages."""
        return torch.zeros(batch, 2, self.decoder.target_mean.shape[0])

    @torch.jit.export
    def pose(
        self, orientation: Tensor, hidden: Tensor, lowpass: Tensor, count: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return local rotations (B, count, 24, 3, 3) and deviations (B, count, 24) of the last frames.

        Also return the new state of the low-pass.

        Args:
            orientation: (B, T, 6, 3, 3) frames.
            hidden: (B, T, hidden) recurrent outputs of these frames.
            lowpass: state of the low-pass.
            count: number of frames to return.
        """
        pose, deviation = self.heads(hidden).chunk(2, dim=-1)
        if self.smoothing > 0.0:
            pose, lowpass = self.smoothed(pose, orientation[:, :, -1], lowpass)
        first = hidden.shape[1] - count
        deviation = nn.functional.softplus(deviation[:, first:]) + self.floor
        rotations = self.decoder.rotations(orientation[:, first:], pose[:, first:])
        return rotations, self.decoder.deviations(deviation), lowpass

    def smoothed(self, pose: Tensor, root: Tensor, lowpass: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the low-pass to frames (B, T, pose outputs) in the level frame of the root (B, T, 3, 3).

        Also return the new state. The state starts at zero without correction: the first outputs are too
        small, but only their directions matter for rotations.
        """
        tilt = tilt_of(root)
        first, second = lowpass.unbind(1)
        outputs: list[Tensor] = []
        for row in turned(pose, tilt).unbind(1):
            first = torch.lerp(row, first, self.smoothing)
            second = torch.lerp(first, second, self.smoothing)
            outputs.append(second)
        pose = turned(torch.stack(outputs, dim=1), tilt.transpose(-1, -2))
        return pose, torch.stack([first, second], dim=1)
