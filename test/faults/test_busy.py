# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals on a machine that is too busy, or too slow for its plans."""

import re
import time

from driven import STOP_S
from fault_report import fault
from processes import crowd
import pytest

pytestmark = pytest.mark.ros

CROWD = 6  # processes that do nothing else than keep a core busy
STEPS = 6
END_S = 20.0
TOO_SLOW = 'max_age|no command could be sent|stood still'  # what a goal may end with then
AGES = (0.1, 0.2, 0.4)  # s; a plan of two objects takes .3 s on two idle cores


@fault(f'{CROWD} busy processes, in lock-step', f'goals of {STEPS} steps end bit for bit as '
       'alone', 8, 's for the goal')
def test_busy_lock_step(rig, trials):
    rig.need('visual_mpc_node', 'predictor_node', sim='lock-step')

    def push(number):
        """Return all that is known of how a goal ends."""
        rig.reset(number)
        mode = ('direct', 'subgoal')[number % 2]
        told = []
        end = rig.result(rig.begin(mode=mode, step_budget=STEPS, seed=number, timeout_s=300.0,
                                   on_feedback=told.append))
        return (end, [one.expected_distance for one in told],
                rig.client.camera().positions.tolist())

    for trial in trials:
        with trials.one():
            alone = push(trial)
            assert alone[0].startswith('succeeded'), alone[0]
            begin = time.monotonic()
            with crowd(CROWD):
                beside = push(trial)
            trials.measured(time.monotonic() - begin)
            assert beside == alone, f'alone: {alone}; beside them: {beside}'


@fault(f'{CROWD} busy processes, in real time', 'no node is called dead; the goal succeeds or '
       'says why not; zero last', 10, 'commands of 6 (least)', min)
def test_busy_real_time(rig, trials):
    for trial in trials:
        rig.need('visual_mpc_node', 'predictor_node', sim='real')
        with trials.one(), crowd(CROWD):
            rig.reset(trial)
            begin = time.monotonic()
            result = rig.begin(mode=('direct', 'subgoal')[trial % 2], step_budget=STEPS).result()
            trials.measured(result.steps)
            assert result.end == 'succeeded' or re.search(TOO_SLOW, result.message), (
                result.message)
            ended = time.monotonic()
            time.sleep(1.0)
            rig.arm.assert_still(ended + STOP_S)
            assert rig.arm.seconds_to_stop(begin) < float('inf'), 'no zero was sent'


@fault('plans take longer than max_age', f'within {END_S:g} s a goal of two steps succeeds, or '
       'names both times', 9, 's for the goal')
def test_late_plans(rig, trials):
    for trial in trials:
        age = AGES[trial % len(AGES)]
        rig.need('visual_mpc_node', sim='real', parameters={'visual_mpc_node': {'max_age': age}})
        with trials.one():
            rig.reset(trial)
            begin = time.monotonic()
            result = rig.begin(mode='direct', step_budget=2, timeout_s=3 * END_S).result()
            seconds = time.monotonic() - begin
            trials.measured(seconds)
            assert result.end == 'succeeded' or 'max_age' in result.message, result.message
            assert seconds < END_S * trials.patience, f'it ended after {seconds:.0f} s'
            rig.arm.assert_still(time.monotonic())
