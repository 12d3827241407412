# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer beside a real camera, where no simulator takes goal pictures."""

import json
import time

import numpy as np
from processes import Client, NodeProcess, page_address
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_ros.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.nodes.clients import Newest
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


@pytest.fixture
def camera(tmp_path):
    """Return a node in the place of a camera, and an explorer that sees it."""
    with Client('camera') as node:
        explorer = NodeProcess('explorer_node', tmp_path / 'explorer.log', {
            'port': 0, 'token': 'secret'}).wait_for('ready')
        try:
            yield node, explorer
        finally:
            explorer.kill()


def test_a_photograph_of_a_real_camera_becomes_the_goal(camera):
    node, explorer = camera
    pictures = node.create_publisher(Image, 'camera/image_raw', STREAM)
    objects = node.create_publisher(ObjectStates, 'objects', STREAM)
    goal_image = Newest(node, Image, 'goal/image', LATCHED)
    goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    url = page_address(explorer).replace('http', 'ws').replace('/?', '/socket?')
    assert url.endswith('?token=secret')
    with connect(url, open_timeout=10) as browser:
        stamp, deadline = 0, time.monotonic() + 30
        while not goal_image.count:
            assert time.monotonic() < deadline
            stamp += 10**9
            # Objects come after their picture, when there is a newer one already.
            image[0, 0] = stamp // 10**9
            pictures.publish(encode_image(image, to_stamp(stamp), CAMERA_FRAME))
            objects.publish(cup(stamp - 10**9))
            time.sleep(0.2)
            browser.send('{"do": "photograph"}')
        found = []
        while not any(isinstance(each, bytes) and each.startswith(b'camera\0')
                      for each in found):
            found.append(browser.recv(10))
    goal, found = goal_image.wait(5), goal_objects.wait(5)
    while found.header.stamp != goal.header.stamp:  # the last one may be on its way
        assert time.monotonic() < deadline
        time.sleep(0.1)
        goal, found = goal_image.wait(5), goal_objects.wait(5)
    assert bytes(goal.data)[3:] == image.tobytes()[3:]
    assert [(place.name, place.u, place.v) for place in found.objects] == [('cup', 3.0, 4.0)]
    assert explorer.end() == 0


def test_objects_of_another_moment_are_no_goal(camera):
    node, explorer = camera
    pictures = node.create_publisher(Image, 'camera/image_raw', STREAM)
    objects = node.create_publisher(ObjectStates, 'objects', STREAM)
    goal_image = Newest(node, Image, 'goal/image', LATCHED)
    url = page_address(explorer).replace('http', 'ws').replace('/?', '/socket?')
    deadline = time.monotonic() + 30
    while not all(each.get_subscription_count() for each in (pictures, objects)):
        assert time.monotonic() < deadline  # a picture without any objects would be a goal
        time.sleep(0.1)
    with connect(url, open_timeout=10) as browser:
        text, deadline, stamp = '', time.monotonic() + 30, 0
        while 'no objects have the stamp' not in text:
            assert time.monotonic() < deadline
            stamp += 10**9
            objects.publish(cup(stamp + 1))
            time.sleep(0.1)
            pictures.publish(encode_image(np.zeros((8, 8, 3), np.uint8), to_stamp(stamp),
                                          CAMERA_FRAME))
            time.sleep(0.1)
            browser.send('{"do": "photograph"}')
            text = problem_of(browser)
    assert not goal_image.count


def test_a_camera_that_is_silent_is_not_photographed(camera):
    _, explorer = camera
    url = page_address(explorer).replace('http', 'ws').replace('/?', '/socket?')
    with connect(url, open_timeout=10) as browser:
        browser.send('{"do": "photograph"}')
        assert 'the camera is silent' in problem_of(browser)
