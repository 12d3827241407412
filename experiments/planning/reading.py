# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where objects are in a picture, by their colours alone, and what has to be moved to get there.

A pixel belongs to what has the nearest colour: an object, the hand, or the table behind it, also
in shadow. Colours are those of the scene at its start, where the simulator tells what is where. Of
a new picture nothing else is known: true, predicted and goal pictures are read alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from sim_bridge.world.scene import HALF_HEIGHT
from sim_bridge.world.studio import SAMPLES, SHADOW

# Of the light: so many samples of a pixel are in shadow.
SHADES = 1 - SHADOW * np.linspace(0, 1, SAMPLES ** 2 + 1)
CONTRAST = 14  # of 255: less is no difference to the table
# Faces that turn change in brightness more than in hue. This and the shares below were chosen in
# scenes from seed 700000 on, which are in no result.
BRIGHTNESS = 0.25  # what a difference in brightness weighs
FOREIGN = 40  # of 255, Euclidean: a colour farther than this from all known ones is no object's
SEEN = 0.2  # of the pixels that an object has at its start; a part with fewer is none of it
TWICE = 0.4  # likewise, of a part elsewhere that counts more than a larger one where the object is
ELSEWHERE = 8.0  # px from where an object is
LOW_SHARE = 90  # percent: what covers an object covers it from above, so its lower edge counts
STAYS = 3.0  # px; an object that is shown nearer to where it is now stays there
BESIDE = 4.0  # px, of an object beside the vertical through another one that it is to be put on
HANGS = 0.18  # m, highest place above another object where it is still read as on it
OUT_OF_SIGHT = 20.0  # m
HAND = (0.0, 0.0, 0.06)  # m, of the gripper where its colours are taken
OPENINGS = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class Move:
    """An object is to be put at a place, on whatever is there then."""

    object: int
    place: tuple[float, float]  # m


class PictureReader:
    """Finds the objects of a scene in pictures of it, from the moment after a reset."""

    def __init__(self, simulator, seen):
        away = seen.object_poses.copy()
        away[:, 0] = OUT_OF_SIGHT + np.arange(len(away))
        empty = simulator.photograph(away, hide_arm=True).image.astype(np.float32)
        bare = simulator.observe(hide_arm=True).image.astype(np.float32)
        table = np.stack([shade * empty for shade in SHADES])
        hands = [simulator.photograph(away, np.array([*HAND, opening])).image
                 for opening in OPENINGS]
        v, u = np.nonzero(_differs(bare, *table))
        gaps = np.stack([u, v], -1)[:, None] - seen.object_pixels
        nearest = np.linalg.norm(gaps, axis=-1).argmin(1)
        self._table = _weighed(table)
        self._colours = [_weighed(np.concatenate([
            hand[_differs(hand, *table)] for hand in hands])), *(
            _weighed(bare[v[nearest == k], u[nearest == k]]) for k in range(len(away)))]
        # An object that is as the table is never seen.
        parts = [_parts(mask)[0] if mask.any() else (np.inf, np.zeros(2))
                 for mask in self._masks(bare)]
        self._whole = [size for size, _ in parts]
        self._offsets = np.array([place for _, place in parts]) - seen.object_pixels

    def read(self, picture, now):
        """
        Return where objects are (K, 2), NaN for those not seen; now: (K, 2) where they are.

        What a picture shows twice, where it is and elsewhere, is taken to be elsewhere:
        predictions often leave what they move at its old place, too.
        """
        return np.array([self._find(k, mask, now[k])
                         for k, mask in enumerate(self._masks(picture))])

    def _masks(self, picture):
        """Yield the pixels (H, W) of each object."""
        picture = _weighed(picture)
        gaps = [np.linalg.norm(self._table - picture, axis=-1).min(0)]
        gaps += [_to_nearest(picture, colours) for colours in self._colours]
        nearest = np.argmin(gaps, axis=0)  # 0: table, 1: hand, 2 and up: objects
        known = np.min(gaps, axis=0) < FOREIGN
        for k in range(len(self._colours) - 1):
            yield known & (nearest == 2 + k)

    def _find(self, k, mask, now):
        """Return (2,), where a mask (H, W) shows object k, or NaN."""
        parts = [(size / self._whole[k], place - self._offsets[k]) for size, place in _parts(mask)]
        for share, place in parts:
            if share >= TWICE and np.linalg.norm(place - now) > ELSEWHERE:
                return place
        return parts[0][1] if parts and parts[0][0] >= SEEN else np.full(2, np.nan)


def _weighed(colours):
    """Return colours (..., 3), on 0..255, with differences in brightness made smaller."""
    colours = np.asarray(colours, np.float32)
    return colours - (1 - BRIGHTNESS) * colours.mean(-1, keepdims=True)


def _differs(picture, *others):
    """Say which pixels (H, W) differ from those of all other pictures."""
    return np.all([np.abs(picture - other).max(-1) > CONTRAST for other in others], axis=0)


def _to_nearest(picture, colours):
    """Return how far the colour of each pixel is from the nearest one of colours (N, 3)."""
    if not len(colours):
        return np.full(picture.shape[:2], np.inf)
    return np.linalg.norm(picture[..., None, :] - colours, axis=-1).min(-1)


def _parts(mask):
    """Return size and place (2,), middle column and lower edge, of a mask's parts, large first."""
    count, numbers, about, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=8)
    parts = []
    for i in range(1, count):
        v, u = np.nonzero(numbers == i)
        parts.append((len(v), np.array([u.mean(), np.percentile(v, LOW_SHARE)])))
    return sorted(parts, key=lambda part: -part[0])


def read_moves(pixels, poses, camera):
    """
    Return the Moves that put objects where a picture shows them, the lowest in it first.

    An object that is not seen (NaN) stays. One that is shown above another one, at any height, is
    to be put on that; else it is taken to lie on the table. That is wrong for one that is carried
    over the table, where a picture cannot tell height from depth.
    """
    gaps = np.linalg.norm(pixels - camera.project(poses[:, :3]), axis=1)
    moved = [k for k in np.argsort(-pixels[:, 1]) if gaps[k] >= STAYS]  # not NaN
    places = {k: poses[k, :2] for k in range(len(poses)) if k not in moved}
    for k in moved:
        below = [_height_above(pixels[k], place, camera) for place in places.values()]
        lowest = min(below, default=np.inf)
        places[k] = (list(places.values())[below.index(lowest)] if np.isfinite(lowest) else
                     camera.on_table(pixels[k], HALF_HEIGHT))
    return [Move(int(k), tuple(map(float, places[k]))) for k in moved]


def _height_above(pixel, place, camera):
    """Return how high, in m, above an object at (2,) m a pixel is; infinite where it is not."""
    heights = np.linspace(2 * HALF_HEIGHT, HANGS, 50)
    points = np.column_stack([np.tile(place, (len(heights), 1)), heights])
    gaps = np.linalg.norm(camera.project(points) - pixel, axis=1)
    return heights[gaps.argmin()] if gaps.min() < BESIDE else np.inf
