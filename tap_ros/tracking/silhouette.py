# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a click to the silhouette of an object."""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.base.errors import TrackingError
from tap_ros.tracking.picture import Palette, Picture, weighed
from tap_ros.tracking.plane import Plane

RADIUS = 36  # working pixels from a click to where no object reaches
CORE = 3.5  # px around a click that are the object
COMMON = 0.12  # share of the ring around that a colour of the table has at least
SHADES = (1.0, 0.5)  # of the table's light, in shadows of objects
LIKELY, POSSIBLE, SURE = 12.0, 6.0, 25.0  # from the table's colours, of what may be the object
FLAT = 0.3  # share of a silhouette that is its top at least, else the object is not upright
LEAST_AREA = 64  # px; more than CORE, which is taken for the object whatever it shows
LEAST_CONTRAST = 7.0  # of the object's colours and the table's, for a click to be believed
SPREAD = 1.5  # by which it exceeds what colours of the ring differ from the table's, median
_RINGS = (0.75, 1.3)  # of RADIUS, between which the table is seen


def silhouette(picture: Picture, at: np.ndarray, others: Sequence[np.ndarray] | np.ndarray = (),
               radius: float = RADIUS) -> tuple[np.ndarray, float]:
    """
    Cut out the object around a pixel by GrabCut.

    It begins with colours that are not those of the ring around.

    :param at: (2,) (u, v) in the working picture.
    :param others: pixels of other objects.
    :return: (h, w) bool, all False where nothing differs; and how its colours differ from those
        around it, median; 0 where those differ as much among themselves.
    """
    h, w = picture.size
    u, v = at
    x0, x1 = (int(np.clip(u + side * 1.5 * radius, 0, w)) for side in (-1, 1))
    y0, y1 = (int(np.clip(v + side * 1.5 * radius, 0, h)) for side in (-1, 1))
    window = np.s_[y0:y1, x0:x1]
    y, x = np.ogrid[y0:y1, x0:x1]
    far = np.hypot(x - u, y - v)
    apart = [np.hypot(x - other[0], y - other[1]) for other in others]  # from those
    hidden = picture.hidden[window]
    inner, outer = radius * _RINGS[0], radius * _RINGS[1]
    ring = (far > inner) & (far < outer)
    for clear in (~hidden, *(gap > radius * 0.6 for gap in apart)):
        if (ring & clear).sum() > 50:
            ring &= clear
    empty = np.zeros(picture.size, bool)
    if not ring.any():
        return empty, 0.0
    table = picture.image[window][ring][:, None]
    unlike = np.min([Palette(shaded(table, share), least=COMMON).distance(picture.index[window])
                     for share in SHADES], 0)
    mask = np.full(far.shape, cv2.GC_BGD, np.uint8)
    near = far < radius
    mask[near] = cv2.GC_PR_BGD
    mask[near & (unlike > LIKELY)] = cv2.GC_PR_FGD
    mask[(far < radius / 3) & (unlike > POSSIBLE)] = cv2.GC_PR_FGD
    mask[far < CORE] = cv2.GC_FGD
    own = np.logical_and.reduce([near, *(far < gap for gap in apart)])
    mask[own & (unlike > SURE)] = cv2.GC_FGD
    mask[hidden] = cv2.GC_BGD
    for other, gap in zip(others, apart):
        if np.hypot(other[0] - u, other[1] - v) > 2 * CORE:
            mask[gap < CORE] = cv2.GC_BGD
    if not (mask & 1).any():
        return empty, 0.0
    cv2.setRNGSeed(0)
    cv2.grabCut(np.ascontiguousarray(picture.image[window]), mask, (0, 0, 0, 0), np.zeros((1, 65)),
                np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    found = cv2.morphologyEx(mask & 1, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(found)
    if count > 2:
        inside = labels[(far < 2 * CORE) & (found > 0)]
        part = np.bincount(inside).argmax() if len(inside) else labels.flat[
            np.where(found > 0, far, np.inf).argmin()]
        found = labels == part
    empty[window] = found
    if not empty.any():
        return empty, 0.0
    contrast = float(np.median(unlike[found > 0]))
    return empty, contrast if contrast > SPREAD * np.median(unlike[ring]) else 0.0


def shaded(colours: np.ndarray, share: float) -> np.ndarray:
    """Return colours (N, 1, 3) uint8 rgb with a share of their light, (N, 3) as Picture.lab."""
    return weighed(np.rint(colours * share).astype(np.uint8))[:, 0]


def clicked(picture: Picture, at: np.ndarray, others: np.ndarray, name: str) -> np.ndarray:
    """
    Cut out the object under a click, see silhouette.

    :param name: of the click, for the message.
    :raises TrackingError: for a click outside the picture, on the robot, or on nothing.
    """
    h, w = picture.size
    if not (np.isfinite(at).all() and -0.5 <= at[0] < w - 0.5 and -0.5 <= at[1] < h - 0.5):
        raise TrackingError(f'{name} is outside the picture; click on an object')
    if picture.hidden[round(float(at[1])), round(float(at[0]))]:
        raise TrackingError(f'{name} is on the robot or its shadow; click on an object, or move '
                            'the robot away first')
    mask, contrast = silhouette(picture, at, others)
    if mask.sum() < LEAST_AREA or contrast < LEAST_CONTRAST:
        raise TrackingError(f'{name} is on nothing that differs from the table around it; click '
                            'on an object')
    return mask


def outline(mask: np.ndarray) -> np.ndarray:
    """Return the outer outline (N, 2) of a mask (h, w) in pixels."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL,
                                cv2.CHAIN_APPROX_TC89_L1)
    return max(found, key=len)[:, 0].astype(np.float64) if found else np.zeros((0, 2))


def top_face(mask: np.ndarray, plane: Plane) -> np.ndarray:
    """
    Return the part of a silhouette (h, w) that is the top of an upright object.

    Beneath a pixel of the top the whole side is in the silhouette, too. What is too flat for that
    is all top.
    """
    top = mask.copy()
    rise = plane.rise(plane.of_top(centre(mask)))
    v, u = np.nonzero(mask)
    for share in np.linspace(0, 1, 9)[1:]:
        below = np.rint(np.column_stack([u, v]) - share * rise).astype(int)
        below = below.clip(0, np.array(mask.shape[::-1]) - 1)
        top[v, u] &= mask[below[:, 1], below[:, 0]]
    return top if top.sum() > FLAT * mask.sum() else mask


def centre(mask: np.ndarray) -> np.ndarray:
    """Return the mean pixel (2,) of a mask (h, w)."""
    return np.argwhere(mask)[:, ::-1].mean(0)
