# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where networks run, and in which precision."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache, partial
import time
from typing import TypeVar

from tap_ros.errors import ConfigError
from tap_ros.training.parallel import local_rank
import torch

_WORTHWHILE = 1.15  # of bfloat16_gain; less is within what a trial errs
_TRIALS = 6

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


def pick_precision(precision: str, device: torch.device) -> str:
    """
    Choose the precision to train in.

    :param precision: 'float32', 'bfloat16', or 'auto': bfloat16 on a GPU, and on a CPU that
        convolves in it clearly faster; one that emulates it is ten times slower.
    :param device: torch device.
    :return: 'float32' or 'bfloat16'; for 'auto' the same whenever asked in one process.
    """
    if precision != 'auto':
        return precision
    half = device.type == 'cuda' or (device.type == 'cpu' and bfloat16_gain() > _WORTHWHILE)
    return 'bfloat16' if half else 'float32'


@cache
def bfloat16_gain() -> float:
    """
    Measure how many times faster this CPU convolves in bfloat16 than in float32, in some 30 ms.

    A decoder's convolution, forward and backward, on one thread, by the time of that thread: what
    else the machine does hardly matters.

    :return: the ratio, below 1 where bfloat16 is slower; 0 where torch cannot do it.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _pass_time(torch.float32) / _pass_time(torch.bfloat16)
    except RuntimeError:
        return 0.0
    finally:
        torch.set_num_threads(threads)


def _pass_time(dtype: torch.dtype) -> float:
    """Return the least CPU time of some convolutions, forward and backward."""
    pictures, weight = (  # of ones: the random numbers of a training stay what they are
        torch.ones(shape, dtype=dtype).contiguous(memory_format=torch.channels_last)
        .requires_grad_() for shape in ((8, 64, 16, 16), (32, 64, 3, 3)))
    times = []
    for _ in range(_TRIALS):
        began = time.thread_time()
        torch.nn.functional.conv2d(pictures, weight, padding=1).sum().backward()
        times.append(time.thread_time() - began)
    return min(times)


def make_autocast(precision: str, device: torch.device) -> Autocast:
    """
    Make what networks run in.

    :param precision: 'float32' or 'bfloat16'.
    :param device: torch device.
    :return: function that makes a context manager.
    """
    return partial(torch.autocast, device.type, torch.bfloat16, enabled=precision == 'bfloat16')


def has_bfloat16(device: torch.device | str) -> bool:
    """
    Say whether a device has instructions for bfloat16; others emulate it many times slower.

    For what must be the same in all processes of a machine, which pick_precision does not promise.

    :param device: torch device or its name.
    :return: bool; of CPUs, those with AVX512_BF16.
    """
    if torch.device(device).type == 'cuda':
        return True
    return getattr(torch.cpu, '_is_avx512_bf16_supported', lambda: False)()


def device_name(device: torch.device) -> str:
    """Say what computes: 'cpu', or the name of the GPU."""
    return torch.cuda.get_device_name(device) if device.type == 'cuda' else device.type
