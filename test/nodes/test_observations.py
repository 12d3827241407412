# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of putting messages together by their stamp."""

from itertools import product
from math import inf
import threading
import time

from sensor_msgs.msg import Image, JointState
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.observations import DEPTH, JUMP_NS, Observations, PROOF, reception_time
from tap_ros.nodes.topics import STREAM, to_stamp


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
    assert seen.missing(('image', 'joints')) == ['image', 'joints']
    put(seen, 10, 'image')
    assert seen.missing(('image', 'joints')) == ['joints']
    put(seen, 10, 'joints')
    put(seen, 20, 'joints')
    put(seen, 30, 'image')
    assert stamp_of(seen.newest('image', 'joints')) == 10
    assert stamp_of(seen.newest('image')) == 30
    assert seen.newest('image', 'joints', after_ns=10) is None
    put(seen, 30, 'joints')
    assert stamp_of(seen.newest('image', 'joints', after_ns=10)) == 30


def test_when_time_goes_back_for_good_the_past_is_forgotten():
    seen = Observations('image', 'joints')
    put(seen, 1000, 'image', 'joints')
    for _ in range(PROOF):
        assert stamp_of(seen.newest('image')) == 1000 and seen.jumps == 0
        put(seen, 5, 'image')
    assert stamp_of(seen.newest('image')) == 5 and seen.jumps == 1
    assert seen.newest('image', 'joints') is None
    put(seen, 5, 'joints')
    assert stamp_of(seen.newest('image', 'joints')) == 5


def test_a_stray_stamp_now_and_then_is_not_believed():
    for stray, topic in product((1, 10**17), ('image', 'joints')):
        seen = Observations('image', 'joints')
        for stamp in range(10**9, 20 * 10**9, 10**9):
            put(seen, stamp, 'image', 'joints')
            put(seen, stray, topic)
            put(seen, stray + 1, topic)
            assert stamp_of(seen.newest('image', 'joints')) == stamp
        assert seen.jumps == 0


def test_a_stray_that_is_seconds_ahead_is_dropped():
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


def test_a_stray_that_comes_first_is_found_out():
    seen = Observations('image', 'joints')
    put(seen, 10**17, 'image')
    for stamp in range(10**9, (PROOF + 2) * 10**9, 10**9):
        put(seen, stamp, 'image', 'joints')
    assert stamp_of(seen.newest('image', 'joints')) == (PROOF + 1) * 10**9


def test_a_stamp_is_believed_at_once_up_to_ten_seconds_ahead():
    for ahead, believed in ((JUMP_NS, True), (JUMP_NS + 1, False)):
        seen = Observations('image', 'joints')
        put(seen, 100, 'joints')
        put(seen, 100 + ahead, 'image')
        assert (seen.newest('image') is not None) == believed
        assert seen.ages(('image',), 0.0)['image'] < inf if believed else (
            seen.missing(('image',)) == ['image'])


def test_strays_that_do_not_follow_each_other_prove_nothing():
    for strays in ((10**17, 5 * 10**17) * PROOF, (3, 2) * PROOF, (10**17, 3) * PROOF):
        seen = Observations('image')
        put(seen, 10**9, 'image')
        for stray in strays:
            put(seen, stray, 'image')
        assert stamp_of(seen.newest('image')) == 10**9 and seen.jumps == 0


def test_a_message_that_is_believed_clears_the_suspicion():
    seen = Observations('image')
    put(seen, 10**9, 'image')
    for _ in range(3):
        put(seen, 10**17, 'image')
        put(seen, 10**17 + 1, 'image')
        put(seen, 10**9, 'image')
    assert seen.jumps == 0 and stamp_of(seen.newest('image')) == 10**9


def test_after_a_jump_the_new_clock_counts_and_can_jump_again():
    seen = Observations('image', 'joints')
    put(seen, 10**9, 'image', 'joints')
    for jump, clock in enumerate((10**17, 10**8, 10**15), 1):
        for step in range(PROOF):
            put(seen, clock + step, 'image')
        assert seen.jumps == jump and stamp_of(seen.newest('image')) == clock + PROOF - 1
        assert seen.newest('joints') is None
        put(seen, clock + PROOF, 'image', 'joints')
        assert stamp_of(seen.newest('image', 'joints')) == clock + PROOF


