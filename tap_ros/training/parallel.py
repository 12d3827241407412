# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training in several processes, as torchrun starts them: each takes its part of every batch.

All have the same weights and draw the same random numbers, so that the loss is that of one process
with the whole batch. Gradients are averaged after the backward pass rather than by
DistributedDataParallel, which cannot be told that discriminators stand still while the predictor
learns from them.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import os

from tap_ros.errors import ConfigError
import torch
from torch import distributed, nn


@dataclass(frozen=True)
class Processes:
    """
    The processes that train together.

    :param rank: of this one, from 0; the first one writes files and shows progress.
    :param count: how many there are.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the one that writes files and shows progress."""
        return self.rank == 0

    def part(self, batch_size: int) -> slice:
        """
        Return the slice of a batch that is this process's.

        :raises ConfigError: when the batch cannot be divided.
        """
        if batch_size % self.count:
            raise ConfigError(f'batch_size: {batch_size} episodes cannot be divided among '
                              f'{self.count} processes; choose a multiple of {self.count}')
        size = batch_size // self.count
        return slice(self.rank * size, (self.rank + 1) * size)

    def average_gradients(self, parameters: Iterable[torch.Tensor]) -> None:
        """Replace the gradients of parameters by their mean over the processes."""
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        parts = (flat / self.count).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts):
            gradient.copy_(part.view_as(gradient))

    def mean(self, value: torch.Tensor) -> torch.Tensor:
        """Return the mean of a tensor over the processes."""
        if self.count == 1:
            return value
        value = value.detach().clone()
        distributed.all_reduce(value)
        return value / self.count

    def agree(self, flag: bool, device: torch.device) -> bool:
        """Return what the first process says, so that all do the same."""
        if self.count == 1:
            return flag
        said = torch.tensor(float(flag), device=device)
        distributed.broadcast(said, 0)
        return bool(said)

    def wait(self) -> None:
        """Wait until all processes are here."""
        if self.count > 1:
            distributed.barrier()


ALONE = Processes()


@contextmanager
def joined(device: torch.device) -> Iterator[Processes]:
    """
    Join the processes that torchrun started with this one.

    :param device: torch device of this process.
    :return: context manager of Processes; one alone where torchrun started none.
    :raises ConfigError: for several processes without GPUs; batches are normalised over all
        processes on GPUs only (torch.nn.SyncBatchNorm).
    """
    count = int(os.environ.get('WORLD_SIZE', 1))
    if count == 1:
        yield ALONE
        return
    if device.type != 'cuda':
        raise ConfigError(f'device: {count} processes train on a GPU each, not on {device.type}; '
                          'start one process, with threads')
    distributed.init_process_group('nccl')
    try:
        yield Processes(distributed.get_rank(), count)
    finally:
        distributed.destroy_process_group()


def local_rank() -> int:
    """Return the number of this process among those of its machine, which is that of its GPU."""
    return int(os.environ.get('LOCAL_RANK', 0))


def share_batch_norm(module: nn.Module, processes: Processes) -> None:
    """
    Let batch normalisation use the statistics of the whole batch.

    :param module: changed in place; its weights and their names stay.
    :param processes: Processes.
    """
    if processes.count > 1:
        nn.SyncBatchNorm.convert_sync_batchnorm(module)
