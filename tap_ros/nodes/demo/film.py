# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the demo: numbers on the objects, their ways, and what a run heads for beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
import io

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.messages.subgoals import Subgoal
from tap_ros.text import listing

SIDE = 256  # pixels, height of the film's panels
GAP, HEAD = 8, 26  # between panels, and above them for a line of text
# Of each picture; of the first, and where a run goes on from a subgoal; of the last.
FRAME_MS, START_MS, HOLD_MS = 120, 2500, 3500
QUALITY = 65  # of films, 0 to 100
INK, GOOD, BAD = (34, 34, 34), (0, 110, 70), (190, 30, 45)
GOAL = -1  # what a run heads for when it is no subgoal


@dataclass(frozen=True)
class Run:
    """One attempt at a scene: T steps, K objects."""

    distances: np.ndarray  # (T + 1, K) metres from each object to its goal
    pictures: Sequence[np.ndarray]  # (H, W, 3) uint8: T + 1 of them, or the first and the last
    pixels: np.ndarray  # (T + 1, K, 2) of the objects in these pictures
    heading: Sequence[int]  # (T,) which subgoal it heads for, or GOAL
    subgoals: Sequence[Subgoal]  # in turn
    message: str  # how the planner said that it ended
    planning_ms: float  # median time of one plan

    def heading_at(self, t: int) -> int:
        """Return what it heads for after t steps, in the end as before."""
        return self.heading[min(t, len(self.heading) - 1)] if self.heading else GOAL

    @property
    def reached(self) -> bool:
        """Whether every object ended near its goal."""
        return bool((self.distances[-1] < SUCCESS_DISTANCE).all())

    @property
    def final_cm(self) -> float:
        """Return how far the objects ended from their goals, mean, in cm."""
        return float(100 * self.distances[-1].mean())


@dataclass(frozen=True)
class Scene:
    """A scene and the attempts at it."""

    task: str
    seed: int
    goal: np.ndarray  # (H, W, 3) uint8
    start_pixels: np.ndarray  # (K, 2) where the objects were, in pixels of the goal picture
    goal_pixels: np.ndarray  # (K, 2)
    goals: np.ndarray  # (K, 2) the true goals, in the pictures of the runs
    order: Sequence[int]  # of the objects, the only one that works; (): any does
    runs: dict[str, Run]  # 'direct' and 'subgoal'

    @property
    def numbers(self) -> list[str]:
        """Return what people call each object: its place in the right order."""
        order = list(self.order) or list(range(len(self.goals)))
        return [str(order.index(k) + 1) for k in range(len(self.goals))]

    def decided(self, subgoal: Subgoal) -> str:
        """Say what a predicted subgoal decides, from where it shows the objects alone."""
        start, goal = (self._shrunk(pixels, subgoal) for pixels in (
            self.start_pixels, self.goal_pixels))
        away = np.linalg.norm(subgoal.expected_pixels - start, axis=1)
        left = np.linalg.norm(subgoal.expected_pixels - goal, axis=1)
        done = sorted(number for number, moved in zip(self.numbers, left < away) if moved)
        return f'{listing(done)} first' if 0 < len(done) < len(self.goals) else (
            'all at once' if done else 'none yet')

    def headed(self, heading: int) -> np.ndarray:
        """Draw what a run heads for, a subgoal or the goal picture."""
        if heading == GOAL:
            return mark(self.goal, self.goal_pixels, self.numbers)
        subgoal = self.runs['subgoal'].subgoals[heading]
        return mark(subgoal.image, subgoal.expected_pixels, self.numbers,
                    self._shrunk(self.start_pixels, subgoal), subgoal.expected_pixels)

    def seen(self, mode: str, t: int) -> np.ndarray:
        """Draw what was seen of a run after t steps; -1: in the end."""
        run = self.runs[mode]
        return mark(run.pictures[t], run.pixels[t], self.numbers, run.pixels[0], self.goals)

    def _shrunk(self, pixels: np.ndarray, subgoal: Subgoal) -> np.ndarray:
        """Return pixels of the goal picture in those of a subgoal, which is smaller."""
        return (pixels + 0.5) * len(subgoal.image) / len(self.goal) - 0.5


