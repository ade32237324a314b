"""A kind of network: the module that is trained, the archive that runs it, and what it can do."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor, nn

if TYPE_CHECKING:
    from edgepose_export.networks.shape import NetworkShape, PoseDecoder


class Network(nn.Module):
    """Base of the networks: z-scored inputs (B, T, inputs) to means and deviations (B, T, outputs).

    With a head for the place its outputs (B, T, 10) come third.

    Attributes:
        shape: the shape that it was built from.
    """

    if TYPE_CHECKING:  # TorchScript would compile the annotation
        shape: NetworkShape


class Statistics(NamedTuple):
    """Means and standard deviations of the inputs and of the pose targets over the training set.

    The last 15 inputs are accelerations, if the network has them.
    """

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor


class NetworkKind(NamedTuple):
    """A kind of network; the module of each ends with its constant.

    Attributes:
        network: makes the module that is trained, with random weights, from a shape.
        archive: makes the module of the archive from the trained one, its statistics and its decoder.
        card: description for the model card; {past}, {future}, {latency} (ms) and {hidden} are filled in.
        windowed: whether it can compute a window of any length, past and future, for each frame; otherwise
            the numbers are the attributes `past` and `future` of the network, 0 if it has none.
        streamed: whether it can be trained as a stream: its `forward` has an argument `future`.
        smoothed: whether its archive applies `NetworkShape.smoothing`.
        placed: whether it can have a head for the place, `NetworkShape.place`.
    """

    network: Callable[[NetworkShape], Network]
    archive: Callable[[Any, Statistics, PoseDecoder], nn.Module]
    card: str
    windowed: bool = False
    streamed: bool = False
    smoothed: bool = False
    placed: bool = False
