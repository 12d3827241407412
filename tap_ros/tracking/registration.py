# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Objects anywhere in a picture, such as that of a goal: places that have their colours, then poses.

And mean shift over the colours of one, which is coarse, but minds neither height nor sides.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.base.contract import LOST, SEEN
from tap_ros.tracking.picture import Picture
from tap_ros.tracking.plane import EDGE, Plane
from tap_ros.tracking.protocols import Tracked
from tap_ros.tracking.template import Matcher, Pose, Template

LEAST_FAR = 0.3  # share of an object that has to be seen
LEAST_SURE = 0.9  # confidence, else not found
CHANGED = 8.0  # distance of colours
KEPT = 0.1  # weight of places where nothing changed
PLACES = 6  # that are tried
TRIED = 4  # turns at each of them that are tried finely
APART = 0.035  # m from other objects
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.5)
_TURNS = np.linspace(-np.pi, np.pi, 16, endpoint=False)
_AROUND = np.stack(np.meshgrid(*[np.linspace(-0.03, 0.03, 5)] * 2), -1).reshape(-1, 2)  # m


def locate(matcher: Matcher, template: Template, avoid: Sequence[np.ndarray] = (),
           region: np.ndarray | None = None, extra: Sequence[np.ndarray] = ()) -> Pose | None:
    """
    Search all of a picture for an object, turned by any angle.

    :param avoid: places of other objects.
    :param region: (h, w) weights of places, or None.
    :param extra: places that are tried, too.
    """
    plane = matcher.plane
    side = max(5.0, template.area ** 0.5)
    dense = cv2.GaussianBlur(matcher.likeness(template), (0, 0), side / 2.5)
    if region is not None:
        dense *= region
    peaks = []
    for _ in range(PLACES):
        v, u = np.unravel_index(dense.argmax(), dense.shape)
        if dense[v, u] <= 0.01:
            break
        peaks.append(plane.of_top((u, v)))
        cv2.circle(dense, (int(u), int(v)), int(side * 0.7), 0, -1)
    best: Pose | None = None
    for place in (*peaks, *extra):
        if (plane.calibrated and (np.abs(place) > EDGE).any()
                or any(np.linalg.norm(place - other) < APART for other in avoid)):
            continue
        places = place + _AROUND
        cost, seen = matcher.score(template, places, _TURNS, thin=3)
        cost[seen < LEAST_FAR] = np.inf
        for i in cost.min(1).argsort()[:TRIED]:
            found = matcher.refine(template, places[cost[i].argmin()],
                                   float(_TURNS[i]) + template.angle, 0.02, 0.3, pull=0)
            if found is not None and (best is None or found.cost < best.cost):
                best = found
    return best


def mean_shift(matcher: Matcher, template: Template,
               place: np.ndarray) -> tuple[np.ndarray, float]:
    """
    Follow the colours of an object from a place.

    :return: (2,) the place where they are densest near by; and how much of them is there, as a
        share of the object's own area.
    """
    like = matcher.likeness(template)
    h, w = like.shape
    half = min(max(6, round(template.area ** 0.5 * 0.6)), h // 2, w // 2)
    u, v = matcher.plane.top_pixels(place) - half
    box = (int(np.clip(u, 0, w - 2 * half)), int(np.clip(v, 0, h - 2 * half)), 2 * half, 2 * half)
    _, (u, v, width, height) = cv2.meanShift((255 * like).astype(np.uint8), box, _STOP)
    amount = float(like[v:v + height, u:u + width].sum()) / template.area
    return matcher.plane.of_top((u + half, v + half)), amount


def change(first: Picture, second: Picture) -> np.ndarray:
    """Return which pixels differ between two pictures, the robot aside, (h, w) bool."""
    return (first.apart(second) > CHANGED) & ~first.hidden & ~second.hidden


def register(first: Picture, picture: Picture, plane: Plane,
             objects: Sequence[Template]) -> Tracked:
    """
    Find objects by a template of each, the one that fits best first.

    :param first: the picture of the templates.
    :return: Tracked, LOST what fits nowhere well enough.
    """
    changed = (first.apart(picture) > CHANGED).astype(np.float32)
    region = KEPT + cv2.GaussianBlur(changed, (0, 0), 4)
    matchers = {one.metric: Matcher(picture.by(one.metric), plane) for one in objects}
    found: dict[int, Pose] = {}
    for _ in objects:
        avoid = [pose.place for pose in found.values()]
        tried = {k: pose for k, one in enumerate(objects) if k not in found and (
            pose := locate(matchers[one.metric], one, avoid, region, [one.place])) is not None}
        if not tried:
            break
        best = min(tried, key=lambda k: tried[k].cost)
        found[best] = tried[best]
    pixels, confidence = np.full((len(objects), 2), np.nan), np.zeros(len(objects))
    states, outlines = [LOST] * len(objects), [np.zeros((0, 2))] * len(objects)
    for k, pose in found.items():
        confidence[k] = pose.confidence
        if confidence[k] > LEAST_SURE:
            states[k] = SEEN
            pixels[k] = plane.enlarge(plane.middle_pixels(pose.place))
            outlines[k] = plane.enlarge(plane.top_pixels(
                pose.template.outlined(pose.place, pose.angle)))
    return Tracked(pixels, tuple(states), confidence, tuple(outlines))
