"""Export of trained weights as TorchScript archives, which run without edgepose, even in C++."""

from __future__ import annotations

import json
import re
import subprocess
import warnings
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor, nn

from edgepose import __version__
from edgepose.errors import EdgeposeError, ModelError
from edgepose.inference.archive import FORMAT, METADATA_FILE
from edgepose.inference.weights import WEIGHTS_FILE, recipe_of
from edgepose.placements import PLACEMENTS
from edgepose.pose import CONTACTS
from edgepose.skeleton import JOINTS
from edgepose.utils.durable_files import write_whole
from edgepose_export.networks.kind import Network, Statistics
from edgepose_export.networks.normalisation import FirstFrameNormaliser
from edgepose_export.networks.registry import NETWORKS
from edgepose_export.networks.shape import NetworkShape, PoseDecoder
from edgepose_export.training.dataset import RATE

PLACE_OUTPUTS = {"contacts": list(CONTACTS), "velocity": "level pelvis frame, m/s"}
"""Description of the outputs of a head for the place, in the metadata of archives that have one."""


def new_network(shape: NetworkShape) -> Network:
    """Return a network with the given shape and random weights."""
    return NETWORKS[shape.kind].network(shape)


def build(network: Network, statistics: Statistics, std_scale: Tensor | None = None) -> nn.Module:
    """Return the archive's module, not yet scripted.

    Args:
        network: the trained network.
        statistics: statistics of its training set.
        std_scale: (24,) factors of the joints' standard deviations, see `uncertainty.scales`; all 1 if None.
    """
    shape = network.shape
    decoder = PoseDecoder(shape, statistics.target_mean, statistics.target_std, std_scale)
    module = NETWORKS[shape.kind].archive(network, statistics, decoder)
    return (FirstFrameNormaliser(module) if shape.normalisation == "sequence" else module).eval()


def script(
    network: Network, statistics: Statistics, std_scale: Tensor | None = None
) -> torch.jit.ScriptModule:
    """Return the archive's scripted module; the arguments are those of `build`.

    It is not frozen: a frozen module could not pack its weights, and would only be two percent faster.
    """
    with warnings.catch_warnings():
        # TorchScript is deprecated in favour of torch.export; docs/reference/models.md says why it is used.
        warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
        return torch.jit.script(build(network, statistics, std_scale))


def save(
    module: torch.jit.ScriptModule, path: Path, metadata: dict[str, object], overwrite: bool = True
) -> None:
    """Write an archive, with its metadata as an extra file in JSON.

    Raises:
        EdgeposeError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`torch.jit", category=DeprecationWarning)
            named = Path(folder) / path.name  # torch stores this name in the file
            extra = {METADATA_FILE: json.dumps(metadata, indent=2)}
            torch.jit.save(module, str(named), _extra_files=extra)
            extra |= _weights_file(module, metadata, named)
            torch.jit.save(module, str(named), _extra_files=extra)
            content = named.read_bytes()
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise EdgeposeError(f"{path}: cannot be written: {reason}") from error
    write_whole(path, content, "the archive", overwrite=overwrite)


def _weights_file(module: torch.jit.ScriptModule, metadata: dict[str, object], saved: Path) -> dict[str, str]:
    """Return the extra file that says where a saved archive keeps the weights of its network.

    It is for `edgepose.inference.weights`; networks that do not run there have none. torch numbers the files
    of an archive by itself, but in the same way each time, so they are found by their content.
    """
    try:
        shapes = recipe_of(metadata).shapes()
    except ModelError:
        return {}
    with zipfile.ZipFile(saved) as archive:
        names = [name for name in archive.namelist() if re.fullmatch(r"[^/]+/data/\d+", name)]
        files = {archive.read(name): name.partition("/")[2] for name in names}
    weights = {name: tensor.contiguous().numpy() for name, tensor in module.state_dict().items()}
    index = {
        name: {"file": files[weights[name].astype("<f4").tobytes()], "shape": list(shape)}
        for name, shape in shapes.items()
    }
    return {WEIGHTS_FILE: json.dumps(index, indent=2)}


def revision() -> str | None:
    """Return the commit of the source tree that this code runs from; None for an installed package."""
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
    """Return an archive's metadata, without measures.

    Args:
        name: name of the model.
        network: the network in the archive.
        checkpoint: the state of its training run.
        past: default number of past frames in a window; used for kinds with windows only.
        future: default number of future frames, likewise.
    """
    shape = network.shape
    windowed = NETWORKS[shape.kind].windowed
    if not windowed:
        past, future = getattr(network, "past", 0), getattr(network, "future", 0)
    return {
        "format": FORMAT,
        "name": name,
        "kind": shape.kind,
        "windowed": windowed,
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
        **(
            {"place": {"contacts": list(CONTACTS), "velocity": "level pelvis frame, m/s"}}
            if shape.place
            else {}
        ),
        "edgepose": __version__,
        "revision": revision(),
        "torch": torch.__version__,
    }
