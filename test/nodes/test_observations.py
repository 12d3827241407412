# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of putting messages together by their stamp."""

import threading

import pytest
from sensor_msgs.msg import Image, JointState
from tap_ros.nodes.observations import DEPTH, Observations
from tap_ros.nodes.topics import to_nanoseconds, to_stamp

pytestmark = pytest.mark.ros


def stamped(kind, nanoseconds):
    message = kind()
    message.header.stamp = to_stamp(nanoseconds)
    return message


def put(observations, stamp, *topics):
    for topic in topics:
        observations.put(topic, stamped(Image if topic == 'image' else JointState, stamp))


def stamp_of(found):
    stamps = {to_nanoseconds(message.header.stamp) for message in found.values()}
    assert len(stamps) == 1
    return stamps.pop()


def test_only_messages_of_the_same_stamp_go_together():
    seen = Observations('image', 'joints')
    put(seen, 10, 'image', 'joints')
    put(seen, 20, 'joints')
    put(seen, 30, 'image')
    assert stamp_of(seen.newest('image', 'joints')) == 10
    assert stamp_of(seen.newest('image')) == 30
    assert seen.newest('image', 'joints', after_ns=10) is None
    put(seen, 30, 'joints')
    assert stamp_of(seen.newest('image', 'joints', after_ns=10)) == 30


def test_what_never_came_is_named():
    seen = Observations('image', 'joints')
    assert seen.missing(('image', 'joints')) == ['image', 'joints']
    put(seen, 0, 'image')
    assert seen.missing(('image', 'joints')) == ['joints']
    assert stamp_of(seen.newest('image')) == 0


def test_when_time_goes_back_the_past_is_forgotten():
    seen = Observations('image', 'joints')
    put(seen, 1000, 'image', 'joints')
    put(seen, 5, 'image')
    assert stamp_of(seen.newest('image')) == 5
    assert seen.newest('image', 'joints') is None
    put(seen, 5, 'joints')
    assert stamp_of(seen.newest('image', 'joints')) == 5


def test_memory_does_not_grow():
    seen = Observations('image', 'joints')
    for stamp in range(100 * DEPTH):
        put(seen, stamp, 'image')
    assert len(seen._by_stamp) <= 2 * DEPTH
    assert stamp_of(seen.newest('image')) == 100 * DEPTH - 1


def test_waiting_ends_with_the_message_with_giving_up_and_with_the_time():
    seen = Observations('image', 'joints')
    put(seen, 10, 'image', 'joints')
    assert stamp_of(seen.wait(('image', 'joints'), 0)) == 10
    assert seen.wait(('image', 'joints'), 0, after_ns=10) is None
    assert seen.wait(('image', 'joints'), 1e6, after_ns=10, give_up=lambda: True) is None
    threading.Timer(0.05, put, (seen, 20, 'image', 'joints')).start()
    assert stamp_of(seen.wait(('image', 'joints'), 60, after_ns=10)) == 20
