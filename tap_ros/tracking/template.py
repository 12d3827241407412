# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rigid template of an object on the plane of the tops, compared at many poses."""

from dataclasses import dataclass

import cv2
import numpy as np
from tap_ros.tracking.picture import NEAR, Palette, Picture
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.silhouette import outline

POINTS, RING = 120, 40  # of a template, inside and around
FAR = 22.0  # distance of colours that counts as none
HIDDEN = 0.4  # cost of a point behind the robot: hiding there is no way out
AROUND = 0.35  # weight of points beside the object that look like it
SAME = 17.6  # distance below which a point has its own colour
SURE, SHOWN, LOOKS = 0.9, 0.3, 0.5  # of a pose, from which on it is sure
MERGED = 0.4  # more of the points around have its colours than did: it is not told from those
LEAST_SEEN = 0.2  # share of an object without which no pose near by is believed
LEAST_SAME = 0.3  # share of points with their own colour without which nothing fits
CONTRAST = 8.0  # of object and table, below which the surrounding says nothing
ROUND = 0.06  # cost at the edge of the search: of two places alike the nearer one is meant
# Of a pose's fit, cost and seen: logistic regression on 11,000 poses in simulated scenes, others
# than those of docs/results/tracking.md.
_BIAS, _FIT, _COST, _SEEN = 1.74, 3.25, 7.59, 2.55


class Template:
    """
    Points of an object, with their colours, and points around it.

    :param mask: (h, w) bool of Picture, the object.
    :param place: (2,) of the object; points are relative to it.
    :param angle: of the object in this picture, relative to the first one, rad.
    :ivar area: px.
    :ivar metric: Metric of the colours.
    :ivar outline: (N, 2) m around the place.
    """

    def __init__(self, picture: Picture, plane: Plane, mask: np.ndarray, place: np.ndarray,
                 angle: float = 0.0, face: np.ndarray | None = None) -> None:
        rng = np.random.default_rng(0)
        self.place, self.angle, self.area = place, angle, int(mask.sum())
        self.metric = picture.metric
        self.palette = Palette(picture.lab[mask], self.metric)
        self.outline = plane.of_top(outline(mask)) - place
        part = mask if face is None else face
        if plane.blur:  # pixels at its edge are mixed with the table
            inside = cv2.erode(part.astype(np.uint8), _round(2 * plane.blur + 1)) > 0
            part = inside if inside.sum() > 0.3 * part.sum() else part
        pixels = _draw(part, POINTS, rng)
        self.points = (plane.of_top(pixels) - place).astype(np.float32)
        self.colours = picture.lab[pixels[:, 1], pixels[:, 0]]
        self.kinds = self.palette.nearest(picture.index[pixels[:, 1], pixels[:, 0]])
        inner, outer = (cv2.dilate(part.astype(np.uint8), _round(side + 4 * plane.blur))
                        for side in (5, 9))
        beside = _draw(outer > inner, RING, rng)
        self.normals: np.ndarray | None = None
        if face is not None and plane.calibrated:
            smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), 3)
            slope = -np.stack(np.gradient(smooth)[::-1], -1)[beside[:, 1], beside[:, 0]]
            slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
            normals = plane.of_top(beside + slope) - plane.of_top(beside)
            self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        near = self.palette.distance(picture.index[beside[:, 1], beside[:, 0]])
        self.contrast = float(np.median(near)) if len(near) else 0.0
        if self.normals is None and self.contrast <= CONTRAST:
            beside = beside[:0]
        self.ring = (plane.of_top(beside) - place).astype(np.float32)
        self.beside = float((near < NEAR).mean()) if len(near) else 0.0

    def outlined(self, place: np.ndarray, angle: float) -> np.ndarray:
        """Return the outline (N, 2) of the object at a place, turned from the first picture."""
        c, s = np.cos(angle - self.angle), np.sin(angle - self.angle)
        return place + self.outline @ np.array([[c, s], [-s, c]])


