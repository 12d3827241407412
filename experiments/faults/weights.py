# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of weights files: other numbers are never computed with; each refusal is one line."""

import json
import struct

from experiments.faults.children import Reader
from experiments.faults.fault import Fault
from experiments.faults.recordings import one_line
from safetensors.torch import load
from tap_ros.training.weights import content_digest
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL, PREDICTORS


def flips(job):
    """Load weights with one bit flipped."""
    whole = FORWARD_MODEL.read_bytes()
    header = struct.unpack('<Q', whole[:8])[0] + 8
    path = job.folder / 'flipped.safetensors'
    with Reader() as reader:
        right = reader.read('weights', FORWARD_MODEL)['content']
        for trial in job.trials():
            # Every tenth in the description, which is a small part of the file.
            at = int(job.random.integers(header if trial % 10 == 0 else len(whole)))
            data = bytearray(whole)
            data[at] ^= 1 << int(job.random.integers(8))
            path.write_bytes(data)
            found = reader.read('weights', path)
            why = _refusal(found, path.name)
            if found['error'] is None:
                why = '' if found['content'] == right else 'other weights were accepted'
            job.record(not why, why, found['seconds'])


def nonsense(job):
    """Load weights whose description or numbers are nonsense."""
    makers = list(_nonsense())
    path = job.folder / 'nonsense.safetensors'
    with Reader() as reader:
        for trial in job.trials():
            what, source, change = makers[trial % len(makers)]
            path.write_bytes(_changed(source, change))
            found = reader.read('weights' if source == FORWARD_MODEL else 'predictor', path)
            why = _refusal(found, path.name)
            job.record(not why, f'{what}: {why}', found['seconds'])


def _nonsense():
    """Yield a name, a weights file, and how its header (a dict) and numbers (bytes) change."""
    def about(value):
        def change(header, numbers):
            header['__metadata__']['about'] = value
            return numbers
        return change

    def field(name, value):
        def change(header, numbers):
            fields = json.loads(header['__metadata__']['about'])
            fields.pop(name, None)
            if value is not ...:
                fields[name] = value
            header['__metadata__']['about'] = json.dumps(fields)
            return numbers
        return change

    def setting(name, value):
        def change(header, numbers):
            fields = json.loads(header['__metadata__']['about'])
            fields['config'][name] = value
            header['__metadata__']['about'] = json.dumps(fields)
            return numbers
        return change

    def no_metadata(header, numbers):
        header.pop('__metadata__')
        return numbers

    for source in (FORWARD_MODEL, PREDICTORS[DEFAULT_PREDICTOR]):
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
            yield f'{name}: {value}', source, setting(name, value)
    yield 'flow_scale: NaN', PREDICTORS[DEFAULT_PREDICTOR], setting('flow_scale', float('nan'))
    yield 'flow_scale: 1e30', PREDICTORS[DEFAULT_PREDICTOR], setting('flow_scale', 1e30)


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


def _refusal(found, name):
    """Say why an answer is no clear refusal."""
    if found['error'] is None:
        return 'accepted'
    if not found['expected']:
        return f'{found["kind"]}: {found["error"]}'
    return one_line(found['error'], name)


FAULTS = [
    Fault('weights-flips', 'one bit of a weights file flipped', 'A bad disk or download changed '
          'the weights. A planner or predictor that computes with them would push objects to '
          'wrong places.', 'Refused in one line, or what is computed with is the same to the bit.',
          5000, 0.03, flips, 'to load it', 's'),
    Fault('weights-nonsense', 'nonsense in a weights file', 'A file of another program or '
          'version, an edited one, or one whose training went wrong.', 'Refused in one line '
          'that names the file.', 160, 0.15, nonsense, 'to refuse it', 's')]
