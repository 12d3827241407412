# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of putting messages together by their stamp."""

from itertools import product
import threading
import time

import numpy as np
from processes import Client, until
import pytest
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image, JointState
from tap_msgs.msg import ObjectStates
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.ros.observations import DEPTH, JUMP_NS, Observations, PROOF, reception_time
from tap_ros.ros.polling import PollOnlyGroup
from tap_ros.ros.topics import encode_objects, LATCHED, STREAM, to_stamp


def stamped(kind, nanoseconds):
    message = kind()
    message.header.stamp = to_stamp(nanoseconds)
    return message


def put(observations, stamp, *topics):
    for topic in topics:
        observations.put(topic, stamped(Image if topic == 'image' else JointState, stamp))


def stamp_of(found):
    assert {to_nanoseconds(one.header.stamp) for one in found.messages.values()} == {
        found.stamp_ns}
    return found.stamp_ns


def test_only_messages_of_the_same_stamp_go_together():
    seen = Observations('image', 'joints')
    assert seen.missing(('image', 'joints')) == ['image', 'joints']
    put(seen, 10, 'image')
    assert seen.missing(('image', 'joints')) == ['joints']
    put(seen, 10, 'joints')
    put(seen, 20, 'joints')
    put(seen, 30, 'image')
    assert stamp_of(seen.newest('image', 'joints')) == 10
    assert stamp_of(seen.newest('image')) == 30
    assert seen.newest('image', 'joints', after_ns=10) is None
    seen = Observations('image', 'objects', latched=True)
    for stamp in (5, 10**18, 0):  # what comes now and then may have any stamp
        put(seen, stamp, 'image', 'objects')
        assert stamp_of(seen.newest('image', 'objects')) == stamp


def test_when_the_clock_jumps_for_good_the_past_is_forgotten_each_time():
    seen = Observations('image', 'joints')
    put(seen, 10**9, 'image', 'joints')
    before = 10**9
    for jump, clock in enumerate((10**17, 10**8, 10**15), 1):
        for step in range(PROOF):
            assert stamp_of(seen.newest('image')) == before and seen.jumps == jump - 1
            put(seen, clock + step, 'image')
        assert seen.jumps == jump and stamp_of(seen.newest('image')) == clock + PROOF - 1
        assert seen.newest('joints') is None
        before = clock + PROOF
        put(seen, before, 'image', 'joints')
        assert stamp_of(seen.newest('image', 'joints')) == before


def test_a_stray_stamp_now_and_then_is_not_believed():
    for stray, topic in product((1, 10**17), ('image', 'joints')):
        seen = Observations('image', 'joints')
        for stamp in range(10**9, 20 * 10**9, 10**9):
            put(seen, stamp, 'image', 'joints')
            put(seen, stray, topic)
            put(seen, stray + 1, topic)
            assert stamp_of(seen.newest('image', 'joints')) == stamp
        assert seen.jumps == 0
    for strays in ((10**17, 5 * 10**17) * PROOF, (3, 2) * PROOF, (10**17, 3) * PROOF):
        seen = Observations('image')
        put(seen, 10**9, 'image')
        for stray in strays:  # they do not follow each other
            put(seen, stray, 'image')
        assert stamp_of(seen.newest('image')) == 10**9 and seen.jumps == 0


