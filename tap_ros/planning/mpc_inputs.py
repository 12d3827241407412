# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the planner is given, a scene and a goal: checks that name what is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.errors import PlanningError
from tap_ros.images.pixels import check_image, check_pixels, in_picture
from tap_ros.planning.cost import distances_to_places
from tap_ros.planning.table import Table
import torch

# What a gripper over the table can be: x, y, z in metres, opening. Anything else is another unit,
# another frame or nonsense; learned models would answer it with a move all the same.
GRIPPER_LOW = np.array([-1.0, -1.0, -0.1, -0.1], np.float32)
GRIPPER_HIGH = np.array([1.0, 1.0, 1.0, 1.1], np.float32)
GRIPPER_PARTS = ('x', 'y', 'z', 'opening')


@dataclass(frozen=True)
class Scene:
    """What the robot sees."""

    image: np.ndarray  # (H, W, 3) uint8
    gripper: np.ndarray  # (4,) metres and opening
    object_pixels: np.ndarray  # (K, 2) as (u, v), where the objects are


def check_scene(scene: Scene, size: Sequence[int]) -> Scene:
    """
    Check what the robot sees.

    :param scene: Scene; size: (height, width) of its picture.
    :return: the same Scene, numbers as float32.
    :raises PlanningError: for what cannot be planned with; ImageError: for its picture.
    """
    check_image(scene.image, 'image', size)
    pixels = check_pixels(scene.object_pixels, 'object_pixels')
    if not len(pixels):
        raise PlanningError('object_pixels: no objects; give the position of one at least')
    gripper = np.ascontiguousarray(scene.gripper, np.float32)  # torch takes no flipped views
    if gripper.shape != (4,) or not np.isfinite(gripper).all():
        raise PlanningError(
            f'gripper: expected 4 finite numbers (x, y, z in m, opening), got {gripper}')
    outside = np.flatnonzero((gripper < GRIPPER_LOW) | (gripper > GRIPPER_HIGH))
    if len(outside):
        at = outside[0]
        raise PlanningError(
            f'gripper: {GRIPPER_PARTS[at]} is {gripper[at]:g}; expected {GRIPPER_LOW[at]:g} to '
            f'{GRIPPER_HIGH[at]:g} (metres from the middle of the table, opening 0 to 1)')
    return Scene(scene.image, gripper, pixels)


@dataclass(frozen=True, eq=False)
class Goal:
    """Where K objects should be."""

    distances: torch.Tensor  # (K, n n) px, of every table cell from each object's goal
    places: np.ndarray  # (K, 2) m, the table cells nearest to the goals

    def __len__(self) -> int:
        return len(self.distances)


def tabulate(table: Table, pixels: ArrayLike | None = None,
             maps: ArrayLike | None = None) -> Goal:
    """
    Tabulate a goal once: how far each place on the table is from it.

    For a goal map q the distance is the expected one, so that an object map p costs that between
    the two, E_{p,q}|x - y|.

    :param table: of the forward model.
    :param pixels: (K, 2) as (u, v), in the picture; or
    :param maps: (K, H, W), each of positive mass. Exactly one of the two.
    :raises PlanningError: for goals that cannot be planned to, also ImageError.
    """
    if (maps is None) == (pixels is None):
        raise PlanningError('goal: give exactly one of pixels and maps')
    cells, (height, width) = table.pixels().flatten(0, 1), table.image_size
    if maps is None:
        goals = check_pixels(pixels, 'goal_pixels')
        outside = goals[~in_picture(goals, table.image_size)].tolist()
        if outside:
            raise PlanningError(f'goal_pixels: {outside} outside the {width}x{height} picture')
        distances = torch.cdist(torch.from_numpy(goals).to(cells.device), cells)
    else:
        goals = np.ascontiguousarray(maps, np.float32)
        if goals.ndim != 3 or goals.shape[1:] != (height, width):
            raise PlanningError(f'goal_maps: expected shape (K, {height}, {width}), one map for '
                                f'each object, got {goals.shape}')
        mass = goals.sum((1, 2))
        if not np.isfinite(goals).all() or (goals < 0).any() or (mass <= 0).any():
            raise PlanningError('goal_maps: expected finite values of at least 0 and a positive '
                                f'sum for each object, got sums {mass.tolist()}')
        distances = distances_to_places(torch.from_numpy(goals).to(cells.device), cells)
    return Goal(distances, table.points()[distances.argmin(1)].cpu().numpy())
