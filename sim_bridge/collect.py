# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Collect episodes of the expert into one recording: a rosbag2 bag split into files.

Episode i has seed + i and goes into file i // episodes_per_file, whichever worker makes it, so the
files do not depend on the number of workers. A finished file has its final name; an interrupted
collection goes on with the files that are not there yet.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
import json
from math import inf, nan
from pathlib import Path
import time
from typing import Annotated, Any, Literal

import numpy as np
from sim_bridge.tasks.tasks import get_task, TIMINGS
from sim_bridge.world.looks import CHOICES, DEFAULT_LOOK, LOOKS
from sim_bridge.world.protocol import ability, make_world, World
from tap_ros.base.contract import TABLE
from tap_ros.base.engines import Engine, LOCAL, run_tasks, Work
from tap_ros.base.errors import check_fields, ConfigError, RecordingError
from tap_ros.base.files import only_writer, storage_errors, write_atomically
from tap_ros.base.options import Folder, one_of
from tap_ros.base.plugins import names
from tap_ros.base.progress import Progress
from tap_ros.base.text import counted, escaped
from tap_ros.recording.writer import count_episodes, EpisodeWriter, write_metadata
from tap_ros.robots.arm import DEFAULT_ARM

EPISODE_SPACING_NS = 60 * 10**9  # stamps of episode i start here, times i + 1
SETTINGS_FILE = 'collection.json'
BOTTLENECKS_FILE = 'bottlenecks.json'  # as tap_ros/recording/marks.py reads it
MIN_FRAMES, MAX_FRAMES = 10, 1000  # of the longest episode
Make = Callable[[str, int], World]  # of a task's name and the size of the pictures


