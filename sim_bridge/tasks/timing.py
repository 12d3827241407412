# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
When in an episode the bottleneck comes: the first object is home, the others are untouched.

The expert makes it late by wandering before its first push, and early by interrupting the second
one: it pushes an object a part of the way, wanders, and comes back. Everything it does is done in
the simulator; no picture is moved in time.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sim_bridge.tasks.expert import Expert

SHARES = {'early': (0.2, 0.35), 'middle': (0.4, 0.6), 'late': (0.7, 0.85)}  # of the episode
TIMINGS = ('natural', *SHARES, 'mixed')
MORE_FRAMES = 40  # that an episode may have beyond its task's, so that there is time to wander
# Control periods that things take, about:
PUSH = 14  # a push, from wherever the gripper is,
GAP = 9  # of these until the object is touched,
AGAIN = 3  # on average, pushes that have to be repeated
RETURN = 6  # to leave an object and come back to it
DETOUR = 16  # a push is interrupted once for so many


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
