# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where networks run, and in which precision."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import TypeVar

from tap_ros.errors import ConfigError
from tap_ros.learning.parallel import local_rank
import torch

Placed = TypeVar('Placed', bound=torch.nn.Module)
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
    if name == 'cuda' and local_rank():
        name = f'cuda:{local_rank()}'
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f'device: {name!r} is not usable here ({error}); '
                          "choose 'cpu' or 'auto'") from error
    return torch.device(name)


def placed(module: Placed, device: torch.device | str) -> Placed:
    """Move a module to a device, in the memory format that is the fastest one for pictures."""
    return module.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def make_autocast(precision: str, device: torch.device) -> Autocast:
    """
    Choose the precision to run networks in.

    :param precision: 'float32', 'bfloat16', or 'auto': bfloat16 on a GPU and on CPUs that have
        instructions for it; on others it is ten times slower than float32.
    :param device: torch device.
    :return: function that makes a context manager.
    """
    half = precision == 'bfloat16' or (precision == 'auto' and has_bfloat16(device))
    return partial(torch.autocast, device.type, torch.bfloat16, enabled=half)


def has_bfloat16(device: torch.device | str) -> bool:
    """
    Say whether a device multiplies bfloat16 itself; others emulate it many times slower.

    :param device: torch device or its name.
    :return: bool; of CPUs, those with AVX512_BF16.
    """
    if torch.device(device).type == 'cuda':
        return True
    return getattr(torch.cpu, '_is_avx512_bf16_supported', lambda: False)()


def device_name(device: torch.device) -> str:
    """Say what computes: 'cpu', or the name of the GPU."""
    return torch.cuda.get_device_name(device) if device.type == 'cuda' else device.type
