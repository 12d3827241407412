# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Film strips of the best, the median and the worst scene, run again."""

from experiments.planning.runs import make_episode
import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.images.drawing import draw_crosses, enlarge, film_strip, grid, png_bytes

SAME_CM = 0.01
PICTURES = 10  # of what was done
SCALE = 2
WHITE = (255, 255, 255)


def write_film(job, scenes, path):
    """
    Run three scenes of a Job again, and draw each as a row.

    Of pushing: what was done, the subgoals, the goal. Of stacking: the start, the pictures that
    were brought about, with a cross for each object where it was read, what was done.
    """
    rows, order = [], sorted(scenes, key=lambda seed: (scenes[seed]['final_cm'], seed))
    for seed in (order[0], order[(len(order) - 1) // 2], order[-1]):
        run, before = make_episode(job, seed), scenes[seed]['final_cm']
        ended = 100 * (run.distances if job.stacks else run.distances[-1]).mean()
        if abs(ended - before) > SAME_CM:
            raise ConfigError(
                f'{job.task}, {job.method.name}: scene {seed} ended at {ended:.2f} cm, not at '
                f'{before:.2f} cm as in the results, which are of another machine or version; '
                'remove them, or give --no-films')
        done = [enlarge(frame, SCALE) for frame in film_strip(run.frames, PICTURES)]
        if job.stacks:
            rows.append([enlarge(run.start.image, SCALE), *map(_read, run.stages), *done])
        else:
            shown = [*(subgoal.image for subgoal in run.subgoals), run.goal.image]
            rows.append([*done, *(enlarge(image, SCALE) for image in shown)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, png_bytes(np.ascontiguousarray(grid(rows))))


def _read(stage):
    """Draw a cross in the colour of each object where it was read."""
    canvas = enlarge(stage.picture, SCALE)
    draw_crosses(canvas, stage.pixels, SCALE, WHITE)
    return canvas
