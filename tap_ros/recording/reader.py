# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings once, episode by episode, without a cache."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path

import numpy as np
from tap_ros.recording.align import assemble, runs_of
from tap_ros.recording.bags import check_sizes, find_bags, warn_of_damage
from tap_ros.recording.columns import Columns, decode_file
from tap_ros.recording.episode import Episode
from tap_ros.recording.metadata import read_mount
from tap_ros.recording.reading import AS_RECORDED, for_bags, Reading
from tap_ros.recording.topic_choice import find_topics


def iter_episodes(path: str | Path, reading: Reading = AS_RECORDED) -> Iterator[Episode]:
    """
    Yield the episodes of a recording; one bag is in memory at a time.

    :param path: .mcap file, bag folder, or folder of bag folders.
    :param reading: Reading: which pictures, which part of them, and where episodes are cut.
    :return: iterator over Episode.
    :raises RecordingError: when the recording is missing, empty, damaged or lacks the image topic.
    """
    bags = find_bags(path)
    cutting = for_bags(reading, len(bags))
    for files, camera in product(bags, reading.cameras):
        found, arm = find_topics(files, camera), read_mount(files[0].parent)
        parts = [_decode(file, found, reading) for file in files]
        check_sizes(parts)
        for run in runs_of(parts):
            table = assemble(run, arm, cutting)
            for i in range(len(table)):
                yield table.episode(i)


def _decode(file: Path, found: Mapping[str, str], reading: Reading) -> Columns:
    """Return the Columns of a file, pictures in memory."""
    pieces: defaultdict[str, list[bytes]] = defaultdict(list)
    part = decode_file(file, found, lambda name, pixels: pieces[name].append(pixels.tobytes()),
                       pieces.clear, reading)
    part.pictures = {name: np.frombuffer(b''.join(pieces[name]), np.uint8).reshape(shape)
                     for name, shape in part.shapes.items()}
    warn_of_damage(part)
    return part
