# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Weights files: safetensors with the network's configuration as JSON inside.

No pickle is ever read or written. A file appears under its name only when it is complete.
"""

from dataclasses import asdict, fields, is_dataclass
import json
import os
from pathlib import Path
import tempfile

from safetensors import safe_open, SafetensorError
from safetensors.torch import save_file
from tap_ros.errors import WeightsError

_FORMAT = 'tap_ros 1'


def save_weights(path, module, kind, config, training):
    """
    Write a network's weights.

    :param path: where to; the folder is made. An existing file is replaced in one step.
    :param module: the network, or its state dict.
    :param kind: what it is: 'predictor', 'forward_model'.
    :param config: the dataclass (or dict) that the network was built from.
    :param training: what made it: data hash, seed, steps, scores. Anything JSON can hold.
    """
    state = module if isinstance(module, dict) else module.state_dict()
    config = asdict(config) if is_dataclass(config) else dict(config)
    save_tensors(path, state, {'kind': kind, 'config': config, 'training': training})


def load_weights(path, kind):
    """
    Read what save_weights has written, onto the CPU.

    :param path: the file.
    :param kind: what it has to be.
    :return: (configuration dict, state dict, training dict).
    :raises WeightsError: if it is missing, damaged, or of another kind.
    """
    state, about = load_tensors(path)
    if about.get('kind') != kind:
        raise WeightsError(f'{path}: holds weights of a {about.get("kind")}, not of a {kind}; '
                           f'give the file that was trained with --model {kind}')
    return about['config'], state, about['training']


def make_config(config_class, values, path):
    """
    Turn the configuration found in a file back into its dataclass.

    :param config_class: the dataclass.
    :param values: the dict of load_weights.
    :param path: the file, for the message.
    :return: the dataclass.
    :raises WeightsError: for a key that this version does not know.
    """
    known = {field.name for field in fields(config_class)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise WeightsError(f'{path}: unknown configuration {", ".join(unknown)}; known are '
                           f'{", ".join(sorted(known))}. Use the tap_ros version that wrote it, '
                           'or train again')
    return config_class(**values)


def load_into(module, state, path):
    """
    Put weights into a network.

    :param module: the network.
    :param state: the state dict of load_weights.
    :param path: the file, for the message.
    :raises WeightsError: if names or sizes do not fit.
    """
    wanted = module.state_dict()
    missing = sorted(set(wanted) - set(state))
    unknown = sorted(set(state) - set(wanted))
    if missing or unknown:
        raise WeightsError(f'{path}: does not fit its own configuration; '
                           f'missing {missing[:3]}, unknown {unknown[:3]}. Train again')
    for name, tensor in wanted.items():
        if tensor.shape != state[name].shape:
            raise WeightsError(
                f'{path}: {name} has size {tuple(state[name].shape)}, the configuration wants '
                f'{tuple(tensor.shape)}. Use weights made for this image size and width')
    module.load_state_dict(state)


def save_tensors(path, tensors, about):
    """
    Write tensors and a JSON description into one safetensors file, in one step.

    :param path: where to.
    :param tensors: dict of name to tensor.
    :param about: dict that JSON can hold.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {'format': _FORMAT, 'about': json.dumps(about, sort_keys=True)}
    handle, part = tempfile.mkstemp(prefix=f'{path.name}.', suffix='.part', dir=path.parent)
    os.close(handle)
    try:
        save_file(tensors, part, metadata)
        os.chmod(part, 0o644)
        with open(part, 'rb') as written:
            os.fsync(written.fileno())
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


def load_tensors(path):
    """
    Read what save_tensors has written.

    :param path: the file.
    :return: (dict of name to CPU tensor, description dict).
    :raises WeightsError: if it is missing, damaged, or not written by this package.
    """
    if not Path(path).is_file():
        raise WeightsError(f'{path}: no such weights file; train one with '
                           '`python -m tap_ros train`, or correct the path')
    try:
        with safe_open(path, 'pt', device='cpu') as stored:
            metadata = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}
    except SafetensorError as error:
        raise WeightsError(f'{path}: damaged, truncated, or no safetensors file ({error}); '
                           'copy it again, or train again') from error
    if metadata.get('format') != _FORMAT or 'about' not in metadata:
        raise WeightsError(f'{path}: written by format {metadata.get("format")!r}, not by '
                           f'{_FORMAT!r}; train again with this version')
    return tensors, json.loads(metadata['about'])
