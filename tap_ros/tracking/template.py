# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rigid template of an object on the plane of the tops, searched in pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from tap_ros.tracking.picture import NEAR, Palette, Picture
from tap_ros.tracking.plane import EDGE, MIDDLE, TOP
from tap_ros.tracking.silhouette import top_face

POINTS, RING = 120, 40  # of a template, inside and around
FAR = 22  # distance of colours that counts as none
HIDDEN = 0.4  # cost of a point behind the robot: hiding there is no way out
AROUND = 0.35  # weight of points beside the object that look like it
SAME = 17.6  # distance below which a point has its own colour
SURE, SHOWN = 0.9, 0.3  # confidence in a pose and share seen, from which on it is sure
MERGED = 0.4  # more of the points around have its colours than did: it is not told from those
LEAST_SEEN = 0.2  # share of an object without which no pose near by is believed
LEAST_SAME = 0.3  # share of points with their own colour without which nothing fits
CONTRAST = 8.0  # of object and table, below which the surrounding says nothing
ROUND = 0.06  # cost at the edge of the search: of two places alike the nearer one is meant
# Anywhere in a picture: places that have the colours of an object, then poses.
LEAST_FAR = 0.3  # share of an object that has to be seen
PLACES, TRIED = 6, 4  # that are tried, and turns at each of them that are tried finely
APART = 0.035  # m from other objects
_TURNS = np.linspace(-np.pi, np.pi, 16, endpoint=False)
# Of refine: places along x and y, turns, every so many points, and what the next level is of this.
_LEVELS = ((7, 5, 2, 1 / 3.2, 1 / 2.5), (5, 5, 1, 1 / 3, 1 / 2.5), (5, 3, 1, 1 / 3, 1 / 2.5),
           (3, 3, 1, 1 / 3, 1 / 2.5))
# Of a pose's fit, cost and seen: logistic regression on 11,000 poses in simulated scenes, others
# than those of docs/results/tracking.md.
_BIAS, _FIT, _COST, _SEEN = 1.74, 3.25, 7.59, 2.55


class Template:
    """
    Points of an object, with their colours, and points around it.

    :param mask: (h, w) bool of Picture, the object.
    :param place: (3,) of the object; points are relative to it.
    :param angle: of the object in this picture, relative to the first one, rad.
    :param top: compare its top alone.
    :ivar area: px.
    :ivar metric: Metric of the colours.
    :ivar outline: (N, 2) m around the place.
    """

    def __init__(self, picture: Picture, mask: np.ndarray, place: np.ndarray,
                 angle: float, top: bool = False) -> None:
        plane, rng = picture.plane, np.random.default_rng(0)
        part = top_face(mask, plane) if top else mask
        self.place, self.angle, self.area = place, angle, int(mask.sum())
        self.metric = picture.metric
        self.palette = Palette(picture.lab[mask], self.metric)
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL,
                                       cv2.CHAIN_APPROX_TC89_L1)
        self.outline = plane.places(max(outlines, key=len)[:, 0])[:, :2] - place[:2]
        if plane.blur:  # pixels at its edge are mixed with the table
            inside = cv2.erode(part.astype(np.uint8), _round(2 * plane.blur + 1)) > 0
            part = inside if inside.sum() > 0.3 * part.sum() else part
        pixels = _draw(part, POINTS, rng)
        self.points = (plane.places(pixels) - place)[:, :2].astype(np.float32)
        self.colours = np.pad(picture.lab[pixels[:, 1], pixels[:, 0]], ((0, 0), (0, 1)))
        self.indices = picture.index[pixels[:, 1], pixels[:, 0]]
        inner, outer = (cv2.dilate(part.astype(np.uint8), _round(side + 4 * plane.blur))
                        for side in (5, 9))
        beside = _draw(outer > inner, RING, rng)
        near = self.palette.distance(picture.index[beside[:, 1], beside[:, 0]])
        self.contrast = float(np.median(near)) if len(near) else 0.0
        self.beside = float((near < NEAR).mean()) if len(near) else 0.0
        self.outward: np.ndarray | None = None  # rad, of points around
        if plane.calibrated and top:  # sides of the object are beside it
            smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), 3)
            slope = -np.stack(np.gradient(smooth)[::-1], -1)[beside[:, 1], beside[:, 0]]
            out = plane.places(beside + slope) - plane.places(beside)
            self.outward = np.arctan2(out[:, 1], out[:, 0])
        elif self.contrast <= CONTRAST:
            beside = beside[:0]
        self.ring = (plane.places(beside) - place)[:, :2].astype(np.float32)

    def placed(self, points: np.ndarray, place: np.ndarray, angle: float) -> np.ndarray:
        """Return points (N, 2) m of the object at a place (3,), turned: (N, 3)."""
        c, s = np.cos(angle - self.angle), np.sin(angle - self.angle)
        return place + points @ np.array([[c, s, 0], [-s, c, 0]])


