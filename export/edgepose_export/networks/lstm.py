"""The recurrent networks of DIP 3.4 as they run in archives: from calibrated frames to poses, frame by frame.

The LSTM cells are written out, which for single frames is several times faster than `torch.nn.LSTM`. An
archive contains everything between calibration and pose: root normalisation, statistics, network, projection
to rotations. Statistics are folded into the adjacent weights.

For one wearer, an operation of torch costs about as much as its product with a layer's weights. So the code
counts operations: it joins products, works in place, and takes no slices where there is one frame.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from edgepose_export.networks.kind import NetworkKind, Statistics
from edgepose_export.networks.lstm_cell import BACKWARD, FORWARD, LstmCell, input_products
from edgepose_export.networks.lstm_ends import NormalisationAndDecoding
from edgepose_export.networks.lstm_place import PlaceMethods
from edgepose_export.networks.shape import PoseDecoder, PoseNetwork


class RecurrentArchive(nn.Module):
    """Base of both archives: the methods that return poses alone.

    In all methods `orientation` is (B, [T,] 6, 3, 3), calibrated bone orientations R_TB, and `acceleration`
    (B, [T,] 6, 3), m/s^2 in T without gravity, for B wearers. Poses are (B, [T,] 24, 3, 3) local rotations
    with (B, [T,] 24) standard deviations in radians.
    """

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return the pose of frame `index` of a window (DIP 3.4), equal to that of `forward` over the window.

        A unidirectional network does not use the later frames.
        """
        rotations, std, _ = self.at(orientation, acceleration, index)
        return rotations, std

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process one frame and return the pose (B, 1, 24, 3, 3) of the frame `future` frames ago.

        The result is empty, (B, 0, 24, 3, 3), until enough frames have arrived.
        """
        rotations, std, _, state = self.advanced(orientation, acceleration, 1, state)
        return rotations, std, state

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Process several frames (B, T, ...) and return all poses that `stream` would return one by one."""
        frames = orientation.shape[1]
        rotations, std, _, state = self.advanced(
            orientation.flatten(0, 1), acceleration.flatten(0, 1), frames, state
        )
        return rotations, std, state

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the poses of all frames that still wait when a stream ends, oldest first."""
        rotations, std, _ = self.drained(state)
        return rotations, std

    def none(self, batch: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return no poses and places of a number of wearers."""
        place = self.ends.heads.bias.shape[0] - 2 * self.ends.size
        return torch.zeros(batch, 0, 24, 3, 3), torch.zeros(batch, 0, 24), torch.zeros(batch, 0, place)


