"""Model archives: finding, checking and describing them without running code, loading them once trusted.

An archive is a TorchScript file, and loading it runs the code in it. So a file is loaded only if its SHA-256
checksum is listed in `SHA256SUMS` next to the bundled archives or in the user's own list, or if the user
trusts it explicitly for this once.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import zipfile
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from edgepose.errors import ModelError
from edgepose.inference.quantisation import suppress_quantisation_warning
from edgepose.placements import PLACEMENTS
from edgepose.pose import CONTACTS
from edgepose.utils.safe_npz import BROKEN
from edgepose.utils.similar_names import choices

if TYPE_CHECKING:
    import torch

METADATA_FILE = "edgepose.json"
FORMAT = 1
MODELS = Path(str(resources.files("edgepose.inference") / "models"))

ALIASES = {"birnn-cmu": "birnn", "rnn-cmu": "rnn"}
"""Names that bundled archives had before, and their present ones."""

_log = logging.getLogger(__name__)

_METADATA_LIMIT = 1 << 20
_MOST_FRAMES = 1000


class ArchiveInfo(NamedTuple):
    """Information about an archive, available before it is loaded.

    Attributes:
        path: the file.
        sha256: its checksum, hexadecimal.
        trusted: the checksum is that of a bundled archive or on the user's own list.
        metadata: the archive's own JSON description.
    """

    path: Path
    sha256: str
    trusted: bool
    metadata: dict[str, Any]


def is_windowed(metadata: Mapping[str, Any]) -> bool:
    """Whether a model can compute a window of any length, past and future, for each frame."""
    return bool(metadata.get("windowed", metadata["kind"] == "birnn"))  # the first archives do not say


def has_place(metadata: Mapping[str, Any]) -> bool:
    """Whether a model estimates contacts and the velocity of the pelvis, see `EngineOutput.place`."""
    return "place" in metadata


def _settings() -> str:
    """Return the folder of the user's settings; it starts with "~" if the user has no home folder."""
    return os.path.expanduser(os.environ.get("XDG_CONFIG_HOME") or "~/.config")  # noqa: PTH111 - never raises


def has_home() -> bool:
    """Whether the user has a home folder for a list of trusted checksums; some users in containers do not."""
    return not _settings().startswith("~")


def trust_file() -> Path:
    """Return the path of the user's own list of trusted checksums, in the format of `sha256sum`.

    Raises:
        ModelError: the user has no home folder.
    """
    if not has_home():
        raise ModelError("you have no home folder for a list of trusted archives: set XDG_CONFIG_HOME")
    return Path(_settings()) / "edgepose" / "trusted-archives"


def bundled_archives() -> list[Path]:
    """Return the archives that come with the package, by name."""
    return sorted(MODELS.glob("*.pt"))


def find_archive(name: str) -> Path:
    """Return the path of the bundled archive of that name, present or former, or of the file at that path.

    Raises:
        ModelError: there is neither.
    """
    bundled = {path.stem: path for path in bundled_archives()}
    if name in bundled:
        return bundled[name]
    if Path(name).is_file():
        return Path(name)
    if ALIASES.get(name) in bundled:
        _note_alias(name)
        return bundled[ALIASES[name]]
    hint = choices(name, bundled, "give the path of an archive, or one of")
    if Path(name).exists():
        raise ModelError(f"{name}: it is not a file on a disk; {hint}")
    raise ModelError(f"{name}: no such model; {hint}")


@cache
def _note_alias(name: str) -> None:
    """Warn once that a name is a former one."""
    _log.warning("model %s is called %s now", name, ALIASES[name])


def _read_checksums(path: Path) -> set[str]:
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return {line.split()[0].lower() for line in lines if line.strip()}
    except FileNotFoundError:
        return set()
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror}") from error


