# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes that are started wrongly or ended at any moment, forged text, and for a while."""

from concurrent.futures import ThreadPoolExecutor
import re
import signal
import time

from driven import first_pictures, goal_fields, objects_message, predict_fields
from fault_report import fault
import numpy as np
from processes import NodeProcess, until
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates
from tap_ros.base.contract import NODE_CLASSES
from tap_ros.base.errors import TapError
from tap_ros.ros.topics import STREAM, to_stamp

pytestmark = pytest.mark.ros

END_S = 10.0
WARM_UP = 0.15  # share of the time that the slope of memory leaves out
GOALS_PER_HOUR = 500  # about what fits; the share of them is the share of the hour
MOST_MB_PER_HOUR = 20.0
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FORGED = 'FORGED LINE'
WEIGHTS = [(name, 'weights') for name in ('predictor_node', 'visual_mpc_node')]
NAMES = (f'red\n{FORGED}', f'\x1b[31m{FORGED}\x1b[0m', f'a\r{FORGED}', f'a\x85{FORGED}',
         f'a\u2028{FORGED}', '\x1b]0;title\x07', f'a\x00\n{FORGED}')


@pytest.mark.parametrize('name', ('sim_node', 'predictor_node', 'visual_mpc_node',
                                  'recorder_node'))
@pytest.mark.errors('nothing was recorded')
@fault('a node is started and ended at any moment', f'ends within {END_S:g} s, exit code 0 (130 '
       'or the signal during imports, 1 of an empty recorder)', 50, 's until it had ended')
def test_start_stop(trials, tmp_path, name):
    random = np.random.default_rng(0)

    def node(number):
        parameters = ({'folder': tmp_path / f'bag{number}'} if name == 'recorder_node' else {})
        return NodeProcess(name, tmp_path / f'{number}.log', parameters)

    def once(trial, early_s, late_s):
        """Start and end a node; return it, the signal, and the seconds and code of its end."""
        process = node(trial)
        if trial % 2:
            time.sleep(early_s)
        else:
            process.wait_for('ready')
            time.sleep(late_s)
        began = '[INFO]' in process.text
        number = SIGNALS[trial // 2 % len(SIGNALS)]
        asked = time.monotonic()
        code = process.end(number, END_S)
        return process, began, number, time.monotonic() - asked, code

    with ThreadPoolExecutor(2) as pool:
        begin = time.monotonic()
        for first in list(pool.map(node, ('usual0', 'usual1'))):
            first.wait_for('ready').kill()
        usual_s = time.monotonic() - begin
        early = 0
        for process, began, number, seconds, code in pool.map(
                once, *zip(*[(trial, random.uniform(0, 1.2 * usual_s), random.uniform(0, 0.5))
                             for trial in trials])):
            trials.measured(seconds)
            text = process.text
            if not began and (code == -number or (
                    number, code, text.strip()) == (signal.SIGINT, 130, 'interrupted')):
                early += 1  # before Python has run the first line of the node
                trials.record()
                continue
            with trials.one():
                assert code is not None, f'did not end within {END_S:g} s of {number.name}'
                assert 'Traceback' not in text, f'a traceback after {number.name}'
                # A recorder that nobody sends anything has failed.
                assert code == int('nothing was recorded' in text), (
                    f'exit code {code} after {number.name}: {process.last_line()}')
    trials.note = f'{early} by the signal'


@pytest.mark.parametrize('given', [
    {'wieghts': 'push2'}, {'weights': 'push2'}, {'image_topic': '/camera/image_raw'}],
    ids=lambda given: next(iter(given)))
@pytest.mark.errors('nothing was recorded')
@fault('unknown parameters, or weights by name, to each node', 'it works, or one line in the log '
       'names the parameter', 2 * len(NODE_CLASSES))
def test_parameters(trials, tmp_path, given):
    (parameter, value), = given.items()
    for trial in trials:
        name = list(NODE_CLASSES)[trial % len(NODE_CLASSES)]
        own = {'folder': tmp_path / 'bag'} if name == 'recorder_node' else (
            {'port': 0} if name == 'explorer_node' else {})
        process = NodeProcess(name, tmp_path / f'{name}.log', own | {parameter: value})
        with trials.one():
            deadline = time.monotonic() + 60.0
            while process.alive and 'ready' not in process.text:
                assert time.monotonic() < deadline, 'neither ready nor ended'
                time.sleep(0.1)
            named = re.compile(f'(?:WARN|ERROR|FATAL).*{parameter}')
            takes_it = parameter == 'weights' and name in ('predictor_node', 'visual_mpc_node')
            assert takes_it and process.alive or until(
                lambda process=process, named=named: named.search(process.text), 10.0), (
                f'{name}: {parameter} is not named')
            assert 'Traceback' not in process.text, f'{name}: a traceback'
        process.end(signal.SIGINT)


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
                wrong = [node for node, process in rig.processes.items()
                         if is_forged(process.text)]
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


@fault('goals, predictions, resets and recording in turn (12 minutes in a whole run)',
       f'each goal ends as it should; in a whole run no node grows by more than '
       f'{MOST_MB_PER_HOUR:g} MB an hour', GOALS_PER_HOUR // 5, 'MB/h, the node that grows most')
def test_soak(rig, trials, tmp_path):
    rig.need('visual_mpc_node', 'predictor_node', sim='real')
    rig.start('recorder_node', folder=tmp_path / 'bag').wait_for('ready')
    hours = trials.count / GOALS_PER_HOUR
    begin, goals, kept = time.monotonic(), 0, []
    while (time.monotonic() - begin) / 3600 < hours:
        with trials.one():
            push_once(rig, goals)
        kept.append([(time.monotonic() - begin) / 3600,
                     *(process.memory_mb() for process in rig.processes.values())])
        rig.check()
        goals += 1
        for data in (False, True) if goals % 20 == 0 else ():
            rig.client.record(data)
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
