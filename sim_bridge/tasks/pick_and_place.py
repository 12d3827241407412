# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Take one object after another and put it down somewhere, on the table or on another object.

Each grasp is found as grasp_expert.py finds it, in the true simulator.
"""

from collections.abc import Callable, Iterator

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.grasp_expert import GraspConfig, GraspExpert, straight
from sim_bridge.world.scene import HALF_HEIGHT
from tap_ros.contract import CLEAR

# High enough to carry a block over a tower of two, and no place at random: towers are to stand.
STACK_CONFIG = GraspConfig(
    explore=0.0, hover=(0.14, 0.148), low=(0.01, 0.014), lift=(0.132, 0.135),
    travel_speed=(0.045, 0.075))
HELD = 0.09  # m, an object whose origin is lower was missed
GAP = 0.003  # m, from an object that is let go to what is below it
TRIES = 2  # grasps of an object


class PickAndPlace:
    """
    Plans the moves of one episode.

    :param simulator: Simulator, already reset, of a task with a gripper that holds.
    :param rng: numpy Generator; every whim of this planner comes from it.
    :param config: GraspConfig.
    :param rollout: mujoco.rollout.Rollout to share between episodes.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator, config: GraspConfig,
                 rollout: mujoco.rollout.Rollout) -> None:
        self._simulator, self._rng, self._config = simulator, rng, config
        self._rollout = rollout

    def move(self, k: int, below: Callable[[], np.ndarray]) -> Iterator[np.ndarray]:
        """
        Yield (n, 4) actions, each to be carried out before the next is asked for.

        :param k: the object to be moved.
        :param below: says (3,) m where the origin of what is to be below it is now, see on_table.
        """
        simulator = self._simulator
        grasp = GraspExpert(simulator, self._rng, self._config, self._rollout, k)
        for _ in range(TRIES):
            yield self._rise(grasp)
            yield grasp.pick_and_lift()
            if simulator.object_poses()[k, 2] > HELD:
                break
        yield self._carry(k, below())
        yield self._lower(k, below())
        yield np.array([[0, 0, 0, 0.5], [0, 0, 0, 1]])

    def _rise(self, grasp: GraspExpert) -> np.ndarray:
        """Go straight up from among the objects, if the gripper is there."""
        here = self._simulator.target
        if here[2] >= CLEAR:
            return np.empty((0, 4))
        return np.array([[0, 0, grasp.hover - here[2], here[3]]])

    def _carry(self, k: int, below: np.ndarray) -> np.ndarray:
        """Carry object k above its place."""
        speed = self._rng.uniform(*self._config.travel_speed)
        gap = self._gap(k, below)
        path = straight(np.zeros(3), gap, max(1, int(np.ceil(np.linalg.norm(gap) / speed))))
        return _moves([np.zeros(3), *path])

    def _lower(self, k: int, below: np.ndarray) -> np.ndarray:
        """Bring object k, as it hangs now, down onto what is below it and hold still."""
        down = below[2] + 2 * HALF_HEIGHT + GAP - self._simulator.object_poses()[k, 2]
        above = self._gap(k, below)
        path = straight(above, above + [0, 0, down], int(self._rng.integers(2, 4)))
        return _moves([np.zeros(3), above, *path, path[-1]])

    def _gap(self, k: int, below: np.ndarray) -> np.ndarray:
        """Return the way (3,), level, from object k to above its place."""
        return np.append(below[:2] - self._simulator.object_poses()[k, :2], 0)


def on_table(place: np.ndarray) -> np.ndarray:
    """Return the origin (3,) of what would be below an object on the table at (2,) m."""
    return np.append(place, -HALF_HEIGHT)


def _moves(path: list[np.ndarray]) -> np.ndarray:
    """Return the actions along points (3,), with closed fingers."""
    return np.column_stack([np.diff(path, axis=0), np.zeros(len(path) - 1)])
