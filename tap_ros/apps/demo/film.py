# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the demo: numbers on the objects, their ways, and what a run heads for beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
import io

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tap_ros.base.contract import SUCCESS_DISTANCE
from tap_ros.base.text import listing
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.messages.subgoals import Subgoal

SIDE = 300  # pixels, of the film's panels
MARGIN, LEAST = 0.13, 0.5  # around the objects, and side of the part shown; of a picture's height
GAP, HEAD = 8, 26  # between panels, and above them for a line of text
WIDTH = 2 * SIDE + GAP
# Of each picture; of the first, and where a run goes on from a subgoal; of the last.
FRAME_MS, START_MS, HOLD_MS = 120, 2500, 3500
CODING = {'quality': 80, 'method': 2, 'kmax': 0}  # of films, without key frames
INK, GOOD, BAD = (34, 34, 34), (0, 110, 70), (190, 30, 45)
GOAL = -1  # what a run heads for when it is no subgoal


@dataclass(frozen=True)
class Run:
    """One attempt at a scene: T steps, K objects."""

    distances: np.ndarray  # (T + 1, K) metres from each object to its goal
    # uint8 (H, W, 3) of the camera's view: T + 1 with the arm, or the first and last without
    pictures: Sequence[np.ndarray]
    pixels: np.ndarray  # (T + 1, K, 2) of the objects, in pixels of the goal picture
    heading: Sequence[int]  # (T,) which subgoal it heads for, or GOAL
    subgoals: Sequence[Subgoal]  # in turn
    message: str  # how the planner said that it ended
    planning_ms: float  # median time of one plan

    def heading_at(self, t: int) -> int:
        """Return what it heads for after t steps, in the end as before."""
        return self.heading[min(t, len(self.heading) - 1)] if self.heading else GOAL

    def begun_at(self, t: int) -> int:
        """Return since which step it has headed for what it does after t steps."""
        return next(i for i in range(len(self.pixels)) if self.heading_at(i) == self.heading_at(t))

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
    order: Sequence[int]  # of the objects, the only one that works; (): any does
    runs: dict[str, Run]  # 'direct' and 'subgoal'

    @property
    def numbers(self) -> list[str]:
        """Return what people call each object: its place in the right order."""
        order = list(self.order) or list(range(len(self.goal_pixels)))
        return [str(order.index(k) + 1) for k in range(len(order))]

    @property
    def window(self) -> tuple[float, float, float]:
        """Return the part of pictures that is shown: left, top and side, of the goal picture."""
        height, width = self.goal.shape[:2]
        places = np.concatenate([self.goal_pixels, *(
            run.pixels.reshape(-1, 2) for run in self.runs.values())])
        low, high = places.min(0), places.max(0)
        side = float(np.clip(
            (high - low).max() + 2 * MARGIN * height, LEAST * height, min(height, width)))
        left, top = np.clip((low + high + 1 - side) / 2, 0, (width - side, height - side))
        return float(left), float(top), side

    def decided(self, subgoal: Subgoal) -> str:
        """Say what a predicted subgoal decides, from where it shows the objects alone."""
        expected = self._expected(subgoal)
        away, left = (np.linalg.norm(expected - pixels, axis=1) for pixels in (
            self.start_pixels, self.goal_pixels))
        done = sorted(number for number, moved in zip(self.numbers, left < away) if moved)
        return f'{listing(done)} first' if 0 < len(done) < len(self.numbers) else (
            'all at once' if done else 'none yet')

    def headed(self, heading: int) -> np.ndarray:
        """Draw what a run heads for, a subgoal or the goal picture."""
        if heading == GOAL:
            return self._mark(self.goal, self.goal_pixels)
        subgoal = self.runs['subgoal'].subgoals[heading]
        expected = self._expected(subgoal)
        return self._mark(subgoal.image, expected, self.start_pixels, expected)

    def seen(self, mode: str, t: int) -> np.ndarray:
        """Draw what was seen of a run after t steps, -1: in the end, and what it pushes where."""
        run = self.runs[mode]
        heading = run.heading_at(t)
        ends = self.goal_pixels if heading == GOAL else self._expected(run.subgoals[heading])
        return self._mark(run.pictures[t], run.pixels[t], run.pixels[run.begun_at(t)], ends)

    def _expected(self, subgoal: Subgoal) -> np.ndarray:
        """Return where a subgoal shows the objects, in pixels of the goal picture."""
        return (subgoal.expected_pixels + 0.5) * len(self.goal) / len(subgoal.image) - 0.5

    def _mark(self, picture: np.ndarray, places: np.ndarray, starts: np.ndarray | None = None,
              ends: np.ndarray | None = None) -> np.ndarray:
        """
        Return the window of a picture, (SIDE, SIDE, 3), with a number above each object.

        :param picture: uint8 (H, W, 3) of the camera's view; places: (K, 2) of the objects.
        :param starts: (K, 2) of arrows to ends (K, 2), or None.
        """
        left, top, side = self.window
        scale, finer = SIDE / side, len(picture) / len(self.goal)
        step = finer / scale  # pixels of the picture in one that is shown
        canvas = cv2.warpAffine(
            picture, np.array([[step, 0, (finer * left) + step / 2 - 0.5],
                               [0, step, (finer * top) + step / 2 - 0.5]]), (SIDE, SIDE),
            flags=cv2.WARP_INVERSE_MAP | (cv2.INTER_LINEAR if step > 0.3 else cv2.INTER_NEAREST))

        def at(pixels: np.ndarray) -> list[tuple[int, int]]:
            return [(int(u), int(v)) for u, v in (pixels + 0.5 - (left, top)) * scale]

        for k, (first, last) in enumerate(
                zip(at(starts), at(ends)) if starts is not None and ends is not None else ()):
            if np.hypot(*np.subtract(last, first)) > SIDE / 20:
                for colour, width in (((255, 255, 255), 5), (OBJECT_COLOURS[k], 3)):
                    cv2.arrowedLine(canvas, first, last, colour, width, cv2.LINE_AA, tipLength=0.2)
        image = Image.fromarray(canvas)
        draw = ImageDraw.Draw(image)
        for k, (u, v) in enumerate(at(places)):
            draw.ellipse((u - 10, v - 28, u + 10, v - 8), OBJECT_COLOURS[k], (255, 255, 255))
            draw.text((u, v - 18), self.numbers[k], (255, 255, 255), ImageFont.load_default(16),
                      anchor='mm', stroke_width=1, stroke_fill=INK)
        return np.array(image)


