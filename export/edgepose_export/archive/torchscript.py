"""Trained weights to a TorchScript archive that runs without edgepose (C++ with libtorch included)."""

from __future__ import annotations

import json
import subprocess
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from edgepose import __version__
from edgepose.errors import EdgeposeError
from edgepose.inference.archive import FORMAT, METADATA_FILE
from edgepose.placements import PLACEMENTS
from edgepose.skeleton import JOINTS
from edgepose.utils.durable_files import write_whole
from edgepose_export.networks.lstm import BirnnArchive, NormalisationAndDecoding, RnnArchive
from edgepose_export.networks.normalisation import FirstFrameNormaliser, Inputs
from edgepose_export.networks.receptive_field import FeedForward, FieldArchive, WaveNet
from edgepose_export.networks.shape import NetworkShape, PoseDecoder, PoseNetwork
from edgepose_export.training.dataset import RATE

Network = PoseNetwork | FeedForward | WaveNet

KINDS: dict[str, type[Network]] = {
    "birnn": PoseNetwork,
    "rnn": PoseNetwork,
    "feed-forward": FeedForward,
    "wavenet": WaveNet,
}
"""What trains a network of each kind."""


class Statistics(NamedTuple):
    """Means and standard deviations over the training set: of the inputs, the last 15 being accelerations
    where the network has them, and of the pose targets.
    """

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor


def new_network(shape: NetworkShape) -> Network:
    """A network of a shape with random weights."""
    return KINDS[shape.kind](shape)


def build(network: Network, statistics: Statistics, std_scale: Tensor | None = None) -> nn.Module:
    """The archive's module, in Python.

    Args:
        network: a trained one.
        statistics: of what it was trained on.
        std_scale: (24,) factors of the joints' standard deviations, see `reliability`; ones when None.
    """
    shape = network.shape
    decoder = PoseDecoder(shape, statistics.target_mean, statistics.target_std, std_scale)
    if isinstance(network, PoseNetwork):
        ends = NormalisationAndDecoding(network, statistics.input_mean, statistics.input_std, decoder)
        module: nn.Module = (BirnnArchive if shape.kind == "birnn" else RnnArchive)(network, ends)
    else:
        inputs = Inputs(shape.normalisation, shape.acceleration, statistics.input_mean, statistics.input_std)
        module = FieldArchive(network, inputs, decoder)
    return (FirstFrameNormaliser(module) if shape.normalisation == "sequence" else module).eval()


def script(
    network: Network, statistics: Statistics, std_scale: Tensor | None = None
) -> torch.jit.ScriptModule:
    """The archive's module, scripted; arguments as in `build`.

    It is not frozen: a frozen module could not pack its weights, and gains two percent.
    """
    with warnings.catch_warnings():
        # TorchScript is deprecated in favour of torch.export; on purpose, see docs/reference/models.md.
        warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
        return torch.jit.script(build(network, statistics, std_scale))


def save(
    module: torch.jit.ScriptModule, path: Path, metadata: dict[str, object], overwrite: bool = True
) -> None:
    """Writes an archive with its metadata as a JSON extra file.

    Raises:
        EdgeposeError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
            named = Path(folder) / path.name  # the name goes into the file
            torch.jit.save(module, str(named), _extra_files={METADATA_FILE: json.dumps(metadata, indent=2)})
            content = named.read_bytes()
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise EdgeposeError(f"{path}: cannot be written: {reason}") from error
    write_whole(path, content, "the archive", overwrite=overwrite)


def revision() -> str | None:
    """The commit of the source tree that this code runs from; None when it was installed as a package."""
    root = Path(__file__).parents[3]
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
    name: str, network: Network, checkpoint: dict[str, Any], past: int, future: int
) -> dict[str, Any]:
    """Metadata of an archive, without measures.

    Args:
        name: of the model.
        network: whose weights the archive holds.
        checkpoint: the training run's state.
        past: default frames before the present one in a window, of a bidirectional network.
        future: default frames after it.
    """
    shape = network.shape
    if not isinstance(network, PoseNetwork):
        past, future = network.past, network.future
    elif shape.kind == "rnn":
        past, future = 0, 0
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
        "normalisation": shape.normalisation,
        "acceleration": shape.acceleration,
        "smoothing": shape.smoothing,
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
