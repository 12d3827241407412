# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the demo leaves of its scenes: a table, a self-contained HTML page, a film."""

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import io
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

import cv2
from jinja2 import Environment
import numpy as np
from PIL import Image
from tap_ros.files import write_atomically
from tap_ros.images.drawing import (
    enlarge,
    film_strip,
    grid,
    OBJECT_COLOURS,
    overlay,
    png_bytes,
)

SCALE = 4
SMALL = 128  # pixels, side of goal and subgoal, one above the other on the left of the film
GAP, HEAD = 8, 24  # pixels between panels of the film, and above them for the names
HEIGHT = 2 * SMALL + HEAD  # of a run's picture beside both
FRAME_MS, HOLD_MS = 100, 1800  # of a film: of each frame, and of the end of a scene
QUALITY = 70  # of films, 0 to 100
MODE_NAMES = {'direct': 'direct', 'subgoal': 'via the subgoal'}


@dataclass(frozen=True)
class Run:
    """One attempt at a scene."""

    frames: list[np.ndarray]  # T + 1 pictures (H, W, 3) uint8
    distances: np.ndarray  # (T + 1, K) metres from each object to its goal
    message: str  # how the planner said that it ended
    planning_ms: float  # median time of one plan
    side: Sequence[np.ndarray] = ()  # pictures (H, W, 3) uint8 from the side, if there are any
    plans: Sequence[np.ndarray] = ()  # pictures (H, W, 3) uint8 of what the planner considered


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


def final_distances(scenes: Sequence[SceneRuns]) -> Iterator[tuple[str, np.ndarray]]:
    """
    Yield how far from their goals the objects ended, of each scene and as the mean of a task.

    :param scenes: SceneRuns with the same modes, those of a task together.
    :return: iterator of a label, and cm, mean over the objects: nothing done, then each mode.
    """
    for task, group in groupby(scenes, lambda scene: scene.task):
        kept = []
        for scene in group:
            ends = [run.distances[-1].mean() for run in scene.runs.values()]
            start = next(iter(scene.runs.values())).distances[0].mean()
            kept.append(100 * np.array([start, *ends]))
            yield f'{scene.task} {scene.seed}', kept[-1]
        yield f'{task}, mean of {len(kept)}', np.mean(kept, 0)


def results_table(scenes: Sequence[SceneRuns]) -> str:
    """Return final_distances as lines of text."""
    head = f'{"final mean distance, cm":<26}' + ''.join(
        f'{name:>12}' for name in ('do nothing', *scenes[0].runs))
    return '\n'.join([head, '-' * len(head), *(
        f'{label:<26}' + ''.join(f'{d:>12.1f}' for d in distances)
        for label, distances in final_distances(scenes))])


def write_report(path: str | Path, scenes: Sequence[SceneRuns], note: str = '',
                 facts: Mapping[str, str] = MappingProxyType({})) -> None:
    """
    Write the page; everything is inside the one file.

    :param path: of the HTML file.
    :param scenes: list of SceneRuns.
    :param note: a sentence on how the numbers were made.
    :param facts: what made the page: name and value, such as date, commit and command.
    """
    template = Path(__file__).with_name('report.html').read_text()
    pushed = [scene for scene in scenes if scene.runs]
    write_atomically(path, Environment(autoescape=True).from_string(template).render(
        rows=list(final_distances(pushed)),
        modes=[MODE_NAMES[mode] for mode in pushed[0].runs] if pushed else (),
        note=note, facts=facts, scenes=[
            (f'{scene.task} {scene.seed}', list(_figures(scene))) for scene in scenes]))


