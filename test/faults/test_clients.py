# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many clients, large requests and streams of pictures: every call is answered, and soon."""

import re
import statistics
import time

from driven import predict_fields
from experiments.bench.nodes.service import compare_latency, measure_load, streaming
from fault_report import fault
import numpy as np
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectState, ObjectStates
from tap_ros.base.errors import TapError
from tap_ros.ros.topics import SERVICE_QOS

pytestmark = pytest.mark.ros

DEFAULT_DEPTH = 10  # of the queue of a client in ROS 2
SOON_S = 10.0
CLIENTS = '12, 16 or 64 clients at once (10 s or 2 min in a whole run)'
LEAST = 0.95  # share of calls that are answered with a short queue


@pytest.mark.parametrize('clients', [
    pytest.param(clients, id=name, marks=fault(
        CLIENTS, 'each call is answered', seconds, 'answers a second', min))
    for name, seconds, clients in (
        *((f'clients-{count}', 10, count) for count in (12, 16, 64)), ('clients-long', 120, 16))])
def test_(rig, trials, clients):
    rig.need('predictor_node')
    load = measure_load(clients, float(trials.count), SERVICE_QOS.depth)
    trials.record(times=len(load.latencies) + load.counts['busy'])  # a trial is a call
    trials.measured(load.per_second)
    trials.note = f'{load.counts["busy"]} told to come later'
    if len(load.latencies) < load.counts['busy']:
        trials.record('most requests were told to come later')
    for end in ('lost', 'refused'):
        if load.counts[end]:
            trials.record(f'a good request was {end}', load.counts[end])


# DDS brings a client the answers to all; its queue may be full of those to others.
@fault(f'16 clients with the default queue of {DEFAULT_DEPTH}', f'at least {LEAST:.0%} of '
       'the calls are answered', 4, '% of the calls (least)', min)
def test_clients_default_queue(rig, trials):
    rig.need('predictor_node')
    for _ in trials:
        with trials.one():
            load = measure_load(16, 10.0, DEFAULT_DEPTH)
            ends = len(load.latencies) + load.counts.total()
            answered = 1 - (load.counts['lost'] + load.counts['refused']) / max(ends, 1)
            trials.measured(100 * answered)
            assert answered >= LEAST, f'{load.counts}'


@fault('16 clients against one', 'at least 1.5 times as many answers a second', 3,
       'times as many (median)', statistics.median)
def test_clients_throughput(rig, trials):
    rig.need('predictor_node')
    for _ in trials:
        with trials.one():
            one, many = (measure_load(count, 10.0).per_second for count in (1, 16))
            trials.measured(many / one)
            assert many >= 1.5 * one, f'{many:.0f} answers a second instead of {one:.0f}'


@fault('too many objects, samples or pixels', f'answered or refused within {SOON_S:g} s; the '
       'next good request is answered', 14, 's until the answer')
def test_large_requests(rig, trials):
    requests = list(large_requests())
    for trial in trials:
        rig.need('predictor_node')
        what, fields = requests[trial % len(requests)]
        begin = time.monotonic()
        with trials.one():
            try:
                rig.client.call('predict', 120.0, **fields)
            except TapError as error:
                if 'refused' not in str(error):
                    rig.processes['predictor_node'].kill()
                assert re.search('at most|expected', str(error)), f'{what}: {error}'
            seconds = time.monotonic() - begin
            trials.measured(seconds)
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
    rig.need('predictor_node')
    with streaming(30.0) as stream:
        for _ in trials:
            found = compare_latency(stream, 2, 50)
            alone, asked = (1e3 * np.median(times) for times in (found.alone, found.service))
            trials.measured(asked / alone)
            trials.note = f'{asked:.1f} ms, the bare model {alone:.1f} ms'
            slow = asked > trials.patience * (1.2 * alone + 1.0)
            trials.record(trials.note if slow else '')
