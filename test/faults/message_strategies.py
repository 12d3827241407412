# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hypothesis strategies for every message that the nodes take: any fields, and likely ones."""

import array
from functools import cache
from importlib import import_module
from importlib.util import find_spec
import re

from fault_world import first_pictures
from hypothesis import strategies as st
from tap_ros.contract import (
    GRIPPER_JOINTS,
    MAP_ENCODING,
    MASK_ENCODING,
    PICTURE_ENCODING,
    ROBOT_MASK_ARM,
    ROBOT_MASK_FREE,
    ROBOT_MASK_HAND,
)
from tap_ros.images.encodings import ENCODINGS
from tap_ros.robots.description import robot_description
from tap_ros.robots.ur10e import UR10E

MASK = 'sensor_msgs/msg/Image mask'  # what comes after a blank tells strategies apart
TOPICS = {
    'camera/image_raw': 'sensor_msgs/msg/Image', 'objects': 'tap_msgs/msg/ObjectStates',
    'joint_states': 'sensor_msgs/msg/JointState', 'goal/image': 'sensor_msgs/msg/Image',
    'goal/objects': 'tap_msgs/msg/ObjectStates', 'gripper/command': 'std_msgs/msg/Float64',
    'arm/delta_twist_cmds': 'geometry_msgs/msg/TwistStamped', 'episode': 'tap_msgs/msg/Episode',
    'arm/command_timeout': 'std_msgs/msg/Float64', 'arm/refused': 'tap_msgs/msg/CommandRefused',
    'predictor_node/heartbeat': 'std_msgs/msg/Header', 'clock': 'rosgraph_msgs/msg/Clock',
    'camera/camera_info': 'sensor_msgs/msg/CameraInfo', 'camera/robot_mask': MASK,
    'goal/robot_mask': MASK, 'observer/image_raw': 'sensor_msgs/msg/Image',
    'robot_description': 'std_msgs/msg/String', 'predictor_node/model_card': 'std_msgs/msg/String'}
LATCHED_TOPICS = ('goal/image', 'goal/objects', 'goal/robot_mask', 'robot_description',
                  'arm/command_timeout', 'predictor_node/model_card')
SERVICES = {
    'predict_subgoal': 'tap_msgs/srv/PredictSubgoal', 'sim/reset': 'tap_msgs/srv/ResetScene',
    'sim/set_goal': 'tap_msgs/srv/SetGoal', 'sim/step': 'tap_msgs/srv/StepScene',
    'sim/pause': 'std_srvs/srv/SetBool', 'recorder/record': 'std_srvs/srv/SetBool'}
if find_spec('simulation_interfaces') is not None:  # no wheel has it
    SERVICES |= {f'sim_node/{name}': f'simulation_interfaces/srv/{kind}' for name, kind in (
        ('get_entities', 'GetEntities'), ('get_entity_state', 'GetEntityState'),
        ('set_entity_state', 'SetEntityState'), ('step_simulation', 'StepSimulation'),
        ('reset_simulation', 'ResetSimulation'), ('set_simulation_state', 'SetSimulationState'))}
ACTION = 'tap_msgs/action/ReachGoal'

NUMBERS = (0.0, -0.0, 1.0, -1.0, 31.5, 63.0, 64.0, 5000.0, -7000.0, 5.4e8, 1e30, -1e308, 5e-324,
           float('inf'), float('-inf'), float('nan'))
TEXTS = ('', 'red', 'green', 'object_0', 'gripper_x', 'push2', 'direct', 'subgoal', 'forward',
         'bidirectional', 'a\nb', '\x1b[31m', 'x' * 1000, '\u202e', '\x00', '(.*)*$', 'a{99999}')


def numbers():
    """Return finite and other floats, extreme ones often."""
    return st.sampled_from(NUMBERS) | st.floats()


def texts():
    """Return strings that can be sent; with control characters."""
    return st.sampled_from(TEXTS) | st.text(st.characters(codec='utf-8'), max_size=12)


def integers(least, most):
    """Return integers of a range, its edges and likely sizes often."""
    likely = [value for value in (0, 1, 2, 3, 48, 64, 101, 192) if value <= most]
    return st.sampled_from([*likely, least, most]) | st.integers(least, most)


def few(values, empty):
    """Return these values, or more often what is left empty."""
    return st.just(empty) | st.just(empty) | values


def images():
    """Return pictures: whole ones, and such whose fields do not fit together."""
    def whole(side, header, value):
        return image_type()(
            header=header, width=side, height=side, encoding=PICTURE_ENCODING, step=3 * side,
            data=array.array('B', [value] * (3 * side * side)))
    encodings = st.sampled_from((*ENCODINGS, MAP_ENCODING)) | texts()
    return st.builds(
        whole, st.sampled_from((64, 64, 1, 16, 65)), messages('std_msgs/msg/Header'),
        st.integers(0, 255)) | built('sensor_msgs/msg/Image', encoding=encodings)


def image_type():
    """Return sensor_msgs/msg/Image."""
    return message_type('sensor_msgs/msg/Image')


