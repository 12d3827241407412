# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Collect episodes of the expert into one recording: a rosbag2 bag split into files.

Episode i has seed + i and goes into file i // episodes_per_file, whichever worker makes it, so the
files do not depend on the number of workers. A finished file has its final name; an interrupted
collection goes on with the files that are not there yet.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
import json
from pathlib import Path
import time
from typing import Any

import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode, TIMINGS
from sim_bridge.world.looks import DEFAULT_LOOK
from sim_bridge.world_protocol import Observation
from tap_ros.engines import Engine, LOCAL, run_tasks, Work
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.files import only_writer, storage_errors, write_atomically
from tap_ros.recording.episode import Episode
from tap_ros.recording.writer import count_episodes, EpisodeWriter, write_metadata
from tap_ros.robots.arm import DEFAULT_ARM
from tap_ros.text import escaped
from tqdm import tqdm

EPISODE_SPACING_NS = 60 * 10**9  # stamps of episode i start here, times i + 1
SETTINGS_FILE = 'collection.json'
# What they were before they were settings.
EARLIER = {'misses': 0.0, 'frames': 0, 'timing': 'natural', 'look': 'plain', 'appearance': 'usual',
           'arm': DEFAULT_ARM}
MIN_FRAMES, MAX_FRAMES = 10, 1000  # of the longest episode


@dataclass(frozen=True)
class CollectSettings:
    """
    What to collect.

    :param task: name of a task, see tasks.task_names.
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
    :param look: of the world, see looks.LOOKS.
    :param appearance: of table, light and camera, see appearance.CHOICES; 'random' is drawn anew
        for every episode.
    :param arm: name of an arm, see robots.arm.get_arm.
    """

    task: str = 'push2'
    episodes: int = 1000
    seed: int = 0
    image_size: int = 64
    episodes_per_file: int = 25
    frames: int = 0
    timing: str = 'natural'
    misses: float = 0.0
    look: str = DEFAULT_LOOK
    appearance: str = 'usual'
    arm: str = DEFAULT_ARM


@dataclass(frozen=True)
class CollectConfig(CollectSettings):
    """
    All that a recording follows from; two collections of equal ones are equal to the byte.

    :param expert: what it is collected with; None: as is usual for the task.
    """

    expert: Any = None


