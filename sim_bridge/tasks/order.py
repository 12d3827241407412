# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushing where the order matters: each object stands on the next one's goal.

The objects are a chain. The last one of it stands near an edge of the workspace and goes along the
edge; the one before goes outwards, to where the last one stood, and with three objects the first
goes to where the second stood. The gripper begins beside the first, away from the others. Whoever
begins with that one pushes what stands on its goal outwards, where the gripper cannot get behind
it any more.

Before each push the expert tries all orders in the simulator, see find_order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations
from typing import ClassVar

import numpy as np
from sim_bridge.tasks.motions import after_plans, direction, Moment, Push, push_actions
from sim_bridge.tasks.push import (
    Expert,
    GOAL_DISTANCE,
    OBJECT_RANGE,
    PushTask,
    TILT_COST,
    with_yaws,
)
from sim_bridge.tasks.tasks import apart, TaskScene
from sim_bridge.world.scene import ObjectShape, random_shape
from sim_bridge.world.table import GRIPPER_HEIGHT, GRIPPER_MARGIN, GRIPPER_RANGE, Table
from tap_ros.base.contract import WORKSPACE_HIGH

EDGE_RANGE = (0.35, 0.38)  # m from the middle, where the object at the edge stands
OUTWARDS = 0.35  # rad, largest angle between the edge's normal and the way onto that place
ALONG = (1.7, 2.1)  # rad, between the edge's normal and the way of the object at the edge
NEAR = 0.02  # m, largest distance from an object to the goal on which it stands
ORDER_SEPARATION = 0.17  # m between object origins at the start, and between goals
FREE_WAY = 0.13  # m, least from a way to the objects that stand beside it, in the right order
BEHIND = 0.13  # m, where a push begins
HAND_DISTANCE = (GRIPPER_MARGIN, 0.24)  # m from the first object of the chain to the gripper
# The search for an order: pushes of each object at each place in it; the first goes straight.
SAMPLES = 10
ANGLE_STD, OFFSET_STD, OVERSHOOT_STD = 0.25, 0.015, 0.02  # rad, m, m
SPEED, TRAVEL_SPEED = 0.05, 0.08  # m per control period


@dataclass(frozen=True)
class OrderTask(PushTask):
    """Push every object to its goal, in the right order."""

    start_separation: float = ORDER_SEPARATION
    ordered: ClassVar[bool] = True
    object_range: ClassVar[float] = EDGE_RANGE[1]

    def draw(self, rng: np.random.Generator, spread: float) -> TaskScene:
        """Draw a scene in which the order of pushes matters."""
        while True:  # they do not touch each other ORDER_SEPARATION apart, whatever their yaw
            shapes = tuple(random_shape(rng) for _ in range(self.num_objects))
            if sum(sorted(map(_radius, shapes))[-2:]) < ORDER_SEPARATION:
                break
        starts, goals, hand = draw_chain(rng, self.num_objects)
        # So that a name, or a place in a list, does not tell the order.
        names = rng.permutation(self.num_objects)
        starts[names], goals[names] = starts.copy(), goals.copy()
        start_poses, goal_poses = with_yaws(rng, starts, goals)
        return TaskScene(shapes, start_poses, goal_poses, hand, tuple(names[::-1].tolist()))

    def next_object(self, expert: Expert, todo: Sequence[int]) -> int:
        """Return the first in the best order."""
        return find_order(expert.table, Moment.of(expert.table), expert.goals, todo, expert.rng)[0]


ORDER2 = OrderTask('order2', num_objects=2, num_frames=55, stream=6)
ORDER3 = OrderTask('order3', num_objects=3, num_frames=90, stream=7)


