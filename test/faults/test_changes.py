# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes that change during a goal, clocks that jump, names that forge log lines."""

from concurrent.futures import ThreadPoolExecutor
import threading
import time

from fault_report import fault
from fault_rig import Attacked, STOP_S
from fault_world import first_pictures, goal_fields, objects_message, predict_fields, TOPICS
import numpy as np
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates
from tap_ros.errors import TapError
from tap_ros.nodes.topics import STREAM, to_stamp

pytestmark = pytest.mark.ros

END_S = 8.0
DISCOVERED_S = 0.5  # that a new publisher takes to be heard
ABORTED = f'aborted with the reason; no move later than {STOP_S:g} s after the change'
FORGED = 'FORGED LINE'
NAMES = (f'red\n{FORGED}', f'\x1b[31m{FORGED}\x1b[0m', f'a\r{FORGED}', f'a\x85{FORGED}',
         f'a\u2028{FORGED}', '\x1b]0;title\x07', f'a\x00\n{FORGED}')


def judge(rig, trials, reaching, moment, limit_s=STOP_S):
    """Raise AssertionError unless a goal is aborted after a change, and nothing moves then."""
    rig.expect_end(reaching, 'aborted: ', 'the scene has changed', END_S)
    trials.measured(time.monotonic() - moment)
    late = rig.commands.moves(moment + limit_s * trials.patience)
    assert not late, f'a move was sent {late[-1].at - moment:.1f} s after the change'


def any_goal(trial):
    """Return a goal that brings its own picture, or one whose picture comes by topic."""
    return goal_fields() if trial % 2 else {'mode': 'direct', 'step_budget': 1000}


@fault('the scene is reset during a goal', ABORTED, 20, 's until the goal ended')
def test_scene_reset(rig, trials):
    for trial in trials:
        rig.need('visual_mpc_node', sim='real')
        with trials.one():
            rig.reset(2 * trial)
            handle = rig.begin_moving(**any_goal(trial))
            rig.reset(2 * trial + 1)
            judge(rig, trials, handle, time.monotonic())


@fault('a second simulator is started during a goal', 'aborted with the reason; no move later '
       f'than {STOP_S + DISCOVERED_S:g} s after it is ready', 10, 's until the goal ended')
def test_scene_other_simulator(rig, trials):
    for trial in trials:
        rig.need('visual_mpc_node', sim='real')
        other = Attacked('sim_node', rig.folder / 'other_sim.log', {'seed': 99},
                         ('-r', '__node:=other_sim'))
        with trials.one():
            rig.reset(trial)
            handle = rig.begin_moving(1, **any_goal(trial))
            try:
                other.start().wait_for('ready')
                judge(rig, trials, handle, time.monotonic(), STOP_S + DISCOVERED_S)
            finally:
                other.end()


def clock_jump(world, trial):
    """Let the clock jump ahead or back."""
    world.shift_s = (3600.0, -3600.0, 10.0, -10.0)[trial % 4]


def objects_change(world, trial):
    """Let an object vanish or appear."""
    seen = first_pictures()[0]
    if trial % 2:
        world.spoil(pixels=seen.object_pixels[:1], names=seen.object_names[:1])
    else:
        world.spoil(pixels=np.concatenate([seen.object_pixels, [[5.0, 5.0]]]),
                    names=(*seen.object_names, 'newcomer'))


@pytest.mark.parametrize('change', [clock_jump, objects_change], ids=['clock', 'objects'])
@fault('the clock jumps, or objects appear or vanish, during a goal', ABORTED, 20,
       's until the goal ended')
def test_scene(rig, trials, change):
    rig.need('visual_mpc_node')
    with rig.world() as world:
        for trial in trials:
            world.restore()
            time.sleep(0.5)
            rig.need('visual_mpc_node')
            with trials.one():
                handle = rig.begin_moving()
                change(world, trial)
                judge(rig, trials, handle, time.monotonic())


@fault('messages from the future once a second', 'the goal of four steps succeeds', 20,
       's for the goal')
def test_future_stamps(rig, trials):
    rig.need('visual_mpc_node')
    publishers = {topic: rig.node.create_publisher(kind, name, STREAM)
                  for topic, (kind, name) in TOPICS.items()}
    choices = [[topic] for topic in TOPICS] + [list(TOPICS)]
    try:
        with rig.world() as world:
            for trial in trials:
                ended, begin = threading.Event(), time.monotonic()

                def publish(ended, topics):
                    while not ended.wait(1.0):
                        messages = world.messages(to_stamp(time.time_ns() + 10**15))
                        for topic in topics:
                            publishers[topic].publish(messages[topic])

                with ThreadPoolExecutor(1) as pool, trials.one():
                    pool.submit(publish, ended, choices[trial % len(choices)])
                    try:
                        rig.expect_end(rig.begin(**goal_fields(step_budget=4)), 'succeeded')
                    finally:
                        ended.set()
                    trials.measured(time.monotonic() - begin)
    finally:
        for publisher in publishers.values():
            rig.node.destroy_publisher(publisher)


@fault('newlines and control characters in names', 'logs and answers show them escaped, in one '
       'line', 28)
def test_forged_names(rig, trials):
    nodes = ('visual_mpc_node', 'predictor_node', 'recorder_node')
    rig.need(*nodes, sim='real')
    rogue = rig.node.create_publisher(ObjectStates, 'objects', STREAM)
    episodes = rig.node.create_publisher(Episode, 'episode', STREAM)
    seen = first_pictures()[0]

    def said_of(call, *args, **options):
        """Return what a call is answered: an end or an error."""
        try:
            return call(*args, **options) or ''
        except TapError as error:
            return str(error)
    try:
        for trial in trials:
            name = NAMES[trial % len(NAMES)]
            objects = objects_message(seen, to_stamp(0), names=(name, name))
            with trials.one():
                said = [said_of(rig.reset, 0, name)]
                for fields in ({'mode': name}, {'start_objects': objects}, {
                        'start': Image(width=64, height=64, encoding=name, step=192)}):
                    with pytest.raises(TapError) as refused:
                        rig.client.call('predict', 10.0, **predict_fields(**fields))
                    said.append(str(refused.value))
                rogue.publish(objects)
                episodes.publish(Episode(event=Episode.START, task=name, outcome=name))
                said += [said_of(lambda fields=fields: rig.result(
                    rig.begin(**goal_fields(**fields, timeout_s=15.0))))
                    for fields in ({'mode': name}, {'goal_pixels': {name: (9, 9)}})]
                texts = {node: attacked.text for node, attacked in rig.processes.items()}
                wrong = [node for node, text in texts.items() if is_forged(text)]
                if wrong:  # what is in a log stays there
                    for node in list(rig.processes):
                        rig.remove(node)
                    rig.need(*nodes, sim='real')
                assert not wrong, f'a forged line in the log of {", ".join(wrong)}'
                assert all(text.isprintable() for text in said), 'an answer that does not print'
                rig.check()
    finally:
        rig.node.destroy_publisher(rogue)
        rig.node.destroy_publisher(episodes)


def is_forged(text):
    """Tell whether a log holds control characters, or a line that a name has made."""
    return any(line.startswith(FORGED) or not line.isprintable()
               for line in text.replace('\t', ' ').split('\n'))
