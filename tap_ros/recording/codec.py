# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
CDR, the bytes of ROS 2 messages, to and from Python without ROS.

`encode` and `decode` take one message. `Layout` is for many: it notes where the numbers of one
message lie, and then reads those of all messages that look alike with one numpy view.
"""

import math
import struct

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.recording.schemas import fields, PRIMITIVES

HEADER = b'\x00\x01\x00\x00'  # encapsulation: plain CDR, little endian
MAX_ELEMENTS = 4096  # of a sequence of texts or of messages
MAX_TEXT = 65536  # bytes
_SCALAR = {'u1': 'B', 'i1': 'b', 'u2': 'H', 'i2': 'h', 'u4': 'I', 'i4': 'i', 'u8': 'Q', 'i8': 'q',
           'f4': 'f', 'f8': 'd'}


def encode(type_name, message):
    """
    Serialize a message.

    :param type_name: for example 'sensor_msgs/msg/JointState'.
    :param message: dict by field name, nested; what is left out is 0, '' or empty.
    :return: bytes with the 4-byte encapsulation header.
    :raises RecordingError: for a field that the type does not have, or an array of a wrong length.
    """
    out = bytearray()
    _encode(type_name, message, out)
    return HEADER + bytes(out)


def decode(type_name, data):
    """
    Read one message.

    :param type_name: for example 'sensor_msgs/msg/JointState'.
    :param data: bytes-like, with the encapsulation header.
    :return: dict by field name, nested; arrays of numbers as numpy arrays.
    :raises RecordingError: when the bytes are not such a message.
    """
    return Layout(type_name, data).read(data)


class Layout:
    """
    Where the values of a message lie, for all messages of the same structure.

    :param type_name: for example 'sensor_msgs/msg/JointState'.
    :param data: bytes of one such message.
    :param skip: name of the last field, when rows are to end where its content begins.
    :param same: names of number fields that have to be equal as well.
    :raises RecordingError: when the bytes are not such a message.
    """

    def __init__(self, type_name, data, skip=None, same=()):
        data = bytes(data)
        self.type_name, self.example = type_name, data
        self.size = len(data)
        self.values = {}  # path -> (offset, dtype, shape); numbers
        self.strings = {}  # path -> text
        self.counts = {}  # path -> length of a sequence
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise RecordingError(
                f'{type_name}: expected plain CDR (first bytes 00 00 or 00 01), '
                f'got {data[:2].hex(" ") or "nothing"}')
        self._order = '<' if data[1] else '>'
        self._static = np.zeros(len(data), bool)
        self._static[:2] = True
        self._end = 4
        try:
            self._visit_struct(type_name, '')
        except (struct.error, UnicodeDecodeError, ValueError) as error:
            raise RecordingError(f'{type_name}: damaged message: {error}') from error
        for path in same:
            offset, dtype, _ = self.values[path]
            self._static[offset:offset + dtype.itemsize] = True
        self.prefix = self.values[skip][0] if skip else len(data)
        self._where = np.flatnonzero(self._static[:self.prefix])
        self._template = np.frombuffer(data, np.uint8)[self._where]
        del self._static

    def matches(self, rows):
        """
        Tell which messages have this structure.

        :param rows: (N, prefix) uint8, the bytes of messages of this size.
        :return: (N,) bool.
        """
        return (rows[:, self._where] == self._template).all(1)

    def column(self, rows, *paths):
        """
        Read numbers of many messages.

        :param rows: (N, prefix) uint8, the bytes of messages that match.
        :param paths: of values of the same kind; several are stacked along a new last axis.
        :return: (N,) or (N, len(paths)), with the shape of an array value behind.
        """
        found = [self._column(rows, *self.values[path]) for path in paths]
        return found[0] if len(found) == 1 else np.stack(found, 1)

    def stamps(self, rows, path='header.stamp'):
        """
        Read time stamps of many messages.

        :return: (N,) int64 nanoseconds.
        """
        seconds = self.column(rows, f'{path}.sec').astype(np.int64)
        return seconds * 10**9 + self.column(rows, f'{path}.nanosec')

    def read(self, data):
        """Return one message of this structure as a nested dict."""
        row = np.frombuffer(data, np.uint8)[None]
        flat = {path: self._column(row, *value)[0] for path, value in self.values.items()}
        return self._build(self.type_name, '', flat)

    @staticmethod
    def _column(rows, offset, dtype, shape):
        size = dtype.itemsize * math.prod(shape)
        part = np.ascontiguousarray(rows[:, offset:offset + size])
        return part.view(dtype).reshape(len(rows), *shape) if size else np.empty(
            (len(rows), *shape), dtype)

    def _build(self, type_name, path, flat):
        """Put values and strings into nested dicts."""
        message = {}
        for name, base, count in fields(type_name):
            here = f'{path}{name}'
            if base in PRIMITIVES:
                message[name] = flat[here] if count is not None else flat[here].item()
            elif count is None:
                message[name] = self._build_one(base, here, flat)
            else:
                n = self.counts[here] if count == -1 else count
                message[name] = [self._build_one(base, f'{here}[{i}]', flat) for i in range(n)]
        return message

    def _build_one(self, base, here, flat):
        return self.strings[here] if base == 'string' else self._build(base, f'{here}.', flat)

    def _visit_struct(self, type_name, path):
        """Walk over the fields of a message and note where they lie."""
        for name, base, count in fields(type_name):
            here = f'{path}{name}'
            n = self._length(here) if count == -1 else count
            if base in PRIMITIVES:
                self._visit_numbers(here, PRIMITIVES[base], () if n is None else (n,))
            elif n is None:
                self._visit_one(base, here)
            else:
                if n > MAX_ELEMENTS:
                    raise ValueError(
                        f'{here} claims {n} elements; at most {MAX_ELEMENTS} are read')
                for i in range(n):
                    self._visit_one(base, f'{here}[{i}]')

    def _visit_one(self, base, here):
        if base == 'string':
            start = self._end_of_length(size := self._length(here))
            if size > MAX_TEXT:
                raise ValueError(f'{here} has {size} bytes; at most {MAX_TEXT} are read')
            self._static[start:start + size] = True
            self.strings[here] = self.example[start:start + max(size - 1, 0)].decode()
        else:
            self._visit_struct(base, f'{here}.')

    def _length(self, here):
        """Read the length of a string or sequence; it is part of the structure."""
        start = self._align(4)
        (n,) = struct.unpack_from(self._order + 'I', self.example, start)
        self._end = start + 4
        self.counts[here] = n
        self._static[start:start + 4] = True
        return n

    def _end_of_length(self, size):
        start = self._end
        self._end += size
        if self._end > len(self.example):
            raise ValueError(f'a string of {size} bytes ends behind the message')
        return start

    def _visit_numbers(self, here, kind, shape):
        dtype = np.dtype(self._order + kind)
        if shape == (0,):  # CDR aligns for elements only when there are some
            self.values[here] = (self._end, dtype, shape)
            return
        start = self._align(dtype.itemsize)
        self._end = start + dtype.itemsize * (shape[0] if shape else 1)
        if self._end > len(self.example):
            raise ValueError(f'{here} ends at byte {self._end} of {len(self.example)}')
        self.values[here] = (start, dtype, shape)

    def _align(self, size):
        return self._end + (4 - self._end) % size


def _encode(type_name, message, out):
    known = fields(type_name)
    unknown = set(message) - {name for name, _, _ in known}
    if unknown:
        raise RecordingError(
            f'{type_name} has no field {", ".join(sorted(unknown))}; '
            f'it has {", ".join(name for name, _, _ in known)}')
    for name, base, count in known:
        value = message.get(name)
        if count is None:
            _encode_one(base, value, out)
            continue
        value = () if value is None and count == -1 else value
        if base in PRIMITIVES:
            _encode_numbers(f'{type_name}.{name}', PRIMITIVES[base], count, value, out)
            continue
        value = [None] * count if value is None else value
        if count == -1:
            _pack('I', len(value), out)
        elif len(value) != count:
            raise RecordingError(f'{type_name}.{name}: expected {count} values, got {len(value)}')
        for element in value:
            _encode_one(base, element, out)


def _encode_one(base, value, out):
    if base == 'string':
        text = (value or '').encode() + b'\0'
        _pack('I', len(text), out)
        out += text
    elif base in PRIMITIVES:
        _pack(_SCALAR[PRIMITIVES[base]], value or 0, out)
    else:
        _encode(base, value or {}, out)


def _encode_numbers(name, kind, count, value, out):
    if isinstance(value, (bytes, bytearray, memoryview)):
        array = np.frombuffer(value, np.uint8)
    else:
        array = np.zeros(count) if value is None else np.asarray(value)
    array = np.ascontiguousarray(array, '<' + kind).reshape(-1)
    if count == -1:
        _pack('I', array.size, out)
    elif array.size != count:
        raise RecordingError(f'{name}: expected {count} values, got {array.size}')
    if array.size:
        out += bytes(-len(out) % array.itemsize)
        out += array.tobytes()


def _pack(code, value, out):
    out += bytes(-len(out) % struct.calcsize(code))
    out += struct.pack('<' + code, value)