def mark(picture: np.ndarray, places: np.ndarray, numbers: Sequence[str],
         starts: np.ndarray | None = None, ends: np.ndarray | None = None) -> np.ndarray:
    """
    Return a picture of height SIDE with a number above each object.

    :param picture: uint8 (H, W, 3); places: (K, 2) of the objects; numbers: K.
    :param starts: (K, 2) of arrows to ends (K, 2), or None.
    """
    scale = SIDE / len(picture)
    canvas = cv2.resize(
        picture, (round(scale * picture.shape[1]), SIDE),
        interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)

    def at(pixels: np.ndarray) -> list[tuple[int, int]]:
        return [(int(u), int(v)) for u, v in (np.asarray(pixels) + 0.5) * scale]

    for k, (first, last) in enumerate(
            zip(at(starts), at(ends)) if starts is not None and ends is not None else ()):
        if np.hypot(*np.subtract(last, first)) > 6:
            for colour, width in (((255, 255, 255), 4), (OBJECT_COLOURS[k], 2)):
                cv2.arrowedLine(canvas, first, last, colour, width, cv2.LINE_AA, tipLength=0.2)
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    for k, (u, v) in enumerate(at(places)):
        draw.circle((u, v - 15), 9, fill=OBJECT_COLOURS[k], outline=(255, 255, 255))
        draw.text((u, v - 15), numbers[k], (255, 255, 255), ImageFont.load_default(14),
                  anchor='mm', stroke_width=1, stroke_fill=INK)
    return np.array(image)


def film(scene: Scene) -> bytes:
    """Return an animated WebP of both attempts, one above the other, that begins anew for ever."""
    length = max(len(run.pictures) for run in scene.runs.values())
    first, *others = (Image.fromarray(_frame(scene, t)) for t in range(length))
    buffer = io.BytesIO()
    first.save(buffer, 'webp', save_all=True, append_images=others, quality=QUALITY, loop=0,
               duration=[*(_pause(scene, t) for t in range(length - 1)), HOLD_MS])
    return buffer.getvalue()


def _pause(scene: Scene, t: int) -> int:
    """Return the ms that step t is shown."""
    goes_on = any(run.heading_at(t) != run.heading_at(t - 1) for run in scene.runs.values())
    return START_MS if t == 0 or goes_on else FRAME_MS


def _frame(scene: Scene, t: int) -> np.ndarray:
    """Draw step t of both attempts."""
    rows = [np.concatenate([_line(*_title(scene, mode, t)), _panels(scene, mode, t)])
            for mode in scene.runs]
    width = rows[0].shape[1]
    if scene.order:
        rows.insert(0, _line(f'{order_in_words(scene)}.', width=width))
    gap = np.full((GAP, width, 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (gap, row)])


def order_in_words(scene: Scene) -> str:
    """Say which order works, and why."""
    numbers = ', '.join(str(i + 1) for i in range(len(scene.order)))
    return f'Only the order {numbers} works: ' + (
        '1 stands where 2 has to go' if len(scene.order) == 2 else
        'each stands where the next has to go')


def _panels(scene: Scene, mode: str, t: int) -> np.ndarray:
    """Draw what a run heads for, and what is seen of it."""
    run = scene.runs[mode]
    seen = scene.seen(mode, min(t, len(run.pictures) - 1))
    return np.concatenate(
        [scene.headed(run.heading_at(t)), np.full((SIDE, GAP, 3), 255, np.uint8), seen], axis=1)


def _title(scene: Scene, mode: str, t: int) -> tuple[str, str, tuple[int, int, int], int]:
    """Return what stands above a run: left, right, and the colour of that; the width."""
    run, width = scene.runs[mode], _panels(scene, mode, 0).shape[1]
    name = 'Direct: straight to the goal picture'
    if run.subgoals:
        heading = run.heading_at(t)
        name = ('Subgoal done, now the goal picture' if heading == GOAL else
                f'Predicted subgoal: {scene.decided(run.subgoals[heading])}')
    distances = run.distances[min(t, len(run.distances) - 1)]
    left = f'{scene.numbers[distances.argmax()]} is {100 * distances.max():.0f} cm off'
    if t < len(run.distances) - 1:
        return name, left, INK, width
    limit = f'{100 * SUCCESS_DISTANCE:.0f} cm'
    return name, (f'reached: all within {limit}' if run.reached else f'failed: {left}'), (
        GOOD if run.reached else BAD), width


def _line(left: str, right: str = '', colour: tuple[int, int, int] = INK,
          width: int = 0) -> np.ndarray:
    """Draw a line of text, uint8 (HEAD, width, 3)."""
    image = Image.new('RGB', (width, HEAD), 'white')
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(17)
    draw.text((2, HEAD // 2), left, INK, font, anchor='lm')
    draw.text((width - 2, HEAD // 2), right, colour, font, anchor='rm')
    return np.array(image)
