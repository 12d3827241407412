# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushes in Meta-World where one object slides, recorded as the planner acts there.

From demonstrations, straight pushes to the goal that vary as a person's do, a predictor learns;
from pushes at random, which hit, graze and miss, a forward model. Objects are ground truth.
"""

import numpy as np
from sim_bridge.demonstrations import Demonstration, to_episode
from sim_bridge.metaworld import MetaWorld
from sim_bridge.tasks.motions import Push, push_actions
from tap_ros.base.contract import LIFTED
from tap_ros.base.errors import SceneError

TRIES = 20  # a scene without a goal is drawn anew; the last one's error says why
MOST_PUSHES, RANDOM_PUSHES = 4, 3  # of an episode: of a demonstration, at random
REACH_LOW, REACH_HIGH = (-0.2, -0.28), (0.2, 0.12)  # m, in view: where to pushes at random lead
TRAVEL = (0.06, 0.08)  # m per control period, while lifted
PUSHED = (0.025, 0.05)  # likewise, while low
OVERSHOOT = -0.035  # m, of push_actions: these fingers and objects are small
NEAR = 0.02  # m from its goal; an object that is nearer is left alone
ASIDE = 0.03  # rad and m, standard deviations of what demonstrations are off
MISS = (0.3, 0.02, 0.03)  # rad, m, m: likewise, of pushes at random


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
        if np.linalg.norm(goal - here) < NEAR:
            break
        off, speeds = np.zeros(3), (PUSHED[1], TRAVEL[1])
        if rng is not None:
            off = rng.normal(0, ASIDE, 3) * (2, 0.2, 0.3)
            speeds = rng.uniform(*PUSHED), rng.uniform(*TRAVEL)
        yield from _push(off, speeds, seen.gripper, here, goal)
    yield np.array([0, 0, LIFTED - world.observe().gripper[2], 0])


def push_about(world, rng):
    """Push towards places at random, and past the object, too; see push_to_goal."""
    for _ in range(RANDOM_PUSHES):
        seen, goal = world.observe(), rng.uniform(REACH_LOW, REACH_HIGH)
        off, speeds = rng.normal(0, MISS), (rng.uniform(*PUSHED), rng.uniform(*TRAVEL))
        yield from _push(off, speeds, seen.gripper, seen.object_poses[0, :2], goal)


def _push(off, speeds, hand, here, goal):
    """Return a push, off by rad, m aside and m beyond; see motions.push_actions."""
    x, y = goal - here
    push = Push(np.arctan2(y, x) + off[0], off[1], OVERSHOOT + off[2], *speeds)
    return push_actions(push, hand, here, goal) * (1, 1, 1, 0)


class GoalPushes(MetaWorld):
    """Meta-World whose expert pushes the object to its goal, with all that training takes."""

    pushes = staticmethod(push_to_goal)

    def demonstrate(self, seed, num_frames=0):
        """Push in a scene that is drawn from a seed, in the first of TRIES that has a goal."""
        for attempt in range(TRIES):
            rng = np.random.default_rng([seed, attempt])
            try:
                seen, actions = [self.reset(int(rng.integers(2 ** 31)))], []
                break
            except SceneError:
                if attempt == TRIES - 1:
                    raise
        for action in self.pushes(self, rng):
            actions.append(action)
            seen.append(self.step(action))
        return Demonstration(to_episode(
            seen, np.array([*actions, np.zeros(4)], np.float32), self.goal(), self.task_name,
            seed, self.outcome()))


class RandomPushes(GoalPushes):
    """Meta-World whose expert pushes about."""

    pushes = staticmethod(push_about)


WORLDS = {'random': RandomPushes, 'goal': GoalPushes}
