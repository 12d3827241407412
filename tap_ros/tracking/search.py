# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An object anywhere in a picture: places that have its colours, then poses of its template."""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.tracking.template import FAR, Matcher, Pose, Template

PLACES = 6  # that are tried
APART = 0.035  # m from other objects
EDGE = 0.47  # m, |x| and |y| on a calibrated table
_TURNS = np.linspace(-np.pi, np.pi, 16, endpoint=False)
_LINE = np.linspace(-0.03, 0.03, 5)  # m around a place
_GRID = np.stack(np.meshgrid(_LINE, _LINE, _TURNS, indexing='ij'), -1).reshape(-1, 3)


def likeness(matcher: Matcher, template: Template) -> np.ndarray:
    """Return how like the object's colours pixels are that are not covered, (h, w) 0 to 1."""
    like = np.clip(1 - template.palette.distance(matcher.picture) / FAR, 0, 1)
    like[matcher.covered] = 0
    return like


def locate(matcher: Matcher, template: Template, avoid: Sequence[np.ndarray] = (),
           region: np.ndarray | None = None, extra: Sequence[np.ndarray] = (),
           least: float = 0.3) -> Pose | None:
    """
    Search all of a picture for an object, turned by any angle.

    :param avoid: places of other objects.
    :param region: (h, w) weights of places, or None.
    :param extra: places that are tried, too.
    :param least: share of the object that has to be seen.
    """
    plane = matcher.plane
    side = max(5.0, template.area ** 0.5)
    dense = cv2.GaussianBlur(likeness(matcher, template), (0, 0), side / 2.5)
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
        places, angles = place + _GRID[:, :2], _GRID[:, 2]
        cost, seen, _ = matcher.score(template, places, angles, thin=3)
        cost[seen < least] = np.inf
        j = int(cost.argmin())
        if not np.isfinite(cost[j]):
            continue
        found = matcher.refine(template, places[j], angles[j] + template.angle, 0.02, 0.3, pull=0)
        if found is not None and (best is None or found.cost < best.cost):
            best = found
    return best
