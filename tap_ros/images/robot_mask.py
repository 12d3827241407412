# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The picture behind the robot: what it hides is taken from when it was seen free.

An arm that reaches over the table is most of what changes in a picture, and its shadow with it.
In training the nearest frame of the episode fills the gap, at serving the last one that was seen.
"""

from collections.abc import Mapping
from typing import Any, cast, Literal

import numpy as np
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASKS

RobotMask = Literal['none', 'arm', 'all']  # contract.ROBOT_MASKS
_FAR = 2**29  # frames; further than any


def hidden_pixels(mask: np.ndarray, robot_mask: RobotMask) -> np.ndarray:
    """
    Say which pixels the robot hides.

    :param mask: uint8, any shape, of contract.ROBOT_MASK_FREE, _HAND and _ARM.
    :param robot_mask: 'none'; 'arm': the arm with its shadow, so that the hand stays in the
        picture; 'all': the hand, too.
    :return: bool, the same shape.
    """
    if robot_mask == 'arm':
        return mask == ROBOT_MASK_ARM
    if robot_mask == 'all':
        return mask != ROBOT_MASK_FREE
    return np.zeros(mask.shape, bool)


def nearest_free(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return for each pixel (K, 2) the nearest that the robot does not hide; itself if all are."""
    free = np.argwhere(mask == ROBOT_MASK_FREE)[:, ::-1]
    return np.array([free[((free - pixel) ** 2).sum(1).argmin()] if len(free) else pixel
                     for pixel in pixels])


def trained_robot_mask(training: Mapping[str, Any]) -> tuple[RobotMask, float]:
    """
    Return what weights were trained with.

    :param training: the training dict of a weights file, of any version.
    :return: robot_mask, and the share of the context pictures that were filled, too; of forward
        models, which say no share, all are.
    """
    settings = training.get('settings')
    settings = settings if isinstance(settings, dict) else {}
    robot_mask, share = settings.get('robot_mask'), settings.get('fill_context', 1.0)
    if robot_mask not in ROBOT_MASKS or not isinstance(share, (int, float)):
        return 'none', 0.0
    return cast(RobotMask, robot_mask), float(share)


def fill_in_time(frames: np.ndarray, masks: np.ndarray,
                 robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """
    Fill hidden pixels with what is seen there in the nearest frame where they are free.

    Of two that are equally near the earlier one counts. A hand that stays in the picture fills
    nothing: it would leave copies of itself on the way of the arm behind it.

    :param frames: uint8 (T, H, W, 3), an episode.
    :param masks: uint8 (T, H, W), its robot masks.
    :param robot_mask: see hidden_pixels.
    :return: uint8 (T, H, W, 3); bool (H, W), False where a pixel is hidden and never free: such
        ones stay as they are.
    """
    free = masks == ROBOT_MASK_FREE
    now = np.arange(len(frames), dtype=np.int32)[:, None, None]
    past = np.maximum.accumulate(np.where(free, now, -_FAR), 0)
    future = np.minimum.accumulate(np.where(free, now, _FAR)[::-1], 0)[::-1]
    source = np.where(now - past <= future - now, past, future)
    there, hidden = (source >= 0) & (source < len(frames)), hidden_pixels(masks, robot_mask)
    filled = np.array(frames)
    t, v, u = np.nonzero(hidden & there)
    filled[t, v, u] = frames[source[t, v, u], v, u]
    return filled, np.logical_not((hidden & ~there).any(0))


def fill_from_past(frames: np.ndarray, masks: np.ndarray,
                   robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """
    Fill hidden pixels with what was seen there free last, as FreeView does with a stream.

    :param frames: uint8 (T, H, W, 3), an episode.
    :param masks: uint8 (T, H, W), its robot masks.
    :param robot_mask: see hidden_pixels.
    :return: uint8 (T, H, W, 3); bool (H, W), False where a pixel is hidden before it is ever free:
        until then such ones stay as they are.
    """
    view = FreeView(robot_mask)
    filled = np.stack([view.update(*both) for both in zip(frames, masks)])
    known = np.maximum.accumulate(masks == ROBOT_MASK_FREE, 0)
    return filled, np.logical_not((hidden_pixels(masks, robot_mask) & ~known).any(0))


def last_free(frames: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """
    Return what was seen free last at each pixel (H, W, 3), the last frame where it never was.

    :param frames: uint8 (T, H, W, 3), an episode; masks: uint8 (T, H, W), its robot masks.
    """
    back = np.argmax((masks == ROBOT_MASK_FREE)[::-1], 0)  # frames before the last one
    v, u = np.indices(back.shape)
    return frames[len(frames) - 1 - back, v, u]


class FreeView:
    """
    Fill hidden pixels of a stream of pictures with what was seen free there last.

    Pixels that were never seen free stay as they are.

    :param robot_mask: see hidden_pixels.
    """

    def __init__(self, robot_mask: RobotMask) -> None:
        self._robot_mask: RobotMask = robot_mask
        self.clear()

    def clear(self) -> None:
        """Forget what was seen."""
        self._seen: np.ndarray | None = None  # (H, W, 3) uint8
        self._known = np.zeros((0, 0), bool)  # (H, W)

    def update(self, picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """
        Remember what a picture shows, the newest one so far, and fill it.

        :param picture: uint8 (H, W, 3); one of another size than before makes a new beginning.
        :param mask: uint8 (H, W), its robot mask.
        :return: uint8 (H, W, 3).
        """
        if self._seen is None or self._seen.shape != picture.shape:
            self._seen, self._known = np.zeros_like(picture), np.zeros(mask.shape, bool)
        free = mask == ROBOT_MASK_FREE
        self._seen[free] = picture[free]
        self._known |= free
        return self.fill(picture, mask)

    def fill(self, picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """
        Fill a picture of the same scene, and remember nothing of it.

        :param picture: uint8 (H, W, 3).
        :param mask: uint8 (H, W), its robot mask.
        :return: uint8 (H, W, 3); as it is where nothing of this size was seen.
        """
        if self._seen is None or self._seen.shape != picture.shape:
            return picture
        gaps = hidden_pixels(mask, self._robot_mask) & self._known
        return np.where(gaps[..., None], self._seen, picture)
