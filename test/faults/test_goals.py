# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals one after another in lock-step, subscribers that come late, an hour of everything."""

from contextlib import suppress
import threading
import time

from fault_report import fault
import numpy as np
import pytest
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import Subgoal
from tap_ros.errors import TapError
from tap_ros.nodes.clients import Newest, Spinner
from tap_ros.nodes.topics import LATCHED, STREAM

pytestmark = pytest.mark.ros

JOIN_S = 5.0
WARM_UP = 0.15  # share of the time that the slope of memory leaves out
GOALS_PER_HOUR = 500  # about what fits; the share of them is the share of the hour
MOST_MB_PER_HOUR = 20.0


def expect_goal(rig, trials):
    """Raise AssertionError unless a goal of one step succeeds."""
    begin = time.monotonic()
    rig.expect_end(rig.begin(mode='direct', step_budget=1), 'succeeded')
    trials.measured(time.monotonic() - begin)


@fault('a goal right after a cancel, in lock-step', 'a goal of one step succeeds', 200,
       's for the goal')
def test_goals_after_cancel(rig, trials):
    random = np.random.default_rng(0)
    rig.need('visual_mpc_node', sim='lock-step')
    rig.reset(0)
    for _ in trials:
        moving = threading.Event()
        with trials.one():
            handle = rig.begin(mode='direct', step_budget=200,
                               on_feedback=lambda _, moving=moving: moving.set())
            assert moving.wait(20), 'the first goal did not move'
            time.sleep(random.uniform(0, 0.3))
            rig.finish(handle)
            expect_goal(rig, trials)


@fault('a goal right after a reset, in lock-step', 'a goal of one step succeeds', 200,
       's for the goal')
def test_goals_after_reset(rig, trials):
    rig.need('visual_mpc_node', sim='lock-step')
    for trial in trials:
        with trials.one():
            rig.reset(trial % 20)
            expect_goal(rig, trials)


@fault('subscribers that come late', 'picture, goal picture and subgoal come within '
       f'{JOIN_S:g} s', 100, 's until all three were there')
def test_late_joiners(rig, trials):
    rig.need('predictor_node', sim='lock-step')
    for trial in trials:
        if trial % 10 == 0:
            rig.reset(trial)
            deadline = time.monotonic() + 10  # what a prediction needs may be on its way
            while time.monotonic() < deadline:
                with suppress(TapError):
                    rig.client.predict()
                    break
                time.sleep(0.1)
        begin = time.monotonic()
        context = Context()
        context.init()
        node = Node('late', context=context)
        try:
            topics = [Newest(node, Image, 'camera/image_raw', STREAM),
                      Newest(node, Image, 'goal/image', LATCHED),
                      Newest(node, Subgoal, 'subgoal', LATCHED)]
            with trials.one(), Spinner(node):
                for newest in topics:
                    newest.wait(JOIN_S)
                trials.measured(time.monotonic() - begin)
        finally:
            node.destroy_node()
            context.try_shutdown()


@fault('an hour of goals, predictions, resets and recording', 'each goal ends as it should; no '
       f'node grows by more than {MOST_MB_PER_HOUR:g} MB an hour', GOALS_PER_HOUR,
       'MB/h by which the node that grows most grows')
def test_soak(rig, trials, tmp_path):
    rig.need('visual_mpc_node', 'predictor_node', sim='real')
    rig.start('recorder_node', folder=tmp_path / 'bag').wait_for('ready')
    hours = trials.count / GOALS_PER_HOUR
    begin, goals, kept = time.monotonic(), 0, []
    while (time.monotonic() - begin) / 3600 < hours:
        with trials.one():
            push_once(rig, goals)
        kept.append([(time.monotonic() - begin) / 3600,
                     *(attacked.memory_mb() for attacked in rig.processes.values())])
        rig.check()
        goals += 1
        for data in (False, True) if goals % 20 == 0 else ():
            rig.client.call('record', data=data)
    kept = np.array(kept)
    warm = kept[kept[:, 0] >= WARM_UP * kept[-1, 0]]
    half = len(warm) // 2
    if half > 20:  # the median of slopes between samples
        change = warm[-half:] - warm[:half]
        slopes = np.median(change[:, 1:] / change[:, :1], axis=0)
        trials.note = 'MB/h: ' + ', '.join(
            f'{name} {slope:+.1f}' for name, slope in zip(rig.processes, slopes))
        trials.measured(slopes.max())
        if slopes.max() > MOST_MB_PER_HOUR:
            trials.record(f'memory grows: {trials.note}')
    rig.remove('recorder_node')


def push_once(rig, number):
    """Reset, predict and push a little; raise AssertionError for what goes wrong."""
    rig.reset(number)
    for _ in range(3):
        rig.expect_prediction(20.0)
    time.sleep(0.5)  # real time: let the pictures of the new scene come
    handle = rig.begin(mode=('direct', 'subgoal')[number % 2], step_budget=8)
    if number % 10 == 9:
        rig.finish(handle)
    else:
        rig.expect_end(handle, 'succeeded')
