# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros worlds`: foreign bags, and keyframes scored by their truth."""

from dataclasses import dataclass
import json
from pathlib import Path

import cv2
from experiments.pages import render
from experiments.worlds import keyframes
import numpy as np
import pandas as pd
from sim_bridge.collect import BOTTLENECKS_FILE, collect, CollectConfig
from tap_ros.engines import Engine
from tap_ros.errors import ConfigError
from tap_ros.evaluation.intervals import Interval, mean_interval, share_interval
from tap_ros.files import write_atomically
from tap_ros.images.drawing import grid
from tap_ros.options import Flag, Folder
from tap_ros.recording.reader import iter_episodes

TASKS = ('metaworld/coffee-push-v3', 'metaworld/door-open-v3', 'metaworld/peg-insert-side-v3',
         'metaworld/window-open-v3', 'metaworld/drawer-open-v3',
         'metaworld/button-press-topdown-v3', 'ogbench/button', 'ogbench/cube', 'ogbench/drawer',
         'ogbench/window')
HELD_OUT, MARKED = 40, 12  # demonstrations that are scored, the last ones; and marked, the first
SIZE = 64  # px, of the pictures that keyframes are chosen by
STRIPS = 6  # demonstrations that are drawn, of each task


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: world/task each.
    :param episodes: demonstrations of each task.
    :param image_size: width and height in pixels, as recorded.
    :param seed: of the first demonstration.
    :param bags: folder of the bags; what was collected is kept, what was interrupted goes on.
    :param out: folder for worlds.json, worlds.md and worlds.png.
    :param results_only: collect nothing.
    """

    tasks: tuple[str, ...] = TASKS
    episodes: int = 100
    image_size: int = 128
    seed: int = 0
    bags: Folder = 'bags/worlds'
    out: Folder = 'docs/results'
    results_only: Flag = False
    engine: Engine = Engine()


def run(args):
    """Collect, draw strips of the bottlenecks, score keyframes, write what they hit."""
    rows, strips = [], []
    for name in args.tasks:
        world, _, task = name.partition('/')
        folder = Path(args.bags, world, task)
        if not args.results_only:
            collect(folder, CollectConfig(
                world=world, task=task, episodes=args.episodes, seed=args.seed,
                image_size=args.image_size, episodes_per_file=10), args.engine)
        demonstrations = read(folder)
        drawn = [strip(*one) for one in demonstrations[:STRIPS]]
        cv2.imwrite(str(folder / 'bottlenecks.png'), grid(drawn)[..., ::-1])
        strips += drawn[:1]
        rows += [{'world': world, 'task': task, **row} for row in score(demonstrations, args.seed)]
    out = Path(args.out)
    write_atomically(out / 'worlds.json', '[' + ',\n'.join(map(json.dumps, rows)) + ']\n')
    write_atomically(out / 'worlds.md', page(rows))
    cv2.imwrite(str(out / 'worlds.png'), grid(strips)[..., ::-1])
    print(out / 'worlds.md')


def read(folder):
    """
    Read a bag and its true bottlenecks.

    :return: list of (frames (T, H, W, 3), first and last frame of the bottleneck).
    :raises ConfigError: if they are not known.
    """
    path = Path(folder, BOTTLENECKS_FILE)
    if not path.exists():
        raise ConfigError(f'{path}: is not there; collect it by a world that knows bottlenecks')
    known = {mark['episode']: np.array(mark['stamps'][0])
             for mark in json.loads(path.read_text())['marks']}
    found = []
    for i, episode in enumerate(iter_episodes(folder)):
        if i in known and episode.outcome == 'success':
            window = np.searchsorted(episode.stamps, np.rint(1e9 * known[i]).astype(np.int64))
            found.append((episode.frames, tuple(window.tolist())))
    return found


def strip(frames, window):
    """Return the start, the bottleneck's first, middle and last frame, and the goal."""
    return [frames[i] for i in (0, window[0], sum(window) // 2, window[1], -1)]


def score(demonstrations, seed=0):
    """
    Score keyframes.

    :param demonstrations: as read returns them.
    :param seed: of the frame by which each mark is off: -1, 0 or 1.
    :return: list of dicts: method, hit and near (at most a frame beside the bottleneck), each
        with value, low and high, n, and the mean frames of bottlenecks and demonstrations.
    """
    small = [(np.stack([cv2.resize(frame, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
                        for frame in frames]), window) for frames, window in demonstrations]
    marked, held_out = small[:MARKED], small[-HELD_OUT:]
    off = np.random.default_rng(seed).integers(-1, 2, len(marked))
    marks = [int(np.clip(sum(window) // 2 + by, 0, len(frames) - 1))
             for (frames, window), by in zip(marked, off)]
    methods = {
        'middle': keyframes.middle, 'slowest': keyframes.slowest, 'UVD-like': keyframes.uvd,
        f'{MARKED} marks': keyframes.from_marks([frames for frames, _ in marked], marks)}
    length = float(np.mean([last - first + 1 for _, (first, last) in held_out]))
    rows = []
    for name, choose in {'random': None, **methods}.items():
        found = {'hit': 0, 'near': 1}
        for key, beside in found.items():
            found[key] = _random(held_out, beside) if choose is None else share_interval([
                first - beside <= choose(frames) <= last + beside
                for frames, (first, last) in held_out])
        rows.append({'method': name, 'n': len(held_out), 'bottleneck_frames': length,
                     'frames': float(np.mean([len(frames) for frames, _ in held_out])),
                     **{key: Interval(*map(float, value))._asdict()
                        for key, value in found.items()}})
    return rows


def _random(demonstrations, beside):
    """Return how often any frame between start and goal hits."""
    return mean_interval([
        np.mean([first - beside <= t <= last + beside for t in range(1, len(frames) - 1)])
        for frames, (first, last) in demonstrations])


def page(rows):
    """Write the page of the results, a line for each task."""
    lines = {}
    for row in rows:
        line = lines.setdefault((row['world'], row['task']), {
            'task': f"{row['world']} {row['task']}",
            'frames': f"{row['frames']:.0f}, {row['bottleneck_frames']:.1f} of the bottleneck"})
        hit, near = row['hit'], row['near']
        line[row['method']] = (f"{hit['value']:.0%} ({100 * hit['low']:.0f} to "
                               f"{100 * hit['high']:.0f}), {near['value']:.0%}")
    return render('worlds/templates/worlds.md.j2', n=rows[0]['n'], marked=MARKED,
                  table=pd.DataFrame(list(lines.values())))