def read_info(path: Path) -> ArchiveInfo:
    """Read an archive's metadata and checksum, without running any of its code.

    Raises:
        ModelError: the file is not an edgepose archive, is damaged, or has a newer format.
    """
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            entries = [e for e in archive.infolist() if e.filename.endswith(f"/extra/{METADATA_FILE}")]
            if len(entries) != 1 or entries[0].file_size > _METADATA_LIMIT:
                raise ModelError(
                    f"{path}: not a model archive of edgepose (it has no {METADATA_FILE}); "
                    "make one with edgepose export"
                )
            metadata = json.loads(archive.read(entries[0]))
            sha256 = _checksum(file)
    except (zipfile.BadZipFile, EOFError) as error:
        raise ModelError(
            f"{path}: not a model archive (no complete zip file); make one with edgepose export"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: {error.strerror or error}") from error
    except BROKEN as error:  # also RecursionError, of deeply nested JSON
        raise ModelError(f"{path}: the archive's metadata cannot be read ({error})") from error
    _check_metadata(path, metadata)
    trusted = _read_checksums(MODELS / "SHA256SUMS")
    if has_home():
        trusted |= _read_checksums(trust_file())
    return ArchiveInfo(path, sha256, sha256 in trusted, metadata)


def _checksum(file: BinaryIO) -> str:
    """Return the SHA-256 checksum of a file, block by block: archives can be large for a small computer."""
    checksum = hashlib.sha256()
    file.seek(0)
    while block := file.read(1 << 18):
        checksum.update(block)
    return checksum.hexdigest()


def _check_metadata(path: Path, metadata: Any) -> None:
    if not isinstance(metadata, dict) or not isinstance(metadata.get("format"), int):
        raise ModelError(f"{path}: the archive's metadata is not what edgepose export writes")
    if metadata["format"] > FORMAT:
        raise ModelError(
            f"{path}: archive format {metadata['format']} is newer than this edgepose reads ({FORMAT}); "
            "update edgepose"
        )
    if not isinstance(metadata.get("kind"), str) or not metadata["kind"].isprintable():
        raise ModelError(f"{path}: the archive's kind of network {metadata.get('kind')!r} is not a name")
    if type(metadata.get("windowed", False)) is not bool:
        raise ModelError(f"{path}: the archive's ability to compute windows is neither true nor false")
    if metadata.get("placements") != list(PLACEMENTS):
        raise ModelError(f"{path}: made for other sensor placements: {metadata.get('placements')}")
    place = metadata.get("place")
    if has_place(metadata) and not (isinstance(place, dict) and place.get("contacts") == list(CONTACTS)):
        raise ModelError(f"{path}: it estimates other contacts than this edgepose reads; update edgepose")
    if not isinstance(metadata.get("rate_hz"), (int, float)) or not 1 <= metadata["rate_hz"] <= 1000:
        raise ModelError(f"{path}: the archive's frame rate {metadata.get('rate_hz')!r} is not a rate")
    for name in ("past", "future"):
        frames = metadata.get(name)
        if type(frames) is not int or not 0 <= frames <= _MOST_FRAMES:
            raise ModelError(f"{path}: the archive's number of {name} frames {frames!r} is not valid")


def load(info: ArchiveInfo, trust: bool = False) -> torch.jit.ScriptModule:
    """Load a trusted archive for the CPU, ready to run on one thread.

    Args:
        info: the archive, from `read_info`.
        trust: load the archive although its checksum is unknown.

    Raises:
        ModelError: the archive is not trusted, or torch cannot load it.
    """
    if not (info.trusted or trust):
        raise ModelError(
            f"{info.path}: loading a model archive runs its code, and this one's SHA-256 checksum "
            f"{info.sha256[:16]}... is not known; if you made it or trust its author, run with --trust, or "
            "once: edgepose models --trust PATH"
        )
    import torch

    torch.set_num_threads(1)
    # torch.nn.LSTM and small products are slower through oneDNN at batch 1.
    torch.backends.mkldnn.enabled = False  # type: ignore[assignment]
    try:
        content = info.path.read_bytes()
        if hashlib.sha256(content).hexdigest() != info.sha256:
            raise ModelError(f"{info.path}: the archive changed while it was being loaded; run again")
        with suppress_quantisation_warning():
            module: torch.jit.ScriptModule = torch.jit.load(io.BytesIO(content), map_location="cpu")
    except (RuntimeError, ValueError, OSError) as error:
        reason = str(error).strip().splitlines()
        raise ModelError(
            f"{info.path}: torch cannot load the archive ({reason[0] if reason else type(error).__name__})"
        ) from error
    if has_place(info.metadata) and not hasattr(module, "stream_place"):
        raise ModelError(f"{info.path}: the contacts that its metadata name are missing; export it again")
    return module


def trust(path: Path) -> ArchiveInfo:
    """Add an archive's checksum to the user's own list.

    Raises:
        ModelError: the file is not an archive, or the list cannot be written.
    """
    info = read_info(path)
    if not info.trusted:
        try:
            trust_file().parent.mkdir(parents=True, exist_ok=True)
            with trust_file().open("a") as file:
                # The leading line break is for a list that was edited and does not end in one.
                file.write(f"\n{info.sha256}  {' '.join(path.name.split())}\n")
        except OSError as error:
            raise ModelError(f"{trust_file()}: {error.strerror}") from error
    return info._replace(trusted=True)
