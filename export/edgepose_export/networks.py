"""The networks of DIP 3.4 in two forms: one that trains fast, one that runs as a TorchScript archive.

Both hold the same weights. `PoseNetwork` uses `torch.nn.LSTM`, which is quickest over long batched sequences.
`RnnArchive` and `BirnnArchive` write the cells out, one matrix product over input and state, which is several
times quicker for one frame at a time, and carry everything between calibration and pose: root normalisation,
statistics, network, projection to rotations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.features import ACCELERATIONS, local_rotations, nearest_rotation, rotation_from_6d
from edgepose.placements import BONES, PLACEMENTS, ROOT
from edgepose.skeleton import PARENTS, PREDICTED, UNOBSERVED
from edgepose_export.normalisation import Inputs

SIGMA_FLOOR = 0.02
"""Smallest standard deviation a network may claim, in normalised units.

Without it, joints that never move take all gradient.
"""


class NetworkShape(NamedTuple):
    """What decides the weights' shapes and the meaning of the outputs.

    Attributes:
        kind: "birnn" or "rnn" (DIP 3.4), "feed-forward" or "wavenet" (DIP appendix A).
        hidden: units of the dense layer and of each LSTM direction, or of the widest layer; 512 in the paper.
        targets: "local-matrix" (the paper: 9 numbers of each local rotation) or "global-6d" (6 numbers of
            each rotation in the root's frame).
        measured: "predicted" (the paper: all 15 joints come from the network) or "passed" (bones that carry a
            sensor take its orientation; the network predicts the other 10). "passed" needs "global-6d".
        normalisation: of the inputs, one of `normalisation.SCHEMES`.
        acceleration: whether accelerations are inputs (without: DIP appendix D).
    """

    kind: str = "birnn"
    hidden: int = 512
    targets: str = "local-matrix"
    measured: str = "predicted"
    normalisation: str = "root"
    acceleration: bool = True

    @property
    def inputs(self) -> int:
        """Numbers of the input: 60 in the paper."""
        sensors = len(PLACEMENTS) - (self.normalisation in ("root", "tilt"))
        own = 3 + 3 * self.acceleration if self.normalisation == "tilt" else 0
        return sensors * (9 + 3 * self.acceleration) + own

    @property
    def joints(self) -> tuple[int, ...]:
        """SMPL joints that the network predicts."""
        return UNOBSERVED if self.measured == "passed" else PREDICTED

    @property
    def numbers(self) -> int:
        """Numbers a joint."""
        return 9 if self.targets == "local-matrix" else 6

    @property
    def pose_outputs(self) -> int:
        """Numbers of the pose part of the output."""
        return len(self.joints) * self.numbers


class PoseNetwork(nn.Module):
    """Dense layer with ReLU, two LSTM layers, heads for means and standard deviations (DIP figure 12)."""

    def __init__(self, shape: NetworkShape) -> None:
        """Random weights for a shape."""
        super().__init__()
        self.shape = shape
        both = shape.kind == "birnn"
        width = shape.hidden * (2 if both else 1)
        outputs = shape.pose_outputs + ACCELERATIONS
        self.dense = nn.Linear(shape.inputs, shape.hidden)
        self.lstm1 = nn.LSTM(shape.hidden, shape.hidden, batch_first=True, bidirectional=both)
        self.lstm2 = nn.LSTM(width, shape.hidden, batch_first=True, bidirectional=both)
        self.mean = nn.Linear(width, outputs)
        self.deviation = nn.Linear(width, outputs)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised means and standard deviations (B, T, outputs) of z-scored inputs (B, T, inputs)."""
        x = torch.relu(self.dense(x))
        x, _ = self.lstm1(x)
        x, _ = self.lstm2(x)
        return self.mean(x), nn.functional.softplus(self.deviation(x)) + SIGMA_FLOOR


class PoseDecoder(nn.Module):
    """Network outputs to SMPL's 24 local rotations; differentiable, scriptable."""

    def __init__(self, shape: NetworkShape, target_mean: Tensor, target_std: Tensor) -> None:
        """Decoder of a network's outputs, whose pose part was normalised by these statistics."""
        super().__init__()
        self.local = shape.targets == "local-matrix"
        self.passed = shape.measured == "passed"
        self.joints = len(shape.joints)
        self.numbers = shape.numbers
        self.register_buffer("target_mean", target_mean)
        self.register_buffer("target_std", target_std)
        self.register_buffer("source", torch.tensor(_sources(shape)))
        self.register_buffer("parents", torch.tensor(PARENTS[1:]))
        self.register_buffer("std_source", torch.tensor(_std_sources(shape)))
        self.register_buffer("std_scale", torch.ones(len(PARENTS)))
        # A small rotation by d moves a matrix's entries by sqrt(2) d, those of its first two columns by
        # sqrt(4/3) d on average.
        self.spread = 2.0 if self.local else 4.0 / 3.0

    def forward(self, orientation: Tensor, mean: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of frames.

        Args:
            orientation: (..., 6, 3, 3) calibrated bone orientations R_TB.
            mean: (..., pose outputs + 15) means in normalised units.
            deviation: the same shape, standard deviations.

        Returns:
            (..., 24, 3, 3) local rotations, joint 0 the pelvis sensor's orientation; (..., 24) standard
            deviations, radians.
        """
        size = self.joints * self.numbers
        y = mean[..., :size] * self.target_std + self.target_mean
        sigma = (deviation[..., :size] * self.target_std).unflatten(-1, (self.joints, self.numbers))
        std = torch.sqrt(sigma.square().sum(-1) / self.spread)
        std = torch.cat([torch.zeros_like(std[..., :1]), std], dim=-1).index_select(-1, self.std_source)
        std = std * self.std_scale
        y = y.unflatten(-1, (self.joints, self.numbers))
        root = orientation[..., -1, :, :]
        identity = torch.eye(3, dtype=y.dtype).expand_as(root).unsqueeze(-3)
        if self.local:
            rotations = nearest_rotation(y.unflatten(-1, (3, 3)))
            local = torch.cat([identity, rotations], dim=-3).index_select(-3, self.source)
            return torch.cat([root.unsqueeze(-3), local[..., 1:, :, :]], dim=-3), std
        known = [identity, rotation_from_6d(y)]
        if self.passed:
            known.append(torch.matmul(root.unsqueeze(-3).transpose(-1, -2), orientation[..., :-1, :, :]))
        relative = torch.cat(known, dim=-3).index_select(-3, self.source)
        return local_rotations(relative, root, self.parents), std


def _sources(shape: NetworkShape) -> list[int]:
    """For each of the 24 joints the row of [identity, predicted..., measured...] that holds its rotation."""
    rows = {joint: 1 + i for i, joint in enumerate(shape.joints)}
    if shape.measured == "passed":
        rows |= {bone: 1 + len(shape.joints) + i for i, bone in enumerate(BONES[:ROOT])}
    result = [0]
    for joint in range(1, 24):
        # Feet, toes, wrists and hands rest: locally the identity, globally their parent's rotation.
        rest = 0 if shape.targets == "local-matrix" else result[PARENTS[joint]]
        result.append(rows.get(joint, rest))
    return result


def _std_sources(shape: NetworkShape) -> list[int]:
    rows = {joint: 1 + i for i, joint in enumerate(shape.joints)}
    return [rows.get(joint, 0) for joint in range(24)]


class LstmCell(nn.Module):
    """One LSTM direction, written out: the products of inputs and of states apart.

    Over a sequence the products of all inputs are one; only those of the states have to wait for each other.
    """

    def __init__(self, lstm: nn.LSTM, suffix: str) -> None:
        """Copies one direction's weights; `suffix` is torch's: "" forwards, "_reverse" backwards."""
        super().__init__()
        self.size = lstm.hidden_size
        weight_ih, weight_hh, bias_ih, bias_hh = (
            getattr(lstm, f"{name}_l0{suffix}").detach()
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        )
        # Gates in the order input, forget, output, candidate, so that the three sigmoids are one.
        order = torch.arange(4 * self.size).view(4, -1)[[0, 1, 3, 2]].flatten()
        self.input = nn.Linear(weight_ih.shape[1], 4 * self.size)
        self.state = nn.Linear(self.size, 4 * self.size, bias=False)
        self.input.weight, self.input.bias = (
            nn.Parameter(weight_ih[order]),
            nn.Parameter((bias_ih + bias_hh)[order]),
        )
        self.state.weight = nn.Parameter(weight_hh[order])

    def forward(self, x: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """New h and c (B, hidden) from input x (B, inputs) and the old ones."""
        return self.step(self.input(x) + self.state(h), c)

    def step(self, gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """New h and c from the sum of both products (B, 4 hidden)."""
        i, f, o = torch.sigmoid(gates[:, : 3 * self.size]).chunk(3, dim=1)
        c = torch.addcmul(f * c, i, torch.tanh(gates[:, 3 * self.size :]))
        return o * torch.tanh(c), c

    @torch.jit.export
    def run(self, x: Tensor, reverse: bool) -> Tensor:
        """Outputs (B, T, hidden) over x (B, T, inputs) from a zero state, in order or from last to first."""
        products = self.input(x).unbind(1)
        if reverse:
            products = products[::-1]
        h, c = self.step(products[0], x.new_zeros(x.shape[0], self.size))
        outputs = [h]
        for product in products[1:]:
            h, c = self.step(product + self.state(h), c)
            outputs.append(h)
        if reverse:
            outputs = outputs[::-1]
        return torch.stack(outputs, dim=1)


class Ends(nn.Module):
    """What both archives share: inputs before the recurrent layers, poses after them."""

    def __init__(
        self, network: PoseNetwork, input_mean: Tensor, input_std: Tensor, decoder: PoseDecoder
    ) -> None:
        """Takes the network's dense layers and the statistics of its inputs, 60 in the paper."""
        super().__init__()
        shape = network.shape
        self.inputs = Inputs(shape.normalisation, shape.acceleration, input_mean, input_std)
        self.dense, self.mean, self.deviation = network.dense, network.mean, network.deviation
        self.decoder = decoder
        self.floor = SIGMA_FLOOR

    def forward(self, orientation: Tensor, acceleration: Tensor) -> Tensor:
        """First hidden layer (..., hidden) of calibrated frames."""
        return torch.relu(self.dense(self.inputs(orientation, acceleration)))

    @torch.jit.export
    def pose(self, orientation: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Local rotations (..., 24, 3, 3) and deviations (..., 24) from the last recurrent outputs."""
        deviation = nn.functional.softplus(self.deviation(hidden)) + self.floor
        return self.decoder(orientation, self.mean(hidden), deviation)


class RnnArchive(nn.Module):
    """Unidirectional network: one step a frame, no look-ahead. Methods and shapes as in `BirnnArchive`."""

    def __init__(self, network: PoseNetwork, ends: Ends) -> None:
        """Takes a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.cell1 = LstmCell(network.lstm1, "")
        self.cell2 = LstmCell(network.lstm2, "")

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of a whole sequence."""
        x = self.cell1.run(self.ends(orientation, acceleration), False)
        return self.ends.pose(orientation, self.cell2.run(x, False))

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Pose of frame `index` of a window; later frames are not used."""
        rotations, std = self.forward(orientation[:, : index + 1], acceleration[:, : index + 1])
        return rotations[:, -1], std[:, -1]

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """State before the first frame; `future` must be 0."""
        if future != 0:
            raise ValueError("a unidirectional network has no future frames")
        zero = torch.zeros(batch, self.cell1.size)
        return [zero, zero, zero, zero]

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """One frame on."""
        h1, c1 = self.cell1(self.ends(orientation, acceleration), state[0], state[1])
        h2, c2 = self.cell2(h1, state[2], state[3])
        rotations, std = self.ends.pose(orientation, h2)
        return rotations.unsqueeze(1), std.unsqueeze(1), [h1, c1, h2, c2]

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
    """

    def __init__(self, network: PoseNetwork, ends: Ends) -> None:
        """Takes a trained network's weights."""
        super().__init__()
        self.ends = ends
        self.forward1, self.backward1 = LstmCell(network.lstm1, ""), LstmCell(network.lstm1, "_reverse")
        self.forward2, self.backward2 = LstmCell(network.lstm2, ""), LstmCell(network.lstm2, "_reverse")

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of a whole sequence."""
        x = self.ends(orientation, acceleration)
        x = torch.cat([self.forward1.run(x, False), self.backward1.run(x, True)], dim=-1)
        x = torch.cat([self.forward2.run(x, False), self.backward2.run(x, True)], dim=-1)
        return self.ends.pose(orientation, x)

    @torch.jit.export
    def window(self, orientation: Tensor, acceleration: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Pose of frame `index` of a window (DIP 3.4), the same as `forward` over the window gives there.

        The second layer runs only over the frames that reach `index`.
        """
        x = self.ends(orientation, acceleration)
        x = torch.cat([self.forward1.run(x, False), self.backward1.run(x, True)], dim=-1)
        before = self.forward2.run(x[:, : index + 1], False)[:, -1]
        after = self.backward2.run(x[:, index:], True)[:, 0]
        return self.ends.pose(orientation[:, index], torch.cat([before, after], dim=-1))

    @torch.jit.export
    def start(self, batch: int, future: int) -> list[Tensor]:
        """State before the first frame of a stream in which each pose sees `future` later frames.

        The state is [h1, c1, h2, c2, waiting inputs, waiting layer-1 outputs, waiting orientations, a tensor
        whose length is `future`]; frames wait until their future has come.
        """
        size = self.forward1.size
        zero = torch.zeros(batch, size)
        waiting = torch.zeros(batch, 0, size)
        return [zero, zero, zero, zero, waiting, waiting, torch.zeros(batch, 0, 6, 3, 3), torch.zeros(future)]

    @torch.jit.export
    def oldest(self, state: list[Tensor]) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Pose of the oldest waiting frame, seen with all that wait behind it, and the state without it.

        Forward states are carried; backward passes start anew at the newest frame (latency-controlled
        bidirectional LSTM).
        """
        x = torch.cat([state[5], self.backward1.run(state[4], True)], dim=-1)
        h2, c2 = self.forward2(x[:, 0], state[2], state[3])
        after = self.backward2.run(x, True)[:, 0]
        rotations, std = self.ends.pose(state[6][:, 0], torch.cat([h2, after], dim=-1))
        rest = [state[0], state[1], h2, c2, state[4][:, 1:], state[5][:, 1:], state[6][:, 1:], state[7]]
        return rotations, std, rest

    @torch.jit.export
    def stream(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """One frame on: the pose of the frame `future` frames ago, (B, 1, 24, 3, 3).

        Or none, (B, 0, 24, 3, 3), while too few frames have come.
        """
        x = self.ends(orientation, acceleration)
        h1, c1 = self.forward1(x, state[0], state[1])
        state = [
            h1,
            c1,
            state[2],
            state[3],
            torch.cat([state[4], x.unsqueeze(1)], dim=1),
            torch.cat([state[5], h1.unsqueeze(1)], dim=1),
            torch.cat([state[6], orientation.unsqueeze(1)], dim=1),
            state[7],
        ]
        if state[4].shape[1] <= state[7].shape[0]:
            batch = x.shape[0]
            return x.new_zeros(batch, 0, 24, 3, 3), x.new_zeros(batch, 0, 24), state
        rotations, std, state = self.oldest(state)
        return rotations.unsqueeze(1), std.unsqueeze(1), state

    @torch.jit.export
    def drain(self, state: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Poses of all frames that still wait when a stream ends, oldest first."""
        batch = state[0].shape[0]
        rotations: list[Tensor] = [torch.zeros(batch, 0, 24, 3, 3)]
        stds: list[Tensor] = [torch.zeros(batch, 0, 24)]
        while state[4].shape[1] > 0:
            rotation, std, state = self.oldest(state)
            rotations.append(rotation.unsqueeze(1))
            stds.append(std.unsqueeze(1))
        return torch.cat(rotations, dim=1), torch.cat(stds, dim=1)
