# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Proposals for the search: go behind an object as seen from its goal, and push it through.

Random displacements seldom touch an object. These candidates use only what the planner is given,
object pixels and goal pixels, brought to the table by the model's homography.
"""

import numpy as np

PACE = 0.9  # of the limits is used, so that the search can still add to it


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
    for k in rng.choice(len(objects), count, p=weights / weights.sum()):
        angle = np.arctan2(*gaps[k][::-1]) + rng.normal(0, 0.2)
        along = np.array([np.cos(angle), np.sin(angle)])
        aside = rng.normal(0, 0.025) * np.array([-along[1], along[0]])
        start = objects[k] - rng.uniform(0.12, 0.15) * along + aside
        # the gripper stops where the object's near side should end
        end = start + (distances[k] + rng.normal(0.07, 0.03)) * along
        proposals.append(_go_and_push(shape, gripper, start, end, objects[k], along))
    return np.stack(proposals)


def _go_and_push(shape, gripper, start, end, target, along):
    """
    Return parameters (D,): travel lifted to the start unless already behind, push to the end.

    :param start: (2,) metres; end (2,); target (2,), the object; along (2,), of the push.
    """
    here = gripper[:2]
    ahead = (target - here) @ along
    beside = np.linalg.norm(target - here - ahead * along)
    lifted = 0
    if not (gripper[2] < 0.05 and 0.02 < ahead < 0.2 and beside < 0.05):
        # as many lifted segments as the way needs at nearly full speed
        while lifted < min(shape.max_lift, shape.num_moves - 1):
            lifted += 1
            periods = _moving_periods(shape, gripper, lifted)
            if np.abs(start - here).max() <= PACE * shape.move_limit * periods[:lifted].sum():
                break
    periods = _moving_periods(shape, gripper, lifted)
    moves = np.zeros((shape.num_moves, 2))
    moves[:lifted] = (start - here) / max(1, periods[:lifted].sum())
    if not lifted:
        start = here
    needed = np.linalg.norm(end - start) / (PACE * shape.push_limit)
    last = lifted + 1
    while last < shape.num_moves and periods[lifted:last].sum() < needed:
        last += 1
    moves[lifted:last] = (end - start) / max(1, periods[lifted:last].sum())
    moves = np.clip(moves, -shape.move_limit, shape.move_limit)
    return np.append(moves.ravel(), lifted)


def _moving_periods(shape, gripper, lifted):
    """Return how many control periods of each segment (num_moves,) move sideways."""
    _, sideways = shape.climbs(np.array([lifted]), gripper[2])
    return np.bincount(shape.segment(), sideways[0], minlength=shape.num_moves)
