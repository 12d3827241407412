# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a click to the silhouette of an object."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from tap_ros.base.errors import TrackingError
from tap_ros.tracking.picture import COLOUR, LIGHT, Metric, Palette, Picture, SQUARE
from tap_ros.tracking.plane import Plane

RADII = 36, 64  # working pixels from a click to where no object reaches; a large one
CORE = 3.5  # px around a click that are the object
COMMON = 0.12  # share of the ring around that a colour of the table has at least
SHADES = (1.0, 0.5)  # of the table's light, in shadows of objects
DIM = 0.9  # of the table's light, in shadows of the robot at most
LIGHTEST = 97  # percentile of the table's lightness: beyond is no table, nor a shadow
LIKELY, POSSIBLE, SURE = 12.0, 6.0, 25.0  # from the table's colours, of what may be the object
ALIKE = 14.0  # from the colours under the click, of what is the object where others touch it
FLAT = 0.3  # share of a silhouette that is its top at least, else the object is not upright
LEAST_AREA = 48  # px; more than CORE, which is taken for the object whatever it shows
LEAST_CONTRAST = 7.0  # of the object's colours and the table's, for a click to be believed
COLOURFUL = 12.0  # contrast of colour without which lightness tells an object, too
SPREAD = 1.5  # by which it exceeds what colours of the ring differ from the table's, median
OFF = 9.0  # px from a click to the middle, from which on a cut is doubted
FARTHER = 14.0  # the same, from which on one that is not whole is left for another one
NEARER, CLEARER = 3.0, 1.5  # px by which another cut is better, and the factor of its contrast
BAND = 9, 25  # sides of squares that a spot is grown by: between them the table is seen, px
TOUCHING = 0.1  # share of an outline at the robot, up to which it is all of the object
# More of an object than a part of it: ends, as a share of those of the part, at most; or its area
# as a multiple of the part's, from and to; and how much of the part is in it, at least.
FEWER, MORE, GROWN, KEPT = 0.7, 1.2, 2.0, 0.8
ENDS = 0.03  # share of an outline at the end of the search, which is to be widened
FARNESS = 1.0  # what a px from the click of one of two that touch adds to a distance of colours
SHARED = 0.1  # share of a cut that is in another one, too, without which they do not touch
_RINGS = (0.75, 1.3)  # of the radius, between which the table is seen


@dataclass(frozen=True)
class Cut:
    """What was cut out of a picture."""

    mask: np.ndarray  # (h, w) bool, all False where nothing differs
    contrast: float  # how its colours differ from those around, median; 0: as those themselves
    metric: Metric  # by which they do
    ends: float  # share of its outline at the robot, its shadow, or the end of the search
    whole: bool  # hardly any of it is at more than a shadow, nor at the picture's edge
    touched: bool = False  # another object touches it, or may be in it

    def off(self, at: np.ndarray) -> float:
        """Return the distance of its middle from a pixel, inf where nothing was cut out."""
        return float(np.linalg.norm(centre(self.mask) - at)) if self.mask.any() else np.inf

    @property
    def sure(self) -> bool:
        """Whether nothing hides or cuts a part of it, and no other object seems to be in it."""
        return self.whole and not (self.open or self.touched)

    @property
    def open(self) -> float:
        """Share of its outline that the robot may hide, 0 if that is hardly any."""
        return self.ends if self.ends > TOUCHING else 0.0

    def has_more(self, part: np.ndarray, ends: float, at: np.ndarray) -> bool:
        """Return whether it is more of an object at a pixel than a part with such ends."""
        known, area = part.sum(), self.mask.sum()
        more = self.ends <= max(FEWER * ends, TOUCHING) or area > MORE * known
        return bool(more and self.contrast >= LEAST_CONTRAST and self.off(at) < OFF
                    and (not (self.open or self.touched) or area < GROWN * known)
                    and part[self.mask].sum() > KEPT * known)


