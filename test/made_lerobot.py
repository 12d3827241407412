# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small LeRobot data sets of several cameras, for tests."""

import json

import cv2
import numpy as np
import pyarrow
from pyarrow import parquet

DATA = 'data/chunk-000/episode_{:06d}.parquet'  # as version 2.1 has it
VIDEO = 'videos/chunk-000/{}/episode_{:06d}.mp4'


def write_set(folder, episodes, fps=10, filmed=False):
    """
    Write a set of version 2.1.

    :param episodes: of each the pictures, (T, H, W, 3) uint8, or the bytes of T files, by camera.
    :param filmed: in videos, else as PNG in the rows.
    """
    kind, first = 'video' if filmed else 'image', 0
    (folder / 'meta').mkdir(parents=True)
    (folder / 'data/chunk-000').mkdir(parents=True)
    (folder / 'meta/info.json').write_text(json.dumps({
        'codebase_version': 'v2.1', 'fps': fps, 'chunks_size': 1000,
        'data_path': 'data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet',
        'video_path':
            'videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4',
        'features': {key: {'dtype': kind, 'shape': [3, 8, 8]} for key in episodes[0]}}))
    with open(folder / 'meta/episodes.jsonl', 'w') as lines:
        for e, cameras in enumerate(episodes):
            index = np.arange(len(next(iter(cameras.values()))))
            lines.write(json.dumps({'episode_index': e, 'length': len(index), 'tasks': ['x']})
                        + '\n')
            cells = {} if filmed else {key: [
                {'bytes': one if isinstance(one, bytes) else png(one), 'path': None}
                for one in pictures] for key, pictures in cameras.items()}
            parquet.write_table(pyarrow.table({
                'timestamp': index / fps, 'index': index + first,
                'episode_index': 0 * index + e, **cells}), folder / DATA.format(e))
            for key, pictures in cameras.items() if filmed else ():
                write_video(folder / VIDEO.format(key, e), pictures, fps)
            first += len(index)
    return folder


def write_video(path, pictures, fps):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'mp4v'), fps,
                             pictures.shape[2:0:-1])
    for one in pictures:
        writer.write(np.ascontiguousarray(one[..., ::-1]))
    writer.release()


def png(picture):
    """Return the file of a picture of colour, or of 16 bits."""
    return cv2.imencode('.png', picture[..., ::-1] if picture.ndim == 3 else picture)[1].tobytes()
