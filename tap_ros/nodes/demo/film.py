# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The scenes of the demo as one film: direct beside via the subgoal, seen from the side."""

from collections.abc import Sequence
import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from PIL import Image
from tap_ros.files import write_atomically
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.nodes.demo.report import MODE_NAMES, SceneRuns

SMALL = 128  # pixels, side of goal and subgoal, one above the other on the left
GAP, HEAD = 8, 24  # pixels between panels, and above them for the names
HEIGHT = 2 * SMALL + HEAD  # of a run's picture beside both
DPI = 100
FRAME_MS, HOLD_MS = 100, 1800  # of each frame, and of the end of a scene
QUALITY = 60  # 0 to 100


def write_film(path: str | Path, scenes: Sequence[SceneRuns]) -> None:
    """
    Write a film of scenes, one after the other; crosses mark where the objects should end.

    :param path: of the WebP file.
    :param scenes: list of SceneRuns with the same modes.
    """
    modes = list(scenes[0].runs)
    canvas, goal, subgoal, panels = _panels(
        [run.pictures[0].shape for run in scenes[0].runs.values()])
    pictures: list[Image.Image] = []
    times: list[int] = []
    for scene in scenes:
        _show(goal, 'goal', scene.goal, scene.goal_pixels)
        _show(subgoal, 'predicted subgoal', scene.subgoal)
        length = max(len(run.pictures) for run in scene.runs.values())
        for t in range(length):
            for panel, mode in zip(panels, modes):
                run = scene.runs[mode]
                distances, picture = (values[min(t, len(values) - 1)]
                                      for values in (run.distances, run.pictures))
                _show(panel, f'{MODE_NAMES[mode]}: {100 * distances.mean():.1f} cm', picture,
                      scene.side_goal_pixels if len(run.side) else scene.goal_pixels)
            canvas.draw()
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
        times += [FRAME_MS] * (length - 1) + [HOLD_MS]
    buffer = io.BytesIO()
    pictures[0].save(buffer, 'webp', save_all=True, append_images=pictures[1:], duration=times,
                     loop=0, quality=QUALITY)
    write_atomically(path, buffer.getvalue())


def _panels(shapes: Sequence[Sequence[int]]) -> tuple[FigureCanvasAgg, Axes, Axes, list[Axes]]:
    """Return a canvas, the panels of goal and subgoal, and those of runs, (H, W, 3) each."""
    widths = [round(HEIGHT * shape[1] / shape[0]) for shape in shapes]
    width = SMALL + sum(widths) + GAP * (2 + len(widths))
    height = HEAD + HEIGHT + GAP
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)

    def panel(left: int, bottom: int, wide: int, high: int) -> Axes:
        axes = figure.add_axes((left / width, bottom / height, wide / width, high / height))
        axes.set_axis_off()
        return axes

    goal = panel(GAP, GAP + SMALL + HEAD, SMALL, SMALL)
    subgoal = panel(GAP, GAP, SMALL, SMALL)
    lefts = np.cumsum([2 * GAP + SMALL, *(wide + GAP for wide in widths[:-1])]).tolist()
    runs = [panel(left, GAP, wide, HEIGHT) for left, wide in zip(lefts, widths)]
    return FigureCanvasAgg(figure), goal, subgoal, runs


def _show(axes: Axes, name: str, picture: np.ndarray,
          goal_pixels: np.ndarray | None = None) -> None:
    """Put a picture, its name and crosses on a panel."""
    for artist in (*axes.images, *axes.lines):
        artist.remove()
    axes.set_title(name, fontsize=10, pad=5)
    axes.imshow(picture, interpolation='nearest', aspect='auto')
    H, W = picture.shape[:2]
    for k, (u, v) in enumerate(() if goal_pixels is None else goal_pixels):
        colour = np.array(OBJECT_COLOURS[k % len(OBJECT_COLOURS)]) / 255
        axes.plot(u, v, 'x', color=colour, markersize=8, markeredgewidth=2)
    axes.set(xlim=(-0.5, W - 0.5), ylim=(H - 0.5, -0.5))
