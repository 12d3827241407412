# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The expert that stacks blocks: it grasps one after another and puts it on the one below.

The episode ends when the last block is let go: frames after that would show the goal already.
"""

from collections.abc import Iterator
from functools import partial

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.episode_run import carry_out, EpisodeRun
from sim_bridge.tasks.grasp_expert import GraspConfig
from sim_bridge.tasks.pick_and_place import PickAndPlace, STACK_CONFIG

SETTLE_STEPS = 2  # control periods after the last frame, then it counts whether the tower stands


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
    mover = PickAndPlace(
        simulator, rng, config or STACK_CONFIG, rollout or mujoco.rollout.Rollout(nthread=0))
    observations, actions, _, seconds = carry_out(
        simulator, first, _plans(simulator, mover), num_frames or simulator.task.num_frames)
    for _ in range(SETTLE_STEPS):
        simulator.step([0, 0, 0, simulator.target[3]])
    return observations, actions, simulator.outcome(), seconds


def _plans(simulator: Simulator, mover: PickAndPlace) -> Iterator[np.ndarray]:
    """Yield the actions of one episode; each waits until those before are carried out."""
    for k in simulator.scene.order:
        yield from mover.move(k, partial(_place_of, simulator, k - 1))


def _place_of(simulator: Simulator, k: int) -> np.ndarray:
    """Return where the origin of object k is now, (3,) m."""
    return simulator.object_poses()[k, :3]