@dataclass(frozen=True)
class CollectConfig:
    """
    What to collect: all that a recording follows from.

    :param world: mujoco_table, or another whose expert demonstrates, such as metaworld, where
        scripts act as unsteadily as a person; a camera and the commands are recorded, and a file
        beside the recording says when the bottleneck is, by the simulator.
    :param task: one that the world has, such as push2; of metaworld door-open-v3.
    :param episodes: how many in all; a larger number later adds to the same folder.
    :param seed: of the first episode; the others count on from it.
    :param image_size: width and height in pixels, by default what the shipped weights see.
    :param episodes_per_file: the bag is split into files of so many.
    :param frames: of the longest episode; 0: as is usual for the task.
    :param timing: when in an episode of several pushed objects the first one is home and the
        others are untouched; natural: as it comes, mostly in the middle; mixed: early, middle or
        late, drawn for each episode.
    :param misses: share of the pushes that are at random, so that objects are hit, grazed and
        missed: what a forward model has to tell apart.
    :param pushes: in another world, to record what the planner sees there, with robot masks and
        objects: pushes of its object to the 'goal', or at 'random' for a forward model.
    :param look: of the world: the whole arm at its table, or its hand alone.
    :param appearance: of table, light and camera; 'random' is drawn anew for every episode.
    :param arm: at the table.
    """

    world: Annotated[str, one_of(names('tap_ros.worlds'))] = TABLE
    task: str = 'push2'
    episodes: int = 1000
    seed: int = 0
    image_size: int = 64
    episodes_per_file: int = 25
    frames: int = 0
    timing: Annotated[str, one_of(TIMINGS)] = 'natural'
    misses: float = 0.0
    pushes: Literal['', 'goal', 'random'] = ''
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    appearance: Annotated[str, one_of(CHOICES)] = 'usual'
    arm: Annotated[str, one_of(names('tap_ros.arms'))] = DEFAULT_ARM


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param out: folder of the recording, say bags/push2; an interrupted collection goes on there.
    """

    out: Folder
    recording: CollectConfig = CollectConfig()
    engine: Engine = Engine()


def run(args: Options) -> None:
    """Collect and say what was collected."""
    result = collect(args.out, args.recording, args.engine)
    if not result['episodes']:
        print(f'{args.out}: all {args.recording.episodes} episodes were there already')
        return
    print(f"{args.out}: {counted(result['episodes'], 'episode')}, {result['frames']} frames in "
          f"{result['seconds']['wall']:.0f} s; objects end "
          f"{100 * result['mean_final_distance']:.1f} cm from their goals on average, "
          f"{result['success_rate']:.0%} of the episodes succeed")
    if known := result['bottlenecks']:
        print(f'{BOTTLENECKS_FILE}: ' + ', '.join(
            f'{why or "known"} in {count}' for why, count in known.most_common()))


def collect(folder: str | Path, config: CollectConfig, engine: Engine = LOCAL,
            progress: bool = True, make: Make | None = None) -> dict[str, Any]:
    """
    Collect a recording, or go on with one that was interrupted.

    :param folder: of the recording; made if it is not there.
    :param config: CollectConfig.
    :param engine: Engine; on a cluster the folder is one that all its machines share.
    :param progress: show a progress bar.
    :param make: makes a world with `demonstrate` of a task and an image size, in the place of that
        which is named; the name only tells its recordings from others.
    :return: dict of episodes, frames, seconds (wall, and of acting and writing, summed over
        workers), success rate, mean final distance in metres, bottlenecks (Counter of why they
        are not known, '' of those that are), of the episodes collected by this call.
    :raises ConfigError: when the folder holds a recording made with other settings.
    :raises EngineError: when worker processes are killed again and again.
    :raises StorageError: when the disk is full, or another process is collecting there. Files
        that are finished stay.
    """
    _check(config, make)
    folder, rows = Path(folder), list[dict[str, Any]]()
    with only_writer(folder), storage_errors(folder):
        _check_settings(folder, config)
        for left in folder.glob('*.part'):  # by a process that was killed
            left.unlink()
        start = time.perf_counter()
        missing = [i for i in range(-(-config.episodes // config.episodes_per_file))
                   if not _is_whole(folder, config, i)]
        total = sum(len(_episodes(config, i)) for i in missing)
        tasks = [Work(_shard_path(folder, i).name, _collect_shard, (str(folder), config, i, make))
                 for i in missing]
        with Progress(total=total, unit='episode', disable=not progress) as bar:
            try:
                for _, get in run_tasks(tasks, engine):
                    found = get()
                    _note_bottlenecks(folder, [row['mark'] for row in found if row['mark']])
                    rows += found
                    bar.update(len(found))
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    'files that are finished stay, the same command goes on') from None
        seconds = {'wall': time.perf_counter() - start, **{
            name: sum(row[name] for row in rows) for name in ('act', 'write')}}
        write_metadata(folder)
    distances = [distance for row in rows for distance in row['distances']]
    return {
        'episodes': len(rows), 'frames': sum(row['frames'] for row in rows), 'seconds': seconds,
        'success_rate': float(np.mean([row['success'] for row in rows] or nan)),
        'mean_final_distance': float(np.mean(distances or nan)),
        'bottlenecks': Counter(row['unknown'] for row in rows if row['mark'] or row['unknown'])}


def _check(config: CollectConfig, make: Make | None) -> None:
    """Raise ConfigError, or SceneError, for what cannot be collected."""
    check_fields(config, {
        'misses': (0, 1), 'episodes': (1, inf), 'episodes_per_file': (1, inf),
        **({'frames': (MIN_FRAMES, MAX_FRAMES)} if config.frames else {})})  # 0: the usual ones
    if config.world != TABLE:
        said = [name for name in ('timing', 'misses', 'look', 'appearance', 'arm')
                if getattr(config, name) != getattr(CollectConfig(), name)]
        if said:
            raise ConfigError(f'{", ".join(said)}: of world {TABLE}, not of {config.world}')
        world = _make(config, make)
        ability(world, 'demonstrate')
        world.close()
        if config.pushes and not getattr(world, 'slides', False):
            raise ConfigError(f'pushes: nothing can be pushed about in {config.task} of '
                              f'{config.world}; leave it out')
    elif config.pushes:
        raise ConfigError(f'pushes: of other worlds; in {TABLE} see misses')
    elif get_task(config.task).kind != 'push' and (config.misses or config.timing != 'natural'):
        raise ConfigError(f'misses and timing are of tasks of pushing, not of {config.task}')


def _make(config: CollectConfig, make: Make | None) -> World:
    if make is not None:
        return make(config.task, config.image_size)
    options = {name: getattr(config, name) for name in ('look', 'appearance', 'arm')}
    return make_world(config.world, config.task, config.image_size,
                      **options if config.world == TABLE else {})


def _check_settings(folder: Path, config: CollectConfig) -> None:
    """Keep the settings beside the recording and refuse to mix it with other ones."""
    path, settings = folder / SETTINGS_FILE, asdict(config)
    if path.exists():
        try:
            before = asdict(CollectConfig()) | json.loads(path.read_text())
            fewer = settings['episodes'] < before['episodes']
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise ConfigError(
                f'{escaped(path)}: damaged ({escaped(error)}); remove it and give the same '
                'settings as before, or choose another folder') from error
        changed = [k for k in settings if k != 'episodes' and before[k] != settings[k]]
        if changed:
            raise ConfigError(
                f'{folder} holds a recording made with other settings ({", ".join(changed)}); '
                f'choose another folder or the settings in {path}')
        if fewer:
            raise ConfigError(
                f"{folder} is a recording of {before['episodes']} episodes; ask for at least as "
                'many, or choose another folder')
    write_atomically(path, json.dumps(settings, indent=2) + '\n')


def _is_whole(folder: Path, config: CollectConfig, shard: int) -> bool:
    """Return whether a file is there with all its episodes; the last may have been of fewer."""
    path, episodes = _shard_path(folder, shard), _episodes(config, shard)
    marked = _bottlenecks(folder)
    if marked and marked.keys().isdisjoint(episodes):
        return False  # killed before its bottlenecks were noted
    try:
        return path.exists() and count_episodes(path) == len(episodes)
    except RecordingError:  # it is made anew
        return False


def _shard_path(folder: str | Path, shard: int) -> Path:
    """Return the path of one file, named as rosbag2 names the files of a split bag."""
    return Path(folder) / f'{Path(folder).resolve().name}_{shard}.mcap'


def _episodes(config: CollectConfig, shard: int) -> range:
    """Return the numbers of the episodes in one file."""
    return range(config.episodes)[shard * config.episodes_per_file:][:config.episodes_per_file]


def _collect_shard(folder: str, config: CollectConfig, shard: int,
                   make: Make | None) -> list[dict[str, Any]]:
    """Collect one file; runs in a worker process. Return what is told of each of its episodes."""
    world, rows = _make(config, make), []
    how: dict[str, Any] = {'pushes': config.pushes} if config.pushes else {}
    if config.world == TABLE:
        how = {'timing': config.timing, 'misses': config.misses}
    with EpisodeWriter(_shard_path(folder, shard), camera_matrix=world.camera_matrix) as writer:
        for i in _episodes(config, shard):
            times = [time.perf_counter()]
            found = ability(world, 'demonstrate')(config.seed + i, config.frames, **how)
            stamps = found.episode.stamps + (i + 1) * EPISODE_SPACING_NS
            times.append(time.perf_counter())
            writer.write(replace(found.episode, stamps=stamps))
            times.append(time.perf_counter())
            mark = found.bottleneck and {
                'recording': '.', 'episode': i,
                'stamps': [[float(stamps[t]) / 1e9 for t in found.bottleneck]]}
            rows.append({
                'frames': len(stamps), 'success': found.episode.outcome == 'success',
                'mark': mark, 'unknown': found.unknown,
                'distances': world.distances().tolist(), 'act': times[1] - times[0],
                'write': times[2] - times[1]})
    world.close()
    return rows


def _note_bottlenecks(folder: Path, found: list[dict[str, Any]]) -> None:
    """Add marks to the file beside the recording, one a line."""
    if found:
        marks = _bottlenecks(folder) | {mark['episode']: mark for mark in found}
        lines = ',\n'.join(json.dumps(marks[i]) for i in sorted(marks))
        write_atomically(folder / BOTTLENECKS_FILE, f'{{"marks": [\n{lines}\n]}}\n')


def _bottlenecks(folder: Path) -> dict[int, dict[str, Any]]:
    """Return the marks beside the recording, by episode."""
    path = folder / BOTTLENECKS_FILE
    return {mark['episode']: mark for mark in json.loads(path.read_text())['marks']
            } if path.exists() else {}
