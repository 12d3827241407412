# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Generated messages to every input of every node; what ends or blocks one is shrunk."""

import array
from functools import cache
from importlib import import_module
import re
import time

from driven import first_pictures
from fault_report import fault
import hypothesis
from hypothesis import strategies as st
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from tap_ros.base.contract import GRIPPER_JOINTS, MAP_ENCODING, MASK_ENCODING, NODE_CLASSES
from tap_ros.base.errors import TapError
from tap_ros.images.encodings import ENCODINGS
from tap_ros.robots.description import robot_description
from tap_ros.robots.ur10e import UR10E
from tap_ros.ros import heartbeat
from tap_ros.ros.calls import call, CallError
from tap_ros.ros.reaching import Reaching
from tap_ros.ros.topics import LATCHED

pytestmark = pytest.mark.ros

BATCH = 25  # messages between two looks at the nodes
ROUND = 200  # batches between two good calls to everything
ANSWER_S = 10.0
# So that masks and descriptions are used.
PARAMETERS = {'sim_node': {'look': 'arm'}, 'predictor_node': {'robot_mask': 'arm'},
              'visual_mpc_node': {'robot_mask': 'arm'}}
TOPICS = {
    'camera/image_raw': 'sensor_msgs/msg/Image', 'objects': 'tap_msgs/msg/ObjectStates',
    'joint_states': 'sensor_msgs/msg/JointState', 'goal/image': 'sensor_msgs/msg/Image',
    'goal/objects': 'tap_msgs/msg/ObjectStates', 'gripper/command': 'std_msgs/msg/Float64',
    'arm/delta_twist_cmds': 'geometry_msgs/msg/TwistStamped', 'episode': 'tap_msgs/msg/Episode',
    'arm/command_timeout': 'std_msgs/msg/Float64', 'arm/refused': 'tap_msgs/msg/CommandRefused',
    'predictor_node/heartbeat': 'std_msgs/msg/Header', 'clock': 'rosgraph_msgs/msg/Clock',
    'camera/camera_info': 'sensor_msgs/msg/CameraInfo',
    'camera/robot_mask': 'sensor_msgs/msg/Image', 'goal/robot_mask': 'sensor_msgs/msg/Image',
    'observer/image_raw': 'sensor_msgs/msg/Image', 'robot_description': 'std_msgs/msg/String',
    'predictor_node/model_card': 'std_msgs/msg/String'}
LATCHED_TOPICS = ('goal/image', 'goal/objects', 'goal/robot_mask', 'robot_description',
                  'arm/command_timeout', 'predictor_node/model_card')
SERVICES = {
    'predict_subgoal': 'tap_msgs/srv/PredictSubgoal', 'sim/reset': 'tap_msgs/srv/ResetScene',
    'sim/set_goal': 'tap_msgs/srv/SetGoal', 'sim/step': 'tap_msgs/srv/StepScene',
    'sim/pause': 'std_srvs/srv/SetBool', 'recorder/record': 'std_srvs/srv/SetBool'}

NUMBERS = st.floats() | st.sampled_from((
    0.0, 1.0, -1.0, 31.5, 64.0, 5000.0, -7000.0, 5.4e8, 1e30, -1e308, 5e-324, float('nan')))
TEXTS = st.text(st.characters(codec='utf-8'), max_size=12) | st.sampled_from((
    'red', 'green', 'object_0', 'gripper_x', 'push2', 'direct', 'subgoal', 'forward', 'a\nb',
    'bidirectional', '\x1b[31m', 'x' * 1000, '\u202e', '\x00', '(.*)*$', 'a{99999}'))
NEAR = st.floats(-3, 3)


def whole_images():
    """Return pictures and masks whose fields fit together."""
    def image(side, header, row, encoding, padding):
        channels = 3 if encoding == 'rgb8' else 1
        row = (row * side * channels)[:side * channels] + [0] * padding
        return message_type('sensor_msgs/msg/Image')(
            header=header, width=side, height=side, encoding=encoding, step=len(row),
            data=array.array('B', row * side))
    return st.builds(
        image, st.sampled_from((64, 64, 1, 16, 65)), messages('std_msgs/msg/Header'),
        st.lists(st.sampled_from((0, 128, 255)) | st.integers(0, 255), min_size=1, max_size=4),
        st.sampled_from(('rgb8', MASK_ENCODING)), st.sampled_from((0, 0, 2)))


