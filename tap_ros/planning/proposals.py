# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Proposals for the search: go behind an object as seen from its goal, and push it through.

Random displacements seldom touch an object. These candidates use only what the planner is given,
object pixels and goal pixels, brought to the table by the model's homography.
"""

import numpy as np

PERIOD_SLACK = 0.9  # of the move limit is used, so that the search can still add to it


def push_proposals(shape, gripper, objects, goals, count, rng, weights=None):
    """
    Propose pushes.

    :param shape: SequenceShape.
    :param gripper: (4,) metres.
    :param objects: (K, 2) metres on the table; goals (K, 2).
    :param count: P, how many.
    :param rng: numpy Generator.
    :param weights: (K,) how often each object is chosen; default: by its distance to its goal.
    :return: (P, D) parameters, P = 0 when every object is at its goal.
    """
    gaps = goals - objects
    distances = np.linalg.norm(gaps, axis=1)
    weights = np.where(distances > 0.01, distances, 0) if weights is None else weights
    if weights.sum() <= 0:
        return np.zeros((0, shape.size))
    proposals = []
    chosen = rng.choice(len(objects), count, p=weights / weights.sum())
    for k in chosen:
        direction = gaps[k] / distances[k]
        side = np.array([-direction[1], direction[0]])
        offset = rng.normal(0, 0.025)
        standoff = rng.uniform(0.07, 0.14)
        start = objects[k] - standoff * direction + offset * side
        # the gripper's own half width is part of the way to the object's far side
        end = goals[k] - rng.uniform(0.02, 0.08) * direction + 0.5 * offset * side
        proposals.append(_go_and_push(shape, gripper, start, end, direction, objects[k]))
    return np.stack(proposals)


def _go_and_push(shape, gripper, start, end, direction, target):
    """Return parameters (D,): travel lifted to the start if needed, then push to the end."""
    periods = np.full(shape.num_moves, shape.repeat)
    periods[0] -= shape.phase
    limit = shape.move_limit * PERIOD_SLACK
    here, low = gripper[:2], gripper[2] < 0.05
    behind = (target - here) @ direction
    beside = abs((target - here) @ np.array([-direction[1], direction[0]]))
    moves, i = np.zeros((shape.num_moves, 2)), 0
    if not (low and 0.02 < behind < 0.18 and beside < 0.05):
        # travel: as many segments as the distance needs, at an even pace
        total = np.abs(start - here).max()
        while i < min(shape.max_lift, shape.num_moves - 1):
            i += 1
            if total <= limit * periods[:i].sum():
                break
        moves[:i] = (start - here) / periods[:i].sum()
        here = start
    lifted = i
    gap = end - here
    needed = max(1, int(np.ceil(np.abs(gap).max() / (limit * shape.repeat))))
    last = min(i + needed, shape.num_moves)
    moves[i:last] = gap / periods[i:last].sum()
    moves = np.clip(moves, -shape.move_limit, shape.move_limit)
    return np.append(moves.ravel(), lifted)
