"""Precision of an archive's weights at run time: as stored, or packed into fewer bytes.

A network that runs frame by frame is limited by the time it takes to read its weights from memory. An archive
stores them in f32; its method `pack` converts them in place to a precision that this machine can multiply.
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

_AT_HWCAP, _HWCAP_ASIMDFHM = 16, 1 << 23  # Linux's names, for 64-bit ARM


def has_fp16_products(machine: str, hwcap: int) -> bool:
    """Whether a processor can multiply fp16 weights.

    On 64-bit ARM torch packs fp16 weights on any processor, but the first product kills the process
    ("Illegal instruction") unless the processor has FEAT_FHM, which Linux calls asimdfhm. No Raspberry Pi
    has it.

    Args:
        machine: kind of processor, as named by `platform.machine`.
        hwcap: Linux's bits for the processor's features, AT_HWCAP.
    """
    return machine in ("x86_64", "AMD64") or (machine == "aarch64" and bool(hwcap & _HWCAP_ASIMDFHM))


def is_int8_fast(machine: str) -> bool:
    """Whether int8 weights are faster than f32 on a kind of processor; on 64-bit ARM they are much slower."""
    return machine in ("x86_64", "AMD64")


def _hwcap() -> int:
    """Return this processor's feature bits from the Linux kernel; 0 on other systems."""
    if sys.platform != "linux":
        return 0
    getauxval = ctypes.CDLL(None).getauxval
    getauxval.argtypes, getauxval.restype = [ctypes.c_ulong], ctypes.c_ulong
    return int(getauxval(_AT_HWCAP))


def _check_fp16() -> None:
    """Raise ModelError if fp16 weights would kill the process."""
    if not has_fp16_products(platform.machine(), _hwcap()):
        raise ModelError("this processor cannot multiply fp16 numbers (no asimdfhm)")


def quantise_weights(
    module: torch.jit.ScriptModule,
    info: ArchiveInfo,
    choice: str = "auto",
    notify: Callable[[str], None] = lambda text: None,
) -> str:
    """Pack the weights of a loaded archive; call it once.

    Args:
        module: the archive, from `archive.load`.
        info: information about that archive.
        choice: one of `CHOICES`; "auto" is fp16 if this machine supports it, and f32 otherwise.
        notify: called with a message if "auto" is not fp16, or if int8 is slow on this machine.

    Returns:
        The precision in which the module runs now.

    Raises:
        ModelError: the module cannot run in the chosen precision.
    """
    stored = info.metadata.get("precision", "f32")
    if stored != "f32":
        if choice not in ("auto", stored):
            raise ModelError(f"{info.path}: its weights are {stored}; export it again for {choice}")
        if stored == "fp16":
            with _add_path_and_advice(info.path, "export it again in f32"):
                _check_fp16()
        _warn_if_slow(stored, notify)
        return str(stored)
    # Archives of older exports cannot pack their weights.
    if choice == "f32" or (choice == "auto" and not hasattr(module, "pack")):
        return "f32"
    if choice == "auto":
        return _pack_auto(module, notify)
    with _add_path_and_advice(info.path, "use --precision f32"):
        pack_weights(module, choice)
    _warn_if_slow(choice, notify)
    return choice


def _pack_auto(module: torch.jit.ScriptModule, notify: Callable[[str], None]) -> str:
    if not has_fp16_products(platform.machine(), _hwcap()):
        return "f32"
    try:
        pack_weights(module, "fp16")
    except EdgeposeError as error:
        notify(f"running in f32: {error}")
        return "f32"
    return "fp16"


@contextmanager
def _add_path_and_advice(path: Path, advice: str) -> Iterator[None]:
    """Add the archive's path and advice to errors."""
    try:
        yield
    except EdgeposeError as error:
        raise ModelError(f"{path}: {error}; {advice}") from error


def _warn_if_slow(precision: str, notify: Callable[[str], None]) -> None:
    if precision == "int8" and not is_int8_fast(platform.machine()):
        notify(f"warning: int8 is many times slower than f32 on {platform.machine()}; use --precision f32")


def pack_weights(module: torch.jit.ScriptModule, precision: str) -> None:
    """Call the archive's `pack`.

    Raises:
        ModelError: this machine or kind of network does not support the precision; the weights are unchanged.
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
    """Suppress torch's deprecation of quantized tensors, which the supported versions still have."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="torch.quantize_per_tensor", category=UserWarning)
        yield
