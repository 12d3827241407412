# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The expert that stacks blocks: it grasps one after another and puts it on the one below.

Each grasp is found as grasp_expert.py finds it, in the true simulator. The episode ends when the
last block is let go: frames after that would show the goal already.
"""

from collections.abc import Iterator

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.episode_run import carry_out, EpisodeRun
from sim_bridge.grasp_expert import GraspConfig, GraspExpert, straight
from sim_bridge.scene import HALF_HEIGHT
from sim_bridge.simulator import Simulator
from tap_ros.contract import CLEAR

# High enough to carry a block over a tower of two, and no place at random: towers are to stand.
STACK_CONFIG = GraspConfig(
    explore=0.0, hover=(0.14, 0.148), low=(0.01, 0.014), lift=(0.132, 0.135),
    travel_speed=(0.045, 0.075))
HELD = 0.09  # m, a block whose origin is lower was missed
GAP = 0.003  # m, from a block that is let go to the one below
TRIES = 2  # grasps of a block
SETTLE_STEPS = 2  # control periods after the last frame, then it counts whether the tower stands


class StackExpert:
    """
    Plans one episode of stacking.

    :param simulator: Simulator, already reset.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param config: GraspConfig.
    :param rollout: mujoco.rollout.Rollout to share between episodes.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator, config: GraspConfig,
                 rollout: mujoco.rollout.Rollout) -> None:
        self._simulator, self._rng, self._config = simulator, rng, config
        self._rollout = rollout

    def plans(self) -> Iterator[np.ndarray]:
        """Yield (n, 4) actions, each to be carried out before the next is asked for."""
        simulator = self._simulator
        for k in simulator.scene.order:
            grasp = GraspExpert(simulator, self._rng, self._config, self._rollout, k)
            for _ in range(TRIES):
                yield self._rise(grasp)
                yield grasp.pick_and_lift()
                if simulator.object_poses()[k, 2] > HELD:
                    break
            yield self._carry(k)
            yield self._lower(k)
            yield np.array([[0, 0, 0, 0.5], [0, 0, 0, 1]])

    def _rise(self, grasp: GraspExpert) -> np.ndarray:
        """Go straight up from among the blocks, if the gripper is there."""
        here = self._simulator.target
        if here[2] >= CLEAR:
            return np.empty((0, 4))
        return np.array([[0, 0, grasp.hover - here[2], here[3]]])

    def _carry(self, k: int) -> np.ndarray:
        """Carry block k above the one below it."""
        speed = self._rng.uniform(*self._config.travel_speed)
        gap = self._gap(k)
        path = straight(np.zeros(3), gap, max(1, int(np.ceil(np.linalg.norm(gap) / speed))))
        return _moves([np.zeros(3), *path])

    def _lower(self, k: int) -> np.ndarray:
        """Bring block k, as it hangs now, down onto the one below and hold still."""
        poses = self._simulator.object_poses()
        down = poses[k - 1, 2] + 2 * HALF_HEIGHT + GAP - poses[k, 2]
        above = self._gap(k)
        path = straight(above, above + [0, 0, down], int(self._rng.integers(2, 4)))
        return _moves([np.zeros(3), above, *path, path[-1]])

    def _gap(self, k: int) -> np.ndarray:
        """Return the way (3,), level, from block k to above the one below it."""
        poses = self._simulator.object_poses()
        return np.append(poses[k - 1, :2] - poses[k, :2], 0)


def _moves(path: list[np.ndarray]) -> np.ndarray:
    """Return the actions along points (3,), with closed fingers."""
    return np.column_stack([np.diff(path, axis=0), np.zeros(len(path) - 1)])


def run_stack_episode(
        simulator: Simulator, seed: int, config: GraspConfig | None = None,
        rollout: mujoco.rollout.Rollout | None = None, num_frames: int = 0) -> EpisodeRun:
    """
    Run one episode that ends when the last block is let go.

    :param simulator: Simulator of a task of stacking.
    :param num_frames: at most; 0: the task's. The other parameters are expert.run_episode's.
    :return: EpisodeRun; the outcome is that after SETTLE_STEPS more.
    """
    first = simulator.reset(seed)
    rng = np.random.default_rng([seed, simulator.task.stream, 1])
    expert = StackExpert(
        simulator, rng, config or STACK_CONFIG, rollout or mujoco.rollout.Rollout(nthread=0))
    observations, actions, _, seconds = carry_out(
        simulator, first, expert.plans(), num_frames or simulator.task.num_frames)
    for _ in range(SETTLE_STEPS):
        simulator.step([0, 0, 0, simulator.target[3]])
    return observations, actions, simulator.outcome(), seconds
