# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""tracker_node: objects of the stamp of each picture after a click on each, or the reason."""

import json
import math
from threading import Event
import time
from types import SimpleNamespace

from driven import SEED, select
from geometry_msgs.msg import (
    Point32,
    Polygon,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    TwistStamped,
    Vector3,
)
import numpy as np
from processes import Client, LocalNode, Newest, NodeProcess, until
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from tap_msgs.msg import Episode, ObjectStates
import tap_ros
from tap_ros.apps.explorer.node import ExplorerNode
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.base.errors import TapError
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.tracker.node import TrackerNode
from tap_ros.ros.calls import CallError
from tap_ros.ros.topics import (
    encode_camera_info,
    encode_image,
    encode_joints,
    LATCHED,
    STREAM,
    to_stamp,
)
from tap_ros.ros.views import positions_of
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
        """Move so many metres in one control period; return the stamp of the next picture."""
        command = TwistStamped(header=self.image.wait(10).header)
        x, y, z = np.array(move) / CONTROL_PERIOD
        command.twist.linear = Vector3(x=x, y=y, z=z)
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
    inputs = node.node._inputs  # without the camera's pose objects have no positions
    assert until(lambda: inputs.info is not None and inputs.pose is not None)
    yield scene
    assert node.end() == 0


@pytest.mark.errors('goal/image: expected 128x128')
def test_clicked_objects_are_followed_and_found_in_the_goal(scene, client):
    start_ns, goal_ns = scene.reset()
    select(scene.client, scene.true_clicks(start_ns), start_ns)
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
    select(scene.client, clicks, start_ns)
    scene.at('objects', start_ns)
    first, second = clicks.values()
    for asked, words in (
            ({'names': ['a'], 'u': [first[0]], 'v': []}, '1, 1 and 0 entries'),
            ({'names': [], 'u': [], 'v': []}, 'as many of each, 1 to'),
            ({'names': ['a', 'a'], 'u': [first[0], second[0]], 'v': [first[1], second[1]]},
             'a name of its own'),
            ({'names': ['a' * 200], 'u': [first[0]], 'v': [first[1]]}, 'characters'),
            ({'names': ['a'], 'u': [SIZE + 3.0], 'v': [2.0]}, 'outside the picture'),
            ({'names': ['a'], 'u': [float('nan')], 'v': [2.0]}, 'finite numbers')):
        with pytest.raises(CallError, match=words):
            scene.client.call('select', **asked)
    _, names, _ = scene.at('objects', scene.move(0.0, 0.0, 0.01))
    assert set(names) == set(clicks)


def test_one_refused_click_does_not_refuse_the_others(scene):
    start_ns, _ = scene.reset()
    (name, (u, v)), *_ = scene.true_clicks(start_ns).items()
    answer = scene.client.call('select', names=[name, 'no'], u=[u, 3.0], v=[v, SIZE - 4.0])
    assert [one.name for one in answer.objects] == [name]
    assert f'following {name}; no: click' in answer.message
    _, names, _ = scene.at('objects', scene.move(0.0, 0.0, 0.01))
    assert list(names) == [name]
    with pytest.raises(CallError, match='no: click'):
        scene.client.select({name: (u, v), 'no': (3.0, SIZE - 4.0)})


def test_an_object_can_be_drawn(scene):
    start_ns, _ = scene.reset()
    name, (u, v) = next(iter(scene.true_clicks(start_ns).items()))
    box = Polygon(points=[Point32(x=u + x, y=v + y) for x, y in (
        (-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0))])
    answer = scene.client.call('select', names=[name], u=[u], v=[v], drawn=[box])
    across = [point.x for point in answer.outlines[0].points]
    assert max(across) - min(across) == pytest.approx(18, abs=2)
    with pytest.raises(CallError, match='drawn: expected'):
        scene.client.call('select', names=[name], u=[u], v=[v], drawn=[box, box])
    scribble = Polygon(points=[Point32(x=float(17 * k % 61), y=float(29 * k % 59))
                               for k in range(1001)])
    with pytest.raises(CallError, match='drawn: expected 1000 points at most'):
        scene.client.call('select', names=[name], u=[u], v=[v], drawn=[scribble])


