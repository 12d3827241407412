# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read recordings once, episode by episode, without a cache."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tap_ros.recording.align import assemble, follows
from tap_ros.recording.bags import check_sizes, find_bags, find_topics, warn_of_damage
from tap_ros.recording.columns import Columns, decode_file
from tap_ros.recording.damage import EVERYTHING
from tap_ros.recording.episode import Episode
from tap_ros.recording.metadata import ArmMount, read_mount
from tap_ros.recording.reading import AS_RECORDED, for_bags, Reading

_NO_EVENT = np.empty(0, np.int64)
_NO_GAP = np.empty((0, 3), np.int64)


def iter_episodes(path: str | Path, reading: Reading = AS_RECORDED) -> Iterator[Episode]:
    """
    Yield the episodes of a recording; at most about one file is in memory at a time.

    :param path: .mcap file, bag folder, or folder of bag folders.
    :param reading: Reading: which pictures, which part of them, and where episodes are cut.
    :return: iterator over Episode.
    :raises RecordingError: when the recording is missing, empty, damaged or lacks the image topic.
    """
    bags = find_bags(path)
    cutting = for_bags(reading, len(bags))
    for files in bags:
        found, arm = find_topics(files, reading.image_topic), read_mount(files[0].parent)
        waiting: list[Columns] = []
        checked: list[Columns] = []
        for file in files:
            part = _decode(file, found, reading)
            checked.append(Columns(part.source, part.image_size, damage=part.damage))
            if part.image_size is not None:
                check_sizes(checked)
            if waiting and not follows(waiting[-1], part):
                yield from _episodes(waiting, arm, cutting)
                waiting = []
            waiting.append(part)
            if _closed(part):
                yield from _episodes(waiting, arm, cutting)
                waiting = _kept(waiting)
        yield from _episodes(waiting, arm, cutting)
        check_sizes(checked)


def _decode(file: Path, found: dict[str, str], reading: Reading) -> Columns:
    """Return the Columns of a file, frames in memory."""
    pieces: list[bytes] = []
    masks: list[bytes] = []

    def restart() -> None:
        pieces.clear()
        masks.clear()

    part = decode_file(file, found, lambda pixels: pieces.append(pixels.tobytes()),
                       lambda mask: masks.append(mask.tobytes()), restart, reading)
    order = part.arrays.pop('frame_order', None)
    if pieces and order is not None and part.image_size is not None:
        frames = np.frombuffer(b''.join(pieces), np.uint8).reshape(-1, *part.image_size, 3)
        part.frames = frames if (np.diff(order) == 1).all() else frames[order]
        part.masks = np.frombuffer(b''.join(masks), np.uint8).reshape(-1, *part.image_size)
    warn_of_damage(part)
    return part


def _episodes(parts: Sequence[Columns], arm: ArmMount, reading: Reading) -> Iterator[Episode]:
    table = assemble(parts, arm, reading)
    for i in range(len(table)):
        yield table.episode(i)


def _closed(part: Columns) -> bool:
    """Tell whether the last mark in a file is the end of an episode, and nothing is lost later."""
    events, gap = part.arrays.get('mark_event', _NO_EVENT), part.arrays.get('gap', _NO_GAP)
    return len(events) > 0 and events[-1] == 1 and not (
        gap[gap[:, 2] == EVERYTHING, 1] >= part.arrays['mark_log'][-1]).any()


def _kept(parts: list[Columns]) -> list[Columns]:
    """Return what later files need to know of those before: their marks, goals and gaps."""
    kept = parts[-1:]
    for key in ('goal_log', 'goal_mask_log', 'goal_object_log', 'gap'):
        last = next((part for part in reversed(parts) if key in part.arrays), None)
        if last is not None and not any(last is part for part in kept):
            kept.insert(0, last)
    kept = [part for part in parts if any(part is other for other in kept)]
    return [
        replace(part, frames=None, masks=None, arrays={
            key: value for key, value in part.arrays.items()
            if key.startswith(('goal_', 'mark_', 'gap'))})
        for part in kept]
