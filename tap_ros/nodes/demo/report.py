# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One self-contained HTML page about a few scenes and the subgoals predicted for them."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import html
import io
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

from matplotlib.figure import Figure
import numpy as np
from PIL import Image
from tap_ros.files import write_atomically
from tap_ros.images.drawing import enlarge, film_strip, grid, overlay, png_bytes

SCALE = 4
FRAME_MS, HOLD_MS = 120, 2000  # of a film: of each frame, and of the last one
FILM_QUALITY = 70  # 0 to 100
MODE_NAMES = {'direct': 'direct', 'subgoal': 'via the subgoal'}
MODE_COLOURS = {'direct': '#648fff', 'subgoal': '#dc267f'}


@dataclass(frozen=True)
class Run:
    """One attempt at a scene."""

    frames: list[np.ndarray]  # T + 1 pictures (H, W, 3) uint8
    distances: np.ndarray  # (T + 1, K) metres from each object to its goal
    message: str  # how the planner said that it ended
    planning_ms: float  # median time of one plan
    side: Sequence[np.ndarray] = ()  # pictures (H, W, 3) uint8 from the side, if there are any
    plans: Sequence[np.ndarray] = ()  # pictures (H, W, 3) uint8 of what the planner considered

    @property
    def pictures(self) -> Sequence[np.ndarray]:
        """Those from the side, or where there are none the camera's."""
        return self.side if len(self.side) else self.frames


@dataclass(frozen=True)
class SceneRuns:
    """A scene, the subgoal predicted for it, and the attempts, if any."""

    task: str
    seed: int
    start: np.ndarray  # (H, W, 3) uint8
    goal: np.ndarray
    start_pixels: np.ndarray  # (K, 2)
    goal_pixels: np.ndarray
    subgoal: np.ndarray  # (H, W, 3) uint8
    object_maps: np.ndarray  # (K, H, W)
    runs: dict[str, Run]  # by mode
    side_goal_pixels: np.ndarray | None = None  # (K, 2) in pictures from the side
    expert: Sequence[np.ndarray] = ()  # pictures (H, W, 3) uint8 from the side of its own attempt

    @property
    def name(self) -> str:
        """Task and seed."""
        return f'{self.task} {self.seed}'


def results_table(scenes: Sequence[SceneRuns]) -> str:
    """
    Say in plain text how far from their goals the objects ended.

    :param scenes: list of SceneRuns with the same modes, those of a task together.
    :return: lines of text; distances in cm, mean over the objects.
    """
    modes, rows = list(scenes[0].runs), list[str]()
    for task, group in groupby(scenes, lambda scene: scene.task):
        distances = []
        for scene in group:
            distances.append([scene.runs[modes[0]].distances[0].mean(),
                              *(scene.runs[m].distances[-1].mean() for m in modes)])
            rows.append(_row(scene.name, distances[-1]))
        rows.append(_row(f'{task}, mean of {len(distances)}', np.mean(distances, 0)))
    head = f'{"final mean distance, cm":<26}{"do nothing":>12}' + ''.join(
        f'{m:>12}' for m in modes)
    rule = '-' * len(head)
    return '\n'.join([head, rule, *rows])


def _row(label: str, distances: Iterable[float]) -> str:
    return f'{label:<26}' + ''.join(f'{100 * d:>12.1f}' for d in distances)


def _html_table(scenes: Sequence[SceneRuns]) -> str:
    """Return the same as results_table as HTML."""
    modes, rows = list(scenes[0].runs), list[str]()

    def row(label: str, distances: Iterable[float], kind: str = '') -> None:
        cells = ''.join(f'<td>{100 * d:.1f}</td>' for d in distances)
        rows.append(f'<tr class="{kind}"><th scope="row">{html.escape(label)}</th>{cells}</tr>')

    for task, group in groupby(scenes, lambda scene: scene.task):
        kept = list(group)
        distances = [[scene.runs[modes[0]].distances[0].mean(),
                      *(scene.runs[mode].distances[-1].mean() for mode in modes)]
                     for scene in kept]
        for scene, found in zip(kept, distances):
            row(scene.name, found)
        row(f'{task}, mean of {len(kept)}', np.mean(distances, 0), 'mean')
    head = ''.join(f'<th scope="col">{html.escape(text)}</th>' for text in (
        'final mean distance, cm', 'nothing done', *(MODE_NAMES[mode] for mode in modes)))
    return f'<table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'


def write_report(path: str | Path, scenes: Sequence[SceneRuns], note: str = '',
                 facts: Mapping[str, str] = MappingProxyType({})) -> None:
    """
    Write the page; everything is inside the one file.

    :param path: of the HTML file.
    :param scenes: list of SceneRuns.
    :param note: a sentence on how the numbers were made.
    :param facts: what made the page: name and value, such as date, commit and command.
    """
    made = ''.join(f'<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>'
                   for name, value in facts.items())
    body = ''.join(_scene_section(scene) for scene in scenes)
    pushed = [scene for scene in scenes if scene.runs]
    table = _html_table(pushed) if pushed else ''
    page = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>tap_ros: demo</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 1120px; margin: 2rem auto;
  padding: 0 1rem; color: #222; background: #fff; }}
