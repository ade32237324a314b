"""How an archive's weights are kept while it runs: as stored, or packed into fewer bytes.

A network that runs frame by frame is as fast as its weights come from memory. An archive holds them in f32;
`pack`, one of its methods, turns them in place into what this machine has products for.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from edgepose.errors import EdgeposeError

if TYPE_CHECKING:
    import torch

    from edgepose.archive import ArchiveInfo

PRECISIONS = ("f32", "fp16", "int8")
CHOICES = ("auto", *PRECISIONS)


def pack(
    module: torch.jit.ScriptModule,
    info: ArchiveInfo,
    choice: str = "auto",
    tell: Callable[[str], None] = lambda text: None,
) -> str:
    """Packs the weights of a loaded archive, once.

    Args:
        module: from `archive.load`.
        info: of that archive.
        choice: one of `CHOICES`; "auto" is fp16 where this machine has it and f32 elsewhere.
        tell: hears why "auto" is not fp16.

    Returns:
        The precision in which the module runs now.

    Raises:
        EdgeposeError: it cannot run in the one that was chosen.
    """
    stored = info.metadata.get("precision", "f32")
    if stored != "f32":
        if choice not in ("auto", stored):
            raise EdgeposeError(f"{info.path}: its weights are {stored}; export it again for {choice}")
        return str(stored)
    # Archives of older exports cannot pack their weights.
    if choice == "f32" or (choice == "auto" and not hasattr(module, "pack")):
        return "f32"
    wanted = "fp16" if choice == "auto" else choice
    try:
        pack_weights(module, wanted)
    except EdgeposeError as error:
        if choice != "auto":
            raise EdgeposeError(f"{info.path}: {error}; use --precision f32") from error
        tell(f"running in f32: {error}")
        return "f32"
    return wanted


def pack_weights(module: torch.jit.ScriptModule, precision: str) -> None:
    """Calls the archive's `pack`.

    Raises:
        EdgeposeError: there is no such precision on this machine or for this kind of network; the weights are
            as they were.
    """
    import torch

    if not hasattr(module, "pack"):
        raise EdgeposeError("the archive was made by an older edgepose export")
    try:
        with quantized_quietly():
            module.pack(precision)
    except (RuntimeError, torch.jit.Error) as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("builtins.ValueError: ")
        raise EdgeposeError(f"no {precision} weights here: {reason}") from error


@contextmanager
def quantized_quietly() -> Iterator[None]:
    """Without torch's warning that quantized tensors are to go; the versions we ask for have them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="torch.quantize_per_tensor", category=UserWarning)
        yield
