# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many clients, large requests and streams of pictures: every call is answered, and soon."""

import json
from pathlib import Path
import re
import select
import statistics
import subprocess
import sys
import time

from fault_files import end_group, ROOT
from fault_load import PATIENCE_S
from fault_report import fault
from fault_world import first_pictures, predict_fields, TOPICS
import numpy as np
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectState, ObjectStates
from tap_ros.errors import TapError
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import find_predictor
import torch

pytestmark = pytest.mark.ros

PER_PROCESS = 8
DEFAULT_DEPTH = 10  # of the queue of a client in ROS 2
SOON_S = 10.0
START_S = 60.0  # that a process of clients takes to find the service, or to end
ANSWERED = 'each call is answered'


def call_at_once(clients, seconds, calls=0, depth=SERVICE_QOS.depth):
    """
    Have many clients call at once, from processes of their own.

    :param clients: how many.
    :param seconds: for how long.
    :param calls: most calls of each; 0: any number.
    :param depth: answers that wait in the queue of each.
    :return: dict of good, busy, refused, lost calls, and good ones a second.
    """
    counts = [min(PER_PROCESS, clients - at) for at in range(0, clients, PER_PROCESS)]
    load = Path(__file__).with_name('fault_load.py')
    processes = [subprocess.Popen(
        [sys.executable, str(load), *map(str, (count, seconds, calls, depth))], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, start_new_session=True)
        for count in counts]
    try:
        for process in processes:
            assert read_line(process, START_S) == 'ready\n', 'a process of clients did not start'
        for process in processes:
            process.stdin.write('\n')
            process.stdin.flush()
        until = time.monotonic() + (seconds if not calls else calls * PATIENCE_S) + START_S
        found = [json.loads(read_line(process, until - time.monotonic()))
                 for process in processes]
    finally:
        for process in processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                end_group(process)
            process.stdin.close()
            process.stdout.close()
    total = {key: sum(part.get(key, 0) for part in found)
             for key in ('good', 'busy', 'refused', 'lost')}
    return {**total, 'per_s': total['good'] / max(part['seconds'] for part in found)}


def read_line(process, timeout_s):
    """Return the next line that a process prints; raise AssertionError when none comes in time."""
    ready, _, _ = select.select([process.stdout], [], [], max(timeout_s, 0.0))
    line = process.stdout.readline() if ready else ''
    assert line, 'a process of clients said nothing'
    return line


def take_down(trials, found):
    """Take down what came of many calls; a trial is a call."""
    trials.record(times=found['good'] + found['busy'])
    trials.measured(found['per_s'])
    trials.note = f'{found["busy"]} told to come later'
    if found['good'] < found['busy']:
        trials.record('most requests were told to come later')
    if found['lost']:
        trials.record(f'not answered within {PATIENCE_S:g} s', found['lost'])
    if found['refused']:
        trials.record('a good request was refused', found['refused'])


@pytest.mark.parametrize('clients', [12, 16, 64])
@fault('12, 16 or 64 clients at once', ANSWERED, 10, 'answers a second', min)
def test_clients(rig, trials, clients):
    rig.need('predictor_node')
    take_down(trials, call_at_once(clients, 3600.0, trials.count))


@fault(f'16 clients with the default queue of {DEFAULT_DEPTH}', ANSWERED, 100,
       'answers a second', min)
def test_clients_default_queue(rig, trials):
    rig.need('predictor_node')
    take_down(trials, call_at_once(16, 3600.0, trials.count, DEFAULT_DEPTH))


@fault('16 clients for 10 min', ANSWERED, 600, 'answers a second', min)
def test_clients_long(rig, trials):
    rig.need('predictor_node')
    take_down(trials, call_at_once(16, float(trials.count)))


@fault('16 clients against one', 'at least 1.5 times as many answers a second', 3,
       'times as many (median)', statistics.median)
def test_clients_throughput(rig, trials):
    rig.need('predictor_node')
    for _ in trials:
        with trials.one():
            one, many = (call_at_once(count, 10.0)['per_s'] for count in (1, 16))
            trials.measured(many / one)
            assert many >= 1.5 * one, f'{many:.0f} answers a second instead of {one:.0f}'


@fault('requests for too much: objects, samples, pixels', 'answered or refused with the bound '
       f'within {SOON_S:g} s, and the next good request is answered', 14, 's until the answer')
def test_large_requests(rig, trials):
    requests = list(large_requests())
    for trial in trials:
        rig.need('predictor_node')
        what, fields = requests[trial % len(requests)]
        begin = time.monotonic()
        with trials.one():
            try:
                response = rig.predict(120.0, **fields)
            except TapError:
                rig.processes['predictor_node'].kill()
                raise
            seconds = time.monotonic() - begin
            trials.measured(seconds)
            assert response.success or re.search('at most|expected', response.message), (
                f'{what}: refused without a bound: {response.message}')
            assert seconds < SOON_S * trials.patience, f'{what}: answered after {seconds:.0f} s'
            rig.expect_prediction(5.0)


def large_requests():
    """Yield what is asked for, and the fields of the request."""
    def objects(count):
        return ObjectStates(objects=[
            ObjectState(name=f'object {i}', u=float(i % 64), v=float(i // 64 % 64))
            for i in range(count)])
    for count, depth in ((10_000, 8), (1000, 8), (100_000, 1)):
        yield f'{count} objects x depth {depth}', predict_fields(
            start_objects=objects(count), goal_objects=objects(count), recursion_depth=depth)
    yield '100 samples x depth 8', predict_fields(num_samples=100, recursion_depth=8)
    yield '2^32 - 1 samples', predict_fields(num_samples=2**32 - 1, recursion_depth=2**32 - 1)
    for side in (2048, 3000):
        data = bytes(3 * side * side)
        yield f'{side} x {side} pixels', predict_fields(start=Image(
            width=side, height=side, encoding='rgb8', step=3 * side, data=data))


@fault('requests while pictures stream in at 30 Hz', 'median of 100 calls at most 1.2 times the '
       'bare model and 1 ms', 5, 'times the bare model (median)', statistics.median)
def test_latency(rig, trials):
    start, goal = first_pictures()
    predictor = SubgoalPredictor.load(find_predictor('push2'))
    rig.need('predictor_node')

    def bare():
        predictor.predict(start.image, goal.image, start.object_pixels, goal.object_pixels)
    request = predict_fields()
    threads = torch.get_num_threads()
    with rig.world(30.0) as world:
        for _ in trials:
            world.silence(*TOPICS)
            alone = []
            for count in (1, threads):
                torch.set_num_threads(count)
                alone.append(median_ms(bare, 50))
            world.restore()
            asked = median_ms(lambda: rig.predict(**request), 100)
            trials.measured(asked / min(alone))
            trials.note = f'{asked:.1f} ms, the bare model {min(alone):.1f} ms'
            slow = asked > trials.patience * (1.2 * min(alone) + 1.0)
            trials.record(trials.note if slow else '')


def median_ms(work, times):
    """Return the median time of some work."""
    spent = []
    for _ in range(times + 3):
        begin = time.perf_counter()
        work()
        spent.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(spent[3:]))