def write_film(path: str | Path, scenes: Sequence[SceneRuns]) -> None:
    """
    Write the scenes one after the other: direct beside via the subgoal, seen from the side.

    :param path: of the WebP file.
    :param scenes: list of SceneRuns with the same modes; crosses mark where objects should end.
    """
    pictures, times = [], list[int]()
    for scene in scenes:
        left = np.concatenate([
            _panel(scene.goal, SMALL, 'goal', scene.goal_pixels),
            _panel(scene.subgoal, SMALL, 'predicted subgoal', ())])
        views = {mode: run.side if len(run.side) else run.frames
                 for mode, run in scene.runs.items()}
        length = max(map(len, views.values()))
        for t in range(length):
            panels = [left]
            for mode, run in scene.runs.items():
                distances, picture = (values[min(t, len(values) - 1)]
                                      for values in (run.distances, views[mode]))
                goals = scene.side_goal_pixels if len(run.side) else scene.goal_pixels
                panels += [np.full((len(left), GAP, 3), 255, np.uint8), _panel(
                    picture, HEIGHT, f'{MODE_NAMES[mode]}: {100 * distances.mean():.1f} cm',
                    () if goals is None else goals)]
            pictures.append(np.concatenate(panels, axis=1))
        times += [FRAME_MS] * (length - 1) + [HOLD_MS]
    write_atomically(path, _film(pictures, times))


def _panel(picture: np.ndarray, height: int, name: str,
           goals: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Return a picture of a height under its name, with crosses at goals (u, v)."""
    scale = height / len(picture)
    picture = cv2.resize(picture, (round(scale * picture.shape[1]), height),
                         interpolation=cv2.INTER_NEAREST)
    for k, (u, v) in enumerate((np.asarray(goals).reshape(-1, 2) + 0.5) * scale):
        cv2.drawMarker(picture, (int(u), int(v)), OBJECT_COLOURS[k % len(OBJECT_COLOURS)],
                       cv2.MARKER_TILTED_CROSS, 10, 2, cv2.LINE_AA)
    head = np.full((HEAD, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(head, name, (0, HEAD - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (34, 34, 34), 1,
                cv2.LINE_AA)
    return np.concatenate([head, picture])


def _film(pictures: Sequence[np.ndarray], times: Sequence[int] = ()) -> bytes:
    """Return an animated WebP of pictures and ms that begins anew for ever."""
    first, *others = (Image.fromarray(picture) for picture in pictures)
    buffer = io.BytesIO()
    first.save(buffer, 'webp', save_all=True, append_images=others, quality=QUALITY, loop=0,
               duration=list(times) or [FRAME_MS] * len(others) + [HOLD_MS])
    return buffer.getvalue()


def _prediction(scene: SceneRuns) -> list[tuple[str, np.ndarray]]:
    """Return (caption, picture) of start, goal, subgoal and object maps."""
    maps = overlay(
        scene.start // 3, scene.object_maps, SCALE, scene.start_pixels, scene.goal_pixels)
    return [
        ('start', enlarge(scene.start, SCALE)), ('goal', enlarge(scene.goal, SCALE)),
        ('predicted subgoal', enlarge(scene.subgoal, SCALE)),
        (f'its object maps: {len(scene.object_maps)} colours; circles mark the starts, crosses '
         'the goals', maps)]


def _figures(scene: SceneRuns) -> Iterator[tuple[str, str]]:
    """Yield (caption, data URI) of all that the page shows of a scene."""
    films = [('the expert, seen from the side', scene.expert)]
    for mode, run in scene.runs.items():
        films += [(f'{MODE_NAMES[mode]}, seen from the side', run.side),
                  (f'{MODE_NAMES[mode]}: ways that the planner considered; bold: the chosen one; '
                   'crosses: where it pushes to', run.plans)]
    for caption, pictures in films:
        if len(pictures):
            yield caption, _uri('webp', _film(pictures))
    for caption, picture in _prediction(scene):
        yield caption, _uri('png', png_bytes(picture))
    for mode, run in scene.runs.items():
        yield (f'{MODE_NAMES[mode]}: {100 * run.distances[-1].mean():.1f} cm after '
               f'{len(run.frames) - 1} steps, median planning time {run.planning_ms:.0f} ms. '
               f'{run.message}', _uri('png', png_bytes(grid([film_strip(run.frames)], scale=2))))


def _uri(kind: str, data: bytes) -> str:
    return f'data:image/{kind};base64,{base64.b64encode(data).decode()}'
