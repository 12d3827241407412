# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw blocks that are to be stacked: a tower on the first one."""

import numpy as np
from sim_bridge.world.grasping import GRASP_YAW
from sim_bridge.world.places import apart, GRIPPER_HEIGHT
from sim_bridge.world.scene import HALF_HEIGHT, ObjectShape

BLOCK_HALF_WIDTH = (0.026, 0.032)  # m
BLOCK_RANGE = 0.2  # m, |x| and |y| of the blocks
BLOCK_SEPARATION = 0.14  # m between blocks: the open fingers come down between them
HAND_RANGE = 0.3  # m, |x| and |y| of the gripper's start, all in view
HAND_MARGIN = 0.12  # m between the gripper and any block at the start
STACK_OFFSET = 0.025  # m, most between the origins of a block and the one below, seen from above
LEVEL_TOLERANCE = 0.01  # m, of the height of a block above the one below


def draw_block(rng: np.random.Generator) -> ObjectShape:
    """Draw a block with a square base that the fingers can hold."""
    width = rng.uniform(*BLOCK_HALF_WIDTH)
    colour = tuple(rng.uniform(0.3, 1.0, 3))
    return ObjectShape('bar', ((width, width, HALF_HEIGHT),), ((0, 0),), (colour,))


def draw_blocks(rng: np.random.Generator, count: int,
                spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Draw where K blocks stand, the tower and the gripper.

    :param rng: numpy Generator.
    :param count: K.
    :param spread: factor of the ranges of blocks and gripper.
    :return: start poses (K, 3) and goal poses (K, 3), all on the first block's start and, as the
        closing fingers turn what they hold, in line with x and y; (3,) of the gripper in m.
    """
    places = np.zeros((count, 2))
    while not apart(places, BLOCK_SEPARATION):
        places = spread * rng.uniform(-BLOCK_RANGE, BLOCK_RANGE, (count, 2))
    yaws = rng.uniform(-GRASP_YAW, GRASP_YAW, count)
    hand = places[0]
    while np.linalg.norm(places - hand, axis=1).min() < HAND_MARGIN:
        hand = spread * rng.uniform(-HAND_RANGE, HAND_RANGE, 2)
    goals = np.column_stack([np.tile(places[0], (count, 1)), np.zeros(count)])
    goals[0, 2] = yaws[0]
    return (np.column_stack([places, yaws]), goals,
            np.append(hand, rng.uniform(0, GRIPPER_HEIGHT)))


def levels(count: int) -> np.ndarray:
    """Return how high above the table the blocks of a tower stand, (K,) m."""
    return 2 * HALF_HEIGHT * np.arange(count)


def is_tower(poses: np.ndarray) -> bool:
    """Tell whether blocks stand on each other; poses (K, 3 or more) m, from the lowest on."""
    up = np.diff(poses[:, :3], axis=0)
    return bool((np.linalg.norm(up[:, :2], axis=1) < STACK_OFFSET).all()
                and (np.abs(up[:, 2] - 2 * HALF_HEIGHT) < LEVEL_TOLERANCE).all()
                and abs(poses[0, 2] - HALF_HEIGHT) < LEVEL_TOLERANCE)
