"""Matrix products of an archive, with weights in f32 as they are stored, or packed as fp16 or int8.

For single frames a product takes as long as reading its weights from memory, so half the bytes take about
half the time.
"""

# No `from __future__ import annotations`: TorchScript needs the type of an attribute, not its text.
from typing import Optional

import torch
from torch import Tensor, nn


class PackedLinear(nn.Module):
    """`x W + b`, scriptable; `pack` chooses the precision of W."""

    packed: Optional[torch.classes.quantized.LinearPackedParamsBase]  # noqa: UP045

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        """Copy a weight (outputs, inputs) in torch's layout and a bias (outputs,); None for `onto` only."""
        super().__init__()
        # With this layout a handful of frames takes two thirds of the time.
        self.register_buffer("weight", weight.detach().t().contiguous())
        self.register_buffer("bias", torch.zeros(0) if bias is None else bias.detach().clone())
        self.precision = "f32"
        self.packed = None

    def forward(self, x: Tensor) -> Tensor:
        """Return the products (N, outputs) of x (N, inputs), with the bias."""
        if self.precision == "f32":
            return torch.mm(x, self.weight).add_(self.bias)
        return self.with_packed(x)

    def onto(self, x: Tensor, other: Tensor) -> Tensor:
        """Return the products of x (N, inputs), without a bias, plus `other` (N, outputs)."""
        if self.precision == "f32":
            return torch.mm(x, self.weight).add_(other)
        return self.with_packed(x).add_(other)

    def with_packed(self, x: Tensor) -> Tensor:
        """Return the products with the packed weights, with the bias."""
        packed = torch.jit._unwrap_optional(self.packed)
        if self.precision == "fp16":
            return torch.ops.quantized.linear_dynamic_fp16(x, packed)
        # 7-bit inputs: processors without VNNI add two products in 16 bits, which 8-bit inputs would
        # overflow.
        return torch.ops.quantized.linear_dynamic(x, packed, True)

    @torch.jit.export
    def pack(self, precision: str) -> None:
        """Pack the weights as "fp16" or "int8"; "f32" leaves them as they are.

        torch raises RuntimeError if this machine has no such products.
        """
        if precision == self.precision:
            return
        if self.precision != "f32":
            raise ValueError("the weights are packed already")
        weight = self.weight.t().contiguous()
        bias = self.bias if self.bias.shape[0] > 0 else None
        if precision == "fp16":
            self.packed = torch.ops.quantized.linear_prepack_fp16(weight, bias)
        elif precision == "int8":
            scales = weight.abs().amax(1).clamp(min=1e-8).double() / 127.0
            zeros = torch.zeros(weight.shape[0], dtype=torch.int64)
            whole = torch.quantize_per_channel(weight, scales, zeros, 0, torch.qint8)
            self.packed = torch.ops.quantized.linear_prepack(whole, bias)
        else:
            raise ValueError("unknown precision")
        self.precision = precision
        self.weight = torch.zeros(0)