def silhouette(picture: Picture, at: np.ndarray, others: Sequence[np.ndarray] | np.ndarray = (),
               radius: float = 0.0) -> Cut:
    """
    Cut out the object around a pixel.

    :param at: (2,) (u, v) in the working picture; others: of other objects.
    :param radius: px, up to which it is searched; 0: as far as it reaches, see RADII.
    """
    if radius:
        return _cut(picture, at, others, min(radius, RADII[1]))
    near, far = RADII
    cut = _cut(picture, at, others, near)
    ends = share(cut.mask, _beyond(picture, at, near - 2))
    if cut.contrast < LEAST_CONTRAST or ends > ENDS:
        large = _cut(picture, at, others, far)
        if large.contrast >= LEAST_CONTRAST and (
                share(large.mask, _beyond(picture, at, far - 2)) <= ENDS):
            cut = large
    if cut.contrast < LEAST_CONTRAST:  # it may be as dark as what is beyond the table
        spot = _spot(picture, at)
        if spot.any() and not (spot & _beyond(picture, at, far - 2)).any():
            inner, outer = (cv2.dilate(spot.astype(np.uint8), np.ones((side, side), np.uint8))
                            for side in BAND)
            cut = _cut(picture, at, others, far, ring=outer > inner)
    if cut.off(at) > NEARER:  # another one may touch it
        alone = _cut(picture, at, others, near, alone=True)
        if alone.off(at) < cut.off(at) - NEARER:
            if (not cut.whole and cut.off(at) > FARTHER and alone.contrast > cut.contrast / 2
                    or cut.contrast < SURE and alone.contrast > CLEARER * cut.contrast):
                cut = replace(alone, touched=True)
    return replace(cut, touched=True) if cut.off(at) > OFF else cut


