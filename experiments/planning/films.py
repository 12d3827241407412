# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Film strips and recordings of the best, the median and the worst scene, run again."""

from pathlib import Path

from experiments.planning.episode import as_recording
from experiments.planning.runs import plan_scene
import numpy as np
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.files import write_atomically
from tap_ros.pictures import film_strip, grid, png_bytes
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.writer import EpisodeWriter

SAME_CM = 0.01
PICTURES = 10  # in a strip, besides the subgoals and the goal


def pick_scenes(scenes):
    """Return the seeds of the best, the median and the worst scene, from scenes by seed."""
    order = sorted(scenes, key=lambda seed: (scenes[seed]['final_cm'], seed))
    return [order[0], order[(len(order) - 1) // 2], order[-1]]


def write_films(job, scenes, picture, recording):
    """
    Run three scenes again, unless the recording has just these.

    :param job: runs.Job.
    :param scenes: its results by seed.
    :param picture: .png file: a row for each scene.
    :param recording: .mcap file: an episode for each scene.
    :return: caption of the picture.
    :raises ConfigError: if a scene does not end as it did.
    """
    seeds = pick_scenes(scenes)
    words = [f'{scenes[s]["final_cm"]:.1f} cm (scene {s})' for s in seeds]
    subgoal = ', before it the subgoal' if job.method.predicted else ''
    caption = (f'the best, the median and the worst scene, {words[0]}, {words[1]} and '
               f'{words[2]}; last column: the goal{subgoal}')
    if Path(picture).exists() and _recorded(recording) == seeds:
        return caption
    rows = []
    Path(picture).parent.mkdir(parents=True, exist_ok=True)
    Path(recording).parent.mkdir(parents=True, exist_ok=True)
    with EpisodeWriter(recording) as writer:
        for seed in seeds:
            runs, final = plan_scene(job, seed)
            run, before = runs[0], scenes[seed]['final_cm']
            if abs(100 * final.mean() - before) > SAME_CM:
                raise ConfigError(
                    f'{job.method.name}: scene {seed} ended at {100 * final.mean():.2f} cm, not '
                    f'at {before:.2f} cm as in the results, which are of another machine or '
                    'version; remove them, or give --no-films')
            outcome = 'success' if (final < SUCCESS_DISTANCE).all() else 'failure'
            writer.write(as_recording(run, job.task, seed, outcome))
            rows.append([*film_strip(run.frames, PICTURES),
                         *(subgoal.image for subgoal in run.subgoals), run.goal.image])
    write_atomically(picture, png_bytes(np.ascontiguousarray(grid(rows, scale=2))))
    return caption


def _recorded(path):
    """Return the seeds of the episodes in a recording, none when it cannot be read."""
    try:
        return [episode.seed for episode in iter_episodes(path)]
    except (OSError, RecordingError):
        return []
