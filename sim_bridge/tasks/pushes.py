# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pushes as actions, where they lead in the true simulator, in which order, and when."""

from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from sim_bridge.tasks.tasks import moves, straight
from sim_bridge.world.table import divided, OBJECT_QPOS_START, ramp_controls, SUBSTEPS, Table
from tap_ros.base.contract import LIFTED, LOW, WORKSPACE_HIGH, WORKSPACE_LOW

if TYPE_CHECKING:
    from sim_bridge.tasks.push import Expert

MAX_PUSH_STEPS = 24  # longest macro action, in control periods
UPRIGHT = 0.9  # cosine, an object that is tilted more than this is about to topple
# The search for an order: pushes of each object at each place in it; the first goes straight.
SAMPLES = 10
ANGLE_STD, OFFSET_STD, OVERSHOOT_STD = 0.25, 0.015, 0.02  # rad, m, m
SPEED, TRAVEL_SPEED = 0.05, 0.08  # m per control period
TILT_COST = 0.2  # m, of an object that topples
SHARES = {'early': (0.2, 0.35), 'middle': (0.4, 0.6), 'late': (0.7, 0.85)}  # of the episode
# Control periods that things take, about:
PUSH = 14  # a push, from wherever the gripper is,
GAP = 9  # of these until the object is touched,
AGAIN = 3  # on average, pushes that have to be repeated
RETURN = 6  # to leave an object and come back to it
DETOUR = 16  # a push is interrupted once for so many


class Push(NamedTuple):
    """Go behind an object, come down, push it past its goal."""

    angle: float  # rad, of the way of the gripper
    offset: float  # m, of that way from the object's origin
    overshoot: float  # m
    speed: float  # m per control period, while low
    travel_speed: float  # m per control period, while lifted


class Moment(NamedTuple):
    """The state of a table, from which pushes are rolled out."""

    state: np.ndarray  # as Table.state
    target: np.ndarray  # (4,) as Table.target
    places: np.ndarray  # (K, 3) m, of the objects

    @classmethod
    def of(cls, table: Table) -> 'Moment':
        """Return the present moment of a table."""
        return cls(table.state(), table.target, table.object_poses()[:, :3])


def push_actions(push: Push, hand: np.ndarray, place: np.ndarray,
                 goal: np.ndarray) -> np.ndarray:
    """
    Turn a push into actions: lift, travel, come down, push.

    :param hand: (4,) target of the gripper before it; place, goal: (2,) m, of the object.
    :return: (n, 4), of which there are MAX_PUSH_STEPS at most.
    """
    along = np.array([np.cos(push.angle), np.sin(push.angle)])
    aside = np.array([-along[1], along[0]])
    start = place - 0.13 * along + push.offset * aside
    length = np.linalg.norm(goal - place) + 0.07 + push.overshoot
    lowest, highest = WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2]
    start = np.clip(start, lowest, highest)
    end = np.clip(start + max(length, 0.04) * along, lowest, highest)
    path, above, behind = [hand[:3]], np.append(hand[:2], LIFTED), np.append(start, LOW)
    travel = np.linalg.norm(start - hand[:2])
    if travel > 0.02:
        if hand[2] < LIFTED - 0.03:
            path.append(above)
        path += straight(above, np.append(start, LIFTED), int(np.ceil(travel / push.travel_speed)))
    steps = int(np.ceil(np.linalg.norm(end - start) / push.speed))
    path += [behind, *straight(behind, np.append(end, LOW), steps)]
    return moves(path[:MAX_PUSH_STEPS + 1])


