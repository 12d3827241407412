# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Proposals for the search: go behind an object as seen from its goal, and push it through.

Random displacements seldom touch an object. These candidates use only what the planner is given,
object pixels and goal pixels, brought to the table by the model's homography.
"""

import numpy as np
from tap_ros.planning.action_sequences import REPEAT, SequenceShape

PACE = 0.9  # of the limits is used, so that the search can still add to it


def push_proposals(shape: SequenceShape, gripper: np.ndarray, objects: np.ndarray,
                   goals: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Propose pushes.

    :param shape: SequenceShape.
    :param gripper: (4,) metres.
    :param objects: (K, 2) metres on the table; goals (K, 2).
    :param count: P, how many.
    :param rng: numpy Generator.
    :return: (P, D) parameters, none when every object is at its goal.
    """
    gaps = goals - objects
    distances = np.linalg.norm(gaps, axis=1)
    weights = np.where(distances > 0.01, distances, 0)  # how often each object is chosen
    if not count or weights.sum() <= 0:
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


def _go_and_push(shape: SequenceShape, gripper: np.ndarray, start: np.ndarray, end: np.ndarray,
                 target: np.ndarray, along: np.ndarray) -> np.ndarray:
    """
    Return parameters (D,): travel lifted to the start unless already behind, push to the end.

    :param start: (2,) metres; end (2,); target (2,), the object; along (2,), of the push.
    """
    here = gripper[:2]
    ahead = (target - here) @ along
    beside = np.linalg.norm(target - here - ahead * along)
    lifted, phase = 0, (shape.phase or 0)
    if not (gripper[2] < 0.05 and 0.02 < ahead < 0.2 and beside < 0.05):
        # as many lifted periods as the way needs at nearly full speed
        for lifted, phase in shape.lifts():
            periods = _moving_periods(shape, gripper, lifted, phase)
            if np.abs(start - here).max() <= PACE * shape.move_limit * periods[:lifted].sum():
                break
    start = start if lifted else here
    needed = np.linalg.norm(end - start) / (PACE * shape.push_limit)
    if not lifted and shape.phase is None:
        phase = int(-np.ceil(needed) % REPEAT)  # so that it ends with a segment
    periods = _moving_periods(shape, gripper, lifted, phase)
    moves = np.zeros((shape.num_moves, 2))
    moves[:lifted] = (start - here) / max(1, periods[:lifted].sum())
    last = lifted + 1
    while last < shape.num_moves and periods[lifted:last].sum() < needed:
        last += 1
    moves[lifted:last] = (end - start) / max(1, periods[lifted:last].sum())
    moves = np.clip(moves, -shape.move_limit, shape.move_limit)
    return shape.join(moves, lifted, phase)


def _moving_periods(shape: SequenceShape, gripper: np.ndarray, lifted: int,
                    phase: int) -> np.ndarray:
    """Return how many control periods of each segment (num_moves,) move sideways."""
    _, (sideways,) = shape.climbs(np.array([lifted]), np.array([phase]), gripper[2])
    return np.bincount(shape.segment([phase])[0], sideways, minlength=shape.num_moves)
