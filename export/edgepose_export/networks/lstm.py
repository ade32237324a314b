"""The recurrent networks of DIP 3.4 as they run in archives: from calibrated frames to poses, frame by frame.

The LSTM cells are written out, which for single frames is several times faster than `torch.nn.LSTM`. An
archive contains everything between calibration and pose: root normalisation, statistics, network, projection
to rotations. Statistics are folded into the adjacent weights.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from edgepose_export.networks.kind import NetworkKind, Statistics
from edgepose_export.networks.lstm_cell import LstmCell
from edgepose_export.networks.lstm_ends import NormalisationAndDecoding
from edgepose_export.networks.lstm_place import PlaceMethods
from edgepose_export.networks.shape import PoseDecoder, PoseNetwork


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
        rotations, std, _ = self.whole(orientation, acceleration)
        return rotations, std

    def whole(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `forward` returns, and the recurrent outputs (B, T, hidden)."""
        return self.last(orientation, acceleration, orientation.shape[1])

    def last(self, orientation: Tensor, acceleration: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the poses and the recurrent outputs of the last `count` frames of a sequence."""
        x = self.cell1.run(self.cell1.inputs[0](self.ends(orientation, acceleration)), False)
        x = self.cell2.run(self.cell2.inputs[0](x), False)
        rotations, std, _ = self.ends.pose(orientation, x, self.ends.start(x.shape[0]), count)
        return rotations, std, x[:, x.shape[1] - count :]

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Choose the precision of the recurrent layers' weights, see `PackedLinear.pack`."""
        self.cell1.pack(precision)
        self.cell2.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window; later frames are not used."""
        rotations, std, _ = self.at(orientation, acceleration, index)
        return rotations, std

    def at(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `window` returns, and the recurrent outputs (B, hidden) of that frame."""
        seen = orientation[:, : index + 1], acceleration[:, : index + 1]
        rotations, std, hidden = self.last(seen[0], seen[1], 1)
        return rotations[:, 0], std[:, 0], hidden[:, 0]

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
        rotations, std, _, state = self.advanced(orientation, acceleration, state)
        return rotations, std, state

    def advanced(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return what `stream_many` returns, with the recurrent outputs of these frames before the state."""
        x = self.ends(orientation, acceleration)
        x, h1, c1 = self.cell1.carry(self.cell1.inputs[0](x), state[0], state[1])
        x, h2, c2 = self.cell2.carry(self.cell2.inputs[0](x), state[2], state[3])
        rotations, std, lowpass = self.ends.pose(orientation, x, state[4], x.shape[1])
        return rotations, std, x, [h1, c1, h2, c2, lowpass]

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return no poses: no frame ever waits."""
        rotations, std, _ = self.drained(state)
        return rotations, std

    def drained(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `drain` returns, and the recurrent outputs (B, 0, hidden)."""
        batch = state[0].shape[0]
        none = torch.zeros(batch, 0, self.cell2.size)
        return torch.zeros(batch, 0, 24, 3, 3), torch.zeros(batch, 0, 24), none


class RnnPlaceArchive(PlaceMethods, RnnArchive):
    """The same with a head for the place."""


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
        rotations, std, _ = self.whole(orientation, acceleration)
        return rotations, std

    def whole(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `forward` returns, and the recurrent outputs (B, T, 2 hidden)."""
        ahead, back = self.layer1(orientation, acceleration)
        frames = orientation.shape[1]
        hidden = self.layer2(ahead, back, 0, frames)
        rotations, std, _ = self.ends.pose(orientation, hidden, self.ends.start(hidden.shape[0]), frames)
        return rotations, std, hidden

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
        rotations, std, _ = self.at(orientation, acceleration, index)
        return rotations, std

    def at(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `window` returns, and the recurrent outputs (B, 2 hidden) of that frame."""
        ahead, back = self.layer1(orientation, acceleration)
        first = 0 if self.ends.smoothing > 0.0 else index
        hidden = self.layer2(ahead, back, first, index + 1)
        seen = orientation[:, first : index + 1]
        rotations, std, _ = self.ends.pose(seen, hidden, self.ends.start(hidden.shape[0]), 1)
        return rotations[:, 0], std[:, 0], hidden[:, -1]

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

    def oldest(
        self, state: list[Tensor], count: int, future: int
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return the poses of the `count` oldest waiting frames, and the state without these frames.

        In between are the recurrent outputs (B, count, 2 hidden).

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
        state = [state[0], state[1], h2, c2] + waiting + [lowpass, state[9]]  # noqa: RUF005
        return rotations, std, hidden, state

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
        rotations, std, _, state = self.advanced(orientation, acceleration, state)
        return rotations, std, state

    def advanced(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return what `stream_many` returns, with the recurrent outputs of these frames before the state."""
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
            none = x.new_zeros(batch, 0, 2 * self.forward1.size)
            return x.new_zeros(batch, 0, 24, 3, 3), x.new_zeros(batch, 0, 24), none, state
        return self.oldest(state, due, future)

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the poses of all frames that still wait when a stream ends, oldest first."""
        rotations, std, _ = self.drained(state)
        return rotations, std

    def drained(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `drain` returns, and the recurrent outputs (B, T, 2 hidden)."""
        batch = state[0].shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        outputs: list[Tensor] = [torch.zeros(batch, 0, 2 * self.forward1.size)]
        while state[4].shape[1] > 0:
            rotation, std, hidden, state = self.oldest(state, 1, state[4].shape[1] - 1)
            rotations.append(rotation)
            stds.append(std)
            outputs.append(hidden)
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1), torch.cat(outputs, dim=1)


class BirnnPlaceArchive(PlaceMethods, BirnnArchive):
    """The same with a head for the place."""


def _fields(waiting: Tensor, count: int, future: int) -> Tensor:
    """Return the frames that each of the `count` oldest of (B, T, N) uses, (B * count, future + 1, N)."""
    return waiting.narrow(1, 0, count + future).unfold(1, future + 1, 1).transpose(2, 3).flatten(0, 1)


def _archive(plain: type[nn.Module], with_place: type[nn.Module]) -> Callable[..., nn.Module]:
    """Return the function that makes an archive's module of either class, see `NetworkKind.archive`."""

    def make(network: PoseNetwork, statistics: Statistics, decoder: PoseDecoder) -> nn.Module:
        ends = NormalisationAndDecoding(network, statistics.input_mean, statistics.input_std, decoder)
        return (with_place if network.shape.place else plain)(network, ends)

    return make


BIRNN = NetworkKind(
    PoseNetwork,
    _archive(BirnnArchive, BirnnPlaceArchive),
    "bidirectional LSTM; the pose of a frame is known once its {future} future frames have arrived "
    "({latency:.0f} ms); two layers with {hidden} units per direction",
    windowed=True,
    streamed=True,
    smoothed=True,
    placed=True,
)

RNN = NetworkKind(
    PoseNetwork,
    _archive(RnnArchive, RnnPlaceArchive),
    "unidirectional LSTM; the pose of a frame is known at once; two layers with {hidden} units per direction",
    smoothed=True,
    placed=True,
)