@dataclass(frozen=True)
class Pose:
    """Where a template was found; angle relative to the picture that it was cut from."""

    template: Template
    place: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))  # (3,) m
    angle: float = 0.0  # rad
    cost: float = np.inf  # 0 to 1.35; inf: it was not found
    seen: float = 0.0  # share of the points that the robot does not hide
    fit: float = 0.0  # share of those that have colours of the object
    alone: bool = False  # what is around does not look like the object, too

    @property
    def confidence(self) -> float:
        """The probability that it is right within 2 px of a picture of 64."""
        value = _BIAS + _FIT * self.fit - _COST * self.cost + _SEEN * self.seen
        return float(1 / (1 + np.exp(-value)))

    @property
    def sure(self) -> bool:
        """Whether what is there looks like what was clicked."""
        return self.confidence > SURE and self.seen > SHOWN and self.alone


class Matcher:
    """
    Compares templates with one picture.

    :param covered: (h, w) bool, what hides objects there; by default the robot.
    """

    def __init__(self, picture: Picture, covered: np.ndarray | None = None) -> None:
        self.picture = picture
        self.covered = picture.hidden if covered is None else covered
        # A colour is read as one word, negative where it is covered, as beside the picture.
        words = cv2.merge([picture.lab, np.where(self.covered, np.uint8(255), np.uint8(0))])
        self._words = np.append(np.asarray(words).view(np.int32).ravel(), np.int32(-1))
        self._likeness: dict[Template, np.ndarray] = {}

    def likeness(self, template: Template) -> np.ndarray:
        """Return how like its colours each pixel is, flat: 0 to 1, 0 if covered or beside."""
        if template not in self._likeness:
            like = 1 - template.palette.distance(self.picture.index) / FAR
            self._likeness[template] = np.append(like.clip(0) * ~self.covered, np.float32(0))
        return self._likeness[template]

    def score(self, template: Template, places: np.ndarray, angles: np.ndarray,
              thin: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """
        Compare a template at all places with all angles.

        :param places: (S, 3) m; angles: (A,) relative to the template's picture.
        :param thin: take every so many points.
        :return: (A, S) each: cost, share seen, see Pose.
        """
        apart, free = self._apart(template, self._look(template.points[::thin], places, angles),
                                  thin)
        seen = _mean(free)
        cost = _mean(np.minimum(apart, FAR)) / FAR + (HIDDEN - 1) * (1 - seen)
        if len(template.ring):
            index = self._look(template.ring[::thin], places, angles)
            like, free = self.likeness(template).take(index), self._words.take(index) >= 0
            if template.outward is not None:
                x, y = self.picture.plane.eye - places.mean(0)[:2]
                away = np.cos(template.outward[::thin] + angles[:, None]
                              - np.arctan2(y, x)) < 0.2  # (A, R)
                like, free = like * away[:, None], free & away[:, None]
            cost += AROUND * _mean(like) / np.maximum(_mean(free), 1e-3)
        return cost, seen

    def fit(self, template: Template, place: np.ndarray, angle: float) -> tuple[float, bool]:
        """Return fit and alone of a Pose."""
        turned = np.array([angle])
        index = self._look(template.points, place[None], turned)
        apart, free = self._apart(template, index)
        same, known = (apart < SAME) & free, max(int(free.sum()), 1)
        if same.sum() <= LEAST_SAME * known:
            return 0.0, False
        # other sides show as it turns: any of its colours fits
        like = self.likeness(template)
        own = like.take(index) > 1 - NEAR / FAR
        beside = like.take(self._look(template.ring, place[None], turned))
        # where the camera is known only planks of its colour were beside it, and no other object
        alone = self.picture.plane.calibrated or not beside.size or (
            (beside > 1 - NEAR / FAR).mean() <= template.beside + MERGED)
        return float((same | own).sum() / known), bool(alone)

    def _apart(self, template: Template, index: np.ndarray,
               thin: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return how colours (A, S, P) differ from the template's; and which are seen."""
        words, own = self._words.take(index), template.colours[::thin].ravel()
        read = words.view(np.uint8).reshape(-1, len(own))
        apart = np.asarray(cv2.absdiff(read, np.tile(own, (len(read), 1))))
        sums = apart.reshape(-1, 4).astype(np.float32) @ np.ones(4, np.float32)
        return sums.reshape(index.shape), words >= 0

    def _look(self, points: np.ndarray, places: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return the flat pixels (A, S, P) of points (P, 2) of a template at all poses."""
        h, w = self.picture.size
        c, s = np.cos(angles), np.sin(angles)
        x, y = points.T
        X, Y = np.outer(c, x) - np.outer(s, y), np.outer(s, x) + np.outer(c, y)  # (A, P)
        matrix, tops = self.picture.plane.matrix, places + (0, 0, TOP)
        u, v, scale = (np.add((row[0] * X + row[1] * Y)[:, None].astype(np.float32),
                              (tops @ row[:3] + row[3])[None, :, None].astype(np.float32))
                       for row in matrix)
        u, v = (np.floor(ray / scale + np.float32(0.5)).astype(np.int32) for ray in (u, v))
        return np.where((u < 0) | (u >= w) | (v < 0) | (v >= h), h * w, v * w + u)

    def refine(self, template: Template, place: np.ndarray, angle: float, reach: float,
               turn: float, pull: float = ROUND) -> Pose:
        """
        Search around a pose, coarsely and then finely.

        :param angle: of the object, relative to the first picture.
        :param reach: m and turn: rad, how far at first.
        :param pull: cost of being reach away.
        :return: the best Pose, its angle relative to the first picture; its cost may be inf.
        """
        best, turned, wide = place, angle - template.angle, reach
        for count, turns, thin, next_reach, next_turn in _LEVELS:
            places = best + reach * _square(count)
            angles = turned + turn * _square(turns)[:turns, 0]
            cost, seen = self.score(template, places, angles, thin)
            total = cost + pull * (((places - place) / wide) ** 2).sum(1)
            total[seen < LEAST_SEEN] = np.inf
            i, j = np.unravel_index(total.argmin(), total.shape)
            if not np.isfinite(total[i, j]):
                return Pose(template)
            best, turned = places[j], float(angles[i])
            reach, turn = reach * next_reach, turn * next_turn
        return Pose(template, best, turned + template.angle, float(cost[i, j]), float(seen[i, j]),
                    *self.fit(template, best, turned))

    def locate(self, template: Template, avoid: Sequence[np.ndarray] = (),
               region: np.ndarray | float = 1.0, extra: Sequence[np.ndarray] = ()) -> Pose:
        """
        Search all of the picture for an object, turned by any angle.

        :param avoid: places of other objects.
        :param region: (h, w) weights of places.
        :param extra: places that are tried, too.
        """
        plane, side = self.picture.plane, max(5.0, template.area ** 0.5)
        like = self.likeness(template)[:-1].reshape(self.picture.size)
        dense = cv2.GaussianBlur(like, (0, 0), side / 2.5) * region
        peaks = []
        for _ in range(PLACES):
            v, u = np.unravel_index(dense.argmax(), dense.shape)
            if dense[v, u] <= 0.01:
                break
            peaks.append(plane.places((u, v)))
            cv2.circle(dense, (int(u), int(v)), int(side * 0.7), 0, -1)
        best = Pose(template)
        for place in (*peaks, *extra):
            if (plane.calibrated and (np.abs(place[:2]) > EDGE).any()
                    or any(np.linalg.norm(place - other) < APART for other in avoid)):
                continue
            places = place + 0.03 * _square(5)
            cost, seen = self.score(template, places, _TURNS, thin=3)
            cost[seen < LEAST_FAR] = np.inf
            for i in cost.min(1).argsort()[:TRIED]:
                found = self.refine(template, places[cost[i].argmin()],
                                    float(_TURNS[i]) + template.angle, 0.02, 0.3, pull=0)
                if found.cost < best.cost:
                    best = found
        return best

    def mean_shift(self, template: Template, place: np.ndarray) -> tuple[np.ndarray, float]:
        """
        Follow the colours of an object from a place: coarse, but minds neither height nor sides.

        :return: (3,) the place where they are densest near by; and how much of them is there, as
            a share of the object's own area.
        """
        plane, (h, w) = self.picture.plane, self.picture.size
        like = self.likeness(template)[:-1].reshape(h, w)
        half = min(max(6, round(template.area ** 0.5 * 0.6)), h // 2, w // 2)
        corner = plane.pixels(place, MIDDLE) - half
        u, v = corner.clip(0, (w - 2 * half, h - 2 * half)).astype(int)
        _, (u, v, width, height) = cv2.meanShift(
            (255 * like).astype(np.uint8), (u, v, 2 * half, 2 * half), (3, 15, 0.5))
        amount = float(like[v:v + height, u:u + width].sum()) / template.area
        return plane.places((u + half, v + half), MIDDLE), amount


def _round(side: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))


def _draw(mask: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return some pixels (N, 2) of a mask, drawn without order."""
    return rng.permutation(np.argwhere(mask)[:, ::-1])[:count]


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis, faster than numpy does."""
    P = values.shape[-1]
    return values.astype(np.float32) @ np.full(P, 1 / P, np.float32)


@cache
def _square(count: int) -> np.ndarray:
    """Return places (count * count, 3) from -1 to 1; of the first count the abscissa varies."""
    line = np.linspace(-1, 1, count)
    return np.stack(np.meshgrid(line, line, 0), -1).reshape(-1, 3)
