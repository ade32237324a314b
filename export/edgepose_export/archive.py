"""Trained weights to a TorchScript archive that runs without edgepose (C++ with libtorch included)."""

from __future__ import annotations

import json
import subprocess
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from edgepose import __version__
from edgepose.archive import FORMAT, METADATA_FILE
from edgepose.errors import EdgeposeError
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import JOINTS
from edgepose_export.dataset import RATE
from edgepose_export.networks import BirnnArchive, Ends, PoseDecoder, PoseNetwork, RnnArchive

METHODS = ["window", "start", "stream", "drain"]


class Statistics(NamedTuple):
    """Means and standard deviations over the training set: inputs (60,), accelerations being its last 15, and
    pose targets.
    """

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
    """Writes an archive with its metadata as a JSON extra file.

    Raises:
        EdgeposeError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
            torch.jit.save(module, str(path), _extra_files={METADATA_FILE: json.dumps(metadata, indent=2)})
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise EdgeposeError(f"{path}: cannot be written: {reason}") from error


def revision() -> str | None:
    """The commit of the source tree that this code runs from; None when it was installed as a package."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def describe(
    name: str, network: PoseNetwork, checkpoint: dict[str, Any], past: int, future: int
) -> dict[str, Any]:
    """Metadata of an archive, without measures.

    Args:
        name: of the model.
        network: whose weights the archive holds.
        checkpoint: the training run's state.
        past: default frames before the present one in a window.
        future: default frames after it.
    """
    shape = network.shape
    return {
        "format": FORMAT,
        "name": name,
        "kind": shape.kind,
        "hidden": shape.hidden,
        "parameters": sum(p.numel() for p in network.parameters()),
        "placements": list(PLACEMENTS),
        "rate_hz": RATE,
        "past": past,
        "future": future,
        "joints": [JOINTS[joint] for joint in shape.joints],
        "targets": shape.targets,
        "measured_bones": shape.measured,
        "precision": "f32",
        "training": {
            "steps": checkpoint["step"],
            **checkpoint["data"],
            "config": json.loads(checkpoint["config"]),
        },
        "measures": {},
        "edgepose": __version__,
        "revision": revision(),
        "torch": torch.__version__,
    }
