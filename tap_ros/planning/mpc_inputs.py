# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the planner is given: checks that name what is wrong."""

import numpy as np
from tap_ros.errors import ImageError, PlanningError
from tap_ros.images import check_image

# What a gripper over the table can be: x, y, z in metres, opening. Anything else is another unit,
# another frame or nonsense; learned models would answer it with a move all the same.
GRIPPER_LOW = np.array([-1.0, -1.0, -0.1, -0.1], np.float32)
GRIPPER_HIGH = np.array([1.0, 1.0, 1.0, 1.1], np.float32)
GRIPPER_PARTS = ('x', 'y', 'z', 'opening')


def check_scene(image, gripper, object_pixels, size):
    """
    Check what the robot sees.

    :param image: (H, W, 3) uint8; gripper (4,); object_pixels (K, 2); size: (height, width).
    :return: gripper (4,) and object pixels (K, 2) as float32.
    :raises PlanningError: for inputs that cannot be planned with.
    """
    try:
        check_image(image, 'image', size)
    except ImageError as error:
        raise PlanningError(str(error)) from error
    gripper = np.asarray(gripper, np.float32)
    if gripper.shape != (4,) or not np.isfinite(gripper).all():
        raise PlanningError(
            f'gripper: expected 4 finite numbers (x, y, z in m, opening), got {gripper}')
    outside = np.flatnonzero((gripper < GRIPPER_LOW) | (gripper > GRIPPER_HIGH))
    if len(outside):
        at = outside[0]
        raise PlanningError(
            f'gripper: {GRIPPER_PARTS[at]} is {gripper[at]:g}; expected {GRIPPER_LOW[at]:g} to '
            f'{GRIPPER_HIGH[at]:g} (metres from the middle of the table, opening 0 to 1)')
    return gripper, check_pixels(object_pixels, 'object_pixels', None, size)


def check_pixels(pixels, name, count, size):
    """
    Check pixels (K, 2); return them as float32.

    :param name: 'object_pixels' or 'goal_pixels'; goals have to lie in the picture.
    :param count: K, or None for any; size: (height, width).
    :raises PlanningError: for another shape, or positions that are unknown or outside.
    """
    pixels = np.asarray(pixels, np.float32)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or not len(pixels):
        raise PlanningError(f'{name}: expected shape (K, 2) with K at least 1, '
                            f'got {pixels.shape}')
    if count is not None and len(pixels) != count:
        raise PlanningError(f'{name}: {len(pixels)} goals for {count} objects; '
                            'give one for each object, in the same order')
    if not np.isfinite(pixels).all():
        bad = np.flatnonzero(~np.isfinite(pixels).all(1)).tolist()
        raise PlanningError(f'{name}: unknown (not finite) for objects {bad}; '
                            'plan for known objects only')
    size = np.array(size[::-1])
    if name == 'goal_pixels' and ((pixels < -0.5) | (pixels > size - 0.5)).any():
        bad = pixels[((pixels < -0.5) | (pixels > size - 0.5)).any(1)].tolist()
        raise PlanningError(f'{name}: {bad} outside the {size[0]}x{size[1]} picture')
    return pixels


def check_maps(maps, count, size):
    """
    Check goal maps (K, H, W); return them as float32.

    :raises PlanningError: for a wrong shape, negative or not finite values, or an empty map.
    """
    maps = np.asarray(maps, np.float32)
    if maps.shape != (count, *size):
        raise PlanningError(f'goal_maps: expected shape {(count, *size)} (one map for each '
                            f'object), got {maps.shape}')
    mass = maps.sum((1, 2))
    if not np.isfinite(maps).all() or (maps < 0).any() or (mass <= 0).any():
        raise PlanningError('goal_maps: expected finite values of at least 0 and a positive sum '
                            f'for each object, got sums {mass.tolist()}')
    return maps
