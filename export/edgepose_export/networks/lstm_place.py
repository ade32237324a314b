"""The head for the place in archives of recurrent networks: contacts, and the velocity of the pelvis."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose.pose import CONTACTS
from edgepose_export.networks.lstm_ends import NormalisationAndDecoding
from edgepose_export.networks.packed_linear import PackedLinear
from edgepose_export.networks.shape import PoseNetwork


class PlaceHead(nn.Module):
    """The linear layer of the head, and what turns its outputs into probabilities."""

    def __init__(self, head: nn.Linear) -> None:
        """Copy the weights of a trained head."""
        super().__init__()
        self.linear = PackedLinear(head.weight, head.bias)
        self.contacts = len(CONTACTS)

    def forward(self, hidden: Tensor) -> Tensor:
        """Return the place (..., 10) of recurrent outputs."""
        numbers = self.linear(hidden)
        probabilities = torch.sigmoid(numbers[..., : self.contacts])
        return torch.cat([probabilities, numbers[..., self.contacts :]], dim=-1)


class PlaceMethods(nn.Module):
    """Methods that archives of networks with a head for the place have in addition.

    Beside each method with poses there is one that also returns the place of the same frames, before the
    state. It is (B, [T,] 10): probabilities of the contacts in the order of `edgepose.pose.CONTACTS`, and the
    velocity of the pelvis in its level frame, m/s. Apart from one linear layer these methods cost the same.
    The archives, which inherit from this class first, provide `whole`, `at`, `advanced` and `drained`.
    """

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__(network, ends)
        self.place = PlaceHead(network.place)

    @torch.jit.export
    def forward_place(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `forward`."""
        rotations, std, hidden = self.whole(orientation, acceleration)
        return rotations, std, self.place(hidden)

    @torch.jit.export
    def window_place(
        self, orientation: Tensor, acceleration: Tensor, index: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `window`."""
        rotations, std, hidden = self.at(orientation, acceleration, index)
        return rotations, std, self.place(hidden)

    @torch.jit.export
    def stream_place(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """See `stream`."""
        return self.stream_many_place(orientation.unsqueeze(1), acceleration.unsqueeze(1), state)

    @torch.jit.export
    def stream_many_place(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """See `stream_many`."""
        rotations, std, hidden, state = self.advanced(orientation, acceleration, state)
        return rotations, std, self.place(hidden), state

    @torch.jit.export
    def drain_place(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """See `drain`."""
        rotations, std, hidden = self.drained(state)
        return rotations, std, self.place(hidden)