h1 {{ font-size: 1.5rem; }} h2 {{ font-size: 1.15rem; margin: 2.2rem 0 .6rem; }}
figure {{ display: inline-block; margin: 0 .8rem .8rem 0; vertical-align: top; }}
figcaption {{ font-size: .85rem; color: #555; max-width: 16rem; }}
img {{ image-rendering: pixelated; display: block; max-width: 100%; }}
img.smooth {{ image-rendering: auto; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ padding: .25rem .9rem; text-align: right; }} th:first-child {{ text-align: left; }}
thead th {{ border-bottom: 2px solid #222; }} tbody th {{ font-weight: normal; }}
tr.mean > * {{ font-weight: bold; border-bottom: 1px solid #ccc; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: .85rem;
  color: #555; }} dd {{ margin: 0; overflow-wrap: anywhere; }}
</style>
<h1>Predicted subgoals, and objects pushed to a goal picture via them</h1>
<p>The subgoal is what <code>/predict_subgoal</code> returned: a picture of a moment on the way,
with a probability map of where every object should then be. Where objects are pushed, each scene
was pushed twice: directly, and via the subgoal. Where a gripper is needed nothing was planned; the
film shows the expert whose recordings the predictor learned from.</p>
{table}
<p>{html.escape(note)}</p>
<dl>{made}</dl>
{body}</html>
"""
    write_atomically(path, page)


def write_overview(path: str | Path, scenes: Sequence[SceneRuns]) -> None:
    """
    Write one picture: a row for each scene with start, goal, subgoal and its object maps.

    :param path: of the PNG file.
    :param scenes: list of SceneRuns.
    """
    rows = [[picture for _, picture in _prediction(scene)] for scene in scenes]
    write_atomically(path, png_bytes(grid(rows)))


def _prediction(scene: SceneRuns) -> list[tuple[str, np.ndarray]]:
    """Return (caption, picture) of start, goal, subgoal and object maps."""
    k = len(scene.object_maps)
    maps = overlay(
        scene.start // 3, scene.object_maps, SCALE, scene.start_pixels, scene.goal_pixels)
    return [
        ('start', enlarge(scene.start, SCALE)), ('goal', enlarge(scene.goal, SCALE)),
        ('predicted subgoal', enlarge(scene.subgoal, SCALE)),
        (f'its object maps: {k} colours; circles mark the starts, crosses the goals', maps)]


def _scene_section(scene: SceneRuns) -> str:
    """Return the HTML of one scene."""
    pictures = _prediction(scene)
    for mode, run in scene.runs.items():
        final = 100 * run.distances[-1].mean()
        pictures.append((
            f'end, {MODE_NAMES[mode]}: {final:.1f} cm. {run.message}',
            enlarge(run.frames[-1], SCALE)))
    figures = ''.join(
        _figure(f'{MODE_NAMES[mode]}, seen from the side', _film(run.side), 'smooth', 'webp')
        for mode, run in scene.runs.items() if len(run.side))
    figures += ''.join(
        _figure(f'{MODE_NAMES[mode]}: ways that the planner considered; bold: the chosen one; '
                'crosses: where it pushes to', _film(run.plans), 'smooth', 'webp')
        for mode, run in scene.runs.items() if len(run.plans))
    if len(scene.expert):
        figures += _figure('the expert, seen from the side', _film(scene.expert), 'smooth', 'webp')
    figures += ''.join(_figure(caption, png_bytes(image)) for caption, image in pictures)
    strips = ''.join(
        _figure(f'{MODE_NAMES[mode]}: frames 0 to {len(run.frames) - 1}, median planning time '
                f'{run.planning_ms:.0f} ms', png_bytes(grid([film_strip(run.frames)], scale=2)))
        for mode, run in scene.runs.items())
    plot = _figure('error over time', _error_plot(scene), 'smooth') if scene.runs else ''
    return f'<h2>{html.escape(scene.name)}</h2>{figures}{plot}{strips}'


def _film(pictures: Sequence[np.ndarray]) -> bytes:
    """Return an animated WebP that begins anew after it has stood still for a while."""
    first, *others = (Image.fromarray(picture) for picture in pictures)
    buffer = io.BytesIO()
    times = [FRAME_MS] * len(others) + [HOLD_MS]
    first.save(buffer, 'webp', save_all=True, append_images=others, duration=times, loop=0,
               quality=FILM_QUALITY)
    return buffer.getvalue()


def _figure(caption: str, picture: bytes, kind: str = '', form: str = 'png') -> str:
    data = base64.b64encode(picture).decode()
    return (f'<figure><img class="{kind}" alt="{html.escape(caption)}" '
            f'src="data:image/{form};base64,{data}"><figcaption>{html.escape(caption)}'
            '</figcaption></figure>')


def _error_plot(scene: SceneRuns) -> bytes:
    """Plot the mean distance of the objects to their goals over time; return PNG bytes."""
    figure = Figure(figsize=(5.2, 2.6), dpi=100, layout='constrained')
    axes = figure.subplots()
    for mode, run in scene.runs.items():
        colour = MODE_COLOURS[mode]
        axes.plot(100 * run.distances.mean(1), color=colour, label=MODE_NAMES[mode], lw=2)
        axes.plot(100 * run.distances, color=colour, lw=0.7, alpha=0.6)
    axes.plot([], color='#555', lw=0.7, label='thin: each object; thick: their mean')
    axes.axhline(20, color='#999', ls=':', label='do nothing')
    axes.set(xlabel='step', ylabel='distance to the goal, cm', ylim=(0, None))
    axes.legend(fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png')
    return buffer.getvalue()
