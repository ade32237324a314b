"""The paper's networks without recurrence (DIP appendix A): each pose depends on a receptive field of frames.

A network has `past` and `future`, the frames of its field, and two methods: `hidden` takes sequences that are
longer than the result by the field, and `heads` turns the result into means and standard deviations. At the
ends of a sequence, the first and last frames are repeated to fill the field.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from edgepose.inference.features import ACCELERATIONS
from edgepose_export.networks.kind import Network, NetworkKind, Statistics
from edgepose_export.networks.normalisation import Inputs
from edgepose_export.networks.shape import SIGMA_FLOOR, NetworkShape, PoseDecoder

KERNEL = 2
"""Frames that a layer of the WaveNet combines."""

DILATIONS = (1, 2, 4, 8, 16) * 2
"""Distance of these frames, by layer: a field of 62 past frames. DIP does not state the sizes."""


class Heads(nn.Module):
    """Means and, through SoftPlus, standard deviations, as in the recurrent networks (DIP figure 12)."""

    def __init__(self, width: int, shape: NetworkShape) -> None:
        """Create random weights for inputs of this width."""
        super().__init__()
        outputs = shape.pose_outputs + ACCELERATIONS
        self.mean = nn.Linear(width, outputs)
        self.deviation = nn.Linear(width, outputs)
        self.floor = SIGMA_FLOOR

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and deviations (..., outputs) for (..., width)."""
        return self.mean(x), nn.functional.softplus(self.deviation(x)) + self.floor


def padded(x: Tensor, past: int, future: int) -> Tensor:
    """Return sequences (B, T, C) padded with copies of their first and last frames."""
    before, behind = x[:, :1].expand(-1, past, -1), x[:, -1:].expand(-1, future, -1)
    return torch.cat([before, x, behind], dim=1)


