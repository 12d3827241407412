# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predicted subgoals to messages and back."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from geometry_msgs.msg import Point
import numpy as np
from tap_msgs.msg import Subgoal as SubgoalMessage
from tap_ros.errors import PlanningError
from tap_ros.nodes.image_messages import decode_image, decode_map, encode_image, encode_map
from tap_ros.nodes.object_messages import match_objects
from tap_ros.prediction.predictor import Subgoal
from tap_ros.text import escaped

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from tap_msgs.srv import PredictSubgoal


def encode_subgoal(subgoal: Subgoal, names: Iterable[str], stamp: 'Time',
                   frame_id: str) -> SubgoalMessage:
    """
    Turn a Subgoal of the predictor into a message.

    :param subgoal: prediction.predictor.Subgoal with K objects.
    :param names: K strings.
    :param stamp: builtin_interfaces/Time of the image that the prediction started from.
    :param frame_id: frame of the camera.
    :return: tap_msgs/Subgoal.
    """
    message = SubgoalMessage(
        image=encode_image(subgoal.image, stamp, frame_id), object_names=list(names),
        object_maps=[encode_map(values, stamp, frame_id) for values in subgoal.object_maps],
        expected_pixels=[Point(x=float(u), y=float(v)) for u, v in subgoal.expected_pixels])
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def decode_subgoals(response: 'PredictSubgoal.Response', names: Sequence[str],
                    size: Sequence[int]) -> list[Subgoal]:
    """
    Turn an answer of predict_subgoal into Subgoals.

    :param response: of tap_msgs/PredictSubgoal, a success.
    :param names: K strings, the order wanted of the objects.
    :param size: the (height, width) that pictures must have.
    :return: list of prediction.predictor.Subgoal, in the order of the answer; their mass, which
        the messages lack, is NaN.
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


def decode_subgoal(message: SubgoalMessage, names: Sequence[str], size: Sequence[int],
                   sample: int = 0, level: int = 1) -> Subgoal:
    """
    Turn one tap_msgs/Subgoal into a Subgoal; names, size and errors are as above.

    :param message: tap_msgs/Subgoal.
    :param sample: which sample it belongs to, from 0.
    :param level: level of recursion, from 1.
    :return: prediction.predictor.Subgoal.
    """
    found = tuple(message.object_names)
    if not len(found) == len(message.object_maps) == len(message.expected_pixels):
        raise PlanningError(
            f'subgoal: {len(message.object_maps)} object_maps and {len(message.expected_pixels)} '
            f'expected_pixels for {len(found)} object_names; expected one for each')
    order = match_objects(names, found, np.arange(len(found)), 'objects', 'subgoal')
    points = [message.expected_pixels[i] for i in order]
    pixels = np.array([(point.x, point.y) for point in points], np.float32).reshape(-1, 2)
    if not np.isfinite(pixels).all():
        raise PlanningError('subgoal: expected_pixels hold NaN or infinity; expected finite '
                            'numbers')
    maps = [decode_map(message.object_maps[i], f'object map of {escaped(found[i])}', size)
            for i in order]
    return Subgoal(
        image=decode_image(message.image, 'image of the subgoal', size),
        object_maps=np.array(maps, np.float32).reshape(-1, *size), expected_pixels=pixels,
        mass=np.full(len(order), np.nan, np.float32), sample=sample, level=level)
