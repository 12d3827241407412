# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Collect episodes of the expert into one recording: a rosbag2 bag split into files.

Episode i has seed + i and goes into file i // episodes_per_file, whichever worker makes it, so the
files do not depend on the number of workers. A finished file has its final name; an interrupted
collection goes on with the files that are not there yet.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
import json
from math import inf, nan
from pathlib import Path
import time
from typing import Annotated, Any

import numpy as np
from sim_bridge.demonstrations import to_episode
from sim_bridge.gym_pushes import POLICIES, record_pushes
from sim_bridge.gym_world import GymWorld
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode, TIMINGS
from sim_bridge.world.looks import CHOICES, DEFAULT_LOOK, LOOKS
from sim_bridge.world_protocol import ability, make_world, Observation, World
from tap_ros.base.contract import TABLE
from tap_ros.base.engines import Engine, LOCAL, run_tasks, Work
from tap_ros.base.errors import check_fields, ConfigError, RecordingError
from tap_ros.base.files import only_writer, storage_errors, write_atomically
from tap_ros.base.options import Folder, one_of
from tap_ros.base.plugins import names
from tap_ros.base.text import escaped
from tap_ros.recording.episode import Episode
from tap_ros.recording.writer import count_episodes, EpisodeWriter, write_metadata
from tap_ros.robots.arm import DEFAULT_ARM
from tqdm import tqdm

EPISODE_SPACING_NS = 60 * 10**9  # stamps of episode i start here, times i + 1
SETTINGS_FILE = 'collection.json'
BOTTLENECKS_FILE = 'bottlenecks.json'  # as tap_ros/recording/marks.py reads it
MIN_FRAMES, MAX_FRAMES = 10, 1000  # of the longest episode


