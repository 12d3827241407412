# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer beside a real camera, where no simulator takes goal pictures."""

from contextlib import ExitStack
from itertools import count
import json
import time

import numpy as np
from processes import Client, LocalNode, Newest, until
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_ros.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.nodes.explorer.node import ExplorerNode
from tap_ros.nodes.ros_messages import encode_image, encode_objects
from tap_ros.nodes.topics import LATCHED, STREAM, to_stamp
from websockets.sync.client import connect


def cup(stamp):
    return encode_objects(
        ['cup'], np.array([[3.0, 4.0]]), np.full((1, 7), np.nan), to_stamp(stamp), WORLD_FRAME,
        ObjectStates.SOURCE_TRACKED)


def problem_of(browser):
    """Return the newest thing that could not be done, once there is one."""
    problem = {'count': 0}
    while not problem['count']:
        text = browser.recv(10)
        if isinstance(text, str):
            problem = json.loads(text).get('problem', problem)
    return problem['text']


def test_a_photograph_of_a_real_camera_becomes_the_goal_with_its_own_objects_alone():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    with ExitStack() as stack:
        explorer = LocalNode(ExplorerNode, port=0, token='secret')
        stack.callback(explorer.end)
        node = stack.enter_context(Client('camera'))
        pictures = node.create_publisher(Image, 'camera/image_raw', STREAM)
        objects = node.create_publisher(ObjectStates, 'objects', STREAM)
        goal_image = Newest(node, Image, 'goal/image', LATCHED)
        goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        url = explorer.node.url.replace('http', 'ws').replace('/?', '/socket?')
        assert url.endswith('?token=secret')
        browser = stack.enter_context(connect(url, open_timeout=10))
        stamps = count(10**9, 10**9)

        def photograph(older):
            """Publish a picture and objects that are so much older (ns), and ask for a goal."""
            stamp = next(stamps)
            image[0, 0] = stamp // 10**9
            pictures.publish(encode_image(image, to_stamp(stamp), CAMERA_FRAME))
            # Objects come after their picture, when there is a newer one already.
            objects.publish(cup(stamp - older))
            time.sleep(0.1)
            browser.send('{"do": "photograph"}')

        browser.send('{"do": "photograph"}')
        assert 'the camera is silent' in problem_of(browser)
        # A picture without any objects would be a goal.
        assert until(lambda: all(p.get_subscription_count() for p in (pictures, objects)))
        assert until(lambda: photograph(1) or 'no objects have the stamp' in problem_of(browser))
        assert not goal_image.count
        assert until(lambda: photograph(10**9) or goal_image.count)
        while not (isinstance(text := browser.recv(10), bytes) and text.startswith(b'camera\0')):
            pass
        assert until(lambda: goal_image.wait(5).header.stamp == goal_objects.wait(5).header.stamp)
        assert bytes(goal_image.wait(5).data)[3:] == image.tobytes()[3:]
        place, = goal_objects.wait(5).objects
        assert (place.name, place.u, place.v) == ('cup', 3.0, 4.0)