def draw_chain(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Draw where objects stand and go, object i to where object i + 1 stands, and the gripper.

    :param rng: numpy Generator.
    :param count: K objects; the right order is from the last one to the first.
    :return: starts (K, 2) and goals (K, 2) of the objects, (3,) of the gripper; metres.
    """
    while True:
        starts, goals = _at_the_edge(rng, count)
        if not (_inside(starts, EDGE_RANGE[1]) and _inside(goals, EDGE_RANGE[1])
                and apart(starts, ORDER_SEPARATION) and apart(goals, ORDER_SEPARATION)
                and _free(starts, goals)):
            continue
        away = starts[0] - goals[0]
        angle = np.arctan2(away[1], away[0]) + rng.uniform(-1, 1)
        hand = starts[0] + rng.uniform(*HAND_DISTANCE) * direction(angle)
        gaps = np.linalg.norm(starts - hand, axis=1)
        if gaps.min() >= GRIPPER_MARGIN and gaps.argmin() == 0 and _inside(hand, GRIPPER_RANGE):
            return starts, goals, np.append(hand, rng.uniform(0, GRIPPER_HEIGHT))


def _at_the_edge(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw starts and goals, (K, 2) each, not all of them allowed."""
    edge = rng.integers(4) * np.pi / 2
    turn = np.array([[np.cos(edge), -np.sin(edge)], [np.sin(edge), np.cos(edge)]])
    starts, goals = np.empty((2, count, 2))
    starts[-1] = rng.uniform(*EDGE_RANGE), rng.uniform(-OBJECT_RANGE, OBJECT_RANGE)
    goals[-1] = starts[-1] + GOAL_DISTANCE * direction(rng.choice([-1, 1]) * rng.uniform(*ALONG))
    for k in range(count - 2, -1, -1):
        goals[k] = starts[k + 1] + rng.uniform(0, NEAR) * direction(rng.uniform(0, 2 * np.pi))
        most = OUTWARDS if k == count - 2 else np.pi
        starts[k] = goals[k] - GOAL_DISTANCE * direction(rng.uniform(-most, most))
    return starts @ turn.T, goals @ turn.T


def _free(starts: np.ndarray, goals: np.ndarray) -> bool:
    """Return whether, from the last object to the first, nothing stands in the way of the arm."""
    positions = starts.copy()
    for k in range(len(starts) - 1, -1, -1):
        along = (goals[k] - starts[k]) / GOAL_DISTANCE
        behind = starts[k] - BEHIND * along
        way = behind + np.linspace(0, 1, 18)[:, None] * (goals[k] - behind)
        others = np.delete(positions, k, axis=0)
        gaps = np.linalg.norm(way[:, None] - others, axis=-1)
        if gaps.min() < FREE_WAY or not _inside(behind, WORKSPACE_HIGH[0]):
            return False
        positions[k] = goals[k]
    return True


def _inside(positions: np.ndarray, limit: float) -> bool:
    return bool((np.abs(positions) <= limit).all())


def _radius(shape: ObjectShape) -> float:
    """Return how far a shape reaches from its origin, in m."""
    if shape.kind == 'disc':
        return shape.half_sizes[0][0]
    return max(float(np.linalg.norm(np.abs(centre) + np.array(size)[:2]))
               for centre, size in zip(shape.centres, shape.half_sizes))


def find_order(table: Table, moment: Moment, goals: np.ndarray, todo: Sequence[int],
               rng: np.random.Generator) -> tuple[int, ...]:
    """
    Try all orders of pushing objects, one push for each, and return the best.

    :param moment: from which it is pushed.
    :param goals: (K, 3) m, of all objects.
    :param todo: the objects to be pushed.
    :param rng: numpy Generator.
    :return: todo in the order after which all objects lie nearest to their goals.
    """
    @cache  # orders begin alike
    def after(order: tuple[int, ...]) -> tuple[Moment, float]:
        if not order:
            return moment, 0.0
        before, _ = after(order[:-1])
        return best_push(table, before, goals, order[-1], rng)

    return min(permutations(todo), key=lambda order: after(order)[1])


def best_push(table: Table, moment: Moment, goals: np.ndarray, k: int,
              rng: np.random.Generator) -> tuple[Moment, float]:
    """
    Sample pushes of object k and take the one after which least is missing.

    :return: the moment after it, and what then is missing: m, summed over all objects.
    """
    place, goal = moment.places[k, :2], goals[k, :2]
    straight = np.arctan2(goal[1] - place[1], goal[0] - place[0])
    spread = rng.normal(size=(SAMPLES, 3)) * (ANGLE_STD, OFFSET_STD, OVERSHOOT_STD)
    spread[0] = 0
    after, topples = after_plans(table, moment, [
        push_actions(Push(straight + angle, offset, overshoot, SPEED, TRAVEL_SPEED),
                     moment.target, place, goal) for angle, offset, overshoot in spread])
    missing = np.linalg.norm(after.places - goals, axis=-1) + TILT_COST * topples  # (N, K)
    best = int(missing.sum(1).argmin())
    return Moment(*(part[best] for part in after)), float(missing[best].sum())
