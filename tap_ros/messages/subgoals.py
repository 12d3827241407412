# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predicted subgoals to messages and back."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from tap_ros.base.contract import MAP_ENCODING
from tap_ros.base.errors import PlanningError
from tap_ros.base.text import escaped
from tap_ros.messages.images import decode_image, decode_map, image_fields, map_fields
from tap_ros.messages.objects import match_objects
from tap_ros.messages.stamps import header_fields, Stamp

NEAR = 1 / 16  # of the width: half a side of the square that is one place
ELSEWHERE = 0.25  # of a map: what is decided has less outside of its likeliest place


@dataclass(frozen=True)
class Subgoal:
    """
    A predicted frame: on the way to the goal, or going forward from the start.

    :param image: uint8 (H, W, 3).
    :param object_maps: float32 (K, h, w), each sums to 1: where each object should then be; of
        the size that the network sees, which may be smaller than the picture. (0, h, w) in an
        answer to a request without maps.
    :param expected_pixels: float32 (K, 2), the mean under each map, (u, v) in the picture.
    :param mass: float32 (K,), what each map summed to before normalising; far from 1 the map
        is doubtful (warp.WarpedMaps).
    :param sample: which sample it belongs to, from 0.
    :param level: level of recursion, from 1, the one that is predicted from the request.
    :param distance: of start and goal from those of the most alike demonstration, where one was
        looked up, see prediction.retrieval; else NaN.
    :param warning: why it is not to be trusted; '': nothing is known against it.
    """

    image: np.ndarray
    object_maps: np.ndarray
    expected_pixels: np.ndarray
    mass: np.ndarray
    sample: int
    level: int
    distance: float = math.nan
    warning: str = ''

    @property
    def undecided(self) -> np.ndarray:
        """Whether the map of each object is spread out or has several places, bool (K,)."""
        half = max(1, round(NEAR * self.object_maps.shape[2]))
        side, beside = 2 * half + 1, (half + 1, half)
        sums = np.pad(self.object_maps, ((0, 0), beside, beside)).cumsum(1).cumsum(2)
        rows = sums[:, side:] - sums[:, :-side]
        squares = rows[..., side:] - rows[..., :-side]  # what is around each pixel
        return np.asarray(squares.max((1, 2)) < 1 - ELSEWHERE)


def subgoal_fields(subgoal: Subgoal, names: Iterable[str], stamp: Stamp | int, frame_id: str,
                   encoding: str = MAP_ENCODING) -> dict[str, Any]:
    """
    Return the fields of a tap_msgs/Subgoal.

    :param subgoal: Subgoal with K objects.
    :param names: K strings.
    :param stamp: of the image that the prediction started from, a Stamp or ns.
    :param frame_id: frame of the camera.
    :param encoding: of the maps, one of MAP_ENCODINGS.
    """
    maps = () if encoding == 'none' else subgoal.object_maps
    return {
        'header': header_fields(stamp, frame_id),
        'image': image_fields(subgoal.image, stamp, frame_id), 'object_names': list(names),
        'object_maps': [map_fields(values, stamp, frame_id, encoding) for values in maps],
        'expected_pixels': [
            {'x': float(u), 'y': float(v)} for u, v in subgoal.expected_pixels]}


def decode_subgoals(response: Any, names: Sequence[str],
                    size: Sequence[int] | None = None) -> list[Subgoal]:
    """
    Turn an answer of predict_subgoal into Subgoals.

    :param response: of tap_msgs/PredictSubgoal, a success.
    :param names: K strings, the order wanted of the objects.
    :param size: the (height, width) that object maps must have, or None for any that all have,
        or no maps.
    :return: list of Subgoal, in the order of the answer; their mass and distance, which the
        messages lack, are NaN.
    :raises PlanningError: when subgoals, objects or what tells them apart are missing.
    :raises ImageError: for a picture or map that cannot be used.
    """
    count = len(response.subgoals)
    if not count or not count == len(response.sample) == len(response.level):
        raise PlanningError(
            f'predict_subgoal: {count} subgoals, {len(response.sample)} entries of sample and '
            f'{len(response.level)} of level; expected one or more, and as many of each')
    return [decode_subgoal(message, names, size, sample, level)
            for message, sample, level in zip(
                response.subgoals, response.sample, response.level)]


def decode_subgoal(message: Any, names: Sequence[str], size: Sequence[int] | None = None,
                   sample: int = 0, level: int = 1) -> Subgoal:
    """
    Turn one tap_msgs/Subgoal into a Subgoal; names, size and errors are as above.

    :param message: tap_msgs/Subgoal.
    :param sample: which sample it belongs to, from 0.
    :param level: level of recursion, from 1.
    :return: Subgoal.
    """
    found = tuple(message.object_names)
    if len(found) != len(message.expected_pixels) or len(message.object_maps) not in (
            (len(found),) if size else (0, len(found))):
        raise PlanningError(
            f'subgoal: {len(message.object_maps)} object_maps and {len(message.expected_pixels)} '
            f'expected_pixels for {len(found)} object_names; expected one for each')
    order = match_objects(names, found, np.arange(len(found)), 'objects', 'subgoal')
    points = [message.expected_pixels[i] for i in order]
    pixels = np.array([(point.x, point.y) for point in points], np.float32).reshape(-1, 2)
    if not np.isfinite(pixels).all():
        raise PlanningError('subgoal: expected_pixels hold NaN or infinity; expected finite '
                            'numbers')
    image, maps = decode_image(message.image, 'image of the subgoal'), list[np.ndarray]()
    for i in order if message.object_maps else ():
        maps.append(decode_map(message.object_maps[i], f'object map of {escaped(found[i])}', size))
        size = size or maps[0].shape
    size = size or image.shape[:2]
    return Subgoal(
        image=image, object_maps=np.array(maps, np.float32).reshape(-1, *size),
        expected_pixels=pixels, mass=np.full(len(order), np.nan, np.float32), sample=sample,
        level=level)
