# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An hour of everything at once, with the memory of each node."""

import time

from experiments.faults.fault import Fault
from experiments.faults.nodes.rig import outcome
from experiments.faults.nodes.world import predict_fields
import numpy as np
from std_srvs.srv import SetBool
from tap_ros.nodes.clients import call

WARM_UP = 0.15  # share of the time that the slope leaves out
GOALS_PER_HOUR = 500  # about what fits; the share of them is the share of the hour
MOST_MB_PER_HOUR = 20.0


def soak(job):
    """Push, predict, reset and record in real time; a trial is a goal."""
    rig = job.rig
    rig.need('visual_mpc_node', 'predictor_node', sim='real')
    rig.start('recorder_node', folder=job.folder / 'bag').wait_until_ready()
    hours = job.count / GOALS_PER_HOUR
    begin, goals, kept = time.monotonic(), 0, []
    job.expect(job.count)
    while (passed := (time.monotonic() - begin) / 3600) < hours:
        why = _one_goal(rig, goals)
        kept.append([(time.monotonic() - begin) / 3600,
                     *(attacked.memory_mb() for attacked in rig.processes.values())])
        rig.check()
        goals += 1
        job.record(not why, why)
        if goals % 20 == 0:
            for data in (False, True):
                answer, why = outcome(call, rig.record_client, SetBool.Request(data=data), 20.0)
                if answer is None or not answer.success:
                    job.record(False, f'recorder/record: {why or answer.message}')
    del passed
    _slopes(job, list(rig.processes), np.array(kept))
    rig.remove('recorder_node')


def _one_goal(rig, number):
    """Reset, predict and push a little; say what went wrong."""
    _, why = outcome(rig.reset, number)
    if why:
        return why
    for _ in range(3):
        response, why = outcome(rig.predict, **predict_fields())
        if why or not response.success:
            return why or response.message
    time.sleep(0.5)  # real time: let the pictures of the new scene come
    handle, why = outcome(rig.begin, mode=('direct', 'subgoal')[number % 2], step_budget=8)
    if why:
        return why
    if number % 10 == 9:
        end, why = outcome(rig.finish, handle)
        return why
    end, why = outcome(rig.result, handle, 60.0)
    return why or ('' if end.startswith('succeeded') else f'the goal {end}')


def _slopes(job, names, kept):
    """Take down the steepest slope of memory, by the median of slopes between samples."""
    warm = kept[kept[:, 0] >= WARM_UP * kept[-1, 0]]
    half = len(warm) // 2
    if half < 2:
        return
    found = {}
    for column, name in enumerate(names, 1):
        later, earlier = warm[-half:], warm[:half]
        found[name] = float(np.median(
            (later[:, column] - earlier[:, column]) / (later[:, 0] - earlier[:, 0])))
    steepest = max(found, key=found.get)
    words = ', '.join(f'{name} {slope:+.1f}' for name, slope in found.items())
    held = found[steepest] <= MOST_MB_PER_HOUR
    job.record(held, f'memory grows: {words} MB/h', found[steepest])
    job.note = f'MB/h: {words}'


FAULTS = [
    Fault('soak', 'an hour of goals, predictions, resets and recording', 'The nodes run for days. '
          'Nothing may be lost, and no memory may leak.', 'Each goal ends as it should, and no '
          f'node grows by more than {MOST_MB_PER_HOUR:g} MB an hour after its warm-up.',
          GOALS_PER_HOUR, 7.2, soak, 'growth of the node that grows most', 'MB/h')]
