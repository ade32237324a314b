"""LSTM cells written out, which for single frames is several times faster than `torch.nn.LSTM`.

The products of inputs and of states are separate: over a sequence, the inputs of all frames share one
product, as do both directions of a layer; only the products of states are sequential.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose_export.networks.packed_linear import PackedLinear

FORWARD, BACKWARD = "", "_reverse"
"""torch's suffixes of a layer's directions."""


def input_products(
    lstm: nn.LSTM, directions: list[str], part: slice = slice(None), bias: bool = True
) -> PackedLinear:
    """Return the product of a layer's inputs for some directions, side by side, 4 hidden numbers each.

    Args:
        lstm: the layer.
        directions: `FORWARD`, `BACKWARD` or both.
        part: part of the inputs that the product is for.
        bias: whether this product adds the biases.
    """
    weights = [_scaled(lstm, "weight_ih", direction)[:, part] for direction in directions]
    biases = [_scaled(lstm, "bias_ih", name) + _scaled(lstm, "bias_hh", name) for name in directions]
    return PackedLinear(torch.cat(weights), torch.cat(biases) if bias else None)


def _scaled(lstm: nn.LSTM, name: str, direction: str) -> Tensor:
    """Return weights or biases of a direction with the rows of the candidate, the third gate, doubled.

    So one sigmoid serves all four gates: tanh(x) = 2 sigmoid(2 x) - 1.
    """
    rows = getattr(lstm, f"{name}_l0{direction}").detach().clone()
    rows[2 * lstm.hidden_size : 3 * lstm.hidden_size] *= 2.0
    return rows


class LstmCell(nn.Module):
    """The recurrent part of one LSTM direction, written out."""

    def __init__(self, lstm: nn.LSTM, direction: str) -> None:
        """Copy the weights of a direction, `FORWARD` or `BACKWARD`."""
        super().__init__()
        self.size = lstm.hidden_size
        self.gates = [self.size] * 4
        self.state = PackedLinear(_scaled(lstm, "weight_hh", direction))

    def forward(self, product: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Return the new h and c (B, hidden) from the inputs' product (B, 4 hidden) and the old h and c."""
        i, f, g, o = self.state.onto(h, product).sigmoid_().split_with_sizes(self.gates, 1)
        c = torch.mul(f, c).sub_(i).addcmul_(i, g, value=2.0)
        return torch.tanh(c).mul_(o), c

    def first(self, product: Tensor) -> tuple[Tensor, Tensor]:
        """Return h and c after a first step, from a zero state, which saves a product."""
        i, _, g, o = product.sigmoid().split_with_sizes(self.gates, 1)
        c = torch.neg(i).addcmul_(i, g, value=2.0)
        return torch.tanh(c).mul_(o), c

    @torch.jit.export
    def run(self, products: list[Tensor]) -> list[Tensor]:
        """Return outputs (B, hidden) for the inputs' products (B, 4 hidden) of frames, from a zero state."""
        h, c = self.first(products[0])
        return [h] + self.over(products[1:], h, c)[0]

    @torch.jit.export
    def carry(self, products: Tensor, h: Tensor, c: Tensor, frames: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return outputs (B frames, hidden) for the inputs' products (B frames, 4 hidden), from a state.

        Also return the last h and c.
        """
        if frames == 1:  # live streams; lists would cost a small network a tenth of its time
            h, c = self(products, h, c)
            return h, h, c
        outputs, h, c = self.over(products.unflatten(0, (-1, frames)).unbind(1), h, c)
        return torch.stack(outputs, dim=1).flatten(0, 1), h, c

    def over(self, rows: list[Tensor], h: Tensor, c: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Return the outputs after each of some products, and the last h and c."""
        outputs: list[Tensor] = []
        for row in rows:
            h, c = self(row, h, c)
            outputs.append(h)
        return outputs, h, c

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """See `PackedLinear.pack`."""
        self.state.pack(precision)
