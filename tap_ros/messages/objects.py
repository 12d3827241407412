# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of objects to names and pixels and back."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from tap_ros.base.contract import LOST, STATES
from tap_ros.base.errors import PlanningError
from tap_ros.base.text import escaped, listing
from tap_ros.images.crop import Crop
from tap_ros.images.pixels import in_picture
from tap_ros.messages.stamps import header_fields, Stamp

MAX_OBJECTS = 32  # in one list; every one costs a map of each picture that is predicted
MAX_NAME = 100  # characters


def objects_fields(names: Iterable[str], pixels: np.ndarray, poses: np.ndarray | None,
                   stamp: Stamp | int, frame_id: str, source: str) -> dict[str, Any]:
    """
    Return the fields of a tap_msgs/ObjectStates, all seen.

    :param names: K strings.
    :param pixels: (K, 2) as (u, v).
    :param poses: (K, 7) x, y, z in metres and quaternion x, y, z, w; None: not known.
    :param stamp: of the image that the pixels belong to, a Stamp or ns.
    :param frame_id: frame of the poses.
    :param source: one of the SOURCE_ constants of ObjectStates.
    """
    numbers = np.full((len(pixels), 9), np.nan)
    numbers[:, :2] = pixels
    if poses is not None:
        numbers[:, 2:] = poses
    return {'header': header_fields(stamp, frame_id), 'source': source, 'objects': [
        {'name': name, 'u': u, 'v': v, 'pose': {
            'position': dict(zip('xyz', pose[:3])), 'orientation': dict(zip('xyzw', pose[3:]))}}
        for name, (u, v, *pose) in zip(names, numbers.tolist())]}


def decode_states(message: Any, name: str) -> tuple[str, ...]:
    """
    Return the states of the objects in a message, in its order; none where it tells none.

    :param message: tap_msgs/ObjectStates.
    :raises PlanningError: for another number of states than objects, and for unknown ones.
    """
    _check_count(message, name)
    states = tuple(message.states[:MAX_OBJECTS + 1])
    if states and (len(states) != len(message.objects) or not {*states} <= {*STATES}):
        raise PlanningError(
            f'{name}: states are {escaped(listing(states))} of {len(message.objects)} objects; '
            f'expected none, or one of {", ".join(STATES)} for each object')
    return states


def check_found(message: Any, name: str) -> None:
    """
    Refuse objects that were not found.

    :raises PlanningError: naming those whose state is lost.
    """
    lost = [state.name for state, known in zip(message.objects, decode_states(message, name))
            if known == LOST]
    if lost:
        raise PlanningError(f'{name}: {listing(lost)} not found in the picture; place it, or '
                            'select the objects again')


def decode_objects(message: Any, name: str,
                   size: Sequence[int] | None = None) -> tuple[tuple[str, ...], np.ndarray]:
    """
    Turn a message into names and pixels.

    :param message: tap_msgs/ObjectStates.
    :param name: how an error calls it, for example 'goal_objects'.
    :param size: (height, width) of the picture that the pixels must be in, or None for any.
    :return: names, a tuple of K strings, and pixels, float32 (K, 2) as (u, v).
    :raises PlanningError: for too many objects, for names that are empty, too long or used twice,
        and for pixels that are unknown or outside the picture.
    """
    _check_count(message, name)
    names = tuple(state.name for state in message.objects)
    pixels = np.array([(state.u, state.v) for state in message.objects]).reshape(len(names), 2)
    right = size is not None and in_picture(pixels, size).all()  # all at once: one by one is slow
    for index, object_name in enumerate(names):
        if not object_name or object_name in names[:index]:
            raise PlanningError(
                f"{name}: objects[{index}].name is '{escaped(object_name, MAX_NAME)}'; "
                'every object needs a name of its own')
        if len(object_name) > MAX_NAME:
            raise PlanningError(
                f'{name}: objects[{index}].name has {len(object_name)} characters; '
                f'at most {MAX_NAME} are taken')
        if not right:
            _check_pixel(f'{name}: {escaped(object_name)}', pixels[index], size)
    return names, pixels.astype(np.float32)


def decode_cut_objects(message: Any, name: str, size: Sequence[int],
                       crop: Crop) -> tuple[tuple[str, ...], np.ndarray]:
    """
    Decode objects of a picture of which only a part is used.

    :param message: tap_msgs/ObjectStates, pixels in the whole picture.
    :param name: how an error calls it.
    :param size: (height, width) of the whole picture.
    :param crop: Crop.
    :return: names, and pixels float32 (K, 2) in the part, scaled like it.
    :raises PlanningError: as decode_objects, and for an object that is not in the part.
    """
    names, pixels = decode_objects(message, name, size)
    cut = crop.pixels(pixels, size)
    if cut is pixels:
        return names, cut
    outside = [names[i] for i in np.flatnonzero(~in_picture(cut, crop.cut_size(size)))]
    if outside:
        left, top, width, height = crop.window(size)
        raise PlanningError(
            f'{name}: {listing(outside)} not in the part of the picture that the weights see, '
            f'{width}x{height} pixels from ({left}, {top}) on; leave it out')
    return names, cut


def _check_count(message: Any, name: str) -> None:
    """Refuse more objects than MAX_OBJECTS, before anything looks at each."""
    if len(message.objects) > MAX_OBJECTS:
        raise PlanningError(
            f'{name}: has {len(message.objects)} objects; at most {MAX_OBJECTS} are taken')


def _check_pixel(name: str, pixel: np.ndarray, size: Sequence[int] | None) -> None:
    """Refuse a pixel (u, v) that is unknown, or not in a picture of this (height, width)."""
    if size is None:
        with np.errstate(over='ignore'):  # what float32 cannot hold becomes infinite
            pixel = pixel.astype(np.float32)
    u, v = pixel
    if not np.isfinite(pixel).all():
        raise PlanningError(f'{name} has the pixel ({u}, {v}); expected finite numbers, '
                            'leave out objects that are not seen')
    if size is None:
        return
    height, width = size
    if not in_picture(pixel, size):
        raise PlanningError(
            f'{name} has the pixel ({u}, {v}), which is outside the picture; expected u from -0.5 '
            f'to {width - 0.5} and v from -0.5 to {height - 0.5}, leave out objects that are not '
            'seen')


def match_objects(names: Sequence[str], other_names: Sequence[str], other_pixels: np.ndarray,
                  name: str, other_name: str) -> np.ndarray:
    """
    Put pixels of the same objects into the same order.

    :param names: K strings, the order wanted.
    :param other_names: at least the same strings, in any order.
    :param other_pixels: (len(other_names), 2).
    :param name: how an error calls the first list.
    :param other_name: how an error calls the second list.
    :return: (K, 2).
    :raises PlanningError: if one of `names` is not among `other_names`.
    """
    missing = [object_name for object_name in names if object_name not in other_names]
    if missing:
        raise PlanningError(
            f'{other_name}: lacks {listing(missing)} of {name}; it has '
            f'{listing(other_names) or "no objects"}')
    return other_pixels[[other_names.index(object_name) for object_name in names]]
