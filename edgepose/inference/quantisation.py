"""How an archive's weights are kept while it runs: as stored, or packed into fewer bytes.

A network that runs frame by frame is as fast as its weights come from memory. An archive holds them in f32;
`pack`, one of its methods, turns them in place into what this machine has products for.
"""

from __future__ import annotations

import ctypes
import platform
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from edgepose.errors import EdgeposeError, ModelError

if TYPE_CHECKING:
    import torch

    from edgepose.inference.archive import ArchiveInfo

PRECISIONS = ("f32", "fp16", "int8")
CHOICES = ("auto", *PRECISIONS)

_AT_HWCAP, _HWCAP_ASIMDFHM = 16, 1 << 23  # Linux' names, for 64-bit ARM


def has_fp16_products(machine: str, hwcap: int) -> bool:
    """Whether fp16 weights can be multiplied on a processor.

    On 64-bit ARM torch packs them everywhere, and their first product ends the process ("Illegal
    instruction") unless the processor has FEAT_FHM, which Linux calls asimdfhm. No Raspberry Pi has
    it.

    Args:
        machine: kind of processor, as `platform.machine` names it.
        hwcap: Linux' bits for what the processor can do, AT_HWCAP.
    """
    return machine in ("x86_64", "AMD64") or (machine == "aarch64" and bool(hwcap & _HWCAP_ASIMDFHM))


def is_int8_fast(machine: str) -> bool:
    """Whether int8 weights are faster than f32 on such a processor; on 64-bit ARM they are much slower."""
    return machine in ("x86_64", "AMD64")


def _hwcap() -> int:
    """What this processor can do, as the Linux kernel says; 0 elsewhere."""
    if sys.platform != "linux":
        return 0
    getauxval = ctypes.CDLL(None).getauxval
    getauxval.argtypes, getauxval.restype = [ctypes.c_ulong], ctypes.c_ulong
    return int(getauxval(_AT_HWCAP))


def _check_fp16() -> None:
    """Raises EdgeposeError where fp16 weights would end the process."""
    if not has_fp16_products(platform.machine(), _hwcap()):
        raise ModelError("this processor has no products of fp16 numbers (asimdfhm)")


def quantise_weights(
    module: torch.jit.ScriptModule,
    info: ArchiveInfo,
    choice: str = "auto",
    notify: Callable[[str], None] = lambda text: None,
) -> str:
    """Packs the weights of a loaded archive, once.

    Args:
        module: from `archive.load`.
        info: of that archive.
        choice: one of `CHOICES`; "auto" is fp16 where this machine has it and f32 elsewhere.
        notify: hears why "auto" is not fp16, and that int8 is slow here.

    Returns:
        The precision in which the module runs now.

    Raises:
        ModelError: it cannot run in the one that was chosen.
    """
    stored = info.metadata.get("precision", "f32")
    if stored != "f32":
        if choice not in ("auto", stored):
            raise ModelError(f"{info.path}: its weights are {stored}; export it again for {choice}")
        if stored == "fp16":
            with _about(info.path, "export it again in f32"):
                _check_fp16()
        _tell_of_slow(stored, notify)
        return str(stored)
    # Archives of older exports cannot pack their weights.
    if choice == "f32" or (choice == "auto" and not hasattr(module, "pack")):
        return "f32"
    if choice == "auto":
        return _pack_auto(module, notify)
    with _about(info.path, "use --precision f32"):
        pack_weights(module, choice)
    _tell_of_slow(choice, notify)
    return choice


def _pack_auto(module: torch.jit.ScriptModule, tell: Callable[[str], None]) -> str:
    if not has_fp16_products(platform.machine(), _hwcap()):
        return "f32"
    try:
        pack_weights(module, "fp16")
    except EdgeposeError as error:
        tell(f"running in f32: {error}")
        return "f32"
    return "fp16"


@contextmanager
def _about(path: Path, advice: str) -> Iterator[None]:
    """Errors name the archive and what to do."""
    try:
        yield
    except EdgeposeError as error:
        raise ModelError(f"{path}: {error}; {advice}") from error


def _tell_of_slow(precision: str, tell: Callable[[str], None]) -> None:
    if precision == "int8" and not is_int8_fast(platform.machine()):
        tell(f"warning: int8 is many times slower than f32 on {platform.machine()}; use --precision f32")


def pack_weights(module: torch.jit.ScriptModule, precision: str) -> None:
    """Calls the archive's `pack`.

    Raises:
        ModelError: there is no such precision on this machine or for this kind of network; the weights are
            as they were.
    """
    import torch

    if not hasattr(module, "pack"):
        raise ModelError("the archive was made by an older edgepose export")
    if precision == "fp16":
        _check_fp16()
    try:
        with suppress_quantisation_warning():
            module.pack(precision)
    except (RuntimeError, torch.jit.Error) as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("builtins.ValueError: ")
        raise ModelError(f"no {precision} weights here: {reason}") from error


@contextmanager
def suppress_quantisation_warning() -> Iterator[None]:
    """Without torch's warning that quantized tensors are to go; the versions we ask for have them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="torch.quantize_per_tensor", category=UserWarning)
        yield