class Eye:
    """A tracker in a namespace of its own, and a camera that shows it a red block on a table."""

    def __init__(self, client, name, **parameters):
        self.name, self._client = name, client
        self.node = LocalNode(TrackerNode, f'/{name}', robot_mask='none', **parameters)
        self._publishers = {}
        self.objects = []
        client.create_subscription(
            ObjectStates, f'/{name}/objects', self.objects.append, STREAM)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        assert self.node.end() == 0

    def send(self, topic, message, qos=STREAM):
        """Publish a message once the tracker listens."""
        if topic not in self._publishers:
            made = self._client.create_publisher(type(message), f'/{self.name}/{topic}', qos)
            self._publishers[topic] = made
            assert until(made.get_subscription_count)
        self._publishers[topic].publish(message)

    def picture(self, second, block=True, size=SIZE, topic='camera/image_raw', qos=STREAM):
        """Show a picture of a stamp."""
        picture = np.full((size, size, 3), 90, np.uint8)
        if block:
            picture[40:60, 50:80] = 200, 40, 40
        self.send(topic, encode_image(picture, to_stamp(second * 10**9), 'eye'), qos)

    def goal(self, second, block=True):
        """Show a goal picture."""
        self.picture(second, block, topic='goal/image', qos=LATCHED)

    def begin(self, second):
        """Mark the begin of an episode, and wait until it is known."""
        mark, before = Episode(event=Episode.START), self.node.node._inputs.episode
        mark.header.stamp = to_stamp(second * 10**9)
        self.send('episode', mark)
        assert until(lambda: self.node.node._inputs.episode != before)

    def calibrate(self, place=(0.0, -1.1, 1.3), turn=(0.94, 0.0, 0.0, -0.34), focal=140.0):
        """Tell where the camera is, and how it sees."""
        self.send('camera/camera_info', encode_camera_info(
            np.array([[focal, 0, 63.5], [0, focal, 63.5], [0, 0, 1]]), (SIZE, SIZE), to_stamp(1),
            'eye'))
        pose = PoseStamped()
        for field, values in ((pose.pose.position, place), (pose.pose.orientation, turn)):
            for axis, value in zip('xyzw', values):
                setattr(field, axis, value)
        self.send('camera/pose', pose, LATCHED)
        inputs = self.node.node._inputs
        assert until(lambda: repr(inputs.pose) == repr(pose) and inputs.info is not None)

    def ask(self, **fields):
        """Call select_objects once a picture has come; return why it refuses, else ''."""
        assert until(lambda: self.node.node._inputs.sensors.newest('image'))
        with tap_ros.Client(f'/{self.name}') as user:
            try:
                user.call('select', **fields)
            except CallError as error:
                return str(error)
        return ''

    def select(self):
        """Click on the block."""
        with tap_ros.Client(f'/{self.name}') as user:
            select(user, {'red': (65, 50)})
        assert until(lambda: self.objects)

    def followed(self, second):
        """Return the states of the objects in a picture; it has to be followed."""
        def found():
            return [one for one in self.objects if one.header.stamp.sec == second]
        assert until(found, 10)
        return list(found()[0].states)


def test_a_picture_waits_for_its_joints_as_long_as_it_is_told_to(client):
    def joints(second):
        return encode_joints(np.zeros(4), to_stamp(second * 10**9), 'world')

    with Eye(client, 'late', patience=60.0) as eye:
        eye.send('joint_states', joints(1))
        eye.picture(1)
        eye.select()
        eye.picture(2)
        time.sleep(1)
        assert len(eye.objects) == 1
        eye.send('joint_states', joints(2))
        eye.followed(2)


def test_an_object_that_is_unsure_and_seen_again_is_told_of_once(client, capfd):
    with Eye(client, 'unsure') as eye:
        eye.picture(1)
        eye.select()
        for second, block in enumerate((True, False, True, True), 2):
            eye.picture(second, block)
            assert eye.followed(second) == ['seen' if block else 'unsure']
        assert len(eye.objects) == 5
    lines = capfd.readouterr().err.splitlines()
    assert [line.split()[0] for line in lines if 'red is' in line] == ['[WARN]', '[INFO]']
    assert not [line for line in lines if 'Traceback' in line or '[ERROR]' in line]


