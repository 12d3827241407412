# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where things may stand when a scene is drawn, and in which order objects are taken."""

import numpy as np
from numpy.typing import ArrayLike

OBJECT_RANGE = 0.35  # m, |x| and |y| of object origins at start and goal
GOAL_DISTANCE = 0.2  # m from start to goal of every object that is pushed
GOAL_YAW_RANGE = 0.2  # rad
GRIPPER_RANGE = 0.4  # m, |x| and |y| of the gripper at the start
GRIPPER_HEIGHT = 0.14  # m, highest start of the gripper
GRIPPER_MARGIN = 0.16  # m between the gripper and any object origin at the start
GRIPPER_NEAR = 0.2  # m, at most, to the object that is pushed first


def apart(positions: np.ndarray, separation: float) -> bool:
    """Tell whether all pairs of positions (K, 2) are at least so far apart."""
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return (gaps[np.triu_indices(len(positions), 1)] >= separation).all()


def gripper_away_from(rng: np.random.Generator, positions: np.ndarray, low: ArrayLike,
                      high: ArrayLike) -> np.ndarray:
    """
    Draw a place of the gripper that touches no object.

    :param rng: numpy Generator.
    :param positions: (K, 2) object origins in metres.
    :param low: (2,) m, x and y that the arm reaches, least; high: greatest.
    :return: (3,) metres.
    """
    while True:
        xy = rng.uniform(-GRIPPER_RANGE, GRIPPER_RANGE, 2)
        away = np.linalg.norm(positions - xy, axis=1).min()
        if away > GRIPPER_MARGIN and (xy >= low).all() and (xy <= high).all():
            return np.append(xy, rng.uniform(0, GRIPPER_HEIGHT))


def gripper_beside_one(rng: np.random.Generator, positions: np.ndarray) -> np.ndarray:
    """
    Draw a place of the gripper that touches no object and is near one of them.

    So the start picture tells which object is pushed first, also where a goal picture with the
    arm elsewhere does not tell which was last.

    :param rng: numpy Generator.
    :param positions: (K, 2) object origins in metres, at least GRIPPER_MARGIN apart.
    :return: (3,) metres.
    """
    while True:
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(GRIPPER_MARGIN, GRIPPER_NEAR)
        xy = positions[rng.integers(len(positions))] + distance * np.array(
            [np.cos(angle), np.sin(angle)])
        away = np.linalg.norm(positions - xy, axis=1)
        if (away >= GRIPPER_MARGIN).all() and (np.abs(xy) <= GRIPPER_RANGE).all():
            return np.append(xy, rng.uniform(0, GRIPPER_HEIGHT))


def nearest_first(hand: np.ndarray, starts: np.ndarray, goals: np.ndarray) -> list[int]:
    """
    Order objects as the expert mostly takes them: always the one nearest to the gripper.

    :param hand: (2,) metres, where the gripper is; starts (K, 2), goals (K, 2) of the objects.
    :return: list of K object indices.
    """
    order, left = [], list(range(len(starts)))
    while left:
        k = min(left, key=lambda i: np.linalg.norm(starts[i] - hand))
        left.remove(k)
        order.append(k)
        hand = goals[k]
    return order
