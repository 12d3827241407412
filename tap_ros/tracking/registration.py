# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The objects in another picture of the same camera, such as that of a goal."""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.tracking.picture import Palette, Picture
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.protocols import LOST, SEEN, Tracked, View
from tap_ros.tracking.search import locate
from tap_ros.tracking.silhouette import centre, silhouette
from tap_ros.tracking.template import Matcher, Pose, Template

LEAST_SURE = 0.9  # confidence, else not found
CHANGED = 8.0  # distance of colours
LEAST_CHANGED = 60  # px of the working picture
KEPT = 0.1  # weight of places where nothing changed


def change(first: Picture, second: Picture) -> np.ndarray:
    """Return which pixels differ between two pictures, the robot aside, (h, w) bool."""
    return (first.apart(second) > CHANGED) & ~first.hidden & ~second.hidden


def register(first: Picture, picture: Picture, plane: Plane,
             objects: Sequence[Sequence[Template]]) -> Tracked:
    """
    Find objects by their templates, the one that fits best first.

    :param first: the picture of the first templates.
    :return: Tracked, LOST what fits nowhere well enough.
    """
    matcher = Matcher(picture, plane)
    changed = (first.apart(picture) > CHANGED).astype(np.float32)
    region = KEPT + cv2.GaussianBlur(changed, (0, 0), 4)
    found: dict[int, tuple[Pose, Template]] = {}
    left = set(range(len(objects)))
    while left:
        avoid = [pose.place for pose, _ in found.values()]
        tried = {}
        for k in left:
            poses = [(pose, key) for key in objects[k] if (pose := locate(
                matcher, key, avoid, region, [objects[k][0].place])) is not None]
            if poses:
                tried[k] = min(poses, key=lambda one: one[0].cost)
        if not tried:
            break
        best = min(tried, key=lambda k: tried[k][0].cost)
        found[best] = tried[best]
        left.remove(best)
    pixels, confidence = np.full((len(objects), 2), np.nan), np.zeros(len(objects))
    states, outlines = [LOST] * len(objects), [np.zeros((0, 2))] * len(objects)
    for k, (pose, key) in found.items():
        confidence[k] = pose.confidence
        if confidence[k] > LEAST_SURE:
            states[k] = SEEN
            pixels[k] = plane.enlarge(plane.middle_pixels(pose.place))
            outlines[k] = plane.enlarge(plane.top_pixels(key.outlined(pose.place, pose.angle)))
    return Tracked(pixels, tuple(states), confidence, tuple(outlines))


def propose(start: View, goal: View) -> np.ndarray:
    """
    Find objects without a click: what one picture shows and the other one does not.

    :param start: the picture in which the objects are wanted; goal: another of the same camera.
    :return: (N, 2) pixels of the start picture, the largest object first.
    """
    plane = Plane(None, start.image.shape[:2])
    before, after = Picture(start, plane), Picture(goal, plane)
    changed = cv2.morphologyEx(change(before, after).astype(np.uint8), cv2.MORPH_OPEN,
                               np.ones((3, 3), np.uint8))
    count, labels, stats, centres = cv2.connectedComponentsWithStats(changed)
    found: list[tuple[int, np.ndarray]] = []
    for i in np.argsort(-stats[1:, cv2.CC_STAT_AREA]) + 1:
        if stats[i, cv2.CC_STAT_AREA] < LEAST_CHANGED:
            break
        part = labels == i
        beside = cv2.dilate(part.astype(np.uint8), np.ones((15, 15), np.uint8)) > changed
        around = beside & ~before.hidden & ~after.hidden
        if not around.any():
            continue
        table = Palette(before.lab[around])
        here, there = (float(np.median(table.distance(picture.index[part])))
                       for picture in (before, after))
        if here <= there:  # something came there
            continue
        mask, _ = silhouette(before, centres[i])
        if mask.any() and not any(np.hypot(*(centre(mask) - other)) < 8 for _, other in found):
            found.append((int(mask.sum()), centre(mask)))
    found.sort(key=lambda one: -one[0])
    return plane.enlarge([at for _, at in found]).reshape(-1, 2)
