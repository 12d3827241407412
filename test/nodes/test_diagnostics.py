# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What /diagnostics says of a node's inputs and work."""

import math
from threading import Thread

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from processes import LocalNode, Newest
import pytest
from sensor_msgs.msg import JointState
from tap_ros.nodes.diagnostics import Diagnostics, Record
from tap_ros.nodes.recorder.node import RecorderNode
from tap_ros.nodes.topics import STREAM


def statuses(message):
    """Return {name: (level, message, {key: value})}."""
    return {status.name: (status.level, status.message, {v.key: v.value for v in status.values})
            for status in message.status}


def wait_for(newest, name, accept):
    """Return level, message and values of the status `name` once they are acceptable."""
    message = newest.wait(
        20.0, lambda message: name in statuses(message) and accept(*statuses(message)[name]))
    return statuses(message)[name]


def test_an_input_is_not_received_then_ok_then_stale(client, tmp_path):
    newest = Newest(client, DiagnosticArray, '/diagnostics', 10)
    joints = client.create_publisher(JointState, 'joint_states', STREAM)
    node = LocalNode(RecorderNode, folder=tmp_path / 'bag')
    topic, service = 'recorder_node: /joint_states', 'recorder_node: service'
    try:
        level, _, values = wait_for(newest, topic, lambda *_: True)
        assert (level, values['status']) == (DiagnosticStatus.WARN, 'NotReceived')
        assert (values['count'], values['age_s']) == ('0', 'nan')
        assert wait_for(newest, service, lambda *_: True)[0] == DiagnosticStatus.OK

        stream = client.create_timer(0.05, lambda: joints.publish(JointState()))
        level, word, values = wait_for(
            newest, topic, lambda level, word, values: int(values['count']) > 1)
        assert (level, word) == (DiagnosticStatus.OK, 'OK')
        assert float(values['rate_hz']) > 1.0 and 0 <= float(values['age_s']) <= 2.0

        stream.cancel()
        level, word, values = wait_for(newest, topic, lambda level, word, values: word != 'OK')
        assert (level, word) == (DiagnosticStatus.STALE, 'Stale')
        assert float(values['age_s']) >= 2.0  # it is rounded
    finally:
        node.end()


def test_work_and_inputs_of_many_threads_are_counted(client):
    waiting = ['a', 'b', 'c']
    diagnostics = Diagnostics(
        client, {'camera/image_raw': 1.0, '/goal/image': math.inf}, queue=lambda: len(waiting))

    def work():
        for index in range(100):
            diagnostics.received('camera/image_raw')
            diagnostics.received('/camera/image_raw')
            diagnostics.took(index % 100, 'predict_subgoal')
    threads = [Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    diagnostics.error('bad\nname \x1b[31m')
    newest = Newest(client, DiagnosticArray, '/diagnostics', 10)
    message = newest.wait(10.0)
    found = statuses(message)
    assert set(found) == {
        'test_client: service', 'test_client: /camera/image_raw', 'test_client: /goal/image'}
    assert {status.hardware_id for status in message.status} == {'/test_client'}
    assert found['test_client: /camera/image_raw'][2]['count'] == '1600'
    level, text, values = found['test_client: service']
    assert (level, text) == (DiagnosticStatus.ERROR, r'bad\nname \x1b[31m')
    assert values.pop('last_error_age_s')
    assert values == {
        'queue': '3', 'errors': '1', 'last_error': text, 'predict_subgoal calls': '800',
        'predict_subgoal p50_ms': '49.50', 'predict_subgoal p99_ms': '98.01'}
    stamp = message.header.stamp
    now = client.get_clock().now().nanoseconds * 1e-9
    assert 0 <= now - (stamp.sec + stamp.nanosec * 1e-9) < 60


def test_a_rate_is_the_frequency_and_percentiles_are_of_recent_values_alone():
    for frequency in (0.5, 4.0, 30.0, 5000.0):
        record = Record(10.0)
        for index in range(500):
            record.add(index / frequency)
        assert record.rate(500 / frequency) == pytest.approx(frequency, rel=1e-6)
    record, rng = Record(60.0), np.random.default_rng(0)
    assert record.rate(0.0) == 0.0 and np.isnan(record.percentiles(0.0)).all()
    times = np.cumsum(rng.exponential(0.1, 2000))
    values = rng.exponential(5.0, 2000)
    for now, value in zip(times, values):
        record.add(now, value)
    now = times[-1] + 3.0
    late = values[now - times <= 60.0]
    assert 300 < len(late) < 900 and record.count == 2000
    assert record.percentiles(now).tolist() == np.percentile(late, (50, 99)).tolist()
    assert len(record.recent(times[-1] + 59.9)) >= 1
    assert len(record.recent(times[-1] + 60.1)) == 0 and record.rate(times[-1] + 60.1) == 0.0
