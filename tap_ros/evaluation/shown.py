# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a prediction shows the hand and the objects that the frame it matches shows.

An l1 error hardly tells: where little of a picture moves, leaving it out is cheap. So the picture
is compared with the matched frame and with the same frame without the hand, or without the
object, over those pixels alone in which the two differ. Robot masks and object positions are the
recordings'; they score only.
"""

import cv2
import numpy as np
from tap_ros.base.contract import ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.images.robot_mask import fill_in_time
from tap_ros.recording.episode import Episode

SHOWN = 0.5  # least share of the contrast of what counts as shown
OBJECT_RADIUS = 7.0  # px around an object's pixel, in pictures of 64 px
CONTRAST = 0.06  # on [0, 1]: less is no difference
HAND_CONTRAST = 0.25  # likewise, of the hand: less is mostly its shadow, masked with it
MIN_PIXELS = 5  # fewer cannot be judged


class ShownScorer:
    """
    Score pictures against the frames of an episode.

    :param episode: Episode; without robot masks nothing is known.
    """

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._bare = None if episode.robot_masks is None else fill_in_time(
            episode.frames, episode.robot_masks, 'all')[0]

    def score(self, image: np.ndarray, t: int) -> tuple[float, float]:
        """
        Score a picture.

        :param image: (H, W, 3) in 0..1, the prediction.
        :param t: number of the frame that it matches.
        :return: for the hand, and for the worst shown object: 1 when the picture shows it as the
            frame does, 0 when it shows what is behind it; NaN when the frame does not show it.
        """
        if self._bare is None or self._episode.robot_masks is None:
            return np.nan, np.nan
        frame, bare = (pictures[t].astype(np.float32) / 255
                       for pictures in (self._episode.frames, self._bare))
        mask = self._episode.robot_masks[t]
        hand = _share(image, frame, bare, mask == ROBOT_MASK_HAND, HAND_CONTRAST)
        objects = [share for u, v in self._episode.object_pixels[t] if np.isfinite(share := _share(
            image, frame, *_without_object(frame, u, v, mask == ROBOT_MASK_FREE)))]
        return hand, min(objects, default=np.nan)


def _without_object(frame: np.ndarray, u: float, v: float,
                    free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Paint over the surroundings of a pixel; return the picture, and which were free."""
    height, width = frame.shape[:2]
    y, x = np.mgrid[:height, :width]
    disc = np.hypot(x - u, y - v) <= OBJECT_RADIUS * width / 64
    without = cv2.inpaint((frame * 255).astype(np.uint8), (disc | ~free).astype(np.uint8), 3,
                          cv2.INPAINT_TELEA)
    return without.astype(np.float32) / 255, disc & free


def _share(image: np.ndarray, frame: np.ndarray, without: np.ndarray,
           where: np.ndarray, contrast: float = CONTRAST) -> float:
    """Return how much of the contrast between two pictures a third one shows, at most 1."""
    where = where & (np.abs(frame - without).max(-1) > contrast)
    if where.sum() < MIN_PIXELS:
        return np.nan
    return 1 - float(np.abs(image - frame)[where].mean() / np.abs(without - frame)[where].mean())
