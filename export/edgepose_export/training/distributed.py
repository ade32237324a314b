"""The processes of a training run: one alone, or those that torchrun started, each with a share of takes."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, distributed, nn


class Processes(NamedTuple):
    """This process among those of the run.

    Attributes:
        rank: its number; process 0 writes checkpoints and speaks.
        size: how many there are.
        device: where its network is.
    """

    rank: int = 0
    size: int = 1
    device: torch.device = torch.device("cpu")

    def share(self, items: list[Any]) -> list[Any]:
        """This process's share of a list that is the same everywhere."""
        return items[self.rank :: self.size]

    def total(self, tensor: Tensor) -> Tensor:
        """The sum over all processes."""
        if self.size == 1:
            return tensor
        tensor = tensor.to(self.device, copy=True)
        distributed.all_reduce(tensor)
        return tensor.cpu()

    def everywhere(self, value: Any) -> list[Any]:
        """Each process's value, by rank."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        distributed.all_gather_object(values, value)
        return values

    def wrapped(self, network: nn.Module) -> nn.Module:
        """The network such that gradients become the mean of those of all processes."""
        return nn.parallel.DistributedDataParallel(network) if self.size > 1 else network


ALONE = Processes()


@contextmanager
def joined() -> Iterator[Processes]:
    """Meets the other processes that torchrun started, on a GPU each (nccl) or the processor (gloo).

    Networks that `Processes.wrapped` wrapped have to be gone when the block ends, so make them in a function
    that the block calls: the connections close with their last user, and DistributedDataParallel waits for
    their threads in a way that can wait for ever.
    """
    gpus = torch.cuda.device_count()
    if not distributed.is_torchelastic_launched():
        yield Processes(device=torch.device("cuda", 0) if gpus else ALONE.device)
        return
    local = int(os.environ["LOCAL_RANK"])
    if gpus:
        torch.cuda.set_device(local)
    # Functions of this module have the group of the moment as a default argument. DistributedDataParallel
    # imports it, and the group would outlive `destroy_process_group`: its threads can abort an ending Python.
    importlib.import_module("torch.distributed.nn.functional")
    distributed.init_process_group("nccl" if gpus else "gloo")
    try:
        device = torch.device("cuda", local) if gpus else ALONE.device
        yield Processes(distributed.get_rank(), distributed.get_world_size(), device)
        # None may leave while another still talks to it.
        distributed.barrier()
    finally:
        distributed.destroy_process_group()
