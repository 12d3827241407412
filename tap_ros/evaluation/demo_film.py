# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The scenes of the demo as one animated GIF: direct beside via the subgoal."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
import numpy as np
from tap_ros.evaluation.demo_report import MODE_NAMES, SceneRuns
from tap_ros.files import write_atomically
from tap_ros.pictures import enlarge, overlay

SCALE = 3
GAP, HEAD = 8, 26  # pixels between panels, and above them for the names
DPI = 100
FRAMES_PER_S = 10
HOLD = 15  # frames for which the end of a scene stands still


def write_film(path: str | Path, scenes: Sequence[SceneRuns]) -> None:
    """
    Write a film of scenes, one after the other; crosses mark where the objects should end.

    :param path: of the GIF file.
    :param scenes: list of SceneRuns with the same modes.
    """
    modes = list(scenes[0].runs)
    figure, panels = _panels(2 + len(modes), scenes[0].start)
    with TemporaryDirectory() as folder:
        part = Path(folder, 'film.gif')
        writer = PillowWriter(fps=FRAMES_PER_S)
        with writer.saving(figure, part, DPI):
            for scene in scenes:
                _show(panels[0], 'goal', scene.goal)
                _show(panels[1], 'predicted subgoal', scene.subgoal)
                for t in range(max(len(run.frames) for run in scene.runs.values()) + HOLD):
                    for panel, mode in zip(panels[2:], modes):
                        run = scene.runs[mode]
                        now = min(t, len(run.frames) - 1)
                        _show(panel, f'{MODE_NAMES[mode]}: '
                              f'{100 * run.distances[now].mean():.1f} cm', run.frames[now],
                              scene.goal_pixels)
                    writer.grab_frame()
        write_atomically(path, part.read_bytes())


def _panels(count: int, picture: np.ndarray) -> tuple[Figure, list[tuple[Axes, AxesImage]]]:
    """Return a figure and its panels, each the axes and what is drawn on them."""
    H, W = (SCALE * side for side in picture.shape[:2])
    width, height = count * (W + GAP) + GAP, HEAD + H + GAP
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    panels = []
    for i in range(count):
        axes = figure.add_axes((
            (GAP + i * (W + GAP)) / width, GAP / height, W / width, H / height))
        axes.set_axis_off()
        panels.append((axes, axes.imshow(enlarge(picture, SCALE), interpolation='nearest')))
    return figure, panels


def _show(panel: tuple[Axes, AxesImage], name: str, picture: np.ndarray,
          goal_pixels: np.ndarray | None = None) -> None:
    """Put a picture and its name on a panel."""
    axes, drawn = panel
    axes.set_title(name, fontsize=10, pad=5)
    drawn.set_data(overlay(picture, (), SCALE, goal_pixels=goal_pixels))
