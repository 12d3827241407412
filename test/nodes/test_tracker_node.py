# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""tracker_node: objects of the stamp of each picture after a click on each, or the reason."""

import json
from threading import Event
import time

from driven import SEED, select
from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import LocalNode, Newest, NodeProcess, until
import pytest
from sensor_msgs.msg import Image, JointState
from tap_msgs.msg import Episode, ObjectStates
import tap_ros
from tap_ros.contract import CONTROL_PERIOD
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.client import positions_of
from tap_ros.nodes.explorer.node import ExplorerNode
from tap_ros.nodes.ros_messages import encode_image, encode_joints
from tap_ros.nodes.topics import LATCHED, STREAM, to_stamp
from tap_ros.nodes.tracker.node import TrackerNode
from websockets.sync.client import connect

SIZE = 128


class Scene:
    """A simulator whose objects are tracked, and the truth beside."""

    def __init__(self, node):
        self.client = tap_ros.Client(node=node, timeout_s=30.0)
        self.twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.topics = {topic: Newest(node, ObjectStates, topic, qos) for topic, qos in (
            ('objects', STREAM), ('truth/objects', STREAM), ('goal/objects', LATCHED),
            ('truth/goal/objects', LATCHED))}

    def at(self, topic, stamp_ns, accept=lambda message: True):
        """Return what a topic says of a picture: the message, names and pixels."""
        message = self.topics[topic].wait(20, lambda m: accept(m) and to_nanoseconds(
            m.header.stamp) == stamp_ns)
        return message, *decode_objects(message, topic)

    def reset(self, seed=SEED):
        """Start a scene; return the stamps of its first picture and its goal."""
        start, goal = self.client.reset('push2', seed, objects=False)
        return start.stamp_ns, goal.stamp_ns

    def true_clicks(self, stamp_ns):
        """Return what a user would click."""
        _, names, pixels = self.at('truth/objects', stamp_ns)
        return dict(zip(names, pixels.tolist()))

    def move(self, *move):
        """Let one control period pass; return the stamp of the next picture."""
        command = TwistStamped(header=self.image.wait(10).header)
        command.twist.linear.x, command.twist.linear.y, command.twist.linear.z = move
        self.twist.publish(command)
        return to_nanoseconds(command.header.stamp) + round(CONTROL_PERIOD * 1e9)


@pytest.fixture(scope='module')
def sim(tmp_path_factory):
    """Start a simulator that keeps its truth to itself."""
    process = NodeProcess('sim_node', tmp_path_factory.mktemp('sim') / 'log.txt', {
        'lock_step': 'true', 'image_size': SIZE, 'objects': 'tracked'})
    yield process.wait_for('ready')
    process.end()


@pytest.fixture
def scene(sim, client):
    """Return the scene, beside a tracker."""
    scene, node = Scene(client), LocalNode(TrackerNode)
    yield scene
    assert node.end() == 0


@pytest.mark.errors('goal/image: expected 128x128')
def test_clicked_objects_are_followed_and_found_in_the_goal(scene, client):
    start_ns, goal_ns = scene.reset()
    select(scene.client, scene.true_clicks(start_ns))
    for topic, stamp in (('objects', start_ns), ('goal/objects', goal_ns)):
        message, names, pixels = scene.at(topic, stamp)
        true, same, wanted = scene.at(f'truth/{topic}', stamp)
        assert (names, message.source) == (same, ObjectStates.SOURCE_TRACKED)
        assert np.abs(pixels - wanted).max() < SIZE / 64
        assert np.abs(positions_of(message) - positions_of(true)).max() < 0.02
        assert list(message.states) == ['seen'] * 2 and min(message.confidence) > 0.5
    stamp = start_ns
    for _ in range(3):
        stamp = scene.move(0.02, 0.02, 0.0)
        _, _, pixels = scene.at('objects', stamp)
        _, _, wanted = scene.at('truth/objects', stamp)
        assert np.abs(pixels - wanted).max() < SIZE / 64
    count = scene.topics['objects'].count  # sent again, as its picture is
    assert until(lambda: scene.topics['objects'].count > count + 2)
    goal = client.create_publisher(Image, 'goal/image', LATCHED)
    goal.publish(encode_image(np.zeros((16, 16, 3), np.uint8), to_stamp(7), 'eye'))
    empty = scene.topics['goal/objects'].wait(  # those of another selection may come late
        10, lambda m: to_nanoseconds(m.header.stamp) == 7)
    assert not empty.objects  # a goal picture that cannot be used