@pytest.mark.errors('following: ')
def test_what_cannot_be_followed_costs_one_picture(client):
    with Eye(client, 'costly') as eye:
        eye.picture(1)
        eye.select()
        tracker, tried = eye.node.node._selection.tracker, []
        update = tracker.update

        def fail(view):
            tried.append(view)
            raise ValueError('a plug-in has a mistake')

        tracker.update = fail
        eye.picture(2)
        assert until(lambda: tried)
        eye.picture(2)  # sent again
        time.sleep(0.5)
        assert len(tried) == 1 and {one.header.stamp.sec for one in eye.objects} == {1}
        tracker.update = update
        eye.picture(3)
        assert eye.followed(3) == ['seen']


def test_requests_of_no_use_are_refused_with_the_remedy(client):
    with Eye(client, 'asked') as eye, Client('second_eye') as other:
        eye.picture(1)
        count = 10**6
        assert f'{count} entries' in eye.ask(
            names=['a'] * count, u=[1.0] * count, v=[1.0] * count)
        eye.goal(1)
        assert 'shows nothing elsewhere; click' in eye.ask(propose=True)
        for place, turn in (((0.0, 0.0, math.nan), (1.0, 0.0, 0.0, 0.0)),
                            ((0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)),
                            ((0.0, -1.0, 0.06), (0.7, 0.0, 0.0, -0.7)),  # level, at a top's height
                            ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))):  # looks up
            eye.calibrate(place, turn)
            why = eye.ask(names=['a'], u=[65.0], v=[50.0])
            assert why.startswith('camera/pose: ') or ': camera/pose: ' in why
        eye.calibrate()
        with pytest.raises(TapError, match='does not look down'):
            LocalNode(TrackerNode, camera_z=0.06, camera_y=-1.0, camera_qx=0.7, camera_qw=-0.7)
        other.create_publisher(Image, '/asked/camera/image_raw', STREAM)
        assert until(lambda: client.count_publishers('/asked/camera/image_raw') == 2)
        why = eye.ask(names=['a'], u=[65.0], v=[50.0])
        assert '/test_client, /second_eye' in why or '/second_eye, /test_client' in why


def test_the_camera_is_where_tf_says_unless_its_topic_does(client):
    with Eye(client, 'framed') as eye:
        inputs, size = eye.node.node._inputs, (SIZE, SIZE)

        def told(turn):
            place, turn = Vector3(y=-1.1, z=1.3), Quaternion(**dict(zip('xyzw', turn)))
            inputs._frames._take(SimpleNamespace(transforms=[TransformStamped(
                header=Header(frame_id='world'), child_frame_id='eye',
                transform=Transform(translation=place, rotation=turn))]))

        told((0.94, 0.0, 0.0, -0.34))
        assert inputs.calibration(size) == (None, None), 'nothing tells which frame is the camera'
        inputs.info = encode_camera_info(
            np.array([[140.0, 0, 63.5], [0, 140, 63.5], [0, 0, 1]]), size, to_stamp(1), 'eye')
        by_tf, _ = inputs.calibration(size)
        told((0.0, 0.0, 0.0, 1.0))
        with pytest.raises(TapError, match='^tf_static: .* look down'):
            inputs.calibration(size)
        eye.calibrate()
        by_topic, _ = inputs.calibration(size)
        assert by_topic.apart(by_tf) < 1e-6


@pytest.mark.parametrize('change, words', [
    ({'size': 64}, '64x64 pixels now, and had 128x128'),
    ({'focal': 150.0}, 'camera/camera_info or camera/pose has changed'),
    ({'place': (0.1, -1.1, 1.3)}, 'camera/camera_info or camera/pose has changed')])
