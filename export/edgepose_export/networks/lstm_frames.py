"""Calibrated frames as the first layer of a recurrent archive sees them: one product for all sensors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose.inference.rotation_rows import SEEN, SEEN_ROOT
from edgepose.placements import PLACEMENTS, ROOT
from edgepose_export.networks.normalisation import heading_of


class SeenFromRoot(nn.Module):
    """Frames (N, 9, 3, 3) in the root's frame, see `rotation_rows.SEEN`, from (N, 6, 3, 3) and (N, 6, 3)."""

    def __init__(self, scheme: str) -> None:
        """Store the normalisation, one of `normalisation.SCHEMES`."""
        super().__init__()
        self.scheme, self.root = scheme, ROOT
        # Scripted code would make constants again in each frame.
        self.register_buffer("identity", torch.eye(3).view(1, 1, 3, 3))
        # Sums of the entries of a rotation that are sine and cosine of its turn about Y, times a number.
        # The tiny sum stands for no turn where that number is zero, when the root is upside down.
        turn = torch.zeros(3, 3, 2)
        turn[0, 2, 0], turn[2, 0, 0], turn[0, 0, 1], turn[2, 2, 1] = 1.0, -1.0, 1.0, 1.0
        self.register_buffer("turn", turn.view(9, 2))
        self.register_buffer("no_turn", torch.tensor([0.0, 1e-12]))
        # The rotation that takes a turn back, from its sine and cosine.
        back = torch.zeros(2, 3, 3)
        back[0, 0, 2], back[0, 2, 0], back[1, 0, 0], back[1, 2, 2] = -1.0, 1.0, 1.0, 1.0
        vertical = torch.zeros(3, 3)
        vertical[1, 1] = 1.0
        self.register_buffer("back", back.view(2, 9))
        self.register_buffer("vertical", vertical.view(9))

    def forward(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
        """Return the frames in the root's frame, and the numbers (N, 81) that are the network's inputs."""
        count = orientation.shape[0]
        root = orientation.select(1, self.root)
        vectors = torch.cat(
            [
                orientation.transpose(2, 3).contiguous(),
                acceleration.reshape(count, 2, 3, 3),
                self.identity.expand(count, 1, 3, 3),
            ],
            dim=1,
        )
        seen = torch.bmm(vectors.view(count, 27, 3), root)
        inputs = seen
        if self.scheme == "heading":
            inputs = torch.bmm(vectors.view(count, 27, 3), heading_of(root))
        elif self.scheme == "sequence":
            inputs = vectors
        return seen.view(count, 9, 3, 3), inputs.view(count, 81)

    def level(self, root: Tensor) -> Tensor:
        """Return roots (N, 3, 3) without their turn about Y, see `normalisation.tilt_of`."""
        turn = torch.mm(root.reshape(-1, 9), self.turn).add_(self.no_turn)
        turn = turn.div_(torch.linalg.vector_norm(turn, dim=1, keepdim=True))
        return torch.bmm(torch.mm(turn, self.back).add_(self.vertical).view(-1, 3, 3), root)


def input_weights(weight: Tensor, scheme: str, with_acceleration: bool) -> Tensor:
    """Return weights (units, 81) for the numbers of `SeenFromRoot` from those (units, inputs) of a network.

    The inputs of `normalisation.network_inputs` are entries of these numbers and differences between them.
    """
    rows = torch.eye(3 * 3 * SEEN).view(-1, 3 * SEEN, 3)
    bones = rows[:, : 3 * len(PLACEMENTS)].unflatten(1, (-1, 3)).transpose(2, 3)
    acceleration = rows[:, 18:24]
    differences = acceleration - acceleration[:, ROOT:]
    if scheme in ("root", "tilt"):
        numbers = [bones[:, :ROOT].flatten(1)]
        differences = differences[:, :ROOT]
    else:
        numbers = [bones.flatten(1)]
        differences = differences.roll(1, 1)
    if scheme == "tilt":
        numbers.append(rows[:, 3 * SEEN_ROOT + 1])  # T's vertical, Y
        if with_acceleration:
            numbers.append(acceleration[:, ROOT])
    if with_acceleration:
        numbers.append(differences.flatten(1))
    return weight @ torch.cat(numbers, dim=1).T
