# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where networks run: devices, precision, and the processes that torchrun starts.

Of several processes each takes its part of every batch. All have the same weights and draw the
same random numbers, so that the loss is that of one process with the whole batch. Gradients are
averaged after the backward pass rather than by DistributedDataParallel, which cannot be told that
discriminators stand still while the predictor learns from them.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
import os
from typing import TypeVar

from tap_ros.errors import ConfigError
import torch
from torch import distributed, nn

Placed = TypeVar('Placed', bound=nn.Module)
Autocast = Callable[[], AbstractContextManager[object]]  # makes what networks run in


def pick_device(name: str) -> torch.device:
    """
    Choose the device to train on.

    :param name: 'auto', 'cpu', 'cuda' or 'cuda:1'. Each process that torchrun started has a GPU of
        its own where no number says which.
    :return: torch device.
    :raises ConfigError: if it is not there.
    """
    if name == 'auto':
        name = 'cuda' if torch.cuda.is_available() else 'cpu'
    rank = int(os.environ.get('LOCAL_RANK', 0))
    if name == 'cuda' and rank:
        name = f'cuda:{rank}'
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f'device: {name!r} is not usable here ({error}); '
                          "choose 'cpu' or 'auto'") from error
    return torch.device(name)


def placed(module: Placed, device: torch.device | str) -> Placed:
    """Move a module to a device, in the memory format that is the fastest one for pictures."""
    return module.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def has_bfloat16(device: torch.device | str) -> bool:
    """
    Say whether a device has instructions for bfloat16; others emulate it many times slower.

    Of CPUs those with AVX512_BF16 have.
    """
    if torch.device(device).type == 'cuda':
        return True
    return getattr(torch.cpu, '_is_avx512_bf16_supported', lambda: False)()


def pick_precision(precision: str, device: torch.device) -> str:
    """Return 'float32' or 'bfloat16' for these and for 'auto': bfloat16 where it is fast."""
    if precision != 'auto':
        return precision
    return 'bfloat16' if has_bfloat16(device) else 'float32'


def make_autocast(precision: str, device: torch.device) -> Autocast:
    """Return what makes a context manager to run networks in, for 'float32' or 'bfloat16'."""
    return partial(torch.autocast, device.type, torch.bfloat16, enabled=precision == 'bfloat16')


def device_name(device: torch.device) -> str:
    """Say what computes: 'cpu', or the name of the GPU."""
    return torch.cuda.get_device_name(device) if device.type == 'cuda' else device.type


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


def share_batch_norm(module: nn.Module, processes: Processes) -> None:
    """Let batch normalisation use the statistics of the whole batch; weights and names stay."""
    if processes.count > 1:
        nn.SyncBatchNorm.convert_sync_batchnorm(module)