def film(scene: Scene) -> bytes:
    """Return an animated WebP of both attempts, one above the other, that begins anew for ever."""
    length = max(len(run.pictures) for run in scene.runs.values())
    first, *others = (Image.fromarray(_frame(scene, t)) for t in range(length))
    buffer = io.BytesIO()
    first.save(buffer, 'webp', save_all=True, append_images=others, loop=0, **CODING,
               duration=[*(_pause(scene, t) for t in range(length - 1)), HOLD_MS])
    return buffer.getvalue()


def _pause(scene: Scene, t: int) -> int:
    """Return the ms that step t is shown."""
    goes_on = any(run.heading_at(t) != run.heading_at(t - 1) for run in scene.runs.values())
    return START_MS if t == 0 or goes_on else FRAME_MS


def _frame(scene: Scene, t: int) -> np.ndarray:
    """Draw step t of both attempts: what each heads for, and what is seen of it."""
    beside = np.full((SIDE, GAP, 3), 255, np.uint8)
    rows = [_line(f'{order_in_words(scene)}.')] if scene.order else []
    for mode, run in scene.runs.items():
        step = min(t, len(run.pictures) - 1)
        heading = run.heading_at(step)
        aim = _named(scene.headed(heading),
                     'goal picture' if heading == GOAL else 'predicted subgoal')
        now = _named(scene.seen(mode, step), 'now; arrows: where to')
        rows.append(np.concatenate([
            _line(*_title(scene, mode, step)), np.concatenate([aim, beside, now], 1)]))
    gap = np.full((GAP, WIDTH, 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (gap, row)])


def _named(panel: np.ndarray, name: str) -> np.ndarray:
    """Write the name of a panel into its lower left corner."""
    image = Image.fromarray(panel)
    ImageDraw.Draw(image).text(
        (8, len(panel) - 8), name, (255, 255, 255), ImageFont.load_default(15), anchor='ls',
        stroke_width=2, stroke_fill=INK)
    return np.array(image)


def order_in_words(scene: Scene) -> str:
    """Say which order works, and why."""
    numbers = ', '.join(str(i + 1) for i in range(len(scene.order)))
    return f'Only the order {numbers} works: ' + (
        'object 1 is in the way of object 2' if len(scene.order) == 2
        else 'each is in the way of the next')


def _title(scene: Scene, mode: str, t: int) -> tuple[str, str, tuple[int, int, int]]:
    """Return what stands above a run after t steps: left, right, and the colour of that."""
    run = scene.runs[mode]
    name = 'Direct: straight to the goal picture'
    if run.subgoals:
        heading = run.heading_at(t)
        name = ('Subgoal done, now the goal picture' if heading == GOAL else
                f'Predicted subgoal: {scene.decided(run.subgoals[heading])}')
    distances = run.distances[t]
    far = f'object {scene.numbers[distances.argmax()]}, {100 * distances.max():.0f} cm'
    if t < len(run.distances) - 1:
        return name, f'farthest off: {far}', INK
    limit = f'{100 * SUCCESS_DISTANCE:.0f} cm'
    return (name, f'reached: all within {limit}', GOOD) if run.reached else (
        name, f'failed: {far} off', BAD)


def _line(left: str, right: str = '', colour: tuple[int, int, int] = INK) -> np.ndarray:
    """Draw a line of text, uint8 (HEAD, WIDTH, 3)."""
    image = Image.new('RGB', (WIDTH, HEAD), 'white')
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(17)
    draw.text((2, HEAD // 2), left, INK, font, anchor='lm')
    draw.text((WIDTH - 2, HEAD // 2), right, colour, font, anchor='rm')
    return np.array(image)
