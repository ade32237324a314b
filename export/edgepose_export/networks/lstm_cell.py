"""LSTM cells written out, which for single frames is several times faster than `torch.nn.LSTM`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from edgepose_export.networks.packed_linear import PackedLinear


class LstmCell(nn.Module):
    """One LSTM direction, written out, with separate products of inputs and of states.

    Over a sequence, the inputs of all frames share one product; only the products of states are sequential.
    """

    def __init__(self, lstm: nn.LSTM, suffix: str, parts: int = 1) -> None:
        """Copy the weights of one direction.

        Args:
            lstm: the layer.
            suffix: torch's suffix of the direction: "" forwards, "_reverse" backwards.
            parts: number of equal parts that the input comes in, each with a product of its own.
        """
        super().__init__()
        self.size = lstm.hidden_size
        weight_ih, weight_hh, bias_ih, bias_hh = (
            getattr(lstm, f"{name}_l0{suffix}").detach()
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        )
        # The rows of the candidate, the third of four gates, are doubled, so that one sigmoid serves all
        # four: tanh(x) = 2 sigmoid(2 x) - 1.
        scale = torch.tensor([1.0, 1.0, 2.0, 1.0]).repeat_interleave(self.size)[:, None]
        bias = (bias_ih + bias_hh) * scale[:, 0]
        self.inputs = nn.ModuleList(
            PackedLinear(part, bias if i == 0 else None)
            for i, part in enumerate((weight_ih * scale).chunk(parts, dim=1))
        )
        self.state = PackedLinear(weight_hh * scale)

    def forward(self, product: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Return the new h and c (B, hidden) from the inputs' product (B, 4 hidden) and the old h and c."""
        return self.step(self.state.onto(h, product), c)

    def step(self, gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        """Return the new h and c from the sum of both products (B, 4 hidden)."""
        i, f, g, o = torch.sigmoid(gates).chunk(4, dim=1)
        c = torch.addcmul(f * c - i, i, g, value=2.0)
        return o * torch.tanh(c), c

    @torch.jit.export
    def run(self, products: Tensor, reverse: bool) -> Tensor:
        """Return outputs (B, T, hidden) for the inputs' products (B, T, 4 hidden), from a zero state.

        With `reverse`, the frames are processed from last to first.
        """
        rows = products.unbind(1)
        if reverse:
            rows = rows[::-1]
        # The first state is zero, which saves a product.
        h, c = self.step(rows[0], products.new_zeros(products.shape[0], self.size))
        outputs = [h] + self.over(rows[1:], h, c)[0]
        if reverse:
            outputs = outputs[::-1]
        return torch.stack(outputs, dim=1)

    @torch.jit.export
    def carry(self, products: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return outputs (B, T, hidden) for the inputs' products (B, T, 4 hidden), continuing from a state.

        Also return the last h and c.
        """
        if products.shape[1] == 1:  # live streams; lists would cost a small network a tenth of its time
            h, c = self(products[:, 0], h, c)
            return h.unsqueeze(1), h, c
        outputs, h, c = self.over(products.unbind(1), h, c)
        return torch.stack(outputs, dim=1), h, c

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
        for part in self.inputs:
            part.pack(precision)
        self.state.pack(precision)
