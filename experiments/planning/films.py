# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Film strips and recordings of the best, the median and the worst scene, run again."""

import io
from pathlib import Path

from experiments.planning.episode import as_recording
from experiments.planning.runs import plan_scene
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.files import write_atomically
from tap_ros.images.drawing import film_strip, grid
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

    The caption stands in the picture, too, as its Description.

    :param job: runs.Job.
    :param scenes: its results by seed.
    :param picture: .png file: a row for each scene.
    :param recording: .mcap file: an episode for each scene.
    :raises ConfigError: if a scene does not end as it did.
    """
    seeds = pick_scenes(scenes)
    if Path(picture).exists() and _recorded(recording) == seeds:
        return
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
    write_atomically(picture, _captioned(
        grid(rows, scale=2), make_caption(scenes, job.method.predicted)))


def make_caption(scenes, has_subgoals):
    """Say what a film strip of these scenes shows."""
    words = [f'{scenes[seed]["final_cm"]:.1f} cm (scene {seed})' for seed in pick_scenes(scenes)]
    subgoals = 'each predicted subgoal, and ' if has_subgoals else ''
    return (f'the best, the median and the worst of {len(scenes)} scenes: {words[0]}, {words[1]} '
            f'and {words[2]}. Each row: {PICTURES} pictures from the first to the last, then '
            f'{subgoals}the goal')


def read_caption(picture):
    """Return the caption of a film strip, from the file; strips once had none."""
    with Image.open(picture) as image:
        return image.text.get('Description', 'the best, the median and the worst scene')


def _captioned(image, caption):
    """Return the bytes of a PNG file with a caption."""
    about, file = PngInfo(), io.BytesIO()
    about.add_text('Description', caption)
    Image.fromarray(image).save(file, 'PNG', pnginfo=about)
    return file.getvalue()


def _recorded(path):
    """Return the seeds of the episodes in a recording, none when it cannot be read."""
    try:
        return [episode.seed for episode in iter_episodes(path)]
    except (OSError, RecordingError):
        return []
