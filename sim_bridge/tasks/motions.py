# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all experts share: plans of motions, and where they lead in the true physics."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.protocol import Observation
from sim_bridge.world.table import objects_in, ramp_controls, SUBSTEPS, Table, upright
from tap_ros.base.contract import LIFTED, LOW, WORKSPACE_HIGH, WORKSPACE_LOW

UPRIGHT = 0.9  # cosine, an object that is tilted more than this is about to topple
MAX_PUSH_STEPS = 24  # of a push, in control periods
# Observations, (T, 4) float32 actions, of which the last one is zero, and outcome.
EpisodeRun = tuple[list[Observation], np.ndarray, str]


def straight(start: np.ndarray, end: np.ndarray, steps: int) -> list[np.ndarray]:
    """Return the points after start on a straight way of so many steps."""
    return [start + share * (end - start) for share in np.linspace(0, 1, steps + 1)[1:]]


def moves(path: np.ndarray | Sequence[np.ndarray], opened: int = 0,
          closed: int | None = None) -> np.ndarray:
    """
    Return the actions (n, 4) along points (3,) in m.

    :param opened: the fingers are open in so many actions at first.
    :param closed: they are closed in so many at first, then open; None: in all others.
    """
    opening = np.zeros(len(path) - 1)
    opening[:opened] = 1
    if closed is not None:
        opening[closed:] = 1
    return np.column_stack([np.diff(path, axis=0), opening])


class Push(NamedTuple):
    """Go behind an object, come down, push it past its goal."""

    angle: float  # rad, of the way of the gripper
    offset: float  # m, of that way from the object's origin
    overshoot: float  # m
    speed: float  # m per control period, while low
    travel_speed: float  # m per control period, while lifted


def push_actions(push: Push, hand: np.ndarray, place: np.ndarray,
                 goal: np.ndarray) -> np.ndarray:
    """
    Turn a push into actions: lift, travel, come down, push.

    :param hand: (4,) target of the gripper before it; place, goal: (2,) m, of the object.
    :return: (n, 4), of which there are MAX_PUSH_STEPS at most.
    """
    along, limits = direction(push.angle), (WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
    start = place - 0.13 * along + push.offset * np.array([-along[1], along[0]])
    start = np.clip(start, *limits)
    length = np.linalg.norm(goal - place) + 0.07 + push.overshoot
    end = np.clip(start + max(length, 0.04) * along, *limits)
    path, above, behind = [hand[:3]], np.append(hand[:2], LIFTED), np.append(start, LOW)
    travel = np.linalg.norm(start - hand[:2])
    if travel > 0.02:
        if hand[2] < LIFTED - 0.03:
            path.append(above)
        path += straight(above, np.append(start, LIFTED), int(np.ceil(travel / push.travel_speed)))
    steps = int(np.ceil(np.linalg.norm(end - start) / push.speed))
    path += [behind, *straight(behind, np.append(end, LOW), steps)]
    return moves(path[:MAX_PUSH_STEPS + 1])


def divided(actions: np.ndarray, limit: Sequence[float]) -> np.ndarray:
    """Return actions (n, 4) with every one whose move exceeds (3,) m in several equal parts."""
    parts = np.ceil((np.abs(actions[:, :3]) / limit).max(1, initial=0) - 1e-6).astype(int)
    parts = np.maximum(parts, 1)
    return np.repeat(actions / np.stack([parts, parts, parts, np.ones_like(parts)], 1), parts, 0)


def carry_out(table: Table, succeeds: Callable[[Table], bool], first: Observation,
              plans: Iterable[np.ndarray], num_frames: int) -> EpisodeRun:
    """
    Carry out plans until there are no more, or so many frames.

    :param succeeds: as Task.succeeds.
    :param first: Observation at the start.
    :param plans: of (n, 4) actions; each is asked for when those before are carried out.
    :param num_frames: T at most.
    """
    observations, actions = [first], []
    for plan in plans:
        plan = divided(plan, table.arm.action_limit)
        for action in plan[:num_frames - len(observations)]:
            observations.append(table.step(action))
            actions.append(action)
        if len(observations) == num_frames:
            break
    done = np.array([*actions, np.zeros(4)], np.float32)
    return observations, done, 'success' if succeeds(table) else 'failure'


class Moment(NamedTuple):
    """States of a table, from which it is rolled out: of one, or of N (N, ...)."""

    state: np.ndarray  # as Table.state
    target: np.ndarray  # (4,) as Table.target
    places: np.ndarray  # (K, 3) m, of the objects

    @classmethod
    def of(cls, table: Table) -> 'Moment':
        """Return the present moment of a table."""
        return cls(table.state(), table.target, table.object_poses()[:, :3])


def after_plans(table: Table, moment: Moment,
                plans: Sequence[np.ndarray]) -> tuple[Moment, np.ndarray]:
    """
    Carry out each of N plans from a moment in the true physics; the table stays as it is.

    :param plans: N arrays (n, 4) of actions, none empty.
    :return: the N moments after, and (N, K) bool, which objects are then about to topple.
    """
    plans = [divided(plan, table.arm.action_limit) for plan in plans]
    last = np.array([len(plan) for plan in plans]) - 1
    actions = np.zeros((len(plans), last.max() + 1, 4))
    for plan, padded in zip(plans, actions):
        padded[:len(plan)] = plan
    controls, targets = ramp_controls(moment.target, actions, table.arm.low, table.arm.high)
    numbers = np.arange(len(plans))
    states = table.rollout(np.tile(moment.state, (len(plans), 1)), controls)[
        numbers, (last + 1) * SUBSTEPS - 1]
    objects = objects_in(states, table.model)
    return Moment(states, targets[numbers, last], objects[..., :3]), upright(objects) < UPRIGHT


def direction(angles: ArrayLike) -> np.ndarray:
    """Return unit vectors (..., 2) at angles (...), rad."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
