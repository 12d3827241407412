# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras and goals as people publish them: best effort, volatile, large, compressed."""

import numpy as np
from processes import Client, until
import pytest
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import CompressedImage
from tap_msgs.msg import ObjectStates
from tap_ros.errors import PlanningError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.messages.objects import decode_cut_objects
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.ros_messages import encode_objects
from tap_ros.nodes.topics import LATCHED, STREAM, to_stamp


def objects(stamp, u=3.0, v=8.0):
    return encode_objects(['cup'], np.array([[u, v]]), None, to_stamp(stamp), 'world',
                          ObjectStates.SOURCE_TRACKED)


@pytest.mark.parametrize('on_demand', [False, True])
def test_best_effort_and_volatile_publishers_are_heard(client, on_demand):
    heard = []
    camera, goal = Observations('image'), Observations('image', 'objects', latched=True)
    for seen, types, qos in (
            (camera, {'image': (CompressedImage, 'camera/image_raw/compressed')}, STREAM),
            (goal, {'image': (CompressedImage, 'goal/image/compressed'),
                    'objects': (ObjectStates, 'goal/objects')}, LATCHED)):
        seen.subscribe(client, types, qos, on_message=heard.append, on_demand=on_demand)
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


def test_what_was_latched_before_does_not_come_back(client):
    """A goal by hand, volatile, is not undone when its publisher has left."""
    kept = client.create_publisher(ObjectStates, 'goal/objects', LATCHED)
    kept.publish(objects(3 * 10**9, 3.0))
    asked, observed = (Observations('objects', latched=True) for _ in range(2))
    for observations, on_demand in ((asked, True), (observed, False)):
        observations.subscribe(client, {'objects': (ObjectStates, 'goal/objects')}, LATCHED,
                               on_demand=on_demand)

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


def test_an_object_beside_the_part_that_the_weights_see_is_named():
    cut = TrainedCrop(Crop('centre', 64), (480, 640), (64, 64)).of((480, 640), 'start')
    with pytest.raises(PlanningError, match=r'start_objects: cup not in the part of the picture '
                                            r'that the weights see, 480x480 pixels from \(80, 0'):
        decode_cut_objects(objects(0, 20.0, 200.0), 'start_objects', (480, 640), cut)