def masks():
    """Return robot masks: whole ones, often with values of one, and other pictures."""
    def whole(side, header, values, padding):
        row = (values * side)[:side] + [0] * padding
        return image_type()(header=header, width=side, height=side, encoding=MASK_ENCODING,
                            step=len(row), data=array.array('B', row * side))
    values = st.sampled_from((ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM))
    return st.builds(
        whole, st.sampled_from((64, 64, 1, 65)), messages('std_msgs/msg/Header'),
        st.lists(values | st.integers(0, 255), min_size=1, max_size=4),
        st.integers(0, 2)) | images()


def joint_states():
    """Return the joints of the gripper, of the arm whole and in any order, and any others."""
    likely = st.floats(-3, 3)
    return built(
        'sensor_msgs/msg/JointState',
        name=st.permutations(UR10E.joints).map(list) | st.lists(
            st.sampled_from(GRIPPER_JOINTS + UR10E.joints) | texts(), max_size=6),
        position=st.lists(likely, min_size=6, max_size=6) | st.lists(
            likely | numbers(), max_size=7))


def descriptions():
    """Return robot descriptions: the simulator's, whole or with one word replaced or cut."""
    whole = robot_description(UR10E)
    words = ('', 'mesh', 'sphere', 'world', 'base', 'nan', '1e308', '-1', '0 0 0', '<link/>',
             'shoulder_pan_joint', '&a;', '\x01')

    def spoilt(old, new, times, end):
        return whole.replace(old, new, times)[:end]

    found = sorted(set(whole.replace('"', ' ').replace('<', ' ').split()))
    return built('std_msgs/msg/String', data=st.just(whole) | texts() | st.builds(
        spoilt, st.sampled_from(found), st.sampled_from(words) | texts(), st.integers(1, 3),
        st.just(len(whole)) | st.integers(0, len(whole))))


def objects():
    """Return lists of objects, often with the names of the simulator's, at any pixels."""
    kind, one = (message_type(f'tap_msgs/msg/{name}') for name in ('ObjectStates', 'ObjectState'))
    likely = st.tuples(*[st.builds(one, name=st.just(name), u=numbers(), v=numbers())
                         for name in first_pictures()[0].object_names])
    return st.builds(kind, objects=likely.map(list)) | built('tap_msgs/msg/ObjectStates')


def entity_poses():
    """Return poses: of likely places, and of any numbers."""
    near = st.floats(-0.3, 0.3)
    point = message_type('geometry_msgs/msg/Point')
    return built('geometry_msgs/msg/Pose',
                 position=st.builds(point, x=near, y=near, z=near) | built(
                     'geometry_msgs/msg/Point'))


OWN = {'sensor_msgs/msg/Image': images, MASK: masks, 'sensor_msgs/msg/JointState': joint_states,
       'std_msgs/msg/String': descriptions, 'tap_msgs/msg/ObjectStates': objects,
       'geometry_msgs/msg/Pose': entity_poses}
# But quitting, which ends the node as it should.
STATES = {'simulation_interfaces/msg/SimulationState': {
    'state': st.sampled_from((0, 1, 2, 4, 5, 255))}}


@cache
def messages(name):
    """Return the strategy of a type, such as tap_msgs/srv/ResetScene (its requests)."""
    return OWN[name]() if name in OWN else built(name, **STATES.get(name, {}))


def built(name, /, **likely):
    """Return messages of a type with any fields, but those for which strategies are given."""
    kind = message_type(name)
    parts = {field: _values(text) for field, text in kind.get_fields_and_field_types().items()
             if field not in likely}
    return st.builds(kind, **parts, **likely)


def _values(text):
    """Return the strategy of a field's type, as get_fields_and_field_types writes it."""
    if match := re.fullmatch(r'sequence<(.*?)(?:, \d+)?>', text):
        values = st.lists(_values(match[1]), max_size=4)
        return values.map(lambda data: array.array('B', data)) if match[1] == 'uint8' else values
    if match := re.fullmatch(r'(.*)\[(\d+)\]', text):
        return st.lists(_values(match[1]), min_size=int(match[2]), max_size=int(match[2]))
    if match := re.fullmatch(r'(u?)int(\d+)', text):
        bits = int(match[2])
        return integers(0, 2**bits - 1) if match[1] else integers(-2**(bits - 1),
                                                                  2**(bits - 1) - 1)
    simple = {'double': numbers, 'float': lambda: st.floats(width=32), 'string': texts,
              'boolean': st.booleans, 'octet': lambda: st.binary(min_size=1, max_size=1)}
    if text in simple:
        return simple[text]()
    package, kind = text.split('/')
    return few(messages(f'{package}/msg/{kind}'), message_type(f'{package}/msg/{kind}')())


def message_type(name):
    """Import a type such as sensor_msgs/msg/Image; a service's request, an action's goal."""
    package, kind, last = name.split()[0].split('/')
    found = getattr(import_module(f'{package}.{kind}'), last)
    return {'msg': lambda: found, 'srv': lambda: found.Request,
            'action': lambda: found.Goal}[kind]()


def cases():
    """Return pairs of where to send something and the message; mostly topics."""
    topics = st.one_of([st.tuples(st.just(where), messages(kind))
                        for where, kind in TOPICS.items()])
    calls = st.one_of([st.tuples(st.just(where), messages(kind))
                       for where, kind in [*SERVICES.items(), ('reach_goal', ACTION)]])
    return st.integers(0, 24).flatmap(lambda number: calls if number == 24 else topics)