def test_so_many_stamps_are_remembered_for_each_topic():
    for stamps, found in ((2 * DEPTH, True), (2 * DEPTH + 1, False)):
        seen = Observations('image', 'joints', latched=True)
        put(seen, 0, 'joints')
        for stamp in range(1, stamps):
            put(seen, stamp, 'image')
        put(seen, 0, 'image')
        assert (seen.newest('image', 'joints') is not None) == found
        assert seen.count == stamps + 1 and len(seen._by_stamp) <= 2 * DEPTH + 1


def test_what_comes_now_and_then_may_have_any_stamp():
    seen = Observations('image', 'objects', latched=True)
    for stamp in (5, 10**18, 0):
        put(seen, stamp, 'image', 'objects')
        assert stamp_of(seen.newest('image', 'objects')) == stamp


def test_only_what_was_received_since_a_time_counts():
    seen = Observations('image', 'joints')
    for topic, received in (('image', 1.0), ('joints', 2.0)):
        seen.put(topic, stamped(Image, 10), received)
    assert seen.moment(('image', 'joints'), since=1.0).received == 1.0
    assert seen.moment(('image', 'joints'), since=1.5) is None
    seen.put('image', stamped(Image, 10), 3.0)  # sent again, as in lock-step
    assert seen.moment(('image', 'joints'), since=1.5).received == 2.0
    assert seen.ages(('image', 'joints'), 4.0) == {'image': 1.0, 'joints': 2.0}
    assert seen.ages(('image', 'other'), 4.0, renewed=True) == {'image': 3.0, 'other': inf}


def test_time_in_a_queue_makes_a_message_older():
    now = time.monotonic()
    late = reception_time({'received_timestamp': time.time_ns() - 3 * 10**9})
    assert now - 3.5 < late <= time.monotonic() - 3
    assert reception_time({}) >= now
    assert reception_time({'received_timestamp': time.time_ns() + 10**12}) >= now


def test_who_waits_for_a_change_is_woken_by_messages_and_by_wake():
    seen = Observations('image')
    for change in (seen.wake, lambda: put(seen, 5, 'image')):
        count = seen.count
        timer = threading.Timer(0.05, change)
        timer.start()
        seen.wait_for_change(60, count)
        assert seen.count == count + 1
        timer.join()
        seen.wait_for_change(60, count)  # it has come already
    seen.wait_for_change(0.01, seen.count)


def test_topics_that_are_subscribed_to_are_put_together(client):
    seen, told = Observations('image', 'joints'), []
    types = {'image': (Image, 'eye/image'), 'joints': (JointState, 'arm/joints')}
    seen.subscribe(client, types, STREAM, on_message=told.append)
    quiet = Observations('image')
    quiet.subscribe(client, {'image': types['image']}, STREAM)
    publishers = [client.create_publisher(kind, name, STREAM) for kind, name in types.values()]
    begun = time.monotonic()
    for stamp in range(1, 600):
        for publisher, (kind, _) in zip(publishers, types.values()):
            publisher.publish(stamped(kind, stamp))
        if seen.wait(('image', 'joints'), 0.1) and quiet.wait(('image',), 0.1):
            break
    moment = seen.moment(('image', 'joints'))
    assert begun <= moment.received <= time.monotonic()
    assert {topic: type(message) for topic, message in moment.messages.items()} == {
        'image': Image, 'joints': JointState}
    assert set(told) == {'eye/image', 'arm/joints'}
    assert isinstance(quiet.newest('image')['image'], Image)


def test_waiting_ends_with_the_message_with_giving_up_and_with_the_time():
    seen = Observations('image', 'joints')
    put(seen, 10, 'image', 'joints')
    assert stamp_of(seen.wait(('image', 'joints'), 0)) == 10
    assert seen.wait(('image', 'joints'), 0, after_ns=10) is None
    assert seen.wait(('image', 'joints'), 1e6, after_ns=10, give_up=lambda: True) is None
    threading.Timer(0.05, put, (seen, 20, 'image', 'joints')).start()
    assert stamp_of(seen.wait(('image', 'joints'), 60, after_ns=10)) == 20
