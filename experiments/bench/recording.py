# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How fast recordings are decoded, side by side with the usual libraries, in one run.

    python -m tap_ros bench recording

Every contender reads the same files, which were read once before. Ours does more than the others:
it also checks checksums, hashes the file, cuts and aligns the episodes, and writes the cache. On a
machine that is busy otherwise, the frames per second of processor time say more than those by the
clock; ours uses all cores, so that the two differ.
"""

from dataclasses import dataclass
from pathlib import Path
import resource
import tempfile
import time

from mcap.reader import make_reader
import numpy as np
from tap_ros.messages.topics import IMAGE, TOPICS
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.recording.messages import typestore
from tap_ros.recording.writer import EpisodeWriter

DECODED = frozenset(topic.recorded for topic in TOPICS if topic.becomes)


def measure(episodes=400, files=4, repeats=3, image_size=64):
    """
    Measure frames per second of all contenders on a raw and on a compressed recording.

    :param episodes: how many, of 41 frames.
    :param files: number of files that they are spread over.
    :param repeats: the best time of so many counts; contenders take turns.
    :param image_size: of the frames.
    :return: dict compression -> dict contender -> (frames per second by the clock, and of
        processor time).
    """
    contenders = _contenders()
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for compression in ('none', 'zstd'):
            paths, frames = _write(folder, compression, episodes, files, image_size)
            best = {name: np.full(2, np.inf) for name in contenders}
            for _ in range(repeats):
                for name, contender in contenders.items():
                    with tempfile.TemporaryDirectory(dir=folder) as scratch:
                        start = _clocks()
                        seen = contender(paths, scratch)
                        best[name] = np.minimum(best[name], _clocks() - start)
                    if seen != frames:
                        raise RuntimeError(f'{name} saw {seen} of {frames} frames')
            results[compression] = {name: tuple(frames / best[name]) for name in contenders}
    return results


def _clocks():
    """Return the time by the clock, and of processors in this process and those it started."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return np.array([time.perf_counter(), sum(one.ru_utime + one.ru_stime for one in used)])


def _contenders():
    """Return dict name -> function(paths, scratch folder) -> number of frames."""
    return {
        'mcap + rosbags CDR, images only': lambda p, _: _read_rosbags(p, {IMAGE.recorded}),
        'mcap + rosbags CDR, what we decode': lambda p, _: _read_rosbags(p, DECODED),
        'tap_ros cache, new': lambda p, scratch: _build_cache(p, scratch),
    }


def _write(folder, compression, episodes, files, image_size):
    """Write the files to be read; return their paths and the number of frames."""
    paths, frames = [], 0
    for number in range(files):
        paths.append(folder / f'{compression}_{number}.mcap')
        with EpisodeWriter(paths[-1], compression) as writer:
            for seed in range(number, episodes, files):
                episode = _make_episode(seed, image_size)
                writer.write(episode)
                frames += len(episode)
    return paths, frames


def _make_episode(seed, size, T=41, K=2):
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


def _read_rosbags(paths, wanted):
    """Read with mcap's reader, decode with rosbags' type store, copy the pixels out."""
    frames = 0
    for path in paths:
        images = []
        with open(path, 'rb') as stream:
            for schema, channel, message in make_reader(stream).iter_messages(
                    topics=sorted(wanted), log_time_order=False):
                value = typestore().deserialize_cdr(message.data, schema.name)
                if channel.topic == IMAGE.recorded:
                    images.append(value.data.reshape(value.height, value.width, 3))
        frames += len(np.stack(images))
    return frames


def _build_cache(paths, scratch):
    """Open the files with an empty cache."""
    return open_recordings(paths, scratch, progress=False).num_frames


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
    """Print a table of frames per second, and how much faster ours is."""
    results = measure(args.episodes, args.files, args.repeats)
    print(f'{"frames per second":44}{"by the clock":^24}{"of processor time":^24}')
    print(f'{"":44}{"raw":>12}{"zstd":>12}{"raw":>12}{"zstd":>12}')
    for name in results['none']:
        raw, packed = results['none'][name], results['zstd'][name]
        print(f'{name:44}{raw[0]:12,.0f}{packed[0]:12,.0f}{raw[1]:12,.0f}{packed[1]:12,.0f}')
    ours = list(results['none'])[-1]
    for name in list(results['none'])[:-1]:
        ratios = [results[c][ours][i] / results[c][name][i] for i in (0, 1) for c in results]
        print(f'{"ours / " + name:44}' + ''.join(f'{ratio:12.2f}' for ratio in ratios))