def test_what_cannot_be_selected_is_refused_and_the_objects_before_are_followed(scene):
    start_ns, _ = scene.reset()
    clicks = scene.true_clicks(start_ns)
    select(scene.client, clicks)
    scene.at('objects', start_ns)
    first, second = clicks.values()
    for asked, words in (
            ({'names': ['a'], 'u': [first[0]], 'v': []}, '1, 1 and 0 entries'),
            ({'names': [], 'u': [], 'v': []}, 'at least one'),
            ({'names': ['a', 'a'], 'u': [first[0], second[0]], 'v': [first[1], second[1]]},
             'a name of its own'),
            ({'names': ['a' * 200], 'u': [first[0]], 'v': [first[1]]}, 'characters'),
            ({'names': ['a'], 'u': [SIZE + 3.0], 'v': [2.0]}, 'outside the picture'),
            ({'names': ['a'], 'u': [float('nan')], 'v': [2.0]}, 'finite numbers')):
        with pytest.raises(CallError, match=words):
            scene.client.call('select', **asked)
    _, names, _ = scene.at('objects', scene.move(0.0, 0.0, 0.01))
    assert set(names) == set(clicks)


def test_a_picture_waits_for_its_joints_as_long_as_it_is_told_to(client):
    node = LocalNode(TrackerNode, '/late', robot_mask='none', patience=60.0)
    images, joints = (client.create_publisher(kind, f'/late/{topic}', STREAM) for kind, topic in (
        (Image, 'camera/image_raw'), (JointState, 'joint_states')))
    followed = Newest(client, ObjectStates, '/late/objects', STREAM)
    picture = np.full((SIZE, SIZE, 3), 90, np.uint8)
    picture[40:60, 50:80] = 200, 40, 40

    def send(kind, second):
        stamp = to_stamp(second * 10**9)
        kind.publish(encode_image(picture, stamp, 'eye') if kind is images else
                     encode_joints(np.zeros(4), stamp, 'world'))

    try:
        assert until(lambda: images.get_subscription_count() and joints.get_subscription_count())
        send(joints, 1)
        send(images, 1)
        with tap_ros.Client('/late') as user:
            select(user, {'red': (65, 50)})
        followed.wait(10)
        send(images, 2)
        time.sleep(1)
        assert followed.count == 1
        send(joints, 2)
        followed.wait(10, lambda m: m.header.stamp.sec == 2)
    finally:
        assert node.end() == 0


def test_what_is_searched_in_a_goal_is_not_told_if_a_scene_begins_meanwhile(client):
    node = LocalNode(TrackerNode, '/searching', robot_mask='none')
    images, goals, marks = (
        client.create_publisher(kind, f'/searching/{topic}', qos) for kind, topic, qos in (
            (Image, 'camera/image_raw', STREAM), (Image, 'goal/image', LATCHED),
            (Episode, 'episode', STREAM)))
    told, searching = [], Event()
    client.create_subscription(ObjectStates, '/searching/goal/objects', told.append, LATCHED)
    picture = np.full((SIZE, SIZE, 3), 90, np.uint8)
    picture[40:60, 50:80] = 200, 40, 40

    def slow(view):
        searching.set()
        until(lambda: node.node._begun[0] == 5 * 10**9, 5)
        return find(view)

    try:
        assert until(lambda: images.get_subscription_count() and marks.get_subscription_count())
        images.publish(encode_image(picture, to_stamp(10**9), 'eye'))
        goals.publish(encode_image(picture, to_stamp(10**9), 'eye'))
        with tap_ros.Client('/searching') as user:
            select(user, {'red': (65, 50)})
        assert until(lambda: told and told[-1].objects)
        find = node.node._selection.tracker.find
        node.node._selection.tracker.find = slow
        goals.publish(encode_image(picture, to_stamp(5 * 10**9), 'eye'))
        assert searching.wait(10)
        mark = Episode(event=Episode.START)
        mark.header.stamp = to_stamp(5 * 10**9)
        marks.publish(mark)
        assert until(lambda: not told[-1].objects)
    finally:
        assert node.end() == 0
    assert {one.header.stamp.sec for one in told} == {1}