class FeedForward(Network):
    """Five dense layers over 20 past frames, the present one and 5 future ones."""

    def __init__(self, shape: NetworkShape) -> None:
        """Create random weights; with 512 hidden units the layers are DIP's: 256, 512, 512, 256, 256."""
        super().__init__()
        self.shape = shape
        self.past, self.future = 20, 5
        half = max(1, shape.hidden // 2)
        widths = [half, shape.hidden, shape.hidden, half, half]
        # A dense layer over the field of every frame is a convolution.
        self.first = nn.Conv1d(shape.inputs, widths[0], self.past + 1 + self.future)
        self.others = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.heads = Heads(widths[-1], shape)

    def hidden(self, x: Tensor) -> Tensor:
        """Return the last layer (B, T, units) for z-scored inputs (B, past + T + future, inputs)."""
        x = torch.relu(self.first(x.transpose(1, 2)).transpose(1, 2))
        for layer in self.others:
            x = torch.relu(layer(x))
        return x

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return normalised means and deviations (B, T, outputs) for z-scored inputs (B, T, inputs)."""
        mean, deviation = self.heads(self.hidden(padded(x, self.past, self.future)))
        return mean, deviation


class _DilatedLayer(nn.Module):
    """Gated dilated convolution with residual and skip connection (van den Oord et al. 2016, figure 4)."""

    def __init__(self, channels: int, dilation: int, last: bool) -> None:
        super().__init__()
        self.reach = (KERNEL - 1) * dilation
        self.gates = nn.Conv1d(channels, 2 * channels, KERNEL, dilation=dilation)
        self.skip = nn.Conv1d(channels, channels, 1)
        self.residual = nn.Identity() if last else nn.Conv1d(channels, channels, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return (B, channels, N - reach) for the next layer, and the same for the output."""
        filtered, gate = self.gates(x).chunk(2, dim=1)
        z = torch.tanh(filtered) * torch.sigmoid(gate)
        return self.residual(z) + x[:, :, self.reach :], self.skip(z)


class WaveNet(Network):
    """Ten layers of causal dilated convolutions: a long past and no future frames."""

    def __init__(self, shape: NetworkShape) -> None:
        """Create the layers with random weights; `hidden` is the number of channels."""
        super().__init__()
        self.shape = shape
        self.past, self.future = (KERNEL - 1) * sum(DILATIONS), 0
        self.dense = nn.Linear(shape.inputs, shape.hidden)
        last = len(DILATIONS) - 1
        self.layers = nn.ModuleList(
            _DilatedLayer(shape.hidden, dilation, i == last) for i, dilation in enumerate(DILATIONS)
        )
        self.out = nn.Linear(shape.hidden, shape.hidden)
        self.heads = Heads(shape.hidden, shape)

    def hidden(self, x: Tensor) -> Tensor:
        """Return the last layer (B, T, units) for z-scored inputs (B, past + T, inputs)."""
        frames = x.shape[1] - self.past
        x = self.dense(x).transpose(1, 2)
        total = torch.zeros_like(x[:, :, :frames])
        for layer in self.layers:
            x, skip = layer(x)
            total = total + skip[:, :, -frames:]
        return torch.relu(self.out(torch.relu(total).transpose(1, 2)))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return normalised means and deviations (B, T, outputs) for z-scored inputs (B, T, inputs)."""
        mean, deviation = self.heads(self.hidden(padded(x, self.past, self.future)))
        return mean, deviation


class FieldArchive(nn.Module):
    """Archive of a network over a receptive field, from calibrated frames to poses.

    Methods and shapes are those of `BirnnArchive`. Whole sequence, window and stream give the same pose if
    each contains the whole field.
    """

    def __init__(self, network: Any, inputs: Inputs, decoder: PoseDecoder) -> None:
        """Combine a trained network with its inputs and its decoder."""
        super().__init__()
        self.network, self.inputs, self.decoder = network, inputs, decoder
        self.past, self.future = network.past, network.future

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        mean, deviation = self.network(self.inputs(orientation, acceleration))
        return self.decoder(orientation, mean, deviation)

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Check the precision; only "f32" is supported."""
        if precision != "f32":
            raise ValueError("networks without recurrence run in f32 only")

    def at(self, x: Tensor, orientation: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of inputs (B, T, inputs), with its orientation (B, 6, 3, 3)."""
        first, last = max(0, index - self.past), min(x.shape[1], index + self.future + 1)
        field = padded(x[:, first:last], self.past - index + first, self.future + 1 + index - last)
        mean, deviation = self.network.heads(self.network.hidden(field)[:, 0])
        return self.decoder(orientation, mean, deviation)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window."""
        return self.at(self.inputs(orientation, acceleration), orientation[:, index], index)

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the initial state of a stream in which each pose uses up to `future` later frames.

        The state is [inputs of the frames that are still needed, orientations of the frames that wait for a
        pose, a tensor whose length is `future`].
        """
        return [
            torch.zeros(batch, 0, self.inputs.mean.shape[0]),
            torch.zeros(batch, 0, 6, 3, 3),
            torch.zeros(future),
        ]

    def oldest(self, state: list[Tensor]) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return the pose of the oldest waiting frame, and the state without it."""
        seen, waiting = state[0], state[1]
        index = seen.shape[1] - waiting.shape[1]
        rotations, std = self.at(seen, waiting[:, 0], index)
        # The next frame's field begins one frame later.
        return rotations, std, [seen[:, max(0, index + 1 - self.past) :], waiting[:, 1:], state[2]]

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process one frame; return the pose of the frame `future` frames ago, if there is one."""
        x = self.inputs(orientation, acceleration).unsqueeze(1)
        state = [
            torch.cat([state[0], x], dim=1),
            torch.cat([state[1], orientation.unsqueeze(1)], dim=1),
            state[2],
        ]
        if state[1].shape[1] <= state[2].shape[0]:
            batch = x.shape[0]
            return x.new_zeros(batch, 0, 24, 3, 3), x.new_zeros(batch, 0, 24), state
        rotations, std, state = self.oldest(state)
        return rotations.unsqueeze(1), std.unsqueeze(1), state

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process several frames (B, T, ...) and return all poses that are due."""
        batch = orientation.shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        for t in range(orientation.shape[1]):
            rotation, std, state = self.stream(orientation[:, t], acceleration[:, t], state)
            rotations.append(rotation)
            stds.append(std)
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1), state

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the poses of all frames that still wait when a stream ends, oldest first."""
        batch = state[0].shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        while state[1].shape[1] > 0:
            rotation, std, state = self.oldest(state)
            rotations.append(rotation.unsqueeze(1))
            stds.append(std.unsqueeze(1))
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1)


def field_archive(network: Network, statistics: Statistics, decoder: PoseDecoder) -> FieldArchive:
    """Return the archive's module for a network over a receptive field."""
    shape = network.shape
    inputs = Inputs(shape.normalisation, shape.acceleration, statistics.input_mean, statistics.input_std)
    return FieldArchive(network, inputs, decoder)


FEED_FORWARD = NetworkKind(
    FeedForward,
    field_archive,
    "five dense layers over {past} past and {future} future frames; the pose of a frame is known once these "
    "have arrived ({latency:.0f} ms); {hidden} units in the widest layer",
)

WAVENET = NetworkKind(
    WaveNet,
    field_archive,
    "dilated convolutions over {past} past frames; the pose of a frame is known at once; {hidden} units in "
    "the widest layer",
)