def known_objects():
    """Return lists of objects with the names of the simulator's, at any pixels."""
    kind, one = (message_type(f'tap_msgs/msg/{name}') for name in ('ObjectStates', 'ObjectState'))
    return st.builds(kind, objects=st.tuples(*[
        st.builds(one, name=st.just(name), u=NUMBERS, v=NUMBERS)
        for name in first_pictures()[0].object_names]).map(list))


# Of the fields of some types, what is likely; of some types, whole messages.
LIKELY = {
    'sensor_msgs/msg/Image': {
        'encoding': lambda: st.sampled_from((*ENCODINGS, MAP_ENCODING)) | TEXTS},
    'sensor_msgs/msg/JointState': {
        'name': lambda: st.permutations(UR10E.joints).map(list) | st.lists(
            st.sampled_from(GRIPPER_JOINTS + UR10E.joints) | TEXTS, max_size=6),
        'position': lambda: st.lists(NEAR, min_size=6, max_size=6) | st.lists(
            NEAR | NUMBERS, max_size=7)},
    'std_msgs/msg/String': {'data': lambda: st.just(robot_description(UR10E)) | TEXTS},
    'geometry_msgs/msg/Point': {axis: lambda: NEAR | NUMBERS for axis in 'xyz'}}
WHOLE = {'sensor_msgs/msg/Image': whole_images, 'tap_msgs/msg/ObjectStates': known_objects}


@cache
def messages(name):
    """Return the strategy of a type, such as tap_msgs/srv/ResetScene (its requests)."""
    kind, likely = message_type(name), LIKELY.get(name, {})
    parts = {field: likely[field]() if field in likely else values(text)
             for field, text in kind.get_fields_and_field_types().items()}
    return WHOLE[name]() | st.builds(kind, **parts) if name in WHOLE else st.builds(kind, **parts)


def values(text):
    """Return the strategy of a field's type, as get_fields_and_field_types writes it."""
    if match := re.fullmatch(r'sequence<(.*?)(?:, \d+)?>', text):
        found = st.lists(values(match[1]), max_size=4)
        return found.map(lambda data: array.array('B', data)) if match[1] == 'uint8' else found
    if match := re.fullmatch(r'(.*)\[(\d+)\]', text):
        return st.lists(values(match[1]), min_size=int(match[2]), max_size=int(match[2]))
    if match := re.fullmatch(r'(u?)int(\d+)', text):
        least, most = ((0, 2**int(match[2]) - 1) if match[1] else
                       (-2**(int(match[2]) - 1), 2**(int(match[2]) - 1) - 1))
        likely = [value for value in (0, 1, 2, 3, 48, 64, 101, 192) if value <= most]
        return st.sampled_from([*likely, least, most]) | st.integers(least, most)
    simple = {'double': NUMBERS, 'float': st.floats(width=32), 'string': TEXTS,
              'boolean': st.booleans(), 'octet': st.binary(min_size=1, max_size=1)}
    if text in simple:
        return simple[text]
    name = text.replace('/', '/msg/')
    empty = st.just(message_type(name)())
    return empty | empty | messages(name)


def message_type(name):
    """Import a type such as sensor_msgs/msg/Image; a service's request, an action's goal."""
    found = interface(name)
    return found.Request if '/srv/' in name else found.Goal if '/action/' in name else found


def interface(name):
    """Import an interface, such as std_srvs/srv/SetBool."""
    module, last = name.replace('/', '.').rsplit('.', 1)
    return getattr(import_module(module), last)


