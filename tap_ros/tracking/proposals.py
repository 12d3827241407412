# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects without a click: what a goal picture shows elsewhere, and what moves together is one."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.picture import FEW, Palette, Picture, SQUARE
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.protocols import View
from tap_ros.tracking.silhouette import centre, COMMON, LEAST_CONTRAST, LIKELY, SHARED, silhouette
from tap_ros.tracking.template import Matcher, Pose, SURE, Template

LEAST_CHANGED = 60  # px of the working picture
MOST_TRIED = 32  # changes, the largest ones, where an object may have been
MOST_CUTS = 4 * MOST_TRIED  # with what is left of a change beside what was cut out
SHADE = 0.04  # apart in shares of red, green and blue, below which it is one colour
WHOLE = 0.85  # fit in the goal picture of what is one object
LEAST_PIECE = 0.15  # share of what was cut out, of an object in it
NEAR = 0.03  # m, by which the gap of two pieces of one object may change
SEEMS = 1.4  # factor by which it may seem to, beside that, where the camera is not known
MOVED = 0.3  # share of a piece in what has changed, without which it stands where it stood


def propose(start: View, goal: View, camera: PinholeCamera | None = None) -> np.ndarray:
    """
    Find objects without a click: what one picture shows and the other one does not.

    :param start: the picture in which the objects are wanted; goal: another of the same camera.
    :param camera: in the frame of the table, where it is known.
    :return: (N, 2) pixels of the start picture, the largest object first.
    """
    plane = Plane(camera, start.image.shape[:2])
    before, after = Picture(start, plane), Picture(goal, plane)
    found: list[np.ndarray] = []
    parts = list(_changed_objects(before, after))
    for _ in range(MOST_CUTS):
        if not parts or len(found) >= MOST_TRIED:
            break
        part = parts.pop(0)
        cut = silhouette(before, _deepest(part))
        if cut.contrast > LEAST_CONTRAST:
            masks = _apart(before.by(cut.metric), after.by(cut.metric), part, cut.mask)
            found += [mask for mask in masks if all(
                (mask & other).sum() < SHARED * mask.sum() for other in found)]
            rest = part & ~(cv2.dilate(cut.mask.astype(np.uint8), SQUARE) > 0)
            if rest.sum() < part.sum():  # else the cut missed it, and would again
                parts = [*_parts(rest), *parts]
    found.sort(key=lambda mask: -int(mask.sum()))
    return plane.enlarge(np.reshape([_middle(mask) for mask in found], (-1, 2)))


def _changed_objects(before: Picture, after: Picture) -> Iterator[np.ndarray]:
    """Yield parts (h, w) bool that changed, or may have behind the robot, and are no table."""
    may = (before.changed(after) | after.hidden) & ~before.hidden
    for region in _parts(may)[:MOST_TRIED]:
        beside = (cv2.dilate(region.astype(np.uint8), np.ones((15, 15), np.uint8)) > may
                  ) & ~before.hidden
        if beside.any():
            table = Palette(before.lab[beside], least=COMMON)
            yield from _parts(region & (table.distance(before.index) > LIKELY))


def _apart(before: Picture, after: Picture, part: np.ndarray,
           cut: np.ndarray) -> list[np.ndarray]:
    """Return the objects (h, w) bool in what was cut out around a part that has changed."""
    for _, pose in _located(before, after, [cut]):
        if pose.fit > WHOLE and np.linalg.norm(pose.place - pose.template.place) > NEAR:
            return [cut]
    groups: list[list[tuple[np.ndarray, Pose]]] = []
    for piece in _located(before, after, _pieces(before, cut)):
        for group in groups:
            if all(_kept(piece[1], pose, before.plane) for _, pose in group):
                group.append(piece)
                break
        else:
            groups.append([piece])
    masks = [np.logical_or.reduce([mask for mask, _ in group]) for group in groups]
    masks = [mask for mask in masks if mask.sum() > LEAST_PIECE * cut.sum()]
    moved = [mask for mask in masks if (mask & part).sum() > MOVED * mask.sum()]
    return moved if len(masks) > 1 and moved else [cut]


def _pieces(picture: Picture, mask: np.ndarray) -> list[np.ndarray]:
    """Return the parts of a mask (h, w) bool that have one colour each, whatever its shades."""
    colours = cv2.GaussianBlur(picture.image, (3, 3), 0.7)[mask].astype(np.float32) + 1
    colours /= colours.sum(1, keepdims=True)
    cv2.setRNGSeed(0)
    _, labels, found = cv2.kmeans(
        colours, min(FEW, len(colours)), np.zeros((len(colours), 1), np.int32), (3, 15, 1e-3), 2,
        cv2.KMEANS_PP_CENTERS)
    centres = np.asarray(found)
    _, kinds = connected_components(np.linalg.norm(centres[:, None] - centres, axis=-1) < SHADE)
    shown = np.full(mask.shape, -1)
    shown[mask] = kinds[np.ravel(labels)]
    return [part for kind in np.unique(kinds) for part in _parts(shown == kind)]


def _located(before: Picture, after: Picture,
             masks: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, Pose]]:
    """Yield those masks of a picture that are found in another one, and where."""
    matcher = Matcher(after)
    for mask in masks:
        place = before.plane.places(centre(mask))
        pose = matcher.locate(Template(before, mask, place, 0.0, top=True), extra=[place])
        if pose.confidence > SURE:
            yield mask, pose


def _kept(one: Pose, other: Pose, plane: Plane) -> bool:
    """Return whether two pieces are as far apart as before; without calibration as it seems."""
    before, after = (float(np.linalg.norm(first - second)) for first, second in (
        (one.template.place, other.template.place), (one.place, other.place)))
    factor = 1.0 if plane.calibrated else SEEMS
    return before / factor - NEAR < after < before * factor + NEAR


def _parts(mask: np.ndarray) -> list[np.ndarray]:
    """Return the connected parts of a mask (h, w) that are not too small, the largest first."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, SQUARE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    areas = stats[:, cv2.CC_STAT_AREA]
    areas[0] = 0
    return [labels == i for i in np.argsort(-areas) if areas[i] >= LEAST_CHANGED]


def _deepest(mask: np.ndarray) -> np.ndarray:
    """Return the pixel (2,) of a mask (h, w) farthest from all that is not in it."""
    depth = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)
    v, u = np.unravel_index(depth.argmax(), depth.shape)
    return np.array([u - 1.0, v - 1.0])


def _middle(mask: np.ndarray) -> np.ndarray:
    """Return the middle (2,) of a mask (h, w), or where that is not in it its deepest pixel."""
    at = centre(mask)
    u, v = np.rint(at).astype(int)
    return at if mask[v, u] else _deepest(mask)
