"""The recurrent networks of DIP 3.4 as they run: from calibrated frames to poses, one frame at a time.

The LSTM cells are written out, which is several times quicker for single frames than `torch.nn.LSTM`, and an
archive carries everything between calibration and pose: root normalisation, statistics, network, projection
to rotations. Statistics are folded into the weights next to them.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose_export.networks.normalisation import network_inputs, tilt_of
from edgepose_export.networks.packed_linear import PackedLinear
from edgepose_export.networks.shape import SIGMA_FLOOR, PoseDecoder, PoseNetwork, turned


class LstmCell(nn.Module):
    """One LSTM direction, written out: the products of inputs and of states apart.

    Over a sequence the products of all inputs are one; only those of the states have to wait for each other.
    """

    def __init__(self, lstm: nn.LSTM, suffix: str, parts: int = 1) -> None:
        """Copies one direction's weights.

        Args:
            lstm: a layer.
            suffix: torch's, "" forwards, "_reverse" backwards.
            parts: in how many equal parts the input comes, each with a product of its own.
        """
        super().__init__()
        self.size = lstm.hidden_size
        weight_ih, weight_hh, bias_ih, bias_hh = (
            getattr(lstm, f"{name}_l0{suffix}").detach()
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        )
        # Rows of the candidate, the third of four gates, are doubled: tanh(x) = 2 sigmoid(2 x) - 1, so one
        # sigmoid serves all four.
        scale = torch.tensor([1.0, 1.0, 2.0, 1.0]).repeat_interleave(self.size)[:, None]
        bias = (bias_ih + bias_hh) * scale[:, 0]
        self.inputs = nn.ModuleList(
            PackedLinear(part, bias if i == 0 else None)
            for i, part in enumerate((weight_ih * scale).chunk(parts, dim=1))
        )
        self.state = PackedLinear(weight_hh * scale)

    def forward(self, product: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """New h and c (B, hidden) from the inputs' product (B, 4 hidden) and the old ones."""
        return self.step(self.state.onto(h, product), c)

    def step(self, gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """New h and c from the sum of both products (B, 4 hidden)."""
        i, f, g, o = torch.sigmoid(gates).chunk(4, dim=1)
        c = torch.addcmul(f * c - i, i, g, value=2.0)
        return o * torch.tanh(c), c

    @torch.jit.export
    def run(self, products: Tensor, reverse: bool) -> Tensor:
        """Outputs (B, T, hidden) over the inputs' products (B, T, 4 hidden) from a zero state, in order or
        from last to first.
        """
        rows = products.unbind(1)
        if reverse:
            rows = rows[::-1]
        # The first state is zero: a product less.
        h, c = self.step(rows[0], products.new_zeros(products.shape[0], self.size))
        outputs = [h] + self.over(rows[1:], h, c)[0]
        if reverse:
            outputs = outputs[::-1]
        return torch.stack(outputs, dim=1)

    @torch.jit.export
    def carry(self, products: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Outputs (B, T, hidden) over the inputs' products (B, T, 4 hidden) from a state, and the last h and
        c.
        """
        if products.shape[1] == 1:  # live; lists would cost a tenth of the time of a small network
            h, c = self(products[:, 0], h, c)
            return h.unsqueeze(1), h, c
        outputs, h, c = self.over(products.unbind(1), h, c)
        return torch.stack(outputs, dim=1), h, c

    def over(self, rows: list[Tensor], h: Tensor, c: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Outputs after each of some products, and the last h and c."""
        outputs: list[Tensor] = []
        for row in rows:
            h, c = self(row, h, c)
            outputs.append(h)
        return outputs, h, c

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """See `PackedLinear.pack`."""
        for part in self.inputs:
            part.pack(precision)
        self.state.pack(precision)


class NormalisationAndDecoding(nn.Module):
    """What both archives share: the layers before and after the recurrent ones."""

    def __init__(
        self, network: PoseNetwork, input_mean: Tensor, input_std: Tensor, decoder: PoseDecoder
    ) -> None:
        """Takes the network's dense layers and the statistics of its inputs, 60 in the paper."""
        super().__init__()
        shape = network.shape
        self.scheme, self.with_acceleration = shape.normalisation, shape.acceleration
        self.decoder = decoder
        self.floor = SIGMA_FLOOR
        self.smoothing = shape.smoothing
        dense = network.dense.weight.detach() / input_std
        self.dense = PackedLinear(dense, network.dense.bias.detach() - dense @ input_mean)
        # The acceleration part of the outputs serves training alone.
        size = shape.pose_outputs
        mean, deviation = network.mean, network.deviation
        weights = [mean.weight[:size] * decoder.target_std[:, None], deviation.weight[:size]]
        biases = [mean.bias[:size] * decoder.target_std + decoder.target_mean, deviation.bias[:size]]
        self.heads = PackedLinear(torch.cat(weights), torch.cat(biases))

    def forward(self, orientation: Tensor, acceleration: Tensor) -> Tensor:
        """First hidden layer (..., hidden) of calibrated frames."""
        x = network_inputs(orientation, acceleration, self.scheme, self.with_acceleration)
        return torch.relu(self.dense(x))

    @torch.jit.export
    def start(self, batch: int) -> Tensor:
        """State of the low-pass before the first frame: its stages' last outputs, (B, 2, pose outputs)."""
        return torch.zeros(batch, 2, self.decoder.target_mean.shape[0])

    @torch.jit.export
    def pose(
        self, orientation: Tensor, hidden: Tensor, lowpass: Tensor, count: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Local rotations (B, count, 24, 3, 3) and deviations (B, count, 24) of the last of the frames (B, T,
        6, 3, 3) whose recurrent outputs are (B, T, hidden); and the low-pass' new state.
        """
        pose, deviation = self.heads(hidden).chunk(2, dim=-1)
        if self.smoothing > 0.0:
            pose, lowpass = self.smoothed(pose, orientation[:, :, -1], lowpass)
        first = hidden.shape[1] - count
        deviation = nn.functional.softplus(deviation[:, first:]) + self.floor
        rotations = self.decoder.rotations(orientation[:, first:], pose[:, first:])
        return rotations, self.decoder.deviations(deviation), lowpass

    def smoothed(self, pose: Tensor, root: Tensor, lowpass: Tensor) -> tuple[Tensor, Tensor]:
        """Two-pole low-pass over the frames of (B, T, pose outputs) as seen from the root (B, T, 3, 3), made
        level; and its new state.

        It begins at zero and is not corrected for it: the first outputs are too small, but rotations are
        made from the numbers' directions alone.
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
    """Unidirectional network: one step a frame, no look-ahead. Methods and shapes as in `BirnnArchive`."""

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Takes a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.cell1 = LstmCell(network.lstm1, "")
        self.cell2 = LstmCell(network.lstm2, "")

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of a whole sequence."""
        return self.last(orientation, acceleration, orientation.shape[1])

    def last(self, orientation: Tensor, acceleration: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Poses of the last frames of a sequence."""
        x = self.cell1.run(self.cell1.inputs[0](self.ends(orientation, acceleration)), False)
        x = self.cell2.run(self.cell2.inputs[0](x), False)
        rotations, std, _ = self.ends.pose(orientation, x, self.ends.start(x.shape[0]), count)
        return rotations, std

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Chooses how the recurrent layers keep their weights, see `PackedLinear.pack`."""
        self.cell1.pack(precision)
        self.cell2.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Pose of frame `index` of a window; later frames are not used."""
        rotations, std = self.last(orientation[:, : index + 1], acceleration[:, : index + 1], 1)
        return rotations[:, 0], std[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """State before the first frame; `future` must be 0."""
        if future != 0:
            raise ValueError("a unidirectional network has no future frames")
        zero = torch.zeros(batch, self.cell1.size)
        return [zero, zero, zero, zero, self.ends.start(batch)]

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """One frame on."""
        return self.stream_many(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Several frames on."""
        x = self.ends(orientation, acceleration)
        x, h1, c1 = self.cell1.carry(self.cell1.inputs[0](x), state[0], state[1])
        x, h2, c2 = self.cell2.carry(self.cell2.inputs[0](x), state[2], state[3])
        rotations, std, lowpass = self.ends.pose(orientation, x, state[4], x.shape[1])
        return rotations, std, [h1, c1, h2, c2, lowpass]

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Nothing is ever left."""
        batch = state[0].shape[0]
        return torch.zeros(batch, 0, 24, 3, 3), torch.zeros(batch, 0, 24)


class BirnnArchive(nn.Module):
    """Bidirectional network: whole sequence, exact window, or stream with carried forward states.

    Everywhere `orientation` is (B, [T,] 6, 3, 3), calibrated bone orientations R_TB, and `acceleration`
    (B, [T,] 6, 3), m/s^2 in T without gravity; B counts wearers. Poses are (B, [T,] 24, 3, 3) local rotations
    with (B, [T,] 24) standard deviations in radians.

    The second layer's input comes in two parts, what the first layer says forwards and backwards: in a stream
    the first is known for good once its frame has come, the second changes with every new frame.
    """

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Takes a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.forward1, self.backward1 = LstmCell(network.lstm1, ""), LstmCell(network.lstm1, "_reverse")
        self.forward2, self.backward2 = LstmCell(network.lstm2, "", 2), LstmCell(network.lstm2, "_reverse", 2)

    def layer1(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (B, T, hidden) of the first layer over a sequence, forwards and backwards."""
        x = self.ends(orientation, acceleration)
        return (
            self.forward1.run(self.forward1.inputs[0](x), False),
            self.backward1.run(self.backward1.inputs[0](x), True),
        )

    def forward2_products(self, ahead: Tensor, back: Tensor) -> Tensor:
        """What both parts of its input give for the second layer's forward direction."""
        return self.forward2.inputs[0](ahead) + self.forward2.inputs[1](back)

    def backward2_products(self, ahead: Tensor, back: Tensor) -> Tensor:
        """The same for the backward direction."""
        return self.backward2.inputs[0](ahead) + self.backward2.inputs[1](back)

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of a whole sequence."""
        ahead, back = self.layer1(orientation, acceleration)
        frames = orientation.shape[1]
        hidden = self.layer2(ahead, back, 0, frames)
        rotations, std, _ = self.ends.pose(orientation, hidden, self.ends.start(hidden.shape[0]), frames)
        return rotations, std

    def layer2(self, ahead: Tensor, back: Tensor, first: int, end: int) -> Tensor:
        """Outputs (B, end - first, 2 hidden) of the second layer over a sequence, of the frames from `first`
        to before `end`.
        """
        past = self.forward2.run(self.forward2_products(ahead[:, :end], back[:, :end]), False)
        later = self.backward2.run(self.backward2_products(ahead[:, first:], back[:, first:]), True)
        return torch.cat([past[:, first:], later[:, : end - first]], dim=-1)

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Chooses how the recurrent layers keep their weights, see `PackedLinear.pack`."""
        self.forward1.pack(precision)
        self.backward1.pack(precision)
        self.forward2.pack(precision)
        self.backward2.pack(precision)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Pose of frame `index` of a window (DIP 3.4), the same as `forward` over the window gives there.

        The second layer runs only over the frames that reach `index`: with smoothing, all of them do.
        """
        ahead, back = self.layer1(orientation, acceleration)
        first = 0 if self.ends.smoothing > 0.0 else index
        hidden = self.layer2(ahead, back, first, index + 1)
        seen = orientation[:, first : index + 1]
        rotations, std, _ = self.ends.pose(seen, hidden, self.ends.start(hidden.shape[0]), 1)
        return rotations[:, 0], std[:, 0]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """State before the first frame of a stream in which each pose sees `future` later frames.

        The state is [h1, c1, h2, c2, then of the frames that wait for their future: products of layer 1
        backwards, known products of layer 2 forwards, the same backwards, orientations; the low-pass' state;
        last a tensor whose length is `future`].
        """
        size = self.forward1.size
        zero, waiting = torch.zeros(batch, size), torch.zeros(batch, 0, 4 * size)
        orientations = torch.zeros(batch, 0, 6, 3, 3)
        lowpass = self.ends.start(batch)
        return [zero, zero, zero, zero, waiting, waiting, waiting, orientations, lowpass, torch.zeros(future)]

    def oldest(self, state: list[Tensor], count: int, future: int) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Poses of the oldest waiting frames, each seen with `future` that wait behind it, and the state
        without them.

        Forward states are carried; backward passes start anew for each frame at the last one that it sees
        (latency-controlled bidirectional LSTM). Those of several frames run side by side.
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
        """One frame on: the pose of the frame `future` frames ago, (B, 1, 24, 3, 3).

        Or none, (B, 0, 24, 3, 3), while too few frames have come.
        """
        return self.stream_many(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Several frames (B, T, ...) on: all poses that are due, those `stream` gives one by one."""
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
        """Poses of all frames that still wait when a stream ends, oldest first."""
        batch = state[0].shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        while state[4].shape[1] > 0:
            rotation, std, state = self.oldest(state, 1, state[4].shape[1] - 1)
            rotations.append(rotation)
            stds.append(std)
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1)


def _fields(waiting: Tensor, count: int, future: int) -> Tensor:
    """What each of the `count` oldest frames of (B, T, N) sees, (B * count, future + 1, N)."""
    return waiting.narrow(1, 0, count + future).unfold(1, future + 1, 1).transpose(2, 3).flatten(0, 1)
