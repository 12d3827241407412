# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushes of one object in a World of others, recorded as the planner acts and sees there.

From demonstrations, pushes to the goal, around what is in the way, that vary as a person's do, a
predictor learns; from pushes at random, which hit, graze and miss, a forward model.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from sim_bridge.demonstrations import (
    BEFORE,
    Demonstration,
    PAUSE_FRAMES,
    PAUSES,
    to_episode,
    TRIES,
)
from sim_bridge.tasks.motions import Push, push_actions
from tap_ros.base.contract import LIFTED
from tap_ros.base.errors import SceneError

MOST_PUSHES = 3  # of the object to a place, or at random in an episode
REACH_LOW, REACH_HIGH = (-0.2, -0.28), (0.2, 0.12)  # m, in view: where to pushes at random lead
TRAVEL = (0.06, 0.08)  # m per control period, while lifted
PUSHED = (0.025, 0.05)  # likewise, while low
OVERSHOOT = 0.02  # m, of push_actions: these fingers and objects are small
NEAR = 0.03  # m from where it shall be; an object that is nearer is left alone
ASIDE = (0.05, 0.005, 0.008)  # rad, m, m: deviations of what demonstrations are off
MISS = (0.3, 0.02, 0.04)  # likewise, of pushes at random
STRAY = 0.012  # m, deviation of the places by the way
PAUSE_RANGE = (1, 30)  # actions, before which demonstrations pause
WALK = 0.15  # m, to which a demonstration walks about before it begins
Route = list[tuple[int, np.ndarray]]  # objects, and a place (x, y) of each, m


def push_to_goal(world: Any, rng: np.random.Generator | None = None,
                 route: Route | None = None) -> Iterator[np.ndarray]:
    """
    Push the objects of a GymWorld to their goals, knowing all in metres.

    :param world: after its reset.
    :param route: which object goes where; None: that of the world.
    :param rng: of what varies; None: nothing does.
    :yield: actions (4,), each to be carried out before the next is asked for.
    """
    off, speeds = np.zeros(3), (PUSHED[1], TRAVEL[1])
    objects, steps = zip(*(world.route() if route is None else route))
    places = np.array(steps)
    if rng is not None:
        places[:-1] += rng.normal(0, STRAY, places[:-1].shape)
    for k, place in zip(objects, places):
        for _ in range(MOST_PUSHES):
            seen = world.observe()
            here = seen.object_poses[k, :2]
            if np.linalg.norm(place - here) < NEAR:
                break
            if rng is not None:
                off = rng.normal(0, ASIDE)
                speeds = rng.uniform(*PUSHED), rng.uniform(*TRAVEL)
            yield from _push(off, speeds, seen.gripper, here, place)
    yield np.array([0, 0, LIFTED - world.observe().gripper[2], 0])


def push_about(world: Any, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Push towards places at random, and past the object, too; see push_to_goal."""
    for _ in range(MOST_PUSHES):
        seen, goal = world.observe(), rng.uniform(REACH_LOW, REACH_HIGH)
        off, speeds = rng.normal(0, MISS), (rng.uniform(*PUSHED), rng.uniform(*TRAVEL))
        here = seen.object_poses[rng.integers(len(seen.object_poses)), :2]
        yield from _push(off, speeds, seen.gripper, here, goal)


def _push(off: np.ndarray, speeds: tuple[float, float], hand: np.ndarray, here: np.ndarray,
          goal: np.ndarray) -> np.ndarray:
    """Return a push, off by rad, m aside and m beyond; see motions.push_actions."""
    x, y = goal - here
    push = Push(np.arctan2(y, x) + off[0], off[1], OVERSHOOT + off[2], *speeds)
    return push_actions(push, hand, here, goal) * (1, 1, 1, 0)


def _unsteadily(actions: Iterator[np.ndarray], rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Wait, walk about, and pause between actions, as a person does."""
    still = np.zeros(4)
    yield from [still] * int(rng.integers(*BEFORE, endpoint=True))
    steps = int(rng.integers(0, 6))
    yield from [np.append(rng.uniform(-WALK, WALK, 2) / 3, (0, 0)) for _ in range(steps)]
    pauses = {int(rng.integers(*PAUSE_RANGE)): int(rng.integers(*PAUSE_FRAMES, endpoint=True))
              for _ in range(rng.integers(*PAUSES, endpoint=True))}
    for number, action in enumerate(actions):
        yield from [still] * pauses.get(number, 0)
        yield action


HOW: dict[str, Any] = {'goal': push_to_goal, 'random': push_about}


def demonstrate_pushes(world: Any, how: str, seed: int) -> Demonstration:
    """
    Push in a scene that is drawn from a seed, in the first of TRIES that has a goal.

    :param world: a GymWorld.
    :param how: one of HOW.
    :raises SceneError: if none has.
    """
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, attempt])
        try:
            seen, actions = [world.reset(int(rng.integers(2 ** 31)))], list[np.ndarray]()
            break
        except SceneError:
            if attempt == TRIES - 1:
                raise
    pushes = HOW[how](world, rng)
    for action in _unsteadily(pushes, rng) if how == 'goal' else pushes:
        actions.append(action)
        seen.append(world.step(action))
    return Demonstration(to_episode(
        seen, np.array([*actions, np.zeros(4)], np.float32), world.goal(), world.task_name,
        seed, world.outcome()))
