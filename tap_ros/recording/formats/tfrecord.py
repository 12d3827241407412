# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import episodes from TFRecord files, without TensorFlow: RLDS data sets, and BAIR robot pushing.

A record is an episode. Its pictures are the feature steps/observation/NAME, as RLDS data sets of
Open X-Embodiment have it, or 0/NAME/encoded, 1/NAME/encoded and so on, as BAIR has them. Pictures,
the instruction and, as signals, floats are taken; times are nominal, as records do not tell them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import count, islice
import math
import os
from pathlib import Path
import re
import struct
from typing import Any

from google.protobuf.empty_pb2 import Empty  # type: ignore[import-untyped]
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from google.protobuf.unknown_fields import UnknownFieldSet  # type: ignore[import-untyped]
import google_crc32c
import numpy as np
from tap_ros.base.contract import MOST_SIGNALS
from tap_ros.base.errors import ConfigError, ImageError, RecordingError
from tap_ros.base.text import counted, escaped, listing
from tap_ros.images.encodings import decompress
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.other_cameras import other_cameras, print_views
from tap_ros.recording.formats.pictures import (
    decoded,
    FILES,
    find_files,
    make_episode,
    Options,
    print_signals,
    signal_fields,
    Skipped,
    write_bag,
)
from tap_ros.recording.formats.videos import at_rate
from tap_ros.recording.metadata import natural
from tap_ros.recording.writer import Views

FPS = 5.0  # where nobody says another
_MOST_RECORD = 2**31  # bytes; those of protobuf have fewer


def run(args: Options) -> None:
    """
    Import, and print what was; episodes that the camera has no picture of are left out.

    :raises TapError: for records that cannot be read, and a folder that holds something.
    """
    camera, others = next(iter(args.camera), ''), other_cameras(args.camera)
    blank, skipped, kept = Counter[bool](), Skipped(), dict[str, None]()
    files = find_files(args.paths, ('*.tfrecord*',), skipped)
    for name in _missing(file for file in files if file not in set(map(Path, args.paths))):
        skipped.note('it is not there; fetch it, then import again', 'file', name)

    def show(each: bytes) -> np.ndarray:
        return args.cut.image(_picture(each))

    def episodes() -> Iterator[tuple[Episode, Views]]:
        nonlocal camera
        numbers = count()
        for file in files:
            for record, data in read_records(file, skipped):
                number, place = next(numbers), f'{record} of {escaped(file.name)}'
                with skipped.errors_of('record', place):
                    floats: dict[str, np.ndarray] = {}
                    features = parse_example(data, floats)
                    camera = _choose(features, camera)
                    pictures = _pictures(features, camera)
                    found = ((row / (args.fps or FPS), each) for row, each in enumerate(pictures))
                    frames, times = decoded(at_rate(found, args.rate), _picture, skipped,
                                            f'record {place}')
                    is_blank = _is_blank(frames[0])
                    blank[is_blank] += 1
                    said = features.get('steps/language_instruction') or [args.task.encode()]
                    if not is_blank:
                        rows = np.rint(times * (args.fps or FPS)).astype(int)
                        fields = _signals(floats, len(pictures), rows)
                        kept.update(dict.fromkeys(fields.get('signal_names', ())))
                        yield make_episode(
                            list(map(args.cut.image, frames)), times, **fields,
                            task=said[0].decode(errors='replace'), seed=number), {
                            topic: one.view(partial(_of, features, one.key), rows, show, skipped,
                                            f'record {place}') for topic, one in others.items()}

    print(f'{write_bag(args, episodes(), skipped)} of {escaped(camera)}')
    print_views(others)
    print_signals(kept)
    if blank[True]:
        print(f'left out: {counted(blank[True], "episode")} whose pictures of it are of one '
              'colour')


def _missing(files: Iterable[Path]) -> Iterator[str]:
    """Yield what belongs beside the files of a folder, NAME-00003-of-00008, a line a set."""
    found: dict[tuple[str, str], set[int]] = {}
    for file in files:
        if match := re.fullmatch(r'(.+)-(\d{5})-of-(\d{5})', str(file)):
            found.setdefault((match[1], match[3]), set()).add(int(match[2]))
    for (name, total), numbers in found.items():
        first = list(islice((k for k in range(int(total)) if k not in numbers), 3))
        more = int(total) - sum(k < int(total) for k in numbers) - len(first)
        if first:
            yield ', '.join(f'{escaped(Path(name).name)}-{k:05d}-of-{total}' for k in first) + (
                f' and {more} more' if more else '')


def _choose(features: dict[str, list[bytes]], camera: str) -> str:
    """Return the camera whose pictures are taken, with the number of steps in a batch."""
    names = {match[1] or match[2] for name, value in features.items()
             if (match := re.fullmatch(r'steps/observation/(.+)|0/(.+)/encoded', name))
             and _is_picture(value[0] if value else b'')}
    if camera in names:
        return camera
    first = {}  # picture of each camera, but of depth
    for name in sorted(names):
        with suppress(ImageError):
            first[name] = _picture(_pictures(features, name)[0])
    seen = [name for name, picture in first.items() if not _is_blank(picture)]
    if camera or len(seen) > 1 or not first:
        kind = RecordingError if camera or not first else ConfigError  # others may have it
        raise kind(f'--camera: {escaped(camera)}{"; " * bool(camera)}expected one of '
                   f'{listing(seen or first) or "those with pictures, but there are none"}')
    return (seen or list(first))[0]


