# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lock-step: no goal is lost to a picture that was answered before; late joiners see the scene."""

import threading
import time

from experiments.faults.fault import Fault
from experiments.faults.nodes.rig import outcome
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import Subgoal
from tap_ros.nodes.clients import Newest, Spinner
from tap_ros.nodes.topics import LATCHED, STREAM

JOIN_S = 5.0


def after_cancel(job):
    """Send a goal as soon as the one before is cancelled."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='lock-step')
    rig.reset(0)
    for _ in job.trials():
        moving = threading.Event()
        handle, why = outcome(rig.begin, mode='direct', step_budget=200,
                              on_feedback=lambda _, moving=moving: moving.set())
        if handle is not None and not moving.wait(20):
            why = f'the first goal did not move; it {rig.finish(handle)}'
        elif handle is not None:
            time.sleep(job.random.uniform(0, 0.3))
            _, why = outcome(rig.finish, handle)
        _goal(job, why)


def after_reset(job):
    """Send a goal as soon as a scene was reset."""
    rig = job.rig
    rig.need('visual_mpc_node', sim='lock-step')
    for trial in job.trials():
        _, why = outcome(rig.reset, trial % 20)
        _goal(job, why)


def _goal(job, why):
    """Send a goal of one step and take down whether it succeeds."""
    begin = time.monotonic()
    if not why:
        handle, why = outcome(job.rig.begin, mode='direct', step_budget=1)
        if handle is not None:
            end, why = outcome(job.rig.result, handle, 30.0)
            if not why and not end.startswith('succeeded'):
                why = f'the goal {end}'
    job.record(not why, why, time.monotonic() - begin)


def late_joiners(job):
    """Subscribe when everything was sent long ago."""
    rig = job.rig
    rig.need('predictor_node', sim='lock-step')
    rig.reset(1)
    _predict_from_topics(rig)
    for trial in job.trials():
        if trial % 10 == 0:
            rig.reset(trial)
            _predict_from_topics(rig)
        begin = time.monotonic()
        context = Context()
        context.init()
        node = Node('late', context=context)
        try:
            topics = {'camera/image_raw': Newest(node, Image, 'camera/image_raw', STREAM),
                      'goal/image': Newest(node, Image, 'goal/image', LATCHED),
                      'subgoal': Newest(node, Subgoal, 'subgoal', LATCHED)}
            with Spinner(node):
                _, why = outcome(lambda topics=topics: [
                    newest.wait(JOIN_S) for newest in topics.values()])
        finally:
            node.destroy_node()
            context.try_shutdown()
        job.record(not why, why, time.monotonic() - begin)


def _predict_from_topics(rig):
    """Have a subgoal published; what the request is made from may still be on its way."""
    deadline = time.monotonic() + 10
    while not rig.predict().success and time.monotonic() < deadline:
        time.sleep(0.1)


FAULTS = [
    Fault('goals-after-cancel', 'a goal right after a cancel, in lock-step', 'A program that '
          'pushes again and again cancels a goal and sends the next one at once.',
          'The goal of one step succeeds.', 200, 2.0, after_cancel, 'for the goal', 's'),
    Fault('goals-after-reset', 'a goal right after a reset, in lock-step', 'The same after a new '
          'scene: no picture of the old one may be answered.', 'The goal of one step succeeds.',
          200, 1.5, after_reset, 'for the goal', 's'),
    Fault('late-joiners', 'subscribers that come late', 'A viewer or a recorder is started when '
          'all was sent already.', f'It gets the picture, the goal picture and the subgoal within '
          f'{JOIN_S:g} s.', 100, 1.5, late_joiners, 'until all three were there', 's')]