class RnnArchive(RecurrentArchive):
    """Unidirectional network: one step per frame, no look-ahead."""

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.inputs1, self.cell1 = input_products(network.lstm1, [FORWARD]), LstmCell(network.lstm1, FORWARD)
        self.inputs2, self.cell2 = input_products(network.lstm2, [FORWARD]), LstmCell(network.lstm2, FORWARD)

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        rotations, std, _ = self.whole(orientation, acceleration)
        return rotations, std

    def whole(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `forward` returns, and the places (B, T, 10), see `PlaceMethods`."""
        return self.last(orientation, acceleration, orientation.shape[1])

    def last(self, orientation: Tensor, acceleration: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the poses and the places of the last `count` frames of a sequence."""
        batch, frames = orientation.shape[0], orientation.shape[1]
        hidden, seen, state = self.recurrent(
            orientation.flatten(0, 1), acceleration.flatten(0, 1), frames, self.start(batch, 0)
        )
        rotations, std, place, _ = self.ends.pose(seen, hidden, state[4:], frames, count)
        return rotations, std, place

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Choose the precision of the recurrent layers' weights, see `PackedLinear.pack`."""
        self.inputs1.pack(precision)
        self.cell1.pack(precision)
        self.inputs2.pack(precision)
        self.cell2.pack(precision)

    def at(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `window` returns, and the place (B, 10) of that frame."""
        rotations, std, place = self.last(orientation[:, : index + 1], acceleration[:, : index + 1], 1)
        return rotations[:, 0], std[:, 0], place[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the state before the first frame; `future` must be 0.

        The state is [h1, c1, h2, c2, the two stages of the low-pass].
        """
        if future != 0:
            raise ValueError("a unidirectional network has no future frames")
        zero = torch.zeros(batch, self.cell1.size)
        return [zero, zero, zero, zero] + self.ends.start(batch)  # noqa: RUF005

    def recurrent(
        self, orientation: Tensor, acceleration: Tensor, frames: int, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return the recurrent outputs of frames (B frames, ...), what was seen, and the state after them."""
        x, seen = self.ends(orientation, acceleration)
        x, h1, c1 = self.cell1.carry(self.inputs1(x), state[0], state[1], frames)
        x, h2, c2 = self.cell2.carry(self.inputs2(x), state[2], state[3], frames)
        return x, seen, [h1, c1, h2, c2, state[4], state[5]]

    def advanced(
        self, orientation: Tensor, acceleration: Tensor, frames: int, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return what `stream_many` returns for frames (B frames, ...), with places before the state."""
        hidden, seen, state = self.recurrent(orientation, acceleration, frames, state)
        rotations, std, place, lowpass = self.ends.pose(seen, hidden, state[4:], frames, frames)
        return rotations, std, place, state[:4] + lowpass

    def drained(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `drain` returns, nothing as no frame ever waits, and no places."""
        return self.none(state[0].shape[0])


class RnnPlaceArchive(PlaceMethods, RnnArchive):
    """The same with a head for the place."""


class BirnnArchive(RecurrentArchive):
    """Bidirectional network: whole sequences, exact windows, or streams with carried forward states.

    The input of the second layer has two parts, the first layer's forward and backward outputs. In a stream
    the forward output of a frame is final once the frame has arrived; the backward output changes with every
    new frame.
    """

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__()
        self.ends = ends
        lstm1, lstm2, size = network.lstm1, network.lstm2, network.shape.hidden
        self.inputs1 = input_products(lstm1, [FORWARD, BACKWARD])
        self.ahead2 = input_products(lstm2, [FORWARD, BACKWARD], slice(size))
        self.back2_forward = input_products(lstm2, [FORWARD], slice(size, None), bias=False)
        self.back2_backward = input_products(lstm2, [BACKWARD], slice(size, None), bias=False)
        self.forward1, self.backward1 = LstmCell(lstm1, FORWARD), LstmCell(lstm1, BACKWARD)
        self.forward2, self.backward2 = LstmCell(lstm2, FORWARD), LstmCell(lstm2, BACKWARD)
        self.directions = [4 * size, 4 * size]

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of a whole sequence."""
        rotations, std, _ = self.whole(orientation, acceleration)
        return rotations, std

    def whole(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `forward` returns, and the places (B, T, 10), see `PlaceMethods`."""
        frames = orientation.shape[1]
        return self.part(orientation, acceleration, 0, frames, frames)

    def part(
        self, orientation: Tensor, acceleration: Tensor, first: int, end: int, count: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the poses and places of the last `count` of frames `first` to `end` - 1 of a sequence.

        The second layer and the low-pass run over frames `first` to `end` - 1 only.
        """
        batch, frames = orientation.shape[0], orientation.shape[1]
        x, seen = self.ends(orientation.flatten(0, 1), acceleration.flatten(0, 1))
        ahead, back = self.inputs1(x).split_with_sizes(self.directions, 1)
        outputs = self.forward1.run(rows(ahead, frames))
        ahead, back = self.ahead2(joined(outputs)), joined(self.backward1.run(rows(back, frames)[::-1])[::-1])
        ahead, later = ahead.split_with_sizes(self.directions, 1)
        ahead = self.back2_forward.onto(back, ahead)
        later = self.back2_backward.onto(back, later)
        past = self.forward2.run(rows(ahead, frames)[:end])[first:]
        behind = self.backward2.run(rows(later, frames)[first:][::-1])[::-1][: end - first]
        hidden = torch.cat([joined(past), joined(behind)], dim=1)
        seen = seen.unflatten(0, (batch, frames))[:, first:end].flatten(0, 1)
        rotations, std, place, _ = self.ends.pose(seen, hidden, self.ends.start(batch), end - first, count)
        return rotations, std, place

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Choose the precision of the recurrent layers' weights, see `PackedLinear.pack`."""
        self.inputs1.pack(precision)
        self.ahead2.pack(precision)
        self.back2_forward.pack(precision)
        self.back2_backward.pack(precision)
        self.forward1.pack(precision)
        self.backward1.pack(precision)
        self.forward2.pack(precision)
        self.backward2.pack(precision)

    def at(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `window` returns, and the place (B, 10) of that frame.

        The second layer runs only over frames that influence frame `index`; with smoothing, all of them do.
        """
        first = 0 if self.ends.smoothing > 0.0 else index
        rotations, std, place = self.part(orientation, acceleration, first, index + 1, 1)
        return rotations[:, 0], std[:, 0], place[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """Return the state before the first frame of a stream in which each pose uses `future` later frames.

        The state is [h1, c1, h2, c2; for the frames that wait for their future: products of layer 1
        backwards, known products of layer 2 forwards, the same backwards, frames seen from the root; the two
        stages of the low-pass; a tensor whose length is `future`].
        """
        size = self.forward1.size
        zero, waiting = torch.zeros(batch, size), torch.zeros(batch, 0, 4 * size)
        state = [zero, zero, zero, zero, waiting, waiting, waiting, torch.zeros(batch, 0, 9, 3, 3)]
        return state + self.ends.start(batch) + [torch.zeros(future)]

    def oldest(
        self, state: list[Tensor], count: int, future: int
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return the poses and places of the `count` oldest waiting frames, and the state without these.

        Each pose uses the `future` frames behind its own; `count + future` frames wait. Forward states carry
        over; the backward pass of each frame starts afresh at the last frame it uses (latency-controlled
        bidirectional LSTM). The backward passes of several frames run side by side.
        """
        length = future + 1
        parts = [count, future]
        due, waiting = state[5].split_with_sizes(parts, 1)
        seen, waiting_seen = state[7].split_with_sizes(parts, 1)
        back = self.backward1.run(fields(state[4], count, length).unbind(1)[::-1])[::-1]
        known = self.back2_forward.onto(back[0], due.flatten(0, 1))
        past, h2, c2 = self.forward2.carry(known, state[2], state[3], count)
        known = self.back2_backward.onto(joined(back), fields(state[6], count, length).flatten(0, 1))
        later = self.backward2.run(rows(known, length)[::-1])[-1]
        rotations, std, place, lowpass = self.ends.pose(
            seen.flatten(0, 1), torch.cat([past, later], dim=1), state[8:10], count, count
        )
        left = [state[4].narrow(1, count, future), waiting, state[6].narrow(1, count, future), waiting_seen]
        return rotations, std, place, [state[0], state[1], h2, c2] + left + lowpass + state[10:]  # noqa: RUF005

    def advanced(
        self, orientation: Tensor, acceleration: Tensor, frames: int, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Return what `stream_many` returns for frames (B frames, ...), with places before the state."""
        x, seen = self.ends(orientation, acceleration)
        ahead, back = self.inputs1(x).split_with_sizes(self.directions, 1)
        ahead, h1, c1 = self.forward1.carry(ahead, state[0], state[1], frames)
        ahead, later = self.ahead2(ahead).split_with_sizes(self.directions, 1)
        width = self.directions[0]
        waiting = [
            torch.cat([state[4], back.view(-1, frames, width)], dim=1),
            torch.cat([state[5], ahead.view(-1, frames, width)], dim=1),
            torch.cat([state[6], later.view(-1, frames, width)], dim=1),
            torch.cat([state[7], seen.view(-1, frames, 9, 3, 3)], dim=1),
        ]
        state = [h1, c1] + state[2:4] + waiting + state[8:]  # noqa: RUF005
        future = state[10].shape[0]
        due = state[4].shape[1] - future
        if due <= 0:
            rotations, std, place = self.none(h1.shape[0])
            return rotations, std, place, state
        return self.oldest(state, due, future)

    def drained(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `drain` returns, and the places (B, T, 10)."""
        rotations, std, place = self.none(state[0].shape[0])
        poses, stds, places = [rotations], [std], [place]
        while state[4].shape[1] > 0:
            rotations, std, place, state = self.oldest(state, 1, state[4].shape[1] - 1)
            poses.append(rotations)
            stds.append(std)
            places.append(place)
        return torch.cat(poses, dim=1), torch.cat(stds, dim=1), torch.cat(places, dim=1)


class BirnnPlaceArchive(PlaceMethods, BirnnArchive):
    """The same with a head for the place."""


def rows(x: Tensor, frames: int) -> list[Tensor]:
    """Return sequences (B frames, N) as a list of (B, N), one for each frame."""
    return x.view(-1, frames, x.shape[1]).unbind(1)


def joined(outputs: list[Tensor]) -> Tensor:
    """Return a list of (B, N) as sequences (B frames, N); the inverse of `rows`."""
    return torch.cat(outputs, dim=1).view(-1, outputs[0].shape[1])


def fields(waiting: Tensor, count: int, length: int) -> Tensor:
    """Return the `length` frames that each of the `count` oldest of (B, T, N) uses, (B count, length, N)."""
    if count == 1:
        return waiting
    return waiting.unfold(1, length, 1).transpose(2, 3).flatten(0, 1)


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
