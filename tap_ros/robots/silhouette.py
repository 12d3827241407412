# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where convex bodies, and their shadows on a table, are in the picture of a camera.

A convex body projects to the convex hull of its projected corners. What lies in front of the
bodies is not known: an object before the arm is drawn over by it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from tap_ros.base.contract import ROBOT_MASK_FREE

NEAR = 0.01  # m; what is nearer to the camera, or behind it, is cut off
_LOW = 1e-3  # of a unit vector down; a light that falls more level throws shadows without end
_FAR = 20_000.0  # px; farther is not drawn
_SHIFT = 4  # bits of a pixel


@dataclass(frozen=True)
class Body:
    """A convex body, and what the mask says of it."""

    corners: np.ndarray  # (N, 3) m, in the frame of the scene
    label: int


@dataclass(frozen=True)
class PinholeCamera:
    """
    A pinhole camera without distortion.

    :param K: (3, 3) intrinsics in pixels; (0, 0) is the centre of the top-left pixel.
    :param size: (height, width).
    :param pose: (4, 4) of the camera in the scene: z forward, x right, y down in the picture.
    """

    K: np.ndarray
    size: tuple[int, int]
    pose: np.ndarray


@dataclass(frozen=True)
class Light:
    """
    A light from afar onto a level table.

    :param direction: (3,) in which it shines; its z is negative.
    :param height: of the table in the scene, m.
    """

    direction: np.ndarray
    height: float = 0.0


def draw_mask(bodies: Sequence[Body], view: PinholeCamera, dilation: float,
              light: Light | None = None) -> np.ndarray:
    """
    Draw what bodies hide, the nearest last, over what their shadows darken.

    :param dilation: px by which all is enlarged.
    :param light: draw shadows, too.
    :return: uint8 (H, W), labels; where shadows meet, the greatest one.
    """
    mask = np.full(view.size, ROBOT_MASK_FREE, np.uint8)
    if light is not None:
        for body in sorted(bodies, key=lambda body: body.label):
            _fill(mask, _shadow(body.corners, light), view, dilation, body.label)
    to_camera = np.linalg.inv(view.pose)
    depth = [float((body.corners @ to_camera[2, :3]).mean()) for body in bodies]
    for i in np.argsort(depth)[::-1]:
        _fill(mask, bodies[i].corners, view, dilation, bodies[i].label)
    return mask


def _shadow(corners: np.ndarray, light: Light) -> np.ndarray:
    """Return what of a body is above the table, flattened onto it along the light."""
    x, y, z = light.direction / np.linalg.norm(light.direction)
    above = _cut(corners, corners[:, 2] - light.height)
    drop = above[:, 2] - light.height
    return above - drop[:, None] * np.array([x, y, z]) / min(z, -_LOW)


def _cut(corners: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """
    Return corners of the part of a convex body where a linear function is not negative.

    :param inside: (N,) its values at the corners.
    """
    kept, lost = inside >= 0, inside < 0
    if not lost.any():
        return corners
    # Every edge that is cut leads from a kept corner to a lost one.
    share = (inside[kept, None] / (inside[kept, None] - inside[lost]))[..., None]
    cut = corners[kept, None] + share * (corners[lost] - corners[kept, None])
    return np.concatenate([corners[kept], cut.reshape(-1, 3)])


def _fill(mask: np.ndarray, corners: np.ndarray, view: PinholeCamera, dilation: float,
          label: int) -> None:
    """Draw the hull of corners (N, 3) of the scene."""
    to_camera = np.linalg.inv(view.pose)
    seen = corners @ to_camera[:3, :3].T + to_camera[:3, 3]
    seen = _cut(seen, seen[:, 2] - NEAR)
    if not len(seen):
        return
    rays = seen @ view.K.T
    hull = cv2.convexHull((rays[:, :2] / rays[:, 2:]).clip(-_FAR, _FAR).astype(np.float32))[:, 0]
    angle = np.arange(16) * np.pi / 8
    around = dilation / np.cos(np.pi / 16) * np.stack([np.cos(angle), np.sin(angle)], -1)
    grown = cv2.convexHull((hull[:, None] + around).reshape(-1, 2).astype(np.float32))
    cv2.fillConvexPoly(mask, np.rint(grown * 2 ** _SHIFT).astype(np.int32), int(label),
                       shift=_SHIFT)
