# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Stacking blocks: a tower on the first one, and the expert that builds it.

The expert grasps one block after another, as grasp.py's does, and puts it on the one below. The
episode ends when the last block is let go: frames after that would show the goal already.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import ClassVar

import numpy as np
from sim_bridge.tasks.grasp import GRASP_HEIGHT, GRASP_YAW, GraspConfig, GraspExpert
from sim_bridge.tasks.motions import carry_out, EpisodeRun, moves, straight
from sim_bridge.tasks.tasks import apart, DemonstrationOptions, Task, TaskScene
from sim_bridge.world.protocol import Observation
from sim_bridge.world.scene import HALF_HEIGHT, ObjectShape
from sim_bridge.world.table import GRIPPER_HEIGHT, Table
from tap_ros.base.contract import CLEAR

BLOCK_HALF_WIDTH = (0.026, 0.032)  # m
BLOCK_RANGE = 0.2  # m, |x| and |y| of the blocks
BLOCK_SEPARATION = 0.14  # m between blocks: the open fingers come down between them
HAND_RANGE = 0.3  # m, |x| and |y| of the gripper's start, all in view
HAND_MARGIN = 0.12  # m between the gripper and any block at the start
STACK_OFFSET = 0.025  # m, most between the origins of a block and the one below, seen from above
LEVEL_TOLERANCE = 0.01  # m, of the height of a block above the one below
SETTLE_STEPS = 2  # control periods after the last frame, then it counts whether the tower stands
# High enough to carry a block over a tower of two, and no place at random: towers are to stand.
CONFIG = GraspConfig(
    explore=0.0, hover=(0.14, 0.148), low=(0.01, 0.014), lift=(0.132, 0.135),
    travel_speed=(0.045, 0.075))
HELD = 0.09  # m, an object whose origin is lower was missed
GAP = 0.003  # m, from an object that is let go to what is below it
TRIES = 2  # grasps of an object


@dataclass(frozen=True)
class StackTask(Task):
    """Build a tower of all blocks."""

    kind: ClassVar[str] = 'stack'
    gripping: ClassVar[bool] = True

    def draw(self, rng: np.random.Generator, spread: float) -> TaskScene:
        """Draw blocks with a square base that fingers can hold; all but the first are moved."""
        count, shapes = self.num_objects, []
        for _ in range(count):
            width = rng.uniform(*BLOCK_HALF_WIDTH)
            colour = tuple(rng.uniform(0.3, 1.0, 3))
            shapes.append(
                ObjectShape('bar', ((width, width, HALF_HEIGHT),), ((0, 0),), (colour,)))
        places = np.zeros((count, 2))
        while not apart(places, BLOCK_SEPARATION):
            places = spread * rng.uniform(-BLOCK_RANGE, BLOCK_RANGE, (count, 2))
        yaws = rng.uniform(-GRASP_YAW, GRASP_YAW, count)
        hand = places[0]
        while np.linalg.norm(places - hand, axis=1).min() < HAND_MARGIN:
            hand = spread * rng.uniform(-HAND_RANGE, HAND_RANGE, 2)
        # On the first block, in line with x and y: closing fingers turn what they hold.
        goals = np.tile([*places[0], 0], (count, 1))
        goals[0, 2] = yaws[0]
        return TaskScene(tuple(shapes), np.column_stack([places, yaws]), goals,
                         np.append(hand, rng.uniform(0, GRIPPER_HEIGHT)), tuple(range(1, count)))

    @property
    def goal_heights(self) -> np.ndarray:
        """Return how high above the table the blocks of a tower stand, (K,) m."""
        return 2 * HALF_HEIGHT * np.arange(self.num_objects)

    def goal_gripper(self, table: Table, scene: TaskScene) -> np.ndarray:
        """Return where the open gripper has just let go of the top of the tower."""
        top = self.goal_heights[-1]
        return np.array([*scene.goal_poses[-1, :2], top + GRASP_HEIGHT, 1])

    def succeeds(self, table: Table) -> bool:
        """Return whether every block stands on the one below, let go."""
        return is_tower(table.object_poses()) and not table.touching()

    def demonstrate(self, table: Table, scene: TaskScene, first: Observation,
                    rng: np.random.Generator, how: DemonstrationOptions) -> EpisodeRun:
        """Act until the last block is let go; the outcome is that after SETTLE_STEPS more."""
        plans = (plan for k in scene.order
                 for plan in pick_and_place(table, rng, k, itemgetter(k - 1)))
        observations, actions, _ = carry_out(
            table, self.succeeds, first, plans, how.num_frames or self.num_frames)
        for _ in range(SETTLE_STEPS):
            table.step([0, 0, 0, table.target[3]])
        return observations, actions, 'success' if self.succeeds(table) else 'failure'


STACK2 = StackTask('stack2', num_objects=2, num_frames=36, stream=8)
STACK3 = StackTask('stack3', num_objects=3, num_frames=60, stream=9)


def is_tower(poses: np.ndarray) -> bool:
    """Return whether blocks stand on each other; poses (K, 3 or more) m, from the lowest on."""
    up = np.diff(poses[:, :3], axis=0)
    return bool((np.linalg.norm(up[:, :2], axis=1) < STACK_OFFSET).all()
                and (np.abs(up[:, 2] - 2 * HALF_HEIGHT) < LEVEL_TOLERANCE).all()
                and abs(poses[0, 2] - HALF_HEIGHT) < LEVEL_TOLERANCE)


def pick_and_place(table: Table, rng: np.random.Generator, k: int,
                   below: Callable[[np.ndarray], np.ndarray]) -> Iterator[np.ndarray]:
    """
    Yield (n, 4) actions that move an object, each to be carried out before the next is asked for.

    :param table: Table with a scene and a gripper that holds.
    :param rng: numpy Generator of all that varies.
    :param k: the object to be moved.
    :param below: says of object_poses (K, 7) where the origin of what is to be below it is, (3 or
        more,) m, see on_table.
    """
    def gap() -> np.ndarray:
        poses = table.object_poses()
        return below(poses)[:3] + [0, 0, 2 * HALF_HEIGHT] + [0, 0, GAP] - poses[k, :3]

    grasp, here = GraspExpert(table, rng, CONFIG, k), np.zeros(3)
    for _ in range(TRIES):
        height, opening = table.target[2:]
        if height < CLEAR:  # straight up from among the objects
            yield np.array([[0, 0, grasp.hover - height, opening]])
        yield grasp.pick_and_lift()
        if table.object_poses()[k, 2] > HELD:
            break
    speed = rng.uniform(*CONFIG.travel_speed)
    above = np.append(gap()[:2], 0)
    steps = max(1, int(np.ceil(np.linalg.norm(above) / speed)))
    yield moves([here, *straight(here, above, steps)])
    # Down, as it hangs now, and hold still.
    down = gap()
    above = np.append(down[:2], 0)
    path = straight(above, above + [0, 0, down[2]], int(rng.integers(2, 4)))
    yield moves([here, above, *path, path[-1]])
    yield np.array([[0, 0, 0, 0.5], [0, 0, 0, 1]])


def on_table(place: np.ndarray) -> np.ndarray:
    """Return the origin (3,) of what would be below an object on the table at (2,) m."""
    return np.append(place, -HALF_HEIGHT)
