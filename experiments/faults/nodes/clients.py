# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many clients, large requests and streams of pictures: every call is answered, and soon."""

from functools import partial
import json
import re
import select
import subprocess
import sys
import time

from experiments.faults.children import end_group, ROOT
from experiments.faults.fault import Fault
from experiments.faults.nodes.load import PATIENCE_S
from experiments.faults.nodes.rig import outcome
from experiments.faults.nodes.world import first_pictures, predict_fields, TOPICS
import numpy as np
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectState, ObjectStates
from tap_ros.errors import TapError
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import find_predictor
import torch

PER_PROCESS = 8
DEFAULT_DEPTH = 10  # of the queue of a client in ROS 2
SOON_S = 10.0
START_S = 60.0  # that a process of clients takes to find the service, or to end


def call_at_once(clients, seconds, calls=0, depth=SERVICE_QOS.depth):
    """
    Have many clients call at once, from processes of their own.

    :param clients: how many.
    :param seconds: for how long.
    :param calls: most calls of each; 0: any number.
    :param depth: answers that wait in the queue of each.
    :return: dict of good, busy, refused, lost calls, and seconds.
    """
    counts = [min(PER_PROCESS, clients - at) for at in range(0, clients, PER_PROCESS)]
    processes = [subprocess.Popen(
        [sys.executable, '-m', 'experiments.faults.nodes.load',
         *map(str, (count, seconds, calls, depth))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
        start_new_session=True) for count in counts]
    try:
        for process in processes:
            if read_line(process, START_S) != 'ready\n':
                raise TapError('a process of clients did not start')
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
    return {**total, 'seconds': max(part['seconds'] for part in found)}


def read_line(process, timeout_s):
    """Return the next line that a process prints; raise TapError when none comes in time."""
    ready, _, _ = select.select([process.stdout], [], [], max(timeout_s, 0.0))
    line = process.stdout.readline() if ready else ''
    if not line:
        raise TapError('a process of clients ' + (
            'ended without a word' if ready else f'said nothing for {timeout_s:.0f} s'))
    return line


def many(job, clients, depth=SERVICE_QOS.depth):
    """Have many clients make a few calls each; a trial is a call."""
    job.rig.need('predictor_node')
    calls = max(1, round(job.count / clients))
    job.expect(calls * clients)
    _take_down(job, call_at_once(clients, 3600.0, calls, depth))


def for_long(job):
    """Have 16 clients call for ten minutes; a trial is a call."""
    job.rig.need('predictor_node')
    seconds = job.count / 50  # the count is a guess of what gets through
    found = call_at_once(16, seconds)
    job.expect(sum(found[key] for key in ('good', 'busy', 'refused', 'lost')))
    _take_down(job, found)


def _take_down(job, found):
    per_s = found['good'] / max(found['seconds'], 1e-9)
    job.record(True, times=found['good'] + found['busy'], figure=per_s)
    job.note = f'{found["good"]} with a subgoal, {found["busy"]} told to come later'
    if found['good'] < found['busy']:
        job.record(False, 'most requests were told to come later')
    if found['lost']:
        job.record(False, f'not answered within {PATIENCE_S:g} s', times=found['lost'])
    if found['refused']:
        job.record(False, 'a good request was refused', times=found['refused'])


def throughput(job):
    """Compare the answers a second of 16 clients with those of one."""
    job.rig.need('predictor_node')
    for _ in job.trials():
        one, many = call_at_once(1, 10.0), call_at_once(16, 10.0)
        ratio = (many['good'] / many['seconds']) / (one['good'] / one['seconds'])
        why = (f'{many["good"] / many["seconds"]:.0f} answers a second instead of '
               f'{one["good"] / one["seconds"]:.0f}') if ratio < 1.5 else ''
        job.record(not why, why, ratio)


def large(job):
    """Ask for more than can be done."""
    rig = job.rig
    rig.need('predictor_node')
    requests = list(_large_requests())
    for trial in job.trials():
        what, fields = requests[trial % len(requests)]
        begin = time.monotonic()
        response, why = outcome(rig.predict, 120.0, **fields)
        seconds = time.monotonic() - begin
        if response is not None and not response.success and not re.search(
                'at most|expected', response.message):
            why = f'refused without a bound: {response.message}'
        if not why and seconds > SOON_S:
            why = f'answered after {seconds:.0f} s'
        if not why:
            _, why = outcome(rig.expect_prediction, 5.0)
        if why and 'no answer' in why:
            rig.processes['predictor_node'].kill()
        rig.need('predictor_node')
        job.record(not why, f'{what}: {why}', seconds)


def _large_requests():
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


def latency(job):
    """Time requests while pictures stream in, against the bare model's time."""
    start, goal = first_pictures()
    predictor = SubgoalPredictor.load(find_predictor('push2'))
    job.rig.need('predictor_node')

    def bare():
        predictor.predict(start.image, goal.image, start.object_pixels, goal.object_pixels)
    request = predict_fields()
    with job.rig.world(30.0) as world:
        for _ in job.trials():
            world.silence(*TOPICS)
            alone = min(_with_threads(count, bare) for count in (1, torch.get_num_threads()))
            world.restore()
            asked = _median_ms(lambda: job.rig.predict(**request), 100)
            why = f'{asked:.1f} ms, the bare model {alone:.1f} ms' if (
                asked > 1.2 * alone + 1.0) else ''
            job.record(not why, why, asked / alone)
    job.note = f'{asked:.1f} ms, the bare model {alone:.1f} ms'


def _with_threads(count, work):
    """Return the median time of some work with so many threads of torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        return _median_ms(work, 50)
    finally:
        torch.set_num_threads(before)


def _median_ms(work, times):
    """Return the median time of some work."""
    spent = []
    for _ in range(3):
        work()
    for _ in range(times):
        begin = time.perf_counter()
        work()
        spent.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(spent))


ANSWERED = 'Each call is answered, with a subgoal or with how many requests are waiting.'
MEANING = ('A whole team, or a program with many threads, asks one predictor at once. Each client '
           f'has a queue of {SERVICE_QOS.depth}, since DDS brings it the answers to all of them.')
FAULTS = [
    *[Fault(f'clients-{count}', f'{count} clients at once', MEANING, ANSWERED, 10 * count, 0.03,
            partial(many, clients=count), 'answers a second', '1/s', 'least')
      for count in (12, 16, 64)],
    Fault('clients-16-default', f'16 clients at once with the default queue of {DEFAULT_DEPTH}',
          'As clients-16, without the deep queue that one client of many needs: where a busy '
          'machine keeps a client from taking what comes, DDS drops its answer.',
          ANSWERED, 1600, 0.03, partial(many, clients=16, depth=DEFAULT_DEPTH),
          'answers a second', '1/s', 'least'),
    Fault('clients-16-long', '16 clients for 10 min', MEANING, ANSWERED, 30_000, 0.02, for_long,
          'answers a second', '1/s', 'least'),
    Fault('clients-throughput', 'answers a second of 16 clients against one', 'Requests that wait '
          'are predicted together, so that many clients get more answers than one.',
          'At least 1.5 times as many.', 3, 32.0, throughput, 'ratio', '', 'median'),
    Fault('large-requests', 'requests for too much', 'A request with 10 000 objects, hundreds of '
          'samples or a huge picture would keep everybody else waiting.', 'Answered or refused '
          f'within {SOON_S:g} s, and the next good request is answered.', 14, 4.0, large,
          'until the answer', 's'),
    Fault('latency', 'requests while pictures stream in', 'A camera at 30 Hz must not make the '
          'predictor slow.', 'The median time of 100 calls is at most 1.2 times that of the bare '
          'model and 1 ms.', 5, 6.0, latency, 'time of a call against the bare model', '',
          'median')]