def cases():
    """Return pairs of where to send something and the message; mostly topics."""
    def pairs(kinds):
        return st.one_of([st.tuples(st.just(where), messages(kind)) for where, kind in kinds])

    topics = pairs(TOPICS.items())
    calls = pairs([*SERVICES.items(), ('reach_goal', 'tap_msgs/action/ReachGoal')])
    return st.integers(0, 24).flatmap(lambda number: calls if number == 24 else topics)


class Target:
    """
    All nodes, and ways to send a case to them.

    :param rig: Rig.
    """

    def __init__(self, rig):
        self._rig, self.sent = rig, 0
        self._publishers = {
            name: rig.node.create_publisher(
                message_type(kind), name, LATCHED if name in LATCHED_TOPICS else
                heartbeat.QOS if name.endswith('/heartbeat') else QoSProfile(depth=200))
            for name, kind in TOPICS.items()}
        self._clients = {name: rig.node.create_client(interface(kind), name)
                         for name, kind in SERVICES.items()}
        self._parameters = {name: rig.node.create_client(GetParameters, f'{name}/get_parameters')
                            for name in NODE_CLASSES}
        self.restore()

    def close(self):
        """Take back what was published."""
        for publisher in self._publishers.values():
            self._rig.node.destroy_publisher(publisher)

    def restore(self):
        """Have all nodes running, after something ended or blocked one."""
        for name, process in self._rig.processes.items():
            try:
                self._look(name)
            except (AssertionError, TapError):
                process.kill()
        self._rig.need(*NODE_CLASSES.keys() - {'sim_node'}, sim='real', parameters=PARAMETERS)
        for name, client in self._parameters.items():
            assert client.wait_for_service(20), f'{name}: its parameters were not found'

    def send(self, batch):
        """Send cases and wait for the answers; raise an error if a node is none the better."""
        self.sent += len(batch)
        for where, message in batch:
            if where in self._publishers:
                self._publishers[where].publish(message)
        for where, request in batch:
            if where in self._clients:
                call(self._clients[where], request, ANSWER_S)
            elif where not in self._publishers:
                self._pursue(request)
        for name in NODE_CLASSES:
            self._look(name)

    def good_calls(self):
        """Make a good call to everything; raise TapError when one is not answered well."""
        self._rig.expect_prediction(ANSWER_S)
        self._rig.client.pause(False)
        self._rig.reset(1)

    def _look(self, name):
        """Raise an error when a node has ended or does not answer."""
        self._rig.processes[name].check()
        call(self._parameters[name], GetParameters.Request(), ANSWER_S)

    def _pursue(self, goal):
        """Send a goal, let it begin, and cancel it; raise TapError if it does not end."""
        try:
            reaching = Reaching(self._rig.client.goals, goal, 3 * ANSWER_S, ANSWER_S)
        except CallError as error:
            if 'rejected' not in str(error):  # as another one is pursued
                raise
            return
        time.sleep(0.2)
        reaching.cancel()
        reaching.result()


@pytest.mark.errors(r'^\[ERROR\](?!.*Traceback)')  # bad messages are named, in one line each
@fault('random messages: wrong sizes, extreme numbers, control characters', 'no node ends; each '
       'call is answered, good ones well', 50_000)
def test_generated_messages(rig, trials):
    target, seed = Target(rig), 0
    try:
        while target.sent < trials.count and trials.tried == trials.held:
            seed += 1
            attack(target, trials, seed)
    finally:
        target.close()


def attack(target, trials, seed):
    """Send a round of generated messages, or fewer if one does harm."""
    before = target.sent

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=max(1, min(ROUND, -(-(trials.count - before) // BATCH))), deadline=None,
        database=None, print_blob=False, suppress_health_check=list(hypothesis.HealthCheck),
        phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink))
    @hypothesis.given(st.lists(cases(), min_size=BATCH // 2, max_size=BATCH * 3 // 2))
    def send(batch):
        try:
            target.send(batch)
        except (AssertionError, TapError):
            time.sleep(0.5)
            target.restore()
            raise
    with trials.one():
        try:
            send()  # what does harm is made small, and printed
            target.good_calls()
        finally:
            trials.record(times=target.sent - before - 1)
