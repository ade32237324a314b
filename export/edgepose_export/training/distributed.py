"""Processes of a training run: a single one, or those started by torchrun, each with a share of the takes."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, distributed, nn


class Processes(NamedTuple):
    """This process and the others of the run.

    Attributes:
        rank: number of this process; process 0 writes checkpoints and prints messages.
        size: number of processes.
        device: device of this process's network.
    """

    rank: int = 0
    size: int = 1
    device: torch.device = torch.device("cpu")

    def share(self, items: list[Any]) -> list[Any]:
        """Return this process's share of a list that all processes have."""
        return items[self.rank :: self.size]

    def total(self, tensor: Tensor) -> Tensor:
        """Return the sum over all processes."""
        if self.size == 1:
            return tensor
        tensor = tensor.to(self.device, copy=True)
        distributed.all_reduce(tensor)
        return tensor.cpu()

    def gathered(self, value: Any) -> list[Any]:
        """Return the values of all processes, by rank."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        distributed.all_gather_object(values, value)
        return values

    def wrapped(self, network: nn.Module) -> nn.Module:
        """Wrap the network so that its gradients are averaged over all processes."""
        return nn.parallel.DistributedDataParallel(network) if self.size > 1 else network


ALONE = Processes()


@contextmanager
def joined() -> Iterator[Processes]:
    """Connect to the other processes that torchrun started, each on a GPU (nccl), or all on the CPU (gloo).

    Networks from `Processes.wrapped` must no longer exist when the block ends, so create them in a function
    that the block calls. The connections close with their last user, and DistributedDataParallel waits for
    their threads in a way that can block forever.
    """
    gpus = torch.cuda.device_count()
    if not distributed.is_torchelastic_launched():
        yield Processes(device=torch.device("cuda", 0) if gpus else ALONE.device)
        return
    local = int(os.environ["LOCAL_RANK"])
    if gpus:
        torch.cuda.set_device(local)
    # Functions of this module keep the current group as a default argument. If DistributedDataParallel
    # imported it later, the group would outlive `destroy_process_group`, and its threads can abort Python at
    # exit.
    importlib.import_module("torch.distributed.nn.functional")
    distributed.init_process_group("nccl" if gpus else "gloo")
    try:
        device = torch.device("cuda", local) if gpus else ALONE.device
        yield Processes(distributed.get_rank(), distributed.get_world_size(), device)
        # No process may leave while another still communicates with it.
        distributed.barrier()
    finally:
        distributed.destroy_process_group()
