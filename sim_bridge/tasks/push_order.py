# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find by simulation in which order objects are best pushed: every order is tried to its end."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from sim_bridge.tasks.pushes import Moment, Push, push_actions, PushRollouts

SAMPLES = 10  # pushes of each object at each place in an order; the first goes straight
ANGLE_STD, OFFSET_STD, OVERSHOOT_STD = 0.25, 0.015, 0.02  # rad, m, m
SPEED, TRAVEL_SPEED = 0.05, 0.08  # m per control period
TILT_COST = 0.2  # m, of an object that topples


def find_order(rollouts: PushRollouts, moment: Moment, goals: np.ndarray, todo: Sequence[int],
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
                after[order[:n]] = best_push(rollouts, before, goals, order[n - 1], rng)
    return min(orders, key=lambda order: after[order][1])


def best_push(rollouts: PushRollouts, moment: Moment, goals: np.ndarray, k: int,
              rng: np.random.Generator) -> tuple[Moment, float]:
    """
    Sample pushes of object k and take the one after which least is missing.

    :return: the moment after it, and what then is missing: m, summed over all objects.
    """
    gap = goals[k, :2] - moment.places[k, :2]
    spread = rng.normal(size=(SAMPLES, 3)) * (ANGLE_STD, OFFSET_STD, OVERSHOOT_STD)
    spread[0] = 0
    moments, upright = rollouts(moment, [
        push_actions(Push(np.arctan2(gap[1], gap[0]) + angle, offset, overshoot, SPEED,
                          TRAVEL_SPEED), moment.target, moment.places[k, :2], goals[k, :2])
        for angle, offset, overshoot in spread])
    missing = np.linalg.norm(np.array([m.places for m in moments]) - goals, axis=-1)  # (N, K)
    missing = missing + TILT_COST * ~upright
    best = int(missing.sum(1).argmin())
    return moments[best], float(missing[best].sum())