def collect(folder: str | Path, config: CollectConfig, engine: Engine = LOCAL,
            progress: bool = True, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """
    Collect a recording, or go on with one that was interrupted.

    :param folder: of the recording; made if it is not there.
    :param config: CollectConfig.
    :param engine: Engine; on a cluster the folder is one that all its machines share.
    :param progress: show a progress bar.
    :param stop: asked before each file; once it says True, no other begins.
    :return: dict of episodes, frames, seconds (wall and by part, summed over workers), success
        rate, mean final distance in metres, of the episodes collected by this call, and whether
        the recording is whole now.
    :raises ConfigError: when the folder holds a recording made with other settings.
    :raises EngineError: when worker processes are killed again and again.
    :raises StorageError: when the disk is full, or another process is collecting there. Files
        that are finished stay.
    """
    task = get_task(config.task)
    if not 0 <= config.misses <= 1:
        raise ConfigError(f'misses is {config.misses:g}; expected a share from 0 to 1')
    if config.misses and task.kind != 'push':
        raise ConfigError(f'misses are of tasks of pushing, not of {task.name}')
    config = replace(config, expert=config.expert or task.default_config(config.timing))
    if min(config.episodes, config.episodes_per_file) < 1:
        raise ConfigError('episodes and episodes_per_file must be at least 1')
    if config.frames and not MIN_FRAMES <= config.frames <= MAX_FRAMES:
        raise ConfigError(f'frames is {config.frames}; expected {MIN_FRAMES} to {MAX_FRAMES}, or '
                          f'0 for what is usual for the task')
    if config.timing not in TIMINGS:
        raise ConfigError(
            f'timing {config.timing!r} is unknown; valid timings: {", ".join(TIMINGS)}')
    if config.timing != 'natural' and task.kind != 'push':
        raise ConfigError(f'timing {config.timing!r} is for tasks of pushing; with {task.name} '
                          "it can only be 'natural'")
    folder = Path(folder)
    with only_writer(folder), storage_errors(folder):
        _check_settings(folder, config)
        for left in folder.glob('*.part'):  # by a process that was killed
            left.unlink()
        result = _collect_missing(folder, config, engine, progress, stop)
        if result['whole']:
            write_metadata(folder)
    return result


def _collect_missing(folder: Path, config: CollectConfig, engine: Engine, progress: bool,
                     stop: Callable[[], bool]) -> dict[str, Any]:
    """Collect the files that are not there yet; see collect."""
    shards = -(-config.episodes // config.episodes_per_file)
    missing = [i for i in range(shards) if not _is_whole(folder, config, i)]
    start, stats = time.perf_counter(), []
    tasks = [Work(_shard_path(folder, i).name, _collect_shard, (str(folder), config, i))
             for i in missing]
    total = sum(len(_episodes(config, i)) for i in missing)
    with tqdm(total=total, unit='episode', disable=not progress) as bar:
        for _, get in run_tasks(tasks, engine, stop):
            stats.append(get())
            bar.update(len(stats[-1]['outcomes']))
    # In the order of the files, whichever was ready first.
    stats.sort(key=lambda s: s['shard'])
    return _summary(stats, time.perf_counter() - start) | {'whole': len(stats) == len(missing)}


def _summary(stats: Sequence[dict[str, Any]], wall: float) -> dict[str, Any]:
    """Add up what the workers measured."""
    distances = np.concatenate([s['distances'] for s in stats]) if stats else np.zeros((0, 1))
    seconds = {
        part: sum(s['seconds'][part] for s in stats) for part in ('search', 'step', 'write')}
    return {
        'episodes': len(distances), 'frames': sum(s['frames'] for s in stats),
        'success_rate': float(np.mean([o == 'success' for s in stats for o in s['outcomes']]))
        if stats else float('nan'),
        'mean_final_distance': float(distances.mean()) if stats else float('nan'),
        'seconds': {'wall': wall, **seconds}}


def _check_settings(folder: Path, config: CollectConfig) -> None:
    """Keep the settings beside the recording and refuse to mix it with other ones."""
    path = folder / SETTINGS_FILE
    settings = json.loads(json.dumps(asdict(config)))
    if path.exists():
        before = EARLIER | _read_settings(path)
        changed = [k for k in settings if k != 'episodes' and before.get(k) != settings[k]]
        if changed:
            raise ConfigError(
                f'{folder} holds a recording made with other settings ({", ".join(changed)}); '
                f'choose another folder or the settings in {path}')
        if settings['episodes'] < before['episodes']:
            raise ConfigError(
                f"{folder} is a recording of {before['episodes']} episodes; ask for at least as "
                'many, or choose another folder')
    write_atomically(path, json.dumps(settings, indent=2) + '\n')


def _read_settings(path: Path) -> dict[str, Any]:
    """Return the settings that a recording was made with."""
    try:
        before = json.loads(path.read_text())
        int(before['episodes'])
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise ConfigError(
            f'{escaped(path)}: damaged ({escaped(error)}); remove it and give the same settings '
            'as before, or choose another folder') from error
    return before


def _is_whole(folder: Path, config: CollectConfig, shard: int) -> bool:
    """Say whether a file is there with all its episodes; the last may have been of fewer."""
    path = _shard_path(folder, shard)
    try:
        return path.exists() and count_episodes(path) == len(_episodes(config, shard))
    except RecordingError:  # it is made anew
        return False


def _shard_path(folder: str | Path, shard: int) -> Path:
    """Return the path of one file, named as rosbag2 names the files of a split bag."""
    return Path(folder) / f'{Path(folder).resolve().name}_{shard}.mcap'


def _episodes(config: CollectConfig, shard: int) -> range:
    """Return the numbers of the episodes in one file."""
    first = shard * config.episodes_per_file
    return range(first, min(first + config.episodes_per_file, config.episodes))


def _collect_shard(folder: str | Path, config: CollectConfig, shard: int) -> dict[str, Any]:
    """Collect one file; runs in a worker process."""
    simulator = Simulator(
        config.task, config.image_size, config.look, config.appearance, config.arm)
    stats: dict[str, Any] = {
        'shard': shard, 'frames': 0, 'outcomes': [], 'distances': [],
        'seconds': {'search': 0.0, 'step': 0.0, 'write': 0.0}}
    path = _shard_path(folder, shard)
    with EpisodeWriter(path, camera_matrix=simulator.camera.K) as writer:
        for i in _episodes(config, shard):
            seed = config.seed + i
            observations, actions, outcome, seconds = run_episode(
                simulator, seed, config.expert, num_frames=config.frames, timing=config.timing,
                misses=config.misses)
            begin = time.perf_counter()
            writer.write(make_episode(
                simulator, observations, actions, outcome, (i + 1) * EPISODE_SPACING_NS))
            stats['seconds']['write'] += time.perf_counter() - begin
            for part in seconds:
                stats['seconds'][part] += seconds[part]
            stats['frames'] += len(observations)
            stats['outcomes'].append(outcome)
            stats['distances'].append(simulator.distances())
    simulator.close()
    return stats


def make_episode(simulator: Simulator, observations: Sequence[Observation], actions: np.ndarray,
                 outcome: str, start_ns: int = 0) -> Episode:
    """
    Put what was observed and done into an Episode.

    Its goal is the one that it reached: a picture of where the objects ended, with the arm
    elsewhere, as a person would photograph a goal; after a grasp, whose object the arm may still
    hold, the last frame itself. The expert's own goal, from which the outcome
    follows, is drawn again from the seed by tasks.sample_scene.

    :param simulator: Simulator that made it.
    :param observations: list of T Observations.
    :param actions: (T, 4) float32.
    :param outcome: 'success', 'failure' or 'interrupted'.
    :param start_ns: added to the stamps.
    :return: Episode.
    """
    goal = observations[-1]
    if simulator.task.photographed:
        goal = simulator.photograph(goal.object_poses)
    return Episode(
        frames=np.stack([o.image for o in observations]),
        stamps=np.array([o.stamp_ns + start_ns for o in observations], np.int64),
        actions=actions,
        grippers=np.stack([o.gripper for o in observations]),
        object_names=observations[0].object_names,
        object_pixels=np.stack([o.object_pixels for o in observations]),
        object_poses=np.stack([o.object_poses for o in observations]),
        goal_frame=goal.image, goal_pixels=goal.object_pixels, goal_poses=goal.object_poses,
        object_source='ground_truth', task=simulator.task.name, seed=simulator.scene.seed,
        outcome=outcome,
        robot_masks=np.stack([o.robot_mask for o in observations]), goal_mask=goal.robot_mask)
