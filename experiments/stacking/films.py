# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the first scenes that succeed and that fail, run again."""

from experiments.stacking.runs import make_episode
import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically
from tap_ros.images.drawing import draw_crosses, enlarge, film_strip, grid, png_bytes

SUCCEED, FAIL = 1, 3  # scenes of each
FRAMES = 5  # of what was done
SCALE = 2
WHITE = (255, 255, 255)


def pick_scenes(scenes):
    """Return the seeds of the first scenes that succeed, then of those that fail."""
    good = [seed for seed in sorted(scenes) if scenes[seed]['success']]
    bad = [seed for seed in sorted(scenes) if not scenes[seed]['success']]
    return good[:SUCCEED] + bad[:FAIL]


def write_films(job, scenes, path):
    """
    Run some scenes again and draw each as a row.

    :param job: runs.Job.
    :param scenes: its results by seed.
    :param path: .png file.
    :raises ConfigError: if a scene does not end as it did.
    """
    rows = []
    for seed in pick_scenes(scenes):
        run = make_episode(job, seed)
        if run.success != scenes[seed]['success']:
            raise ConfigError(
                f'{job.task}, {job.method.name}: scene {seed} does not end as in the results, '
                'which are of another machine or version; remove them, or give --no-films')
        rows.append([enlarge(run.start.image, SCALE), *map(_read, run.stages),
                     *(enlarge(frame, SCALE) for frame in film_strip(run.frames, FRAMES))])
    write_atomically(path, png_bytes(np.ascontiguousarray(grid(rows))))


def _read(stage):
    """Draw a cross in the colour of each object where it was read."""
    canvas = enlarge(stage.picture, SCALE)
    draw_crosses(canvas, stage.pixels, SCALE, WHITE)
    return canvas
