# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Carry out the plans of an expert, one after another, and keep what is seen."""

from collections.abc import Iterable
import time

import numpy as np
from sim_bridge.simulator import Observation, Simulator

# Observations, (T, 4) float32 actions (the last row is zero), outcome, and seconds spent in the
# search and in stepping and rendering.
EpisodeRun = tuple[list[Observation], np.ndarray, str, dict[str, float]]


def carry_out(simulator: Simulator, first: Observation, plans: Iterable[np.ndarray],
              num_frames: int) -> EpisodeRun:
    """
    Carry out plans until there are no more, or so many frames.

    :param first: Observation at the start.
    :param plans: of (n, 4) actions; each is asked for when those before are carried out.
    :param num_frames: T at most.
    :return: EpisodeRun.
    """
    observations, actions = [first], []
    seconds = {'search': 0.0, 'step': 0.0}
    begin = time.perf_counter()
    for plan in plans:
        planned = time.perf_counter()
        seconds['search'] += planned - begin
        for action in plan[:num_frames - len(observations)]:
            observations.append(simulator.step(action))
            actions.append(action)
        begin = time.perf_counter()
        seconds['step'] += begin - planned
        if len(observations) == num_frames:
            break
    done = np.array([*actions, np.zeros(4)], np.float32)
    return observations, done, simulator.outcome(), seconds
