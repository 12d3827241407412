# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of weights files: other numbers are never computed with; each refusal is one line."""

import json
import struct

from fault_files import assert_refused, Reader
from fault_report import fault
import numpy as np
from safetensors.torch import load
from tap_ros.training.weights import content_digest
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL, PREDICTORS

PREDICTOR = PREDICTORS[DEFAULT_PREDICTOR]


@fault('one bit of a weights file flipped', 'refused in one line, or what is computed with is the '
       'same to the bit', 5000, 's to load it')
def test_weights_flips(trials, tmp_path):
    random = np.random.default_rng(0)
    whole = FORWARD_MODEL.read_bytes()
    header = struct.unpack('<Q', whole[:8])[0] + 8
    path = tmp_path / 'flipped.safetensors'
    with Reader() as reader:
        right = reader.read('weights', FORWARD_MODEL)['content']
        for trial in trials:
            # Every tenth in the description, which is a small part of the file.
            at = int(random.integers(header if trial % 10 == 0 else len(whole)))
            data = bytearray(whole)
            data[at] ^= 1 << int(random.integers(8))
            path.write_bytes(data)
            with trials.one():
                found = reader.read('weights', path)
                trials.measured(found['seconds'])
                if found['error'] is None:
                    assert found['content'] == right, 'other weights were accepted'
                else:
                    assert_refused(found, path.name)


@fault('nonsense in a weights file', 'refused in one line that names the file', 160,
       's to refuse it')
def test_weights_nonsense(trials, tmp_path):
    spoilt = list(nonsense())
    path = tmp_path / 'nonsense.safetensors'
    step = max(1, len(spoilt) // trials.count)
    with Reader() as reader:
        for trial in trials:
            source, what, value = spoilt[trial * step % len(spoilt)]
            path.write_bytes(spoil(source.read_bytes(), what, value))
            with trials.one():
                found = reader.read('weights' if source == FORWARD_MODEL else 'predictor', path)
                trials.measured(found['seconds'])
                assert found['error'] is not None, f'{what}: {value}: accepted'
                assert_refused(found, path.name)


def nonsense():
    """Yield a weights file, which part of it is spoilt, and what stands there instead."""
    for source in (FORWARD_MODEL, PREDICTOR):
        yield from ((source, 'numbers', value) for value in (b'\0\0\0\0', b'\0\0\x80\x7f'))
        yield from ((source, 'about', value) for value in (
            None, '', 'null', '7', '[]', '{', '{}', '"x"', '[' * 100_000))
        yield from ((source, field, value) for field in ('config', 'training', 'kind')
                    for value in (..., None, 7, [], 'x\n\x1b[31m'))
        yield from ((source, f'config {field}', value) for field, value in (
            ('image_size', 0), ('image_size', -1), ('image_size', 10**9), ('width', 10**9),
            ('image_size', 'x'), ('width', None), ('x\n\x1b[31m', 1)))
    yield from ((PREDICTOR, 'config flow_scale', value) for value in (float('nan'), 1e30))


def spoil(data, what, value):
    """Return a weights file with something else in a part, and the hash of what it has then."""
    length, = struct.unpack('<Q', data[:8])
    header, numbers = json.loads(data[8:8 + length]), data[8 + length:]
    about = header['__metadata__']['about']
    if what == 'numbers':
        numbers = (value * len(numbers))[:len(numbers)]
    elif what == 'about':
        about = value
    else:
        fields = json.loads(about)
        *inside, field = what.split(' ', 1)
        target = fields[inside[0]] if inside else fields
        target.pop(field, None)
        if value is not ...:
            target[field] = value
        about = json.dumps(fields)
    if about is None:
        del header['__metadata__']
    else:  # it is the nonsense that has to be refused, and not the hash
        header['__metadata__']['about'] = about
        header['__metadata__']['sha256'] = content_digest(load(packed(header, numbers)), about)
    return packed(header, numbers)


def packed(header, numbers):
    """Return the bytes of a safetensors file."""
    text = json.dumps(header).encode()
    text += b' ' * (-len(text) % 8)
    return struct.pack('<Q', len(text)) + text + numbers