@dataclass(frozen=True)
class CollectConfig:
    """
    What to collect: all that a recording follows from.

    :param world: mujoco_table, or another whose expert demonstrates: metaworld or ogbench, where
        scripts act as unsteadily as a person; a camera and the commands are recorded, and a file
        beside the recording says when the bottleneck is, by the simulator.
    :param task: one that the world has, such as push2; of metaworld door-open-v3; of ogbench cube.
    :param episodes: how many in all; a larger number later adds to the same folder.
    :param seed: of the first episode; the others count on from it.
    :param image_size: width and height in pixels.
    :param episodes_per_file: the bag is split into files of so many.
    :param frames: of the longest episode; 0: as is usual for the task.
    :param timing: when in an episode of several pushed objects the first one is home and the
        others are untouched; natural: as it comes, mostly in the middle; mixed: early, middle or
        late, drawn for each episode.
    :param misses: share of the pushes that are at random, so that objects are hit, grazed and
        missed: what a forward model has to tell apart.
    :param pushes: goal, random: in a world of others whose object slides, such as push-v3 of
        metaworld, pushes to its goal or anywhere instead of its expert; all that a forward model
        learns from is recorded. none: the expert.
    :param look: of the world, see looks.LOOKS.
    :param appearance: of table, light and camera, see looks.CHOICES; 'random' is drawn anew for
        every episode.
    :param arm: name of an arm, see robots.arm.get_arm.
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
    pushes: Annotated[str, one_of(('none', *POLICIES))] = 'none'
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
    print(f"{args.out}: {result['episodes']} episodes, {result['frames']} frames in "
          f"{result['seconds']['wall']:.0f} s; objects end "
          f"{100 * result['mean_final_distance']:.1f} cm from their goals on average, "
          f"{result['success_rate']:.0%} of the episodes succeed")


def collect(folder: str | Path, config: CollectConfig, engine: Engine = LOCAL,
            progress: bool = True) -> dict[str, Any]:
    """
    Collect a recording, or go on with one that was interrupted.

    :param folder: of the recording; made if it is not there.
    :param config: CollectConfig.
    :param engine: Engine; on a cluster the folder is one that all its machines share.
    :param progress: show a progress bar.
    :return: dict of episodes, frames, seconds (wall, and of acting and writing, summed over
        workers), success rate, mean final distance in metres, of the episodes collected by this
        call.
    :raises ConfigError: when the folder holds a recording made with other settings.
    :raises EngineError: when worker processes are killed again and again.
    :raises StorageError: when the disk is full, or another process is collecting there. Files
        that are finished stay.
    """
    _check(config)
    folder = Path(folder)
    with only_writer(folder), storage_errors(folder):
        _check_settings(folder, config)
        for left in folder.glob('*.part'):  # by a process that was killed
            left.unlink()
        result = _collect_missing(folder, config, engine, progress)
        write_metadata(folder)
    return result


def _check(config: CollectConfig) -> None:
    """Raise ConfigError, or SceneError, for what cannot be collected."""
    check_fields(config, {
        'misses': (0, 1), 'episodes': (1, inf), 'episodes_per_file': (1, inf),
        **({'frames': (MIN_FRAMES, MAX_FRAMES)} if config.frames else {})})  # 0: the usual ones
    if config.world != TABLE:
        usual = CollectConfig()
        said = [name for name in ('timing', 'misses', 'look', 'appearance', 'arm')
                if getattr(config, name) != getattr(usual, name)]
        if said:
            raise ConfigError(f'{", ".join(said)}: of world {TABLE}, not of {config.world}')
        world = _make(config)  # it says what it lacks
        world.close()
        if config.pushes != 'none' and not isinstance(world, GymWorld):
            raise ConfigError(f'pushes: world {config.world} can be recorded as its expert acts')
    elif config.pushes != 'none':
        raise ConfigError(f'pushes: of worlds of others, not of {TABLE}; leave it out')
    elif get_task(config.task).kind != 'push' and (config.misses or config.timing != 'natural'):
        raise ConfigError(f'misses and timing are of tasks of pushing, not of {config.task}')


def _make(config: CollectConfig) -> World:
    """Make the world."""
    options = {name: getattr(config, name) for name in ('look', 'appearance', 'arm')}
    return make_world(config.world, config.task, config.image_size,
                      **options if config.world == TABLE else {})


def _collect_missing(folder: Path, config: CollectConfig, engine: Engine,
                     progress: bool) -> dict[str, Any]:
    """Collect the files that are not there yet; see collect."""
    shards = range(-(-config.episodes // config.episodes_per_file))
    missing = [i for i in shards if not _is_whole(folder, config, i)]
    start, done = time.perf_counter(), []
    tasks = [Work(_shard_path(folder, i).name, _collect_shard, (str(folder), config, i))
             for i in missing]
    total = sum(len(_episodes(config, i)) for i in missing)
    with tqdm(total=total, unit='episode', disable=not progress) as bar:
        for _, get in run_tasks(tasks, engine):
            done.append(get())
            _note_bottlenecks(folder, done[-1]['bottlenecks'])
            bar.update(len(done[-1]['outcomes']))

    def every(key: str) -> list[Any]:
        return [value for stats in done for value in stats[key]]

    return {
        'episodes': len(every('outcomes')), 'frames': sum(every('frames')),
        'success_rate': float(np.mean([one == 'success' for one in every('outcomes')] or nan)),
        'mean_final_distance': float(np.mean(every('distances') or nan)),
        'seconds': {'wall': time.perf_counter() - start, 'act': sum(every('act')),
                    'write': sum(every('write'))}}


def _check_settings(folder: Path, config: CollectConfig) -> None:
    """Keep the settings beside the recording and refuse to mix it with other ones."""
    path = folder / SETTINGS_FILE
    settings = asdict(config)
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
    """Say whether a file is there with all its episodes; the last may have been of fewer."""
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
    first = shard * config.episodes_per_file
    return range(first, min(first + config.episodes_per_file, config.episodes))


def _collect_shard(folder: str | Path, config: CollectConfig, shard: int) -> dict[str, list[Any]]:
    """Collect one file; runs in a worker process. Return what is told of its episodes."""
    world = _make(config)
    stats: dict[str, list[Any]] = {
        key: [] for key in ('frames', 'outcomes', 'distances', 'bottlenecks', 'act', 'write')}
    with EpisodeWriter(_shard_path(folder, shard), camera_matrix=world.camera_matrix) as writer:
        for i in _episodes(config, shard):
            begin = time.perf_counter()
            episode, bottleneck = _demonstrated(world, config, i)
            if bottleneck is not None:
                seconds = [float(episode.stamps[t]) / 1e9 for t in bottleneck]
                stats['bottlenecks'].append(
                    {'recording': '.', 'episode': i, 'stamps': [seconds]})
            acted = time.perf_counter()
            writer.write(episode)
            stats['write'].append(time.perf_counter() - acted)
            stats['act'].append(acted - begin)
            stats['frames'].append(len(episode))
            stats['outcomes'].append(episode.outcome)
            stats['distances'] += world.distances().tolist()
    world.close()
    return stats


def _demonstrated(world: World, config: CollectConfig,
                  i: int) -> tuple[Episode, tuple[int, int] | None]:
    """Let the expert of a world act; return episode i and the frames of its bottleneck."""
    seed, start_ns = config.seed + i, (i + 1) * EPISODE_SPACING_NS
    if isinstance(world, Simulator):
        return make_episode(world, *run_episode(
            world, seed, config.frames, config.timing, config.misses), start_ns), None
    if config.pushes != 'none':
        assert isinstance(world, GymWorld)
        episode, bottleneck = record_pushes(world, seed, config.pushes), None
    else:
        found = ability(world, 'demonstrate')(seed, config.frames)
        episode, bottleneck = found.episode, found.bottleneck
    return replace(episode, stamps=episode.stamps + start_ns), bottleneck


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


def make_episode(simulator: Simulator, observations: Sequence[Observation], actions: np.ndarray,
                 outcome: str, start_ns: int = 0) -> Episode:
    """
    Put what was observed and done into an Episode.

    Its goal is the one that it reached: a picture of where the objects ended, with the arm
    elsewhere, as a person would photograph a goal; after a grasp, whose object the arm may still
    hold, the last frame itself. The expert's own goal, from which the outcome
    follows, is drawn again from the seed by tasks.sample_scene.

    :param simulator: Simulator that made it; the others: see to_episode.
    """
    goal = observations[-1]
    if simulator.task.photographed:
        goal = simulator.photograph(goal.object_poses)
    return to_episode(observations, actions, goal, simulator.task_name, simulator.seed, outcome,
                      start_ns)
