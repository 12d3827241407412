# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mean shift over the colours of an object: coarse, but it minds neither height nor sides."""

import cv2
import numpy as np
from tap_ros.tracking.template import Matcher, Template

_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.5)


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