@dataclass(frozen=True)
class Pose:
    """Where a template was found; angle relative to the picture that it was cut from."""

    place: np.ndarray  # (2,) m
    angle: float  # rad
    cost: float  # 0 to 1.35
    seen: float  # share of the points that the robot does not hide
    fit: float  # share of those that have colours of the object
    looks: float  # how alike the shares of each colour are
    template: Template

    @property
    def confidence(self) -> float:
        """The probability that it is right within 2 px of a picture of 64."""
        value = _BIAS + _FIT * self.fit - _COST * self.cost + _SEEN * self.seen
        return float(1 / (1 + np.exp(-value)))

    @property
    def sure(self) -> bool:
        """Whether what is there looks like what was clicked."""
        return self.confidence > SURE and self.seen > SHOWN and self.looks > LOOKS


class Matcher:
    """
    Compares templates with one picture.

    :param covered: (h, w) bool, what hides objects there; by default the robot.
    """

    def __init__(self, picture: Picture, plane: Plane, covered: np.ndarray | None = None) -> None:
        self.picture, self.plane = picture, plane
        self.covered = picture.hidden if covered is None else covered
        # A colour is read as one word, negative where it is covered.
        words = cv2.merge([picture.lab, np.where(self.covered, np.uint8(255), np.uint8(0))])
        self._words = np.asarray(words).view(np.int32).ravel()
        self._likeness: dict[Template, np.ndarray] = {}

    def likeness(self, template: Template) -> np.ndarray:
        """Return how like the object's colours each pixel is, (h, w) 0 to 1, 0 where covered."""
        if template not in self._likeness:
            like = 1 - template.palette.distance(self.picture.index) / FAR
            self._likeness[template] = np.maximum(like, 0) * ~self.covered
        return self._likeness[template]

    def score(self, template: Template, places: np.ndarray, angles: np.ndarray,
              thin: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """
        Compare a template at all places with all angles.

        :param places: (S, 2) m; angles: (A,) relative to the template's picture.
        :param thin: take every so many points.
        :return: (A, S) each: cost, share seen, see Pose.
        """
        apart, free = self._apart(template, *self._look(template.points[::thin], places, angles),
                                  thin)
        cost = _mean(np.minimum(apart, int(FAR))) / FAR
        seen = np.ones_like(cost) if free.all() else _mean(free)
        cost += (HIDDEN - 1) * (1 - seen)
        if len(template.ring):
            index, inside = self._look(template.ring[::thin], places, angles)
            like = self.likeness(template).ravel().take(index)
            free = self._words.take(index) >= 0
            if inside is not None:
                like, free = like * inside, free & inside
            if template.normals is not None:
                toward = self.plane.toward_camera(places.mean(0))
                c, s = np.cos(angles), np.sin(angles)
                turned = np.stack([c * toward[0] + s * toward[1], c * toward[1] - s * toward[0]])
                away = (template.normals[::thin] @ turned).T < 0.2  # (A, R)
                like, free = like * away[:, None], free & away[:, None]
            beside = _mean(like)
            cost += AROUND * (beside if free.all() else beside / np.maximum(_mean(free), 1e-3))
        return cost, seen

    def fit(self, template: Template, place: np.ndarray, angle: float) -> tuple[float, float]:
        """
        Return how well a template fits, see Pose.

        :return: the share of the points seen that have colours of the object; and how alike the
            shares of each colour are there and in the template, 0 where what is around looks
            like the object, too.
        """
        index, inside = self._look(template.points, place[None], np.array([angle]))
        apart, free = self._apart(template, index, inside)
        known = max(int(free.sum()), 1)
        same = (apart < SAME) & free
        if same.sum() <= LEAST_SAME * known:
            return 0.0, 0.0
        # other sides show as it turns: any of its colours fits
        own = (self.likeness(template).ravel().take(index) > 1 - NEAR / FAR) & free
        fit = float((same | own).sum() / known)
        looks = template.palette.recurs(
            self.picture.index.ravel().take(index)[free], template.kinds[free.ravel()])
        if len(template.ring) and template.normals is None:
            index, _ = self._look(template.ring, place[None], np.array([angle]))
            like = self.likeness(template).ravel().take(index)
            if (like > 1 - NEAR / FAR).mean() > template.beside + MERGED:
                return fit, 0.0
        return fit, looks

    def _apart(self, template: Template, index: np.ndarray, inside: np.ndarray | None,
               thin: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Return how colours differ from the template's, (A, S, P); and which are seen."""
        P = index.shape[-1]
        words = self._words.take(index)
        read = words.view(np.uint8).reshape(-1, 4 * P)
        own = np.pad(template.colours[::thin], ((0, 0), (0, 1))).ravel()
        apart = np.asarray(cv2.absdiff(read, np.tile(own, (len(read), 1))))
        # the sum of the four bytes of each word
        sums = apart.view(np.uint32).reshape(index.shape)
        sums = (sums & 0xFF00FF) + ((sums >> 8) & 0xFF00FF)
        sums = (sums & 0xFFFF) + (sums >> 16)
        if inside is None:
            return sums, words >= 0
        return np.where(inside, sums, 255), (words >= 0) & inside

    def _look(self, points: np.ndarray, places: np.ndarray,
              angles: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """
        Project points (P, 2) of a template at all places with all angles.

        :return: (A, S, P) flat pixels; and whether they are in the picture, None if all are.
        """
        h, w = self.picture.size
        c, s = np.cos(angles), np.sin(angles)
        x, y = points.T
        X, Y = np.outer(c, x) - np.outer(s, y), np.outer(s, x) + np.outer(c, y)  # (A, P)
        u, v, scale = (np.add((across * X + down * Y)[:, None].astype(np.float32),
                              (places @ (across, down) + still)[None, :, None].astype(np.float32))
                       for across, down, still in self.plane.top)
        np.reciprocal(scale, out=scale)
        for ray in (u, v):
            ray *= scale
            ray += np.float32(0.5)
        inside = None
        if u.min() < 0 or v.min() < 0 or u.max() >= w or v.max() >= h:
            inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
            u[~inside] = v[~inside] = 0
        return v.astype(np.int32) * np.int32(w) + u.astype(np.int32), inside

    def refine(self, template: Template, place: np.ndarray, angle: float, reach: float,
               turn: float, pull: float = ROUND) -> Pose | None:
        """
        Search around a pose, coarsely and then finely.

        :param angle: of the object, relative to the first picture.
        :param reach: m and turn: rad, how far at first.
        :param pull: cost of being reach away.
        :return: the best Pose, its angle relative to the first picture; or None.
        """
        best, turned, wide = place, angle - template.angle, reach
        for line, turns, thin, next_reach, next_turn in _LEVELS:
            places, angles = best + reach * line, turned + turn * turns
            cost, seen = self.score(template, places, angles, thin)
            total = cost + pull * (((places - place) / wide) ** 2).sum(1)
            total[seen < LEAST_SEEN] = np.inf
            i, j = np.unravel_index(total.argmin(), total.shape)
            if not np.isfinite(total[i, j]):
                return None
            best, turned = places[j], float(angles[i])
            reach, turn = reach * next_reach, turn * next_turn
        return Pose(best, turned + template.angle, float(cost[i, j]), float(seen[i, j]),
                    *self.fit(template, best, turned), template)


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis, faster than numpy does."""
    P = values.shape[-1]
    return values.astype(np.float32) @ np.full(P, 1 / P, np.float32)


def _round(side: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))


def _draw(mask: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return some pixels (N, 2) of a mask, drawn without order."""
    v, u = np.nonzero(mask)
    kept = rng.permutation(len(u))[:count]
    return np.column_stack([u[kept], v[kept]])


def _square(count: int) -> np.ndarray:
    line = np.linspace(-1, 1, count)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


# Of refine: places, turns, every so many points, and what the next level is of this one.
_LEVELS = ((_square(7), np.linspace(-1, 1, 5), 2, 1 / 3.2, 1 / 2.5),
           (_square(5), np.linspace(-1, 1, 5), 1, 1 / 3, 1 / 2.5),
           (_square(5), np.linspace(-1, 1, 3), 1, 1 / 3, 1 / 2.5),
           (_square(3), np.linspace(-1, 1, 3), 1, 1 / 3, 1 / 2.5))
