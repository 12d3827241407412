# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How fast recordings are opened for the first time, side by side with the usual libraries.

Every contender reads the same files, which were read once before. Ours does more than the others:
it also checks checksums, hashes the file, cuts and aligns the episodes, and writes the cache.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import subprocess
import sys
import tempfile
import time

import cv2
from experiments.bench.rows import Row
from mcap.reader import make_reader
import numpy as np
from tap_ros.messages.topics import COMPRESSED_TYPE, IMAGE, TOPICS
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.recording.file_writer import BagWriter
from tap_ros.recording.messages import encode, typestore
from tap_ros.recording.writer import EpisodeWriter

DECODED = frozenset(topic.recorded for topic in TOPICS if topic.becomes)
JPEG_FRAMES, JPEG_SIZE, JPEG_AIM_S = 1300, (192, 320), 10  # of a bag of another camera


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param episodes: how many.
    :param files: that they are spread over.
    :param repeats: the best of so many counts.
    """

    episodes: int = 400
    files: int = 4
    repeats: int = 3


def run(args):
    """Count frames per second, and time how long a bag of JPEG pictures takes to open."""
    with tempfile.TemporaryDirectory() as folder:
        for compression in ('none', 'zstd'):
            paths, frames = write_files(Path(folder), compression, args.episodes, args.files)
            best = dict.fromkeys((build_cache, _read_rosbags), np.inf)
            for _ in range(args.repeats):
                for contender in best:
                    with tempfile.TemporaryDirectory(dir=folder) as scratch:
                        begin = time.perf_counter()
                        seen = contender(paths, scratch)
                        best[contender] = min(best[contender], time.perf_counter() - begin)
                    if seen != frames:
                        raise RuntimeError(f'{contender.__name__} saw {seen} of {frames} frames')
            ours, theirs = best.values()
            yield Row(
                f'open a recording of 64 px, compression {compression}, first time',
                f'{frames / ours:,.0f} frames/s', theirs / ours,
                'the rate of mcap and rosbags alone')
        yield _open_pictures(Path(folder) / 'jpeg')


def _open_pictures(folder):
    """Return the row of opening a bag of JPEG pictures while another process computes."""
    pictures = [cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].ravel()
                for picture in _camera(JPEG_FRAMES, *JPEG_SIZE)]
    with BagWriter(folder) as writer:
        for number, data in enumerate(pictures):
            nanoseconds = (number + 1) * 10**8
            stamp = {'sec': nanoseconds // 10**9, 'nanosec': nanoseconds % 10**9}
            writer.write_raw('/camera/image_raw/compressed', COMPRESSED_TYPE, encode(
                COMPRESSED_TYPE, {'header': {'stamp': stamp}, 'format': 'jpeg', 'data': data}),
                nanoseconds)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch, beside(1):
        begin = time.perf_counter()
        with ThreadPoolExecutor() as pool:
            list(pool.map(lambda data: cv2.imdecode(data, cv2.IMREAD_COLOR), pictures))
        alone = time.perf_counter() - begin
        begin = time.perf_counter()
        frames = open_recordings(folder, scratch, progress=False).num_frames
        seconds = time.perf_counter() - begin
    return Row(f'open {frames} JPEG frames of 320 x 192 beside another job', f'{seconds:.1f} s',
               seconds / alone, 'decoding alone, in threads', f'at most {JPEG_AIM_S} s',
               seconds <= JPEG_AIM_S and frames == JPEG_FRAMES,
               f'decoding {alone / seconds:.0%}')


@contextmanager
def beside(count):
    """Let so many processes compute, each on one core, as long as the with-block lasts."""
    others = [subprocess.Popen([sys.executable, '-S', '-c', 'while True: pass'])
              for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def _camera(count, height, width):
    """Return pictures (count, height, width, 3) of a grainy table, and a disc that moves."""
    random = np.random.default_rng(0)
    table = random.normal(120, 20, (height // 8, width // 8, 3)).clip(0, 255).astype(np.uint8)
    table = cv2.resize(table, (width, height), interpolation=cv2.INTER_CUBIC)
    pictures = np.repeat(table[None], count, 0)
    for number, picture in enumerate(pictures):
        cv2.circle(picture, (number % width, height // 2), 12, (40, 60, 220), -1)
    return pictures


def write_files(folder, compression, episodes, files):
    """Write the files to be read; return their paths and the number of frames."""
    paths, frames = [], 0
    for number in range(files):
        paths.append(folder / f'{compression}_{number}.mcap')
        with EpisodeWriter(paths[-1], compression) as writer:
            for seed in range(number, episodes, files):
                episode = make_episode(seed)
                writer.write(episode)
                frames += len(episode)
    return paths, frames


def make_episode(seed, size=64, T=41, K=2):
    """Make up an episode: a lit table with a grain, and two patches that move."""
    random = np.random.default_rng(seed)
    table = np.linspace(60, 180, size)[:, None, None] + np.linspace(0, 30, size)[:, None]
    frames = np.repeat((table + random.normal(0, 1.5, (size, size, 3)))[None], T, 0)
    patch = max(size // 5, 1)
    pixels = random.uniform(0, size - patch, (T, K, 2)).astype(np.float32)
    for t in range(T):
        for u, v in pixels[t].astype(int):
            frames[t, v:v + patch, u:u + patch] = random.uniform(0, 255, 3)
    actions = random.uniform(-0.08, 0.08, (T, 4)).astype(np.float32)
    actions[-1] = 0
    frames = frames.clip(0, 255).astype(np.uint8)
    return Episode(
        frames=frames, stamps=(seed * 60 + 1) * 10**9 + np.arange(T) * 250_000_000,
        actions=actions, grippers=random.uniform(-0.4, 0.4, (T, 4)).astype(np.float32),
        object_names=tuple(f'object_{k}' for k in range(K)), object_pixels=pixels,
        object_poses=random.normal(size=(T, K, 7)), goal_frame=frames[-1],
        goal_pixels=pixels[-1], goal_poses=random.normal(size=(K, 7)),
        object_source='ground_truth', task='push2', seed=seed, outcome='success')


def _read_rosbags(paths, _):
    """Read with mcap's reader, decode what we do with rosbags, copy the pixels out."""
    frames = 0
    for path in paths:
        images = []
        with open(path, 'rb') as stream:
            for schema, channel, message in make_reader(stream).iter_messages(
                    topics=sorted(DECODED), log_time_order=False):
                value = typestore().deserialize_cdr(message.data, schema.name)
                if channel.topic == IMAGE.recorded:
                    images.append(value.data.reshape(value.height, value.width, 3))
        frames += len(np.stack(images))
    return frames


def build_cache(paths, scratch):
    """Open the files with an empty cache."""
    return open_recordings(paths, scratch, progress=False).num_frames
