# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read TFRecord files of tf.train.Example messages, without TensorFlow."""

from collections.abc import Iterator
from pathlib import Path
import struct
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
import google_crc32c
import numpy as np
from tap_ros.errors import RecordingError

_REMEDY = 'fetch the file again or leave it out'


def read_records(path: str | Path) -> Iterator[bytes]:
    """
    Yield the records of a TFRecord file, each checked against its CRC.

    :param path: of the file, not compressed.
    :return: generator of bytes.
    :raises RecordingError: at the first record that is cut off or damaged; the message names it,
        counted from 0.
    """
    try:
        with open(path, 'rb') as stream:
            number = 0
            while head := stream.read(12):
                where = f'{path}: record {number}'
                if len(head) < 12:
                    raise RecordingError(f'{where} is cut off; {_REMEDY}')
                if _masked_crc(head[:8]) != struct.unpack_from('<I', head, 8)[0]:
                    raise RecordingError(
                        f'{where} is damaged, or this is no uncompressed TFRecord file; {_REMEDY}')
                length = struct.unpack_from('<Q', head)[0]
                data, tail = stream.read(length), stream.read(4)
                if len(data) + len(tail) < length + 4:
                    raise RecordingError(f'{where} is cut off; {_REMEDY}')
                if _masked_crc(data) != struct.unpack('<I', tail)[0]:
                    raise RecordingError(f'{where} is damaged: its CRC does not match; {_REMEDY}')
                yield data
                number += 1
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error


def parse_example(data: bytes) -> dict[str, list[bytes] | np.ndarray]:
    """
    Decode one tf.train.Example (or the context of a tf.train.SequenceExample).

    :param data: bytes of the message.
    :return: dict from names to lists of bytes, float32 arrays or int64 arrays.
    :raises RecordingError: when the bytes are no such message.
    """
    try:
        example = _Example.FromString(data)
    except message.DecodeError as error:
        raise RecordingError('holds no tf.train.Example') from error
    features = {}
    for name, feature in example.features.feature.items():
        kind = feature.WhichOneof('kind')
        values = getattr(feature, kind).value if kind else []
        dtype = {'float_list': np.float32, 'int64_list': np.int64}.get(kind)
        features[name] = np.array(values, dtype) if dtype else list(values)
    return features


def _masked_crc(data: bytes) -> int:
    """Return the CRC-32C as TFRecord files store it."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xa282ead8) & 0xffffffff


def _example_class() -> Any:
    """Declare the messages of tensorflow/core/example/{example,feature}.proto."""
    file = descriptor_pb2.FileDescriptorProto(
        name='tap_ros/example.proto', package='tap_ros', syntax='proto3')
    kinds = {'bytes_list': ('BytesList', 'TYPE_BYTES'), 'float_list': ('FloatList', 'TYPE_FLOAT'),
             'int64_list': ('Int64List', 'TYPE_INT64')}
    for name, kind in kinds.values():
        file.message_type.add(name=name).field.add(
            name='value', number=1, type=kind, label='LABEL_REPEATED')
    feature = file.message_type.add(name='Feature')
    feature.oneof_decl.add(name='kind')
    for number, (field, (name, _)) in enumerate(kinds.items(), 1):
        _add_message(feature, field, number, name, oneof_index=0)
    features = file.message_type.add(name='Features')
    entry = features.nested_type.add(name='FeatureEntry')
    entry.options.map_entry = True
    entry.field.add(name='key', number=1, type='TYPE_STRING', label='LABEL_OPTIONAL')
    _add_message(entry, 'value', 2, 'Feature')
    _add_message(features, 'feature', 1, 'Features.FeatureEntry', label='LABEL_REPEATED')
    _add_message(file.message_type.add(name='Example'), 'features', 1, 'Features')
    pool = descriptor_pool.DescriptorPool()  # its own, so that TensorFlow may be loaded beside it
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName('tap_ros.Example'))


def _add_message(owner: descriptor_pb2.DescriptorProto, name: str, number: int, kind: str,
                 label: str = 'LABEL_OPTIONAL', **options: Any) -> None:
    """Add a field that holds a message."""
    owner.field.add(name=name, number=number, type='TYPE_MESSAGE', label=label,
                    type_name=f'.tap_ros.{kind}', **options)


_Example = _example_class()
