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
    makers = list(_nonsense())
    path = tmp_path / 'nonsense.safetensors'
    step = max(1, len(makers) // trials.count)
    with Reader() as reader:
        for trial in trials:
            what, source, change = makers[trial * step % len(makers)]
            path.write_bytes(_changed(source, change))
            with trials.one():
                found = reader.read('weights' if source == FORWARD_MODEL else 'predictor', path)
                trials.measured(found['seconds'])
                assert found['error'] is not None, f'{what}: accepted'
                assert_refused(found, path.name)


def _nonsense():
    """Yield a name, a weights file, and how its header (a dict) and numbers (bytes) change."""
    def about(value):
        def change(header, numbers):
            header['__metadata__']['about'] = value
            return numbers
        return change

    def field(name, value, inside=None):
        def change(header, numbers):
            fields = json.loads(header['__metadata__']['about'])
            target = fields if inside is None else fields[inside]
            target.pop(name, None)
            if value is not ...:
                target[name] = value
            header['__metadata__']['about'] = json.dumps(fields)
            return numbers
        return change

    def no_metadata(header, numbers):
        header.pop('__metadata__')
        return numbers

    for source in (FORWARD_MODEL, PREDICTOR):
        yield 'zero weights', source, lambda header, numbers: bytes(len(numbers))
        yield 'infinite weights', source, lambda header, numbers: b'\x00\x00\x80\x7f' * (
            len(numbers) // 4) + bytes(len(numbers) % 4)
        yield 'no description', source, no_metadata
        for value in ('', 'null', '7', '[]', '{', '{}', '"x"', '[' * 100_000):
            yield f'about: {value[:9]}', source, about(value)
        for name in ('config', 'training', 'kind'):
            for value in (..., None, 7, [], 'x\n\x1b[31m'):
                yield f'{name}: {value}', source, field(name, value)
        for name, value in (('image_size', 0), ('image_size', -1), ('image_size', 10**9),
                            ('width', 10**9), ('image_size', 'x'), ('width', None),
                            ('x\n\x1b[31m', 1)):
            yield f'{name}: {value}', source, field(name, value, 'config')
    for value in (float('nan'), 1e30):
        yield f'flow_scale: {value}', PREDICTOR, field('flow_scale', value, 'config')


def _changed(source, change):
    """Return a weights file with another header or other numbers, and the hash of these."""
    data = source.read_bytes()
    length, = struct.unpack('<Q', data[:8])
    header = json.loads(data[8:8 + length])
    numbers = change(header, data[8 + length:])
    about = header.get('__metadata__', {}).get('about')
    if about is not None:  # so that it is the nonsense that is refused, and not the hash
        header['__metadata__']['sha256'] = content_digest(load(_pack(header, numbers)), about)
    return _pack(header, numbers)


def _pack(header, numbers):
    packed = json.dumps(header).encode()
    packed += b' ' * (-len(packed) % 8)
    return struct.pack('<Q', len(packed)) + packed + numbers
