# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Weights files: safetensors with the network's configuration as JSON inside, and a SHA-256 of both.

No pickle is ever read or written. A file appears under its name only when it is complete, and what
is read from it is what was written: anything else is refused with a WeightsError of one line.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
import hashlib
import json
import os
from pathlib import Path
import re
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load, save
from tap_ros.base.errors import TapError, WeightsError
from tap_ros.base.files import write_atomically
from tap_ros.base.text import escaped, listing
import torch
from torch.overrides import TorchFunctionMode

Config = TypeVar('Config')  # a dataclass
Network = TypeVar('Network', bound=torch.nn.Module)

_FORMAT = 'tap_ros 2'  # 1 had no SHA-256
_MOST_BYTES = 2**32  # of a file; of the paper's network with all that a training keeps 2**28
_KINDS = {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int32, torch.int64,
          torch.uint8, torch.bool}  # of numbers that are written, and can be computed with
_AGAIN = 'copy it again, or train again'


def save_weights(path: str | Path, module: torch.nn.Module | dict[str, torch.Tensor], kind: str,
                 config: Any, training: Any) -> None:
    """
    Write a network's weights.

    :param path: where to; the folder is made. An existing file is replaced in one step.
    :param module: the network, with its bank of keyframes if it has one; or its state dict.
    :param kind: what it is: 'predictor', 'forward_model'.
    :param config: the dataclass (or dict) that the network was built from.
    :param training: what made it: data hash, seed, steps, scores. Anything JSON can hold.
    """
    state = module if isinstance(module, dict) else module.state_dict()
    if (bank := getattr(module, 'bank', None)) is not None:
        state = {**state, **bank.tensors()}
    values = dict(config) if isinstance(config, Mapping) else asdict(config)
    save_tensors(path, state, {'kind': kind, 'config': values, 'training': training})


def load_weights(path: str | Path,
                 kind: str) -> tuple[dict[str, Any], dict[str, torch.Tensor], dict[str, Any]]:
    """
    Read what save_weights has written, onto the CPU.

    :param path: the file.
    :param kind: what it has to be.
    :return: (configuration dict, state dict, training dict).
    :raises WeightsError: if it is missing, damaged, or of another kind.
    """
    state, about = load_tensors(path)
    if about.get('kind') != kind:
        raise WeightsError(
            f'{escaped(path)}: holds weights of a {escaped(about.get("kind"))}, not of a {kind}; '
            f'give a file of `python -m tap_ros train {kind.partition("_")[0]}`')
    for part in ('config', 'training'):
        if not isinstance(about.get(part), dict):
            raise WeightsError(f'{escaped(path)}: does not say its {part}; train again')
    for name, tensor in state.items():
        if not torch.isfinite(tensor).all():
            raise WeightsError(f'{escaped(path)}: {escaped(name)} holds numbers that are not '
                               'finite; the training has failed, train again')
    if not any(tensor.any() for tensor in state.values()
               if tensor.dim() > 1 and tensor.is_floating_point()):
        raise WeightsError(f'{escaped(path)}: all weights are zero; train again')
    return about['config'], state, about['training']


def make_network(network_class: Callable[[Config], Network], config_class: type[Config],
                 values: Mapping[str, Any], state: Mapping[str, torch.Tensor],
                 path: str | Path) -> Network:
    """
    Make the network of a file, with its weights.

    :param network_class: takes the configuration.
    :param config_class: its dataclass.
    :param values: configuration dict of load_weights; state: its state dict.
    :param path: the file, for messages.
    :return: the network, in float32, on the CPU.
    :raises WeightsError: if the configuration cannot be used, or the weights do not fit it.
    """
    known = {field.name for field in fields(config_class)}  # type: ignore[arg-type]
    unknown, missing = sorted(set(values) - known), sorted(known - set(values))
    if unknown or missing:
        what = f'unknown configuration {listing(unknown)}' if unknown else (
            f'lacks the configuration {listing(missing)}')
        raise WeightsError(f'{escaped(path)}: {what}; known are {", ".join(sorted(known))}. Use '
                           'the tap_ros version that wrote it, or train again')
    try:
        config = config_class(**{
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()})
        with _Unfilled():  # a short file may ask for a network of many gigabytes
            network_class(config).load_state_dict(state)
        network = network_class(config)
        network.load_state_dict(state)
    except TapError as error:
        raise WeightsError(f'{escaped(path)}: {error}') from error
    except (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError,
            ValueError) as error:
        raise WeightsError(f'{escaped(path)}: does not fit its own configuration '
                           f'({escaped(" ".join(str(error).split()), 300)}); {_AGAIN}') from error
    return network


