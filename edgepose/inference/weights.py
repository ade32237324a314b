"""The weights of an archive read as data: arrays of known shapes, without running or unpickling anything.

torch stores each tensor of an archive as raw numbers in a file of its own, and the file `weights.json`, which
`edgepose export` adds, says which file holds which weights.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgepose.errors import ModelError
from edgepose.inference.archive import has_place
from edgepose.inference.rotation_rows import SEEN
from edgepose.pose import CONTACTS
from edgepose.skeleton import JOINTS
from edgepose.utils.safe_npz import BROKEN

WEIGHTS_FILE = "weights.json"
"""Name of the index: a JSON object of weights, each {"file": name, "shape": [...]}, little-endian float32."""

Array = NDArray[np.float32]

_INDEX_LIMIT = 1 << 16
_MOST_UNITS = 2048
_MOST_SMOOTHING = 0.99


class Recipe(NamedTuple):
    """An archive's recurrent network, as its metadata describe it.

    Attributes:
        kind: "rnn" or "birnn".
        hidden: units per layer and direction.
        joints: the joints that the network predicts.
        passed: whether bones with a sensor take its orientation.
        smoothing: both poles of the low-pass; 0 for none.
        place: outputs of the head for the place; 0 without one.
    """

    kind: str
    hidden: int
    joints: tuple[int, ...]
    passed: bool
    smoothing: float
    place: int

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all weights."""
        size, outputs = self.hidden, 6 * len(self.joints)
        width, numbers = size * (2 if self.kind == "birnn" else 1), 2 * outputs + self.place
        shapes = {
            "ends.dense.weight": (9 * SEEN, size),
            "ends.dense.bias": (size,),
            "ends.heads.weight": (width, numbers),
            "ends.heads.bias": (numbers,),
            "ends.variances": (outputs, 24),
            "ends.floor": (),
        }
        layers, cells = {"inputs1": 4, "inputs2": 4}, ["cell1", "cell2"]
        if self.kind == "birnn":
            layers, cells = {"inputs1": 8, "ahead2": 8}, ["forward1", "backward1", "forward2", "backward2"]
            shapes |= {f"back2_{name}.weight": (size, 4 * size) for name in ("forward", "backward")}
        for name, count in layers.items():
            shapes |= {f"{name}.weight": (size, count * size), f"{name}.bias": (count * size,)}
        return shapes | {f"{cell}.state.weight": (size, 4 * size) for cell in cells}


def recipe_of(metadata: Mapping[str, Any]) -> Recipe:
    """Return the recipe of an archive's network.

    Args:
        metadata: from `archive.read_info`.

    Raises:
        ModelError: the network is not a recurrent one as shipped. The message does not name the archive.
    """
    wanted = {
        "kind": ("rnn", "birnn"),
        "targets": ("global-6d",),
        "normalisation": ("root", "tilt"),
        "measured_bones": ("passed", "predicted"),
        "precision": ("f32",),
    }
    for key, values in wanted.items():
        if metadata.get(key) not in values:
            raise ModelError(
                f"numpy runs networks with {key} {' or '.join(values)}, not {repr(metadata.get(key))[:40]}; "
                "use --runtime torch"
            )
    hidden, joints, smoothing = (metadata.get(key) for key in ("hidden", "joints", "smoothing"))
    if type(hidden) is not int or not 1 <= hidden <= _MOST_UNITS:
        raise ModelError("its number of hidden units is not valid")
    names = joints if isinstance(joints, list) else []
    if not names or not set(map(str, names)) < set(JOINTS[1:]) or len(set(names)) < len(names):
        raise ModelError("its joints are not those of a body")
    if not isinstance(smoothing, (int, float)) or not 0.0 <= smoothing <= _MOST_SMOOTHING:
        raise ModelError("its smoothing is not a number from 0 to 0.99")
    return Recipe(
        metadata["kind"],
        hidden,
        tuple(JOINTS.index(name) for name in names),
        metadata["measured_bones"] == "passed",
        float(smoothing),
        len(CONTACTS) + 3 if has_place(metadata) else 0,
    )


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Iterator[tuple[str, Array]]:
    """Yield the names and arrays of an archive's weights, one after the other.

    Args:
        path: the archive.
        shapes: the names of the weights to read, and the shapes that they must have.

    Raises:
        ModelError: the archive has no index, or a weight is missing, has another shape or is not finite. The
            message does not name the archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            folder, index = _read_index(archive)
            for name, shape in shapes.items():
                yield name, _read(archive, folder, index.get(name), name, shape)
    except (OSError, *BROKEN) as error:
        raise ModelError(f"its weights cannot be read ({error}); get or export it again") from error


def _read_index(archive: zipfile.ZipFile) -> tuple[str, dict[str, Any]]:
    """Return the folder that the archive's files are in, and the index."""
    entries = [entry for entry in archive.infolist() if entry.filename.endswith(f"/extra/{WEIGHTS_FILE}")]
    if not entries:
        raise ModelError(
            f"it has no {WEIGHTS_FILE}, as older versions export: export it again, or use --runtime torch"
        )
    if len(entries) > 1 or entries[0].file_size > _INDEX_LIMIT:
        raise ValueError(f"more than one {WEIGHTS_FILE}, or a large one")
    index = json.loads(archive.read(entries[0]))
    if not isinstance(index, dict):
        raise ValueError(f"{WEIGHTS_FILE} is no object")
    return entries[0].filename.removesuffix(f"extra/{WEIGHTS_FILE}"), index


def _read(archive: zipfile.ZipFile, folder: str, about: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Return a weight; `about` is its entry of the index."""
    if not isinstance(about, dict) or about.get("shape") != list(shape):
        raise ValueError(f"{name} is missing or does not have the shape {shape}")
    entry = archive.getinfo(f"{folder}{about.get('file')}")
    # Only what is stored as it is has the size that it says.
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != 4 * int(np.prod(shape)):
        raise ValueError(f"{name} does not have the size of {shape} numbers")
    array = np.frombuffer(archive.read(entry), "<f4").reshape(shape)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a NaN or an infinite number")
    return array.astype(np.float32, copy=False)
