# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read TFRecord files of tf.train.Example messages, without TensorFlow."""

from collections.abc import Iterator
from pathlib import Path
import struct

from google.protobuf import (
    descriptor_pb2,
    descriptor_pool,
    message,
    message_factory,
    text_format,
)
import google_crc32c
import numpy as np
from tap_ros.errors import RecordingError

# The messages of tensorflow/core/example/{example,feature}.proto.
_PROTO = """
name: "tap_ros/example.proto" package: "tap_ros" syntax: "proto3"
message_type { name: "BytesList"
  field { name: "value" number: 1 type: TYPE_BYTES label: LABEL_REPEATED } }
message_type { name: "FloatList"
  field { name: "value" number: 1 type: TYPE_FLOAT label: LABEL_REPEATED } }
message_type { name: "Int64List"
  field { name: "value" number: 1 type: TYPE_INT64 label: LABEL_REPEATED } }
message_type { name: "Feature" oneof_decl { name: "kind" }
  field { name: "bytes_list" number: 1 type_name: ".tap_ros.BytesList" oneof_index: 0 }
  field { name: "float_list" number: 2 type_name: ".tap_ros.FloatList" oneof_index: 0 }
  field { name: "int64_list" number: 3 type_name: ".tap_ros.Int64List" oneof_index: 0 } }
message_type { name: "Features"
  nested_type { name: "FeatureEntry" options { map_entry: true }
    field { name: "key" number: 1 type: TYPE_STRING label: LABEL_OPTIONAL }
    field { name: "value" number: 2 type_name: ".tap_ros.Feature" label: LABEL_OPTIONAL } }
  field { name: "feature" number: 1 type_name: ".tap_ros.Features.FeatureEntry"
          label: LABEL_REPEATED } }
message_type { name: "Example"
  field { name: "features" number: 1 type_name: ".tap_ros.Features" } }
"""
_POOL = descriptor_pool.DescriptorPool()  # its own, so that TensorFlow may be loaded beside it
_POOL.Add(text_format.Parse(_PROTO, descriptor_pb2.FileDescriptorProto()))
_Example = message_factory.GetMessageClass(_POOL.FindMessageTypeByName('tap_ros.Example'))
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
                length, crc = struct.unpack('<QI', head)
                if _masked_crc(head[:8]) != crc:
                    raise RecordingError(
                        f'{where} is damaged, or this is no uncompressed TFRecord file; {_REMEDY}')
                data, tail = stream.read(length), stream.read(4)
                if len(data) + len(tail) < length + 4:
                    raise RecordingError(f'{where} is cut off; {_REMEDY}')
                if _masked_crc(data) != int.from_bytes(tail, 'little'):
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
