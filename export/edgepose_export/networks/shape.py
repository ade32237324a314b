"""The networks of DIP 3.4 in the form in which they are trained, with `torch.nn.LSTM`, and their decoder.

`edgepose_export.networks.lstm` has the form in which the same weights run.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.inference.features import ACCELERATIONS, local_rotations, nearest_rotation, rotation_from_6d
from edgepose.placements import BONES, PLACEMENTS, ROOT
from edgepose.skeleton import PARENTS, PREDICTED, UNOBSERVED
from edgepose_export.networks.kind import Network
from edgepose_export.networks.normalisation import tilt_of
from edgepose_export.synthesis.contacts import PLACE

SIGMA_FLOOR = 0.02
"""Smallest standard deviation a network can predict, in normalised units.

Without it, joints that never move would dominate the gradient.
"""


class NetworkShape(NamedTuple):
    """Choices that decide the shapes of the weights and the meaning and processing of the outputs.

    Attributes:
        kind: a name in `registry.NETWORKS`.
        hidden: units of the dense layer and of each LSTM direction, or of the widest layer; 512 in the paper.
        targets: "local-matrix" (the paper: 9 numbers of each local rotation) or "global-6d" (6 numbers of
            each rotation in the root's frame).
        measured: "predicted" (the paper: all 15 joints come from the network) or "passed" (bones that carry a
            sensor take its orientation; the network predicts the other 10). "passed" needs "global-6d".
        normalisation: normalisation of the inputs, one of `normalisation.SCHEMES`.
        acceleration: whether accelerations are inputs (without: DIP appendix D).
        smoothing: of a recurrent network, both poles of a low-pass over its rotations, 0 (none) to 0.99: each
            of two stages keeps this share of its last output. It is active in training, too, so that the
            network learns to compensate for its delay. It works in a level pelvis frame
            (`normalisation.tilt_of`). In the frame of the pelvis itself, a bone at rest moves whenever the
            pelvis shakes, and smoothing would not undo that. In the room's frame, the body would lag behind
            in every turn, which the inputs do not show. Needs "global-6d".
        place: whether a recurrent network has a head for the place: contacts and velocity, see
            `synthesis.contacts`.
    """

    kind: str = "birnn"
    hidden: int = 512
    targets: str = "local-matrix"
    measured: str = "predicted"
    normalisation: str = "root"
    acceleration: bool = True
    smoothing: float = 0.0
    place: bool = False

    @property
    def inputs(self) -> int:
        """Number of inputs: 60 in the paper."""
        sensors = len(PLACEMENTS) - (self.normalisation in ("root", "tilt"))
        of_root = 3 + 3 * self.acceleration if self.normalisation == "tilt" else 0
        return sensors * (9 + 3 * self.acceleration) + of_root

    @property
    def joints(self) -> tuple[int, ...]:
        """SMPL joints that the network predicts."""
        return UNOBSERVED if self.measured == "passed" else PREDICTED

    @property
    def numbers(self) -> int:
        """Numbers per joint."""
        return 9 if self.targets == "local-matrix" else 6

    @property
    def pose_outputs(self) -> int:
        """Number of outputs that encode the pose."""
        return len(self.joints) * self.numbers


class PoseNetwork(Network):
    """Dense layer with ReLU, two LSTM layers, heads for means and standard deviations (DIP figure 12)."""

    def __init__(self, shape: NetworkShape) -> None:
        """Create the layers with random weights."""
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
        if shape.place:
            self.place = nn.Linear(width, PLACE)

    def forward(self, x: Tensor, future: int = 0) -> tuple[Tensor, ...]:
        """Return normalised means and standard deviations for z-scored inputs.

        Args:
            x: (B, T, inputs).
            future: run a bidirectional network as a stream, in which each pose uses `future` later frames; 0
                for whole sequences.

        Returns:
            Both (B, T, outputs), and with a head for the place its outputs (B, T, 10), logits and m/s. In a
            stream T - future frames, those whose future is known.
        """
        x = torch.relu(self.dense(x))
        if future == 0:
            x, _ = self.lstm1(x)
            x, _ = self.lstm2(x)
        else:
            x = self._streamed(x, future)
        pose = self.mean(x), nn.functional.softplus(self.deviation(x)) + SIGMA_FLOOR
        return (*pose, self.place(x)) if self.shape.place else pose

    def _streamed(self, x: Tensor, future: int) -> Tensor:
        """Return the outputs (B, T - future, 2 hidden) of the recurrent layers in a stream.

        As in `lstm.BirnnArchive.stream`, forward states carry over, and backward passes run over a frame and
        its future only.
        """
        forward1 = _direction(self.lstm1, x, "")
        backward1 = _direction(self.lstm1, _ahead(x, future), "_reverse")
        ahead = torch.cat([_ahead(forward1, future), backward1], dim=-1)
        frames = (len(x), -1)
        forward2 = _direction(self.lstm2, ahead[:, 0].unflatten(0, frames), "")
        backward2 = _direction(self.lstm2, ahead, "_reverse")[:, 0].unflatten(0, frames)
        return torch.cat([forward2, backward2], dim=-1)


def smoothed(pose: Tensor, root: Tensor, smoothing: float) -> Tensor:
    """Apply the low-pass to "global-6d" numbers (B, T, 6 N) in the level frame of the pelvis.

    The results are weighted means of each frame and all frames before it. Apart from their scale they equal
    those of `lstm.NormalisationAndDecoding.smoothed`, which works frame by frame.

    Args:
        pose: numbers in the units of the targets.
        root: (B, T, 3, 3) orientation of the pelvis sensor's bone.
        smoothing: see `NetworkShape`.
    """
    frame = torch.arange(pose.shape[1], device=pose.device, dtype=pose.dtype)
    age = (frame[:, None] - frame).clamp_min(0.0)
    weights = ((age + 1.0) * smoothing**age).tril()  # impulse response of two equal poles
    weights = weights * (weights > 1e-20)  # smaller weights would still slow the product down
    weights = weights / weights.sum(dim=1, keepdim=True)
    tilt = tilt_of(root)
    return turned(weights @ turned(pose, tilt), tilt.transpose(-1, -2))


def turned(pose: Tensor, rotation: Tensor) -> Tensor:
    """Rotate N vectors (..., 3 N) by rotations (..., 3, 3)."""
    return torch.matmul(pose.unflatten(-1, (-1, 3)), rotation.transpose(-1, -2)).flatten(-2)


def _ahead(x: Tensor, future: int) -> Tensor:
    """Return each frame of (B, T, units) with its future: (B (T - future), 1 + future, units)."""
    return x.unfold(1, future + 1, 1).transpose(-1, -2).flatten(0, 1)


def _direction(lstm: nn.LSTM, x: Tensor, suffix: str) -> Tensor:
    """Return the outputs (B, T, hidden) of one direction of a layer: "" forwards, "_reverse" backwards."""
    names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    weights = [getattr(lstm, name + suffix) for name in names]
    zero = x.new_zeros(1, len(x), lstm.hidden_size)
    order = x.flip(1) if suffix else x
    result = torch.lstm(order, (zero, zero), weights, True, 1, 0.0, lstm.training, False, True)[0]
    return result.flip(1) if suffix else result


class PoseDecoder(nn.Module):
    """Decoder from network outputs to SMPL's 24 local rotations; differentiable, scriptable."""

    def __init__(
        self,
        shape: NetworkShape,
        target_mean: Tensor,
        target_std: Tensor,
        std_scale: Tensor | None = None,
    ) -> None:
        """Store the statistics by which the targets were normalised.

        Args:
            shape: shape of the network.
            target_mean: (pose outputs,) means of the targets.
            target_std: (pose outputs,) standard deviations of the targets.
            std_scale: (24,) factors of the joints' standard deviations; all 1 if None.
        """
        super().__init__()
        self.local = shape.targets == "local-matrix"
        self.passed = shape.measured == "passed"
        self.joints = len(shape.joints)
        self.numbers = shape.numbers
        self.register_buffer("target_mean", target_mean)
        self.register_buffer("target_std", target_std)
        self.register_buffer("source", torch.tensor(_sources(shape)))
        self.register_buffer("parents", torch.tensor(PARENTS[1:]))
        scale = torch.ones(len(PARENTS)) if std_scale is None else std_scale
        self.register_buffer("variances", _variances(shape, target_std, scale))

    def forward(self, orientation: Tensor, mean: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses of frames.

        Args:
            orientation: (..., 6, 3, 3) calibrated bone orientations R_TB.
            mean: (..., pose outputs + 15) means in normalised units.
            deviation: standard deviations of the same shape.

        Returns:
            (..., 24, 3, 3) local rotations, of which joint 0 is the pelvis sensor's orientation; (..., 24)
            standard deviations, radians.
        """
        size = self.joints * self.numbers
        pose = mean[..., :size] * self.target_std + self.target_mean
        return self.rotations(orientation, pose), self.deviations(deviation[..., :size])

    @torch.jit.export
    def deviations(self, deviation: Tensor) -> Tensor:
        """Convert standard deviations (..., pose outputs) in normalised units to (..., 24) radians."""
        return torch.sqrt(torch.matmul(deviation.square(), self.variances))

    @torch.jit.export
    def rotations(self, orientation: Tensor, pose: Tensor) -> Tensor:
        """Return local rotations (..., 24, 3, 3) of the pose (..., pose outputs), in the targets' units."""
        y = pose.unflatten(-1, (self.joints, self.numbers))
        root = orientation[..., -1, :, :]
        identity = torch.eye(3, dtype=y.dtype).expand_as(root).unsqueeze(-3)
        if self.local:
            rotations = nearest_rotation(y.unflatten(-1, (3, 3)))
            local = torch.cat([identity, rotations], dim=-3).index_select(-3, self.source)
            return torch.cat([root.unsqueeze(-3), local[..., 1:, :, :]], dim=-3)
        known = [identity, rotation_from_6d(y)]
        if self.passed:
            known.append(torch.matmul(root.unsqueeze(-3).transpose(-1, -2), orientation[..., :-1, :, :]))
        relative = torch.cat(known, dim=-3).index_select(-3, self.source)
        return local_rotations(relative, root, self.parents)


def _sources(shape: NetworkShape) -> list[int]:
    """Return for each of the 24 joints the row of [identity, predicted..., measured...] with its rotation."""
    rows = {joint: 1 + i for i, joint in enumerate(shape.joints)}
    if shape.measured == "passed":
        rows |= {bone: 1 + len(shape.joints) + i for i, bone in enumerate(BONES[:ROOT])}
    result = [0]
    for joint in range(1, 24):
        # Feet, toes, wrists and hands stay at rest: locally the identity, globally their parent's rotation.
        rest = 0 if shape.targets == "local-matrix" else result[PARENTS[joint]]
        result.append(rows.get(joint, rest))
    return result


def _variances(shape: NetworkShape, target_std: Tensor, std_scale: Tensor) -> Tensor:
    """Return factors (pose outputs, 24) from each output's normalised variance to each joint's in rad^2."""
    # A small rotation by d changes a matrix by sqrt(2) d (Frobenius norm), its first two columns by
    # sqrt(4/3) d on average.
    spread = 2.0 if shape.targets == "local-matrix" else 4.0 / 3.0
    joint = torch.tensor(shape.joints).repeat_interleave(shape.numbers)
    result = torch.zeros(len(joint), len(PARENTS))
    result[torch.arange(len(joint)), joint] = ((target_std * std_scale[joint]).square() / spread).float()
    return result
