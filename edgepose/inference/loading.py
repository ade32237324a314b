"""Loading an archive for one of the two runtimes: torch, or numpy where torch is too large."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

from edgepose.errors import ModelError
from edgepose.inference import archive
from edgepose.inference.quantisation import quantise_weights

if TYPE_CHECKING:
    import torch

    from edgepose.inference.numpy_network import NumpyNetwork

RUNTIMES = ("auto", "torch", "numpy")


class LoadedNetwork(NamedTuple):
    """A network that is ready for an engine.

    Attributes:
        module: the TorchScript module, or the network in numpy.
        runtime: "torch" or "numpy".
        precision: precision of the weights.
    """

    module: torch.jit.ScriptModule | NumpyNetwork
    runtime: str
    precision: str


def load(
    info: archive.ArchiveInfo,
    trust: bool,
    runtime: str,
    precision: str,
    notify: Callable[[str], None] = lambda text: None,
) -> LoadedNetwork:
    """Load an archive.

    Args:
        info: the archive, from `archive.read_info`.
        trust: let torch load the archive although its checksum is unknown; numpy needs no trust.
        runtime: one of `RUNTIMES`; "auto" is torch where it is installed.
        precision: one of `quantisation.CHOICES`; numpy has f32 only.
        notify: called with a message if numpy runs because torch is missing, and see `quantise_weights`.

    Raises:
        ModelError: the archive is not trusted or damaged, or cannot run here or in this precision.
    """
    installed = find_spec("torch") is not None
    if runtime == "torch" and not installed:
        raise ModelError("PyTorch is not installed: install it, or use --runtime numpy")
    if runtime == "torch" or (runtime == "auto" and installed):
        module = archive.load(info, trust)
        return LoadedNetwork(module, "torch", quantise_weights(module, info, precision, notify))
    if precision not in ("auto", "f32"):
        raise ModelError(
            f"numpy runs in f32 only, not in {precision}: use --precision f32 or --runtime torch"
        )
    from edgepose.inference import numpy_network

    if runtime == "auto":
        notify("PyTorch is not installed: running with numpy")
    return LoadedNetwork(numpy_network.load(info), "numpy", "f32")
