"""The recurrent networks of DIP 3.4 as they run in archives: from calibrated frames to poses, frame by frame.

The LSTM cells are written out, which for single frames is several times faster than `torch.nn.LSTM`. An
archive contains everything between calibration and pose: root normalisation, statistics, network, projection
to rotations. Statistics are folded into the adjacent weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose_export.networks.kind import NetworkKind, Statistics
from edgepose_export.networks.lstm_cell import LstmCell
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


class RnnArchive(nn.Module):
    """Unidirectional network: one step per frame, no look-ahead. Methods and shapes as in `BirnnArchive`."""

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.cell1 = LstmCell(network.lstm1, "")
        self.cell2 = LstmCell(network.lstm2, "")

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        return self.last(orientation, acceleration, orientation.shape[1])

    def last(self, orientation: Tensor, acceleration: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the poses of the last `count` frames of a sequence."""
        x = self.cell1.run(self.cell1.inputs[0](self.ends(orientation, acceleration)), False)
        x = self.cell2.run(self.cell2.inputs[0](x), False)
        rotations, std, _ = self.ends.pose(orientation, x, self.ends.start(x.shape[0]), count)
        return rotations, std

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Choose the precision of the recurrent layers' weights, see `PackedLinear.pack`."""
        self.cell1.pack(precision)
        self.cell2.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window; later frames are not used."""
        rotations, std = self.last(orientation[:, : index + 1], acceleration[:, : index + 1], 1)
        return rotations[:, 0], std[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the state before the first frame; `future` must be 0."""
        if future != 0:
            raise ValueError("a unidirectional network has no future frames")
        zero = torch.zeros(batch, self.cell1.size)
        return [zero, zero, zero, zero, self.ends.start(batch)]

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process one frame: return its pose, deviations and the new state."""
        return self.stream_many(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process several frames (B, T, ...): return their poses, deviations and the new state."""
        x = self.ends(orientation, acceleration)
        x, h1, c1 = self.cell1.carry(self.cell1.inputs[0](x), state[0], state[1])
        x, h2, c2 = self.cell2.carry(self.cell2.inputs[0](x), state[2], state[3])
        rotations, std, lowpass = self.ends.pose(orientation, x, state[4], x.shape[1])
        return rotations, std, [h1, c1, h2, c2, lowpass]

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return no poses: no frame ever waits."""
        batch = state[0].shape[0]
        return torch.zeros(batch, 0, 24, 3, 3), torch.zeros(batch, 0, 24)


class BirnnArchive(nn.Module):
    """Bidirectional network: whole sequences, exact windows, or streams with carried forward states.

    In all methods `orientation` is (B, [T,] 6, 3, 3), calibrated bone orientations R_TB, and `acceleration`
    (B, [T,] 6, 3), m/s^2 in T without gravity, for B wearers. Poses are (B, [T,] 24, 3, 3) local rotations
    with (B, [T,] 24) standard deviations in radians.

    The input of the second layer has two parts, the first layer's forward and backward outputs. In a stream
    the forward output of a frame is final once the frame has arrived; the backward output changes with every
    new frame.
    """

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.forward1, self.backward1 = LstmCell(network.lstm1, ""), LstmCell(network.lstm1, "_reverse")
        self.forward2, self.backward2 = LstmCell(network.lstm2, "", 2), LstmCell(network.lstm2, "_reverse", 2)

    def layer1(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs (B, T, hidden) of the first layer over a sequence, forwards and backwards."""
        x = self.ends(orientation, acceleration)
        return (
            self.forward1.run(self.forward1.inputs[0](x), False),
            self.backward1.run(self.backward1.inputs[0](x), True),
        )

    def forward2_products(self, ahead: Tensor, back: Tensor) -> Tensor:
        """Return the product of the second layer's whole input with its forward weights."""
        return self.forward2.inputs[0](ahead) + self.forward2.inputs[1](back)

    def backward2_products(self, ahead: Tensor, back: Tensor) -> Tensor:
        """Return the product of the second layer's whole input with its backward weights."""
        return self.backward2.inputs[0](ahead) + self.backward2.inputs[1](back)

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        ahead, back = self.layer1(orientation, acceleration)
        frames = orientation.shape[1]
        hidden = self.layer2(ahead, back, 0, frames)
        rotations, std, _ = self.ends.pose(orientation, hidden, self.ends.start(hidden.shape[0]), frames)
        return rotations, std

    def layer2(self, ahead: Tensor, back: Tensor, first: int, end: int) -> Tensor:
        """Return outputs (B, end - first, 2 hidden) of the second layer for frames `first` to `end` - 1."""
        past = self.forward2.run(self.forward2_products(ahead[:, :end], back[:, :end]), False)
        later = self.backward2.run(self.backward2_products(ahead[:, first:], back[:, first:]), True)
        return torch.cat([past[:, first:], later[:, : end - first]], dim=-1)

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Choose the precision of the recurrent layers' weights, see `PackedLinear.pack`."""
        self.forward1.pack(precision)
        self.backward1.pack(precision)
        self.forward2.pack(precision)
        self.backward2.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window (DIP 3.4), equal to that of `forward` over the window.

        The second layer runs only over frames that influence frame `index`; with smoothing, all of them do.
        """
        ahead, back = self.layer1(orientation, acceleration)
        first = 0 if self.ends.smoothing > 0.0 else index
        hidden = self.layer2(ahead, back, first, index + 1)
        seen = orientation[:, first : index + 1]
        rotations, std, _ = self.ends.pose(seen, hidden, self.ends.start(hidden.shape[0]), 1)
        return rotations[:, 0], std[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the state before the first frame of a stream in which each pose uses `future` later frames.

        The state is [h1, c1, h2, c2; for the frames that wait for their future: products of layer 1
        backwards, known products of layer 2 forwards, the same backwards, orientations; the state of the
        low-pass; a tensor whose length is `future`].
        """
        size = self.forward1.size
        zero, waiting = torch.zeros(batch, size), torch.zeros(batch, 0, 4 * size)
        orientations = torch.zeros(batch, 0, 6, 3, 3)
        lowpass = self.ends.start(batch)
        return [zero, zero, zero, zero, waiting, waiting, waiting, orientations, lowpass, torch.zeros(future)]

    def oldest(self, state: list[Tensor], count: int, future: int) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return the poses of the `count` oldest waiting frames, and the state without these frames.

        Each pose uses `future` frames that wait behind its own. Forward states carry over; the backward pass
        of each frame starts afresh at the last frame it uses (latency-controlled bidirectional LSTM). The
        backward passes of several frames run side by side.
        """
        batch = state[0].shape[0]
        back = self.backward1.run(_fields(state[4], count, future), True)
        known = self.forward2.inputs[1](back[:, 0]).unflatten(0, (batch, count)) + state[5][:, :count]
        past, h2, c2 = self.forward2.carry(known, state[2], state[3])
        later = self.backward2.run(_fields(state[6], count, future) + self.backward2.inputs[1](back), True)
        hidden = torch.cat([past, later[:, 0].unflatten(0, (batch, count))], dim=-1)
        rotations, std, lowpass = self.ends.pose(state[7][:, :count], hidden, state[8], count)
        waiting = [state[4][:, count:], state[5][:, count:], state[6][:, count:], state[7][:, count:]]
        return rotations, std, [state[0], state[1], h2, c2] + waiting + [lowpass, state[9]]  # noqa: RUF005

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process one frame and return the pose (B, 1, 24, 3, 3) of the frame `future` frames ago.

        The result is empty, (B, 0, 24, 3, 3), until enough frames have arrived.
        """
        return self.stream_many(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process several frames (B, T, ...) and return all poses that `stream` would return one by one."""
        x = self.ends(orientation, acceleration)
        ahead, h1, c1 = self.forward1.carry(self.forward1.inputs[0](x), state[0], state[1])
        state = [
            h1,
            c1,
            state[2],
            state[3],
            torch.cat([state[4], self.backward1.inputs[0](x)], dim=1),
            torch.cat([state[5], self.forward2.inputs[0](ahead)], dim=1),
            torch.cat([state[6], self.backward2.inputs[0](ahead)], dim=1),
            torch.cat([state[7], orientation], dim=1),
            state[8],
            state[9],
        ]
        future = state[9].shape[0]
        due = state[4].shape[1] - future
        if due <= 0:
            batch = x.shape[0]
            return x.new_zeros(batch, 0, 24, 3, 3), x.new_zeros(batch, 0, 24), state
        return self.oldest(state, due, future)

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the poses of all frames that still wait when a stream ends, oldest first."""
        batch = state[0].shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        while state[4].shape[1] > 0:
            rotation, std, state = self.oldest(state, 1, state[4].shape[1] - 1)
            rotations.append(rotation)
            stds.append(std)
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1)


def _fields(waiting: Tensor, count: int, future: int) -> Tensor:
    """Return the frames that each of the `count` oldest of (B, T, N) uses, (B * count, future + 1, N)."""
    return waiting.narrow(1, 0, count + future).unfold(1, future + 1, 1).transpose(2, 3).flatten(0, 1)


def _ends(network: PoseNetwork, statistics: Statistics, decoder: PoseDecoder) -> NormalisationAndDecoding:
    return NormalisationAndDecoding(network, statistics.input_mean, statistics.input_std, decoder)


BIRNN = NetworkKind(
    PoseNetwork,
    lambda network, *ends: BirnnArchive(network, _ends(network, *ends)),
    "bidirectional LSTM; the pose of a frame is known once its {future} future frames have arrived "
    "({latency:.0f} ms); two layers with {hidden} units per direction",
    windowed=True,
    streamed=True,
    smoothed=True,
    placed=True,
)

RNN = NetworkKind(
    PoseNetwork,
    lambda network, *ends: RnnArchive(network, _ends(network, *ends)),
    "unidirectional LSTM; the pose of a frame is known at once; two layers with {hidden} units per direction",
    smoothed=True,
    placed=True,
)
