# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where networks run: devices and precision."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import TypeVar

from tap_ros.base.errors import ConfigError
import torch
from torch import nn

Placed = TypeVar('Placed', bound=nn.Module)
Autocast = Callable[[], AbstractContextManager[object]]  # makes what networks run in


def pick_device(name: str) -> torch.device:
    """
    Choose the device to train on.

    :param name: 'auto', 'cpu', 'cuda' or 'cuda:1'.
    :return: torch device.
    :raises ConfigError: if it is not there.
    """
    if name == 'auto':
        name = 'cuda' if torch.cuda.is_available() else 'cpu'
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
    Return whether a device has instructions for bfloat16; others emulate it many times slower.

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