def test_pictures_of_another_camera_end_the_selection(client, capfd, change, words):
    with Eye(client, 'moved') as eye:
        eye.calibrate()
        eye.picture(1)
        eye.select()
        if 'size' not in change:
            eye.calibrate(**change)
        for second in (2, 3):
            eye.picture(second, size=change.get('size', SIZE))
        assert until(lambda: eye.node.node._selection is None)
        assert {one.header.stamp.sec for one in eye.objects} == {1}
    said = capfd.readouterr().err
    assert said.count(words) == said.count('are forgotten') == 1


@pytest.mark.parametrize('early', [True, False])
def test_a_mark_of_another_clock_does_not_lock_the_service(client, early):
    with Eye(client, 'marked') as eye:
        eye.goal(1)
        if early:
            eye.begin(2**31 - 1)  # in 2038
        eye.picture(1)
        if not early:
            eye.select()
            eye.begin(2**31 - 1)
            assert until(lambda: eye.node.node._selection is None)
            assert 'no picture of the new episode' in eye.ask(names=['a'], u=[65.0], v=[50.0])
            eye.picture(2)
        told = Newest(client, ObjectStates, '/marked/goal/objects', LATCHED)
        eye.select()
        told.wait(10, lambda message: message.objects)


def test_what_is_searched_in_a_goal_is_not_told_if_a_scene_begins_meanwhile(client):
    told, searching = [], Event()
    with Eye(client, 'searching') as eye:
        client.create_subscription(
            ObjectStates, '/searching/goal/objects', told.append, LATCHED)
        eye.picture(1)
        eye.goal(1)
        eye.select()
        assert until(lambda: told and told[-1].objects)
        tracker = eye.node.node._selection.tracker
        find = tracker.find

        def slow(view):
            searching.set()
            until(lambda: eye.node.node._inputs.episode[0] == 5 * 10**9, 5)
            return find(view)

        tracker.find = slow
        eye.goal(5)
        assert searching.wait(10)
        eye.begin(5)
        assert until(lambda: not told[-1].objects)
    assert {one.header.stamp.sec for one in told} == {1}


def test_another_scene_or_camera_ends_the_selection(scene, client):
    start_ns, goal_ns = scene.reset()
    select(scene.client, scene.true_clicks(start_ns), start_ns)
    scene.at('goal/objects', goal_ns, lambda m: m.objects)
    start_ns, _ = scene.reset(SEED + 1)
    empty = scene.topics['goal/objects'].wait(10, lambda m: not m.objects)
    assert to_nanoseconds(empty.header.stamp) == goal_ns
    select(scene.client, scene.true_clicks(start_ns), start_ns)
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
            outline = np.array(one['outline']) - (one['u'], one['v'])
            assert (outline.min(axis=0) < -1).all() and (outline.max(axis=0) > 1).all()
        shown = told('state', lambda state: state['goal']['objects'] and state['movable'])
        assert [one['state'] for one in shown['camera']['objects']] == ['seen', 'seen']
        goals = {one['name']: one for one in shown['goal']['objects']}
        goal, count = goals['right'], shown['problem']['count']
        ask('move', name='right', u=goals['left']['u'], v=goals['left']['v'])
        said = told('state', lambda state: state['problem']['count'] > count)['problem']['text']
        assert 'right' in said and 'left' in said and 'object_' not in said, said
        _, names, before = scene.at('truth/goal/objects', goal_ns)
        ask('move', name='right', u=goal['u'] + 8.0, v=goal['v'])
        moved = scene.topics['truth/goal/objects'].wait(
            20, lambda message: to_nanoseconds(message.header.stamp) > goal_ns)
        _, after = decode_objects(moved, 'truth/goal/objects')
        assert np.allclose(after - before, [[8.0, 0.0], [0.0, 0.0]], atol=0.5)
        told('state', lambda state: any(
            one['name'] == 'right' and abs(one['u'] - goal['u'] - 8.0) < SIZE / 64
            for one in state['goal']['objects']))
        scene.move(0.02, 0.02, 0.0)
        told('state', lambda state: all('outline' in one for one in state['camera']['objects']))
        ask('reset', task='push2', seed=SEED + 1)
        told('state', lambda state: state['seed'] == SEED + 1
             and not (state['camera']['objects'] or state['goal']['objects']))
    assert explorer.end() == 0
