# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rigid template of an object on the plane of the tops, compared at many poses."""

from dataclasses import dataclass

import cv2
import numpy as np
from tap_ros.tracking.picture import Palette, Picture
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.silhouette import outline

POINTS, RING = 120, 40  # of a template, inside and around
FAR = 22.0  # distance of colours that counts as none
HIDDEN = 0.4  # cost of a point behind the robot: hiding there is no way out
AROUND = 0.35  # weight of points beside the object that look like it
OWN, SAME = 0.7, 0.8  # of FAR, below which a point has a colour of the object, or its own
LEAST_SAME = 0.3  # share of points with their own colour without which nothing fits
CONTRAST = 8.0  # of object and table, below which the surrounding says nothing
ROUND = 0.06  # cost at the edge of the search: of two places alike the nearer one is meant


@dataclass(frozen=True)
class Pose:
    """Where a template was found; angle relative to the picture that it was cut from."""

    place: np.ndarray  # (2,) m
    angle: float  # rad
    cost: float  # 0 to 1.35
    seen: float  # share of the points that the robot does not hide
    fit: float  # share of those that have colours of the object


class Template:
    """
    Points of an object, with their colours, and points around it.

    :param mask: (h, w) bool of Picture, the object.
    :param place: (2,) of the object; points are relative to it.
    :param angle: of the object in this picture, relative to the first one, rad.
    :ivar area: px.
    :ivar outline: (N, 2) m around the place.
    """

    def __init__(self, picture: Picture, plane: Plane, mask: np.ndarray, place: np.ndarray,
                 angle: float = 0.0) -> None:
        rng = np.random.default_rng(0)
        self.place, self.angle, self.area = place, angle, int(mask.sum())
        pixels = _draw(mask, POINTS, rng)
        self.points = (plane.of_top(pixels) - place).astype(np.float32)
        flat = pixels @ (1, picture.size[1])
        self.colours = picture.lab[:, flat]  # (3, P)
        self.palette = Palette(self.colours.T)
        self.outline = plane.of_top(outline(mask)) - place
        inner, outer = (cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(
            cv2.MORPH_ELLIPSE, (side, side))) for side in (5, 9))
        beside = _draw(outer > inner, RING, rng)
        near = self.palette.look_up(picture.index[beside @ (1, picture.size[1])])
        self.contrast = float(np.median(near)) if len(near) else 0.0
        if self.contrast <= CONTRAST:
            beside = beside[:0]
        self.ring = (plane.of_top(beside) - place).astype(np.float32)

    def outlined(self, place: np.ndarray, angle: float) -> np.ndarray:
        """Return the outline (N, 2) of the object at a place, turned from the first picture."""
        c, s = np.cos(angle - self.angle), np.sin(angle - self.angle)
        return place + self.outline @ np.array([[c, s], [-s, c]])


class Matcher:
    """
    Compares templates with one picture.

    :param covered: (h, w) bool, what hides objects there; by default the robot.
    """

    def __init__(self, picture: Picture, plane: Plane, covered: np.ndarray | None = None) -> None:
        self.picture, self.plane = picture, plane
        self.covered = picture.hidden if covered is None else covered
        self._homography = plane.top.astype(np.float32)

    def score(self, template: Template, places: np.ndarray, angles: np.ndarray,
              thin: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Compare a template at S poses.

        :param places: (S, 2) m; angles: (S,) relative to the template's picture.
        :param thin: take every so many points.
        :return: (S,) each: cost, share seen, share that fits, see Pose.
        """
        index, free = self._look(template.points[::thin], places, angles)  # (S, P)
        difference = np.zeros(index.shape, np.float32)
        for axis, own in zip(self.picture.lab, template.colours):
            apart = axis[index]
            apart -= own[::thin]
            difference += np.abs(apart, out=apart)
        seen = free.mean(1)
        known = np.maximum(free.sum(1), 1)
        cost = (np.minimum(difference, FAR) * free).mean(1) / FAR + HIDDEN * (1 - seen)
        # other sides show as it turns: any of its colours fits
        any_colour = template.palette.look_up(self.picture.index[index]) < OWN * FAR
        fit = (any_colour & free).sum(1) / known
        fit = np.where(((difference < SAME * FAR) & free).sum(1) / known > LEAST_SAME, fit, 0)
        if len(template.ring):
            index, free = self._look(template.ring[::thin], places, angles)
            like = 1 - template.palette.look_up(self.picture.index[index]) / FAR
            cost += AROUND * (np.maximum(like, 0) * free).sum(1) / np.maximum(free.sum(1), 1)
        return cost, seen, fit

    def _look(self, points: np.ndarray, places: np.ndarray,
              angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flat pixels (S, P) of points (P, 2) at S poses, and whether they are seen."""
        places, angles = places.astype(np.float32), angles.astype(np.float32)
        c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x, y = points.T
        X, Y = places[:, :1] + (c * x - s * y), places[:, 1:] + (s * x + c * y)
        m = self._homography
        scale = m[2, 0] * X + m[2, 1] * Y
        scale += m[2, 2]
        u = ((m[0, 0] * X + m[0, 1] * Y + m[0, 2]) / scale + np.float32(0.5)).astype(np.int32)
        v = ((m[1, 0] * X + m[1, 1] * Y + m[1, 2]) / scale + np.float32(0.5)).astype(np.int32)
        h, w = self.picture.size
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        index = np.where(inside, v * w + u, 0)
        return index, inside & ~self.covered.ravel()[index]

    def refine(self, template: Template, place: np.ndarray, angle: float, reach: float,
               turn: float, levels: int = 3, pull: float = ROUND,
               least: float = 0.2) -> Pose | None:
        """
        Search around a pose, coarsely and then finely.

        :param angle: of the object, relative to the first picture.
        :param reach: m and turn: rad, how far at first.
        :param pull: cost of being reach away.
        :param least: share of the object that has to be seen.
        :return: the best Pose, its angle relative to the first picture; or None.
        """
        centre, wide = np.asarray(place), reach
        best, found = (centre, angle - template.angle), None
        for level in range(levels):
            places, angles = best[0] + reach * _GRID[:, :2], best[1] + turn * _GRID[:, 2]
            cost, seen, fit = self.score(template, places, angles, thin=1 + (level == 0))
            total = cost + pull * (((places - centre) / wide) ** 2).sum(1)
            total[seen < least] = np.inf
            j = int(total.argmin())
            if not np.isfinite(total[j]):
                return None
            best = places[j], float(angles[j])
            found = Pose(best[0], best[1] + template.angle, *map(
                float, (cost[j], seen[j], fit[j])))
            reach, turn = reach / 3.2, turn / 2.5
        return found


def _draw(mask: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return some pixels (N, 2) of a mask, drawn without order."""
    v, u = np.nonzero(mask)
    kept = rng.permutation(len(u))[:count]
    return np.column_stack([u[kept], v[kept]])


# (S, 3): x, y from -1 to 1 by seven steps, turned by five.
_GRID = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 2, np.linspace(-1, 1, 5), indexing='ij'),
                 -1).reshape(-1, 3)
