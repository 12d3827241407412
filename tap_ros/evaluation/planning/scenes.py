# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which scenes are planned in."""

import numpy as np
from sim_bridge.tasks import get_task

FIRST_SCENE = 1_000_000  # seed, far from those of the training recordings
PLANNING_TASKS = ('push2', 'push3')


def step_budget(task):
    """Return B of App. F, the control periods of a task: 40 with two objects, 75 with three."""
    return get_task(task).num_frames


def nearest_first(hand, starts, goals):
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
