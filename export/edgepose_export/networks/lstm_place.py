"""Methods of archives of recurrent networks for the place: contacts, and the velocity of the pelvis."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose.pose import CONTACTS
from edgepose_export.networks.lstm_ends import NormalisationAndDecoding
from edgepose_export.networks.shape import PoseNetwork


class PlaceMethods(nn.Module):
    """Methods that archives of networks with a head for the place have in addition.

    Beside each method with poses there is one that also returns the place of the same frames, before the
    state. It is (B, [T,] 10): probabilities of the contacts in the order of `edgepose.pose.CONTACTS`, and the
    velocity of the pelvis in its level frame, m/s. The product that makes the pose makes the place too, so
    these methods cost hardly more. The archives, which inherit from this class first, provide `whole`, `at`,
    `advanced` and `drained`; the places that these return have logits instead of probabilities.
    """

    def __init__(self, network: PoseNetwork, ends: NormalisationAndDecoding) -> None:
        """Copy a trained network's weights."""
        super().__init__(network, ends)
        self.contacts = len(CONTACTS)

    def place(self, logits: Tensor) -> Tensor:
        """Turn the logits of a place (..., 10) into probabilities, in the tensor itself."""
        logits.narrow(-1, 0, self.contacts).sigmoid_()
        return logits

    @torch.jit.export
    def forward_place(self, orientation: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `forward`."""
        rotations, std, place = self.whole(orientation, acceleration)
        return rotations, std, self.place(place)

    @torch.jit.export
    def window_place(
        self, orientation: Tensor, acceleration: Tensor, index: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `window`."""
        rotations, std, place = self.at(orientation, acceleration, index)
        return rotations, std, self.place(place)

    @torch.jit.export
    def stream_place(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """See `stream`."""
        rotations, std, place, state = self.advanced(orientation, acceleration, 1, state)
        return rotations, std, self.place(place), state

    @torch.jit.export
    def stream_many_place(
        self, orientation: Tensor, acceleration: Tensor, state: list[Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """See `stream_many`."""
        frames = orientation.shape[1]
        rotations, std, place, state = self.advanced(
            orientation.flatten(0, 1), acceleration.flatten(0, 1), frames, state
        )
        return rotations, std, self.place(place), state

    @torch.jit.export
    def drain_place(self, state: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """See `drain`."""
        rotations, std, place = self.drained(state)
        return rotations, std, self.place(place)