def _cut(picture: Picture, at: np.ndarray, others: Sequence[np.ndarray] | np.ndarray,
         radius: float, alone: bool = False, ring: np.ndarray | None = None) -> Cut:
    """
    Cut out by GrabCut, which begins with colours that are not those of the ring around.

    :param alone: only what has colours as under the pixel.
    :param ring: (h, w) bool, where the table is seen; by default see _RINGS.
    """
    picture, (h, w), (u, v) = picture.by(COLOUR), picture.size, at
    x0, x1 = (int(np.clip(u + side * 1.5 * radius, 0, w)) for side in (-1, 1))
    y0, y1 = (int(np.clip(v + side * 1.5 * radius, 0, h)) for side in (-1, 1))
    window = np.s_[y0:y1, x0:x1]
    y, x = np.ogrid[y0:y1, x0:x1]
    far = np.hypot(x - u, y - v)
    gaps = [np.hypot(x - other[0], y - other[1]) for other in others]  # from those
    hidden = picture.hidden[window]
    ring = ring[window] if ring is not None else (
        far > radius * _RINGS[0]) & (far < radius * _RINGS[1])
    for clear in (~hidden, *(gap > radius * 0.6 for gap in gaps)):
        if (ring & clear).sum() > 50:
            ring &= clear
    image = picture.image[window]
    shades = [cv2.cvtColor(np.rint(image[ring][:, None] * light).astype(np.uint8),
                           cv2.COLOR_RGB2LAB) for light in SHADES]
    hue = np.min([Palette(np.asarray(cv2.LUT(shade, COLOUR.weighed))[:, 0], least=COMMON).distance(
        picture.index[window]) for shade in shades], 0)
    light = picture.by(LIGHT).lab[window][..., 0].astype(np.float32)
    dark, bright = np.percentile(light[ring], (100 - LIGHTEST, LIGHTEST))
    unlike = hue + np.maximum(light - bright, 0) + np.maximum(dark * SHADES[-1] - light, 0)
    near, core = far < radius, far < CORE
    mask = np.where(near, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    likely = near & (unlike > LIKELY) | (far < radius / 3) & (unlike > POSSIBLE)
    sure = np.logical_and.reduce([near, unlike > SURE, *(far < gap for gap in gaps)])
    if alone:
        shown = picture.by(LIGHT)
        own = Palette(shown.lab[window][core & ~hidden], LIGHT).distance(
            shown.index[window]) < ALIKE if (core & ~hidden).any() else core
        likely, sure = likely & own, sure & own
        mask[(unlike > SURE) & ~own] = cv2.GC_BGD
    mask[likely] = cv2.GC_PR_FGD
    _, parts = cv2.connectedComponents((sure | core).astype(np.uint8))
    mask[core | sure & np.isin(parts, parts[core])] = cv2.GC_FGD
    mask[hidden] = cv2.GC_BGD
    for other, gap in zip(others, gaps):
        if np.hypot(other[0] - u, other[1] - v) > 2 * CORE:
            mask[gap < CORE] = cv2.GC_BGD
    if (mask & 1).any():
        cv2.setRNGSeed(0)
        cv2.grabCut(np.ascontiguousarray(image), mask, (0, 0, 0, 0), np.zeros((1, 65)),
                    np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    whole = np.zeros(picture.size, bool)
    _, parts = cv2.connectedComponents(cv2.morphologyEx(mask & 1, cv2.MORPH_OPEN, SQUARE))
    if not parts.any():
        return Cut(whole, 0.0, COLOUR, 1.0, False)
    inside = parts[(far < 2 * CORE) & (parts > 0)]
    part = parts == (np.bincount(inside).argmax() if len(inside) else parts.flat[
        np.where(parts > 0, far, np.inf).argmin()])
    whole[window] = part
    robot = picture.hidden.copy()  # but for what may be its shadow
    robot[window] &= (unlike > LIKELY) | (light > DIM * np.median(light[ring]))
    contrast, colour = (float(np.median(one[part])) for one in (unlike, hue))
    believed = part.sum() >= LEAST_AREA and contrast > SPREAD * np.median(unlike[ring])
    ends, bare = share(whole, picture.hidden | (_gap(picture, at) > radius - 2)), share(
        whole, robot | _beyond(picture, at, radius - 2))
    return Cut(whole, contrast if believed else 0.0, COLOUR if colour > COLOURFUL else LIGHT,
               ends, bare <= TOUCHING)


def _spot(picture: Picture, at: np.ndarray) -> np.ndarray:
    """Return what is connected to a pixel and has the colours under it, (h, w) bool."""
    shown, core = picture.by(LIGHT), (_gap(picture, at) < CORE) & ~picture.hidden
    if not core.any():
        return core
    own = Palette(shown.lab[core], LIGHT).distance(shown.index) < ALIKE
    _, parts = cv2.connectedComponents((own & ~picture.hidden | core).astype(np.uint8))
    return np.asarray(parts == parts[core][0])


def _gap(picture: Picture, at: np.ndarray) -> np.ndarray:
    """Return the distance of each pixel (h, w) from one, px."""
    y, x = np.ogrid[:picture.size[0], :picture.size[1]]
    return np.asarray(np.hypot(x - at[0], y - at[1]))


def _beyond(picture: Picture, at: np.ndarray, radius: float) -> np.ndarray:
    """Return the pixels (h, w) farther from one than a radius, and those at the edge."""
    beyond = _gap(picture, at) > radius
    beyond[[0, -1]] = beyond[:, [0, -1]] = True
    return beyond


def share(mask: np.ndarray, ends: np.ndarray) -> float:
    """Return which share of the pixels 2 px outside a mask are ends, both (h, w) bool."""
    shown, ends = np.pad(mask.astype(np.uint8), 2), np.pad(ends, 2, 'edge')
    # the pixels next to it are mixed with it
    around = cv2.dilate(shown, np.ones((5, 5), np.uint8)) > cv2.dilate(shown, SQUARE)
    return float(ends[around].mean()) if around.any() else 0.0


def clicked(picture: Picture, at: np.ndarray, others: np.ndarray, name: str,
            line: np.ndarray | None = None) -> Cut:
    """
    Cut out the object under a click, see silhouette.

    :param name: of the click, for the message.
    :param line: (N, 2) outline of the object, where it is known.
    :raises TrackingError: for a click outside the picture, on the robot, or on nothing.
    """
    if not ((at >= -0.5) & (at < np.array(picture.size[::-1]) - 0.5)).all():
        raise TrackingError(f'{name} is outside the picture; click on an object')
    if picture.hidden[round(float(at[1])), round(float(at[0]))]:
        raise TrackingError(f'{name} is on the robot or its shadow; click on an object, or move '
                            'the robot away first')
    if line is not None:
        mask = cv2.fillPoly(np.zeros(picture.size, np.uint8), [
            np.rint(line).clip(-999, 999).astype(int)], 1) > 0
        ends = share(mask, picture.hidden)
        bare = share(mask, picture.hidden | _beyond(picture, at, np.inf))
        cut = Cut(mask & ~picture.hidden, np.inf, LIGHT, ends, bare <= TOUCHING)
    else:
        cut = silhouette(picture, at, others)
    if cut.contrast < LEAST_CONTRAST or cut.mask.sum() < LEAST_AREA:
        raise TrackingError(f'{name} is on nothing that differs from the table around it; click '
                            'on an object')
    return cut


def apart(picture: Picture, clicks: np.ndarray, cuts: Sequence[Cut]) -> list[Cut]:
    """Return the cuts (K,) at clicks (K, 2) without what looks like another one: they touch."""
    found = list(cuts)
    for i, j in combinations(range(len(found)), 2):
        pair = [found[k].mask for k in (i, j)]
        shared = pair[0] & pair[1]
        if shared.sum() <= SHARED * min(mask.sum() for mask in pair):
            continue
        under = [_cut(picture, clicks[k], np.delete(clicks, k, 0), RADII[0], True).mask
                 for k in (i, j)]
        own = [mask & ~shared | alone & ~other for mask, alone, other in zip(
            pair, under, under[::-1])]
        if all(mask.any() for mask in own):
            nearer = np.subtract(*(Palette(picture.lab[mask]).distance(picture.index)
                                   + FARNESS * _gap(picture, clicks[k])
                                   for k, mask in zip((i, j), own))) < 0
            parts = [_connected(mask & (mine | ~shared), _gap(picture, clicks[k]))
                     for k, mask, mine in zip((i, j), pair, (nearer, ~nearer))]
            rest = shared & ~(parts[0] | parts[1])  # what is cut off goes to the other one
            for k, part, mine in zip((i, j), parts, (nearer, ~nearer)):
                cut = replace(found[k], mask=part | rest & ~mine)
                found[k] = replace(cut, touched=cut.off(clicks[k]) > OFF)
    return found


def _connected(mask: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return the connected part of a mask (h, w) with the least gap, all False if it is empty."""
    _, parts = cv2.connectedComponents(mask.astype(np.uint8))
    return mask & (parts == parts.flat[np.where(mask, gap, np.inf).argmin()])


def top_face(mask: np.ndarray, plane: Plane) -> np.ndarray:
    """
    Return the part of a silhouette (h, w) that is the top of an upright object.

    Beneath a pixel of the top the whole side is in the silhouette, too. What is too flat for that
    is all top.
    """
    top, at = mask.copy(), np.argwhere(mask)
    place = plane.places(centre(mask))
    rise = (plane.pixels(place) - plane.pixels(place, 0.0))[::-1]  # 0 without a camera
    for share in np.linspace(0, 1, 9)[1:]:
        below = np.rint(at - share * rise).astype(int).clip(0, np.array(mask.shape) - 1)
        top[mask] &= mask[tuple(below.T)]
    return top if top.sum() > FLAT * mask.sum() else mask


def centre(mask: np.ndarray) -> np.ndarray:
    """Return the mean pixel (2,) of a mask (h, w)."""
    return np.argwhere(mask)[:, ::-1].mean(0)