def _of(features: dict[str, list[bytes]], camera: str) -> list[bytes]:
    """Return the encoded pictures of a camera that was named; RecordingError if there are none."""
    return _pictures(features, _choose(features, camera))


def _pictures(features: dict[str, list[bytes]], camera: str) -> list[bytes]:
    """Return the encoded pictures of an episode."""
    together = features.get(f'steps/observation/{camera}')
    if together is None:
        together = []
        while one := features.get(f'{len(together)}/{camera}/encoded'):
            together += one
    return list(together)


def _signals(floats: dict[str, np.ndarray], length: int, rows: np.ndarray) -> dict[str, Any]:
    """
    Return the fields of an Episode with the floats of a record.

    :param length: steps in the record.
    :param rows: (T,), of those that are taken.
    """
    parts: dict[str, list[np.ndarray]] = {}
    for name in sorted(floats, key=lambda name: natural(Path(name))):
        if match := re.fullmatch(r'(?:steps|\d+)/(.+)', name):  # BAIR has a feature a step
            parts.setdefault(match[1], []).append(floats[name])
    found, left = dict[str, np.ndarray](), MOST_SIGNALS
    for name, values in sorted(parts.items()):
        value = np.concatenate(values)
        width = len(value) // length
        if 0 < width <= left and width * length == len(value):
            left -= width
            found[name] = value.reshape(length, width)[rows]
    return signal_fields(found)


def _is_picture(data: bytes) -> bool:
    """Return whether bytes are a picture file, or the pixels of a square picture."""
    side = math.isqrt(len(data) // 3)
    return data.startswith(FILES) or side >= 8 and side * side * 3 == len(data)


def _picture(data: bytes) -> np.ndarray:
    """Return a picture, uint8 (H, W, 3)."""
    side = math.isqrt(len(data) // 3)
    if data.startswith(FILES) or side * side * 3 != len(data):
        return decompress(data, 'unknown')
    return np.frombuffer(data, np.uint8).reshape(side, side, 3)


def _is_blank(picture: np.ndarray) -> bool:
    return bool((picture == picture[0, 0]).all())


def read_records(path: Path, skipped: Skipped) -> Iterator[tuple[int, bytes]]:
    """
    Yield the records of a TFRecord file, each checked against its CRC.

    :param path: of the file, not compressed.
    :param skipped: is told of records that are damaged or cut off.
    :return: generator of (number from 0, bytes).
    """
    with skipped.errors_of('file', escaped(path.name)), open(path, 'rb') as stream:
        size, number = os.fstat(stream.fileno()).st_size, 0
        if not size:
            raise RecordingError('it is empty; fetch the file again')
        while head := stream.read(12):
            with skipped.errors_of('record', f'{number} of {escaped(path.name)}'):
                if len(head) < 12:
                    raise RecordingError('it is cut off; fetch the file again')
                length, crc = struct.unpack('<QI', head)
                if _masked_crc(head[:8]) != crc:
                    stream.seek(0, 2)  # nothing tells where the next one begins
                    raise RecordingError('it is damaged, or this is no uncompressed TFRecord '
                                         'file; fetch the file again')
                if length + 4 > size - stream.tell():
                    stream.seek(0, 2)
                    raise RecordingError('it is cut off; fetch the file again')
                if length > _MOST_RECORD:
                    stream.seek(length + 4, 1)
                    raise RecordingError(f'it has more than {_MOST_RECORD} bytes')
                data, tail = stream.read(length), stream.read(4)
                if _masked_crc(data) != int.from_bytes(tail, 'little'):
                    raise RecordingError('it is damaged: its CRC does not match; fetch the file '
                                         'again')
                yield number, data
            number += 1


def parse_example(data: bytes, floats: dict[str, np.ndarray] | None = None,
                  ) -> dict[str, list[bytes]]:
    """
    Decode one tf.train.Example (or the context of a tf.train.SequenceExample).

    :param data: bytes of the message.
    :param floats: gets the features of floats, (N,) float32 each.
    :return: dict from names to lists of bytes; empty lists of features that hold numbers.
    :raises ValueError: when the bytes are no such message.
    """
    found = {}
    for features in _fields(data).get(1, []):
        for entry in map(_fields, _fields(features).get(1, [])):
            kinds, name = [*map(_fields, entry.get(2, []))], str(entry[1][0], 'utf-8')
            found[name], numbers = ([
                value for kind in kinds for one in kind.get(number, [])
                for value in _fields(one).get(1, [])] for number in (1, 2))
            if floats is not None and numbers:  # packed, or one by one
                floats[name] = np.concatenate([
                    np.frombuffer(one if isinstance(one, bytes) else (
                        one & 0xffffffff).to_bytes(4, 'little'), '<f4') for one in numbers])
    return found


def _fields(data: bytes) -> dict[int, list[Any]]:
    """Return the fields of a protobuf message by number: integers, or bytes."""
    found: dict[int, list[Any]] = {}
    try:
        for one in UnknownFieldSet(Empty.FromString(data)):
            found.setdefault(one.field_number, []).append(one.data)
    except DecodeError as error:
        raise ValueError('it holds no tf.train.Example') from error
    return found


def _masked_crc(data: bytes) -> int:
    """Return the CRC-32C as TFRecord files store it."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xa282ead8) & 0xffffffff