class _Unfilled(TorchFunctionMode):
    """
    Within, nothing is filled or drawn: networks take no memory, but their shapes can be compared.

    Other than on the device 'meta', whose random numbers import sympy, for seconds.
    """

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (),
                           kwargs: Any = None) -> Any:
        if re.fullmatch(r'[a-z]\w*_', func.__name__):  # in place, by PyTorch's convention
            return args[0] if args else None
        return func(*args, **(kwargs or {}))


def save_tensors(path: str | Path, tensors: Mapping[str, torch.Tensor],
                 about: Mapping[str, Any]) -> None:
    """
    Write tensors and a JSON description into one safetensors file, in one step.

    :param path: where to.
    :param tensors: dict of name to tensor.
    :param about: dict that JSON can hold.
    :raises StorageError: when it cannot be written; an existing file is then what it was.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(about, sort_keys=True)
    write_atomically(path, save(tensors, {
        'format': _FORMAT, 'about': text, 'sha256': content_digest(tensors, text)}))


def load_tensors(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """
    Read what save_tensors has written.

    :param path: the file.
    :return: (dict of name to CPU tensor, description dict).
    :raises WeightsError: if it is missing, damaged, changed, or not written by this package.
    """
    tensors, about, _ = _load(path)
    return tensors, about


def stored_digest(path: str | Path) -> str:
    """
    Return the SHA-256 of what a file holds, once it is found to be right.

    :param path: written by save_tensors.
    :return: 64 hexadecimal digits, of tensors and description; the file's own bytes may differ.
    :raises WeightsError: as load_tensors.
    """
    return _load(path)[2]


def _load(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, Any], str]:
    """Return tensors, description and SHA-256 of a file."""
    name = escaped(path)
    try:
        if not os.path.isfile(path):  # a pipe would wait for somebody to write to it
            raise WeightsError(f'{name}: no such weights file; train one with `python -m tap_ros '
                               'train`, or give another .safetensors file')
        if os.path.getsize(path) > _MOST_BYTES:
            raise WeightsError(f'{name}: has more than {_MOST_BYTES >> 30} GiB, as no weights '
                               'have; give another .safetensors file')
        data = Path(path).read_bytes()
    except (OSError, ValueError, MemoryError) as error:
        raise WeightsError(f'{name}: cannot be read: '
                           f'{escaped(getattr(error, "strerror", None) or error)}') from error
    try:
        tensors = load(data)
        header = json.loads(data[8:8 + int.from_bytes(data[:8], 'little')])
        metadata = header.get('__metadata__') or {}
        if metadata.get('format') != _FORMAT or not {'about', 'sha256'} <= set(metadata):
            raise WeightsError(
                f'{name}: written by format {escaped(metadata.get("format"), 40)}, not by '
                f'{_FORMAT}, which holds a SHA-256; train again with this version')
        digest = content_digest(tensors, metadata['about'])
        about = json.loads(metadata['about'])
    except (SafetensorError, ArithmeticError, AssertionError, AttributeError, LookupError,
            MemoryError, RecursionError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f'{name}: damaged, truncated, or no safetensors file '
                           f'({escaped(error)}); {_AGAIN}') from error
    if digest != metadata['sha256']:
        raise WeightsError(f'{name}: damaged: its content has another SHA-256 than was written '
                           f'with it; {_AGAIN}')
    if others := {str(tensor.dtype) for tensor in tensors.values() if tensor.dtype not in _KINDS}:
        raise WeightsError(f'{name}: holds numbers of the kind {listing(sorted(others))}, which '
                           'are not written; train again')
    if not isinstance(about, dict):
        raise WeightsError(f'{name}: does not describe what it holds; train again')
    return tensors, about, digest


def content_digest(tensors: Mapping[str, torch.Tensor], about: str) -> str:
    """Return the SHA-256 of tensors, in the order of their names, and of a description."""
    found = hashlib.sha256()
    for part in (_FORMAT, about):
        found.update(f'{len(part.encode())}:{part}'.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        found.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()