def test_a_stray_that_is_seconds_ahead_is_dropped_and_believed_up_to_ten():
    for ahead in (1, 5, 9):
        seen = Observations('image', 'joints')
        for stamp in range(10**9, 20 * 10**9, 10**9 // 4):
            put(seen, stamp, 'image', 'joints')
            assert stamp_of(seen.newest('image', 'joints')) == stamp
            if stamp % 10**9 == 0:
                put(seen, stamp + ahead * 10**9, 'image')
                put(seen, stamp, 'image')  # sent again, as in lock-step
                assert stamp_of(seen.newest('image')) == stamp
                put(seen, stamp + ahead * 10**9, 'joints')
        assert seen.jumps == 0
    for ahead, believed in ((JUMP_NS, True), (JUMP_NS + 1, False)):
        seen = Observations('image', 'joints')
        put(seen, 100, 'joints')
        put(seen, 100 + ahead, 'image')
        assert (seen.newest('image') is not None) == believed == (not seen.missing(('image',)))


def test_what_repeats_a_stamp_is_as_old_as_the_first_unless_a_clock_says_that_time_stands():
    seen = Observations('image', 'joints')

    def receive(stamp, image, joints=None):
        seen.put('image', stamped(Image, stamp), image)
        if joints is not None:
            seen.put('joints', stamped(Image, stamp), joints)

    receive(10, 1.0, 2.0)
    assert seen.newest('image', 'joints', since=1.0).received == 1.0
    assert seen.newest('image', 'joints', since=1.5) is None
    receive(10, 3.0)
    seen.on_clock(Clock(clock=to_stamp(10)))  # once: it may run on
    receive(10, 3.5)
    for stray in range(100, 100 + 3 * DEPTH):
        seen.put('joints', stamped(Image, stray), 3.6)
    receive(10, 3.7)  # long forgotten by its stamp
    assert seen.ages(('image',), 4.0) == {'image': 3.0}
    seen.on_clock(Clock(clock=to_stamp(10)))
    receive(10, 3.9)
    assert seen.newest('image', since=3.8).received == 3.9
    assert seen.ages(('image',), 4.0)['image'] == pytest.approx(0.1)
    seen.on_clock(Clock(clock=to_stamp(11)))
    receive(10, 5.0)
    assert seen.ages(('image',), 5.0)['image'] == pytest.approx(1.1)
    receive(12, 6.0)
    assert seen.ages(('image',), 6.0)['image'] == 0


def test_time_in_a_queue_makes_a_message_older():
    now = time.monotonic()
    late = reception_time({'received_timestamp': time.time_ns() - 3 * 10**9})
    assert now - 3.5 < late <= time.monotonic() - 3
    assert min(reception_time({'received_timestamp': stamp})
               for stamp in (0, time.time_ns() + 10**12)) >= now


def test_topics_are_put_together_as_they_come_or_on_demand(client):
    types = {'image': (Image, 'eye/image'), 'joints': (JointState, 'arm/joints')}
    seen, told = Observations('image', 'joints'), []
    seen.subscribe(client, types, STREAM, on_message=told.append)
    asked, taken = Observations('image', 'joints'), []
    asked.subscribe(client, types, STREAM, PollOnlyGroup(), taken.append)
    publishers = [client.create_publisher(kind, name, STREAM) for kind, name in types.values()]
    begun = time.monotonic()
    for stamp in range(1, 600):
        for publisher, (kind, _) in zip(publishers, types.values()):
            publisher.publish(stamped(kind, stamp))
        if seen.wait(('image', 'joints'), 0.1):
            break
    moment = seen.newest('image', 'joints')
    assert begun <= moment.received <= time.monotonic()
    assert {topic: type(message) for topic, message in moment.messages.items()} == {
        'image': Image, 'joints': JointState}
    assert set(told) == {'eye/image', 'arm/joints'} and not taken
    assert asked.wait(('image', 'joints'), 5) and set(taken) == set(told)


def test_waiting_ends_with_the_message_with_giving_up_and_with_the_time():
    seen = Observations('image', 'joints')
    put(seen, 10, 'image', 'joints')
    assert stamp_of(seen.wait(('image', 'joints'), 0)) == 10
    assert seen.wait(('image', 'joints'), 0, after_ns=10) is None
    assert seen.wait(('image', 'joints'), 1e6, after_ns=10, give_up=lambda: True) is None
    threading.Timer(0.05, put, (seen, 20, 'image', 'joints')).start()
    assert stamp_of(seen.wait(('image', 'joints'), 60, after_ns=10)) == 20
    count = seen.count
    seen.wake()
    seen.wait_for_change(60, count)  # it has come already


# What people publish: best effort, volatile, compressed


def objects(stamp, u=3.0, v=8.0):
    return encode_objects(['cup'], np.array([[u, v]]), None, to_stamp(stamp), 'world',
                          ObjectStates.SOURCE_TRACKED)


@pytest.mark.parametrize('group', [None, PollOnlyGroup()])
def test_best_effort_and_volatile_publishers_are_heard(client, group, capfd):
    heard = []
    camera, goal = Observations('image'), Observations('image', 'objects', latched=True)
    for seen, types, qos in (
            (camera, {'image': (CompressedImage, 'camera/image_raw/compressed')}, STREAM),
            (goal, {'image': (CompressedImage, 'goal/image/compressed'),
                    'objects': (ObjectStates, 'goal/objects')}, LATCHED)):
        seen.subscribe(client, types, qos, group, heard.append)
    with Client('camera') as node:
        volatile = QoSProfile(depth=1)  # of a goal, as `ros2 topic pub` has it
        sends = [(node.create_publisher(type(message), topic, qos), message)
                 for message, topic, qos in (
                     (CompressedImage(), 'camera/image_raw/compressed', qos_profile_sensor_data),
                     (CompressedImage(), 'goal/image/compressed', volatile),
                     (objects(0), 'goal/objects', volatile))]

        def came():
            for publisher, message in sends:
                publisher.publish(message)
            return camera.newest('image') and goal.newest('image', 'objects')
        assert until(came, pause=0.1)
    said = capfd.readouterr().err
    assert 'taken best_effort' in said and 'No messages will be received' not in said


def test_what_was_latched_before_does_not_come_back(client):
    """A goal by hand, volatile, is not undone when its publisher has left."""
    kept = client.create_publisher(ObjectStates, 'goal/objects', LATCHED)
    kept.publish(objects(3 * 10**9, 3.0))
    asked, observed = (Observations('objects', latched=True) for _ in range(2))
    for observations, group in ((asked, PollOnlyGroup()), (observed, None)):
        observations.subscribe(
            client, {'objects': (ObjectStates, 'goal/objects')}, LATCHED, group)

    def newest():
        found = [each.newest('objects') for each in (asked, observed)]
        return [one and one.messages['objects'].objects[0].u for one in found]

    assert until(lambda: newest() == [3, 3])
    by_hand = client.create_publisher(ObjectStates, 'goal/objects', QoSProfile(depth=1))
    assert until(lambda: by_hand.publish(objects(5 * 10**9, 5.0)) or newest() == [5, 5],
                 pause=0.2)
    client.destroy_publisher(by_hand)
    # Longer than it takes to look at what is offered.
    assert not until(lambda: newest() != [5, 5], 2, pause=0.1)