def after_plans(table: Table, moment: Moment,
                plans: Sequence[np.ndarray]) -> tuple[list[Moment], np.ndarray]:
    """
    Carry out each of N plans from a moment in the true physics; the table stays as it is.

    :param plans: N arrays (n, 4) of actions, none empty.
    :return: the N moments after, and (N, K) bool, which objects are then upright.
    """
    plans = [divided(plan, table.arm.action_limit) for plan in plans]
    lengths = np.array([len(plan) for plan in plans])
    actions = np.zeros((len(plans), lengths.max(), 4))
    for plan, padded in zip(plans, actions):
        padded[:len(plan)] = plan
    controls, targets = ramp_controls(moment.target, actions, table.arm.low, table.arm.high)
    states = table.rollout(np.tile(moment.state, (len(plans), 1)), controls)
    numbers = np.arange(len(plans))
    last = states[numbers, lengths * SUBSTEPS - 1]  # (N, state)
    objects = last[:, 1 + OBJECT_QPOS_START:1 + table.model.nq].reshape(len(plans), -1, 7)
    upright = 1 - 2 * (objects[..., 4] ** 2 + objects[..., 5] ** 2) >= UPRIGHT
    return [Moment(*moment) for moment in zip(
        last, targets[numbers, lengths - 1], objects[..., :3])], upright


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
    after: dict[tuple[int, ...], tuple[Moment, float]] = {(): (moment, 0.0)}
    orders = list(permutations(int(k) for k in todo))
    for order in orders:
        for n in range(1, len(order) + 1):
            if order[:n] not in after:
                before, _ = after[order[:n - 1]]
                after[order[:n]] = best_push(table, before, goals, order[n - 1], rng)
    return min(orders, key=lambda order: after[order][1])


def best_push(table: Table, moment: Moment, goals: np.ndarray, k: int,
              rng: np.random.Generator) -> tuple[Moment, float]:
    """
    Sample pushes of object k and take the one after which least is missing.

    :return: the moment after it, and what then is missing: m, summed over all objects.
    """
    gap = goals[k, :2] - moment.places[k, :2]
    spread = rng.normal(size=(SAMPLES, 3)) * (ANGLE_STD, OFFSET_STD, OVERSHOOT_STD)
    spread[0] = 0
    moments, upright = after_plans(table, moment, [
        push_actions(Push(np.arctan2(gap[1], gap[0]) + angle, offset, overshoot, SPEED,
                          TRAVEL_SPEED), moment.target, moment.places[k, :2], goals[k, :2])
        for angle, offset, overshoot in spread])
    missing = np.linalg.norm(np.array([m.places for m in moments]) - goals, axis=-1)  # (N, K)
    missing = missing + TILT_COST * ~upright
    best = int(missing.sum(1).argmin())
    return moments[best], float(missing[best].sum())


def draw_share(timing: str, rng: np.random.Generator) -> float:
    """
    Draw when the bottleneck is to come.

    :param timing: one of TIMINGS but 'natural'; 'mixed': any of the others.
    :return: share of the episode, 0..1.
    """
    if timing == 'mixed':
        timing = str(rng.choice(list(SHARES)))
    return float(rng.uniform(*SHARES[timing]))


def timed_plans(expert: 'Expert', share: float, num_frames: int,
                rng: np.random.Generator) -> Iterator[np.ndarray]:
    """
    Yield plans after which the bottleneck has come at a share of the episode.

    :param share: of draw_share.
    :param num_frames: at most.
    :return: iterator of (n, 4) actions, each to be carried out before the next is asked for.
    """
    count = expert.num_objects
    before = (count * PUSH + AGAIN) * share - (PUSH + GAP / 2)
    waiting = min(before / (1 - share), num_frames - count * PUSH)
    plan = expert.wander(max(int(round(waiting)), int(rng.integers(1, 3))))
    done, detours = 0, list[int]()  # control periods so far, and of the interruptions to come
    stage: int | None = None  # the object that is pushed now
    while plan is not None:
        yield plan
        done += len(plan)
        if detours:
            yield (plan := expert.wander(detours.pop()))
            done += len(plan)
        todo = expert.undone()
        if stage not in todo:  # the next one
            stage = expert.next_object()
            if stage is not None and count - len(todo) == 1:
                detours = _detours(done, share, count, num_frames)
        part = 1 / (1 + len(detours))
        plan = expert.plan(num_frames - 1 - done, stage, part)


def _detours(done: int, share: float, count: int, num_frames: int) -> list[int]:
    """Return for how long the second push is interrupted, once or several times."""
    spare = min((done + GAP / 2) / share, num_frames) - done - (count - 1) * PUSH
    if spare < RETURN:
        return []
    times = max(int(round(spare / DETOUR)), 1)
    return [max(int(spare / times) - RETURN, 1)] * times
