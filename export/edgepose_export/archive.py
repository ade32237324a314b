"""Trained weights to a TorchScript archive that runs without edgepose (C++ with libtorch included)."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgepose.archive import METADATA_FILE
from edgepose_export.networks import BirnnArchive, Ends, PoseDecoder, PoseNetwork, RnnArchive

METHODS = ["window", "start", "stream", "drain"]


class Statistics(NamedTuple):
    """Means and standard deviations over the training set: inputs (60,), accelerations being its last 15, and pose targets."""

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor


def build(network: PoseNetwork, statistics: Statistics) -> nn.Module:
    """The archive's module, in Python, sharing the network's weights."""
    decoder = PoseDecoder(network.shape, statistics.target_mean, statistics.target_std)
    ends = Ends(network, statistics.input_mean, statistics.input_std, decoder)
    return (BirnnArchive if network.shape.kind == "birnn" else RnnArchive)(network, ends).eval()


def script(network: PoseNetwork, statistics: Statistics) -> torch.jit.ScriptModule:
    """The archive's module, scripted and frozen."""
    with warnings.catch_warnings():
        # TorchScript is deprecated in favour of torch.export; it is used on purpose, see docs/models.md.
        warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
        return torch.jit.freeze(torch.jit.script(build(network, statistics)), preserved_attrs=METHODS)


def save(module: torch.jit.ScriptModule, path: Path, metadata: dict[str, object]) -> None:
    """Writes an archive with its metadata as a JSON extra file."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
        torch.jit.save(module, str(path), _extra_files={METADATA_FILE: json.dumps(metadata, indent=2)})
