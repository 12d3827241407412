# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushes in Meta-World where one object slides, recorded as the planner acts there.

Demonstrations bring the object to its goal by straight pushes that vary as a person's do; from
them a predictor learns. Pushes at random hit, graze and miss it: what a forward model has to tell
apart. Where objects are is ground truth, and labelled so.
"""

import numpy as np
from sim_bridge.demonstrations import Demonstration, to_episode
from sim_bridge.metaworld import MetaWorld
from sim_bridge.tasks.motions import Push, push_actions
from tap_ros.base.contract import LIFTED
from tap_ros.base.errors import SceneError

TRIES = 20  # a scene without a goal is drawn anew
MOST_PUSHES, RANDOM_PUSHES = 4, 3  # of an episode: of a demonstration, at random
REACH_LOW, REACH_HIGH = (-0.2, -0.28), (0.2, 0.12)  # m, in view: where to pushes at random lead
TRAVEL = (0.06, 0.08)  # m per control period, while lifted
PUSHED = (0.025, 0.05)  # likewise, while low
OVERSHOOT = -0.035  # m, of push_actions: these fingers and objects are small
NEAR = 0.02  # m from its goal; an object that is nearer is left alone
ASIDE = 0.03  # rad and m, standard deviations of what demonstrations are off
MISS = (0.3, 0.02)  # rad, m, of pushes at random


def push_to_goal(world, rng=None):
    """
    Push the object of a World to its goal, as a script that knows both places.

    :param world: after its reset.
    :param rng: numpy Generator of what varies; None: nothing does.
    :yield: actions (4,), each to be carried out before the next is asked for.
    """
    for _ in range(MOST_PUSHES):
        seen = world.observe()
        here, goal = seen.object_poses[0, :2], world.goal_places()[0, :2]
        gap = goal - here
        if np.linalg.norm(gap) < NEAR:
            break
        angle, speeds = np.arctan2(gap[1], gap[0]), (PUSHED[1], TRAVEL[1])
        off = np.zeros(3)
        if rng is not None:
            off = rng.normal(0, ASIDE, 3) * (2, 0.2, 0.3)
            speeds = rng.uniform(*PUSHED), rng.uniform(*TRAVEL)
        yield from push_actions(Push(angle + off[0], off[1], OVERSHOOT + off[2], *speeds),
                                seen.gripper, here, goal)[:, :4] * (1, 1, 1, 0)
    yield np.array([0, 0, LIFTED - world.observe().gripper[2], 0])


def push_about(world, rng):
    """Push towards places at random, and past the object, too; see push_to_goal."""
    for _ in range(RANDOM_PUSHES):
        seen = world.observe()
        here, goal = seen.object_poses[0, :2], rng.uniform(REACH_LOW, REACH_HIGH)
        gap = goal - here
        yield from push_actions(
            Push(np.arctan2(gap[1], gap[0]) + rng.normal(0, MISS[0]), rng.normal(0, MISS[1]),
                 OVERSHOOT + rng.normal(0, 0.03), rng.uniform(*PUSHED), rng.uniform(*TRAVEL)),
            seen.gripper, here, goal) * (1, 1, 1, 0)


class GoalPushes(MetaWorld):
    """Meta-World whose expert pushes the object to its goal, with all that training takes."""

    pushes = staticmethod(push_to_goal)

    def demonstrate(self, seed, num_frames=0):
        """
        Push in a scene that is drawn from a seed; where it has no goal, another one is drawn.

        :raises SceneError: if TRIES scenes in a row have no goal.
        """
        for attempt in range(TRIES):
            rng = np.random.default_rng([seed, attempt])
            try:
                seen = [self.reset(int(rng.integers(2 ** 31)))]
                break
            except SceneError:
                if attempt == TRIES - 1:
                    raise
        actions = []
        for action in self.pushes(self, rng):
            actions.append(action)
            seen.append(self.step(action))
        done = np.array([*actions, np.zeros(4)], np.float32)
        return Demonstration(
            to_episode(seen, done, self.goal(), self.task_name, seed, self.outcome()))


class RandomPushes(GoalPushes):
    """Meta-World whose expert pushes about."""

    pushes = staticmethod(push_about)


WORLDS = {'random': RandomPushes, 'goal': GoalPushes}