def test_another_scene_or_camera_ends_the_selection(scene, client):
    start_ns, goal_ns = scene.reset()
    select(scene.client, scene.true_clicks(start_ns))
    scene.at('goal/objects', goal_ns, lambda m: m.objects)
    start_ns, _ = scene.reset(SEED + 1)
    empty = scene.topics['goal/objects'].wait(10, lambda m: not m.objects)
    assert to_nanoseconds(empty.header.stamp) == goal_ns
    select(scene.client, scene.true_clicks(start_ns))
    scene.at('objects', start_ns)
    client.create_publisher(Image, 'camera/image_raw', STREAM)
    scene.topics['goal/objects'].wait(10, lambda m: not m.objects)
    stamp = scene.move(0.0, 0.0, 0.01)
    scene.at('truth/objects', stamp)
    assert to_nanoseconds(scene.topics['objects'].wait(1).header.stamp) < stamp


def test_the_explorer_selects_proposes_and_moves_goals_of_objects_by_their_own_names(scene):
    start_ns, goal_ns = scene.reset()
    explorer = LocalNode(ExplorerNode, port=0)
    with connect(f'{explorer.node.url.replace("http", "ws")}socket', open_timeout=10) as page:

        def told(kind, accept=lambda message: True):
            """Return the next message of a kind that is acceptable."""
            while True:
                text = page.recv(20)
                found = json.loads(text) if isinstance(text, str) else {}
                if found.get('kind') == kind and accept(found):
                    return found

        def ask(do, **fields):
            page.send(json.dumps({'do': do, **fields}))

        def click(clicks):
            ask('select', objects=[{'name': name, 'u': u, 'v': v}
                                   for name, (u, v) in clicks.items()])

        told('state', lambda state: state['tracker'] and state['simulator'])
        first, second = scene.true_clicks(start_ns).values()
        count, text = 0, 'nothing has come'
        while 'nothing has come' in text:  # to the tracker yet
            click({'corner': (SIZE + 3.0, 2.0)})
            problem = told('state', lambda state, last=count:
                           state['problem']['count'] > last)['problem']
            count, text = problem['count'], problem['text']
        assert 'outside the picture' in text
        ask('propose')
        proposed = told('selection', lambda selection: selection['count'])
        assert not proposed['followed'] and len(proposed['objects']) == 2
        click({'left': second, 'right': first})  # not the names of the simulator
        chosen = told('selection', lambda selection: selection['followed'] and selection['count'])
        for one in chosen['objects']:
            outline = np.array(one['outline'])
            assert (outline.min(axis=0) < -1).all() and (outline.max(axis=0) > 1).all()
        shown = told('state', lambda state: state['goal']['objects'] and state['movable'])
        assert [one['state'] for one in shown['camera']['objects']] == ['seen', 'seen']
        goal = {one['name']: one for one in shown['goal']['objects']}['right']
        _, names, before = scene.at('truth/goal/objects', goal_ns)
        ask('move', name='right', u=goal['u'] + 8.0, v=goal['v'])
        moved = scene.topics['truth/goal/objects'].wait(
            20, lambda message: to_nanoseconds(message.header.stamp) > goal_ns)
        _, after = decode_objects(moved, 'truth/goal/objects')
        assert np.allclose(after - before, [[8.0, 0.0], [0.0, 0.0]], atol=0.5)
        told('state', lambda state: any(
            one['name'] == 'right' and abs(one['u'] - goal['u'] - 8.0) < SIZE / 64
            for one in state['goal']['objects']))
    assert explorer.end() == 0
