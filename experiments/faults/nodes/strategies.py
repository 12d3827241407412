# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hypothesis strategies for everything that the nodes take: as plain dicts, then as messages."""

import array
from importlib import import_module
from importlib.util import find_spec

from experiments.faults.nodes.world import first_pictures
from hypothesis import strategies as st
from sim_bridge.world.robot_description import robot_description
from tap_ros.contract import (
    ENCODINGS,
    GRIPPER_JOINTS,
    MAP_ENCODING,
    MASK_ENCODING,
    PICTURE_ENCODING,
    ROBOT_MASK_ARM,
    ROBOT_MASK_FREE,
    ROBOT_MASK_HAND,
)
from tap_ros.errors import TapError
from tap_ros.robots.ur10e import JOINTS

MASK = 'sensor_msgs/Image mask'  # what comes after a blank tells strategies apart
TOPICS = {
    'camera/image_raw': 'sensor_msgs/Image', 'objects': 'tap_msgs/ObjectStates',
    'joint_states': 'sensor_msgs/JointState', 'goal/image': 'sensor_msgs/Image',
    'goal/objects': 'tap_msgs/ObjectStates', 'arm/delta_twist_cmds': 'geometry_msgs/TwistStamped',
    'gripper/command': 'std_msgs/Float64', 'episode': 'tap_msgs/Episode',
    'arm/command_timeout': 'std_msgs/Float64', 'arm/refused': 'tap_msgs/CommandRefused',
    'predictor_node/heartbeat': 'std_msgs/Header', 'clock': 'rosgraph_msgs/Clock',
    'camera/camera_info': 'sensor_msgs/CameraInfo', 'camera/robot_mask': MASK,
    'goal/robot_mask': MASK, 'observer/image_raw': 'sensor_msgs/Image',
    'robot_description': 'std_msgs/String', 'predictor_node/model_card': 'std_msgs/String'}
LATCHED_TOPICS = ('goal/image', 'goal/objects', 'goal/robot_mask', 'robot_description',
                  'arm/command_timeout', 'predictor_node/model_card')
SERVICES = {
    'predict_subgoal': 'tap_msgs/srv/PredictSubgoal', 'sim/reset': 'tap_msgs/srv/ResetScene',
    'sim/set_goal': 'tap_msgs/srv/SetGoal', 'sim/step': 'tap_msgs/srv/StepScene',
    'sim/pause': 'std_srvs/srv/SetBool',
    'recorder/record': 'std_srvs/srv/SetBool'}
if find_spec('simulation_interfaces') is not None:  # no wheel has it
    SERVICES |= {f'sim_node/{name}': f'simulation_interfaces/srv/{kind}' for name, kind in (
        ('get_entities', 'GetEntities'), ('get_entity_state', 'GetEntityState'),
        ('set_entity_state', 'SetEntityState'), ('step_simulation', 'StepSimulation'),
        ('reset_simulation', 'ResetSimulation'),
        ('set_simulation_state', 'SetSimulationState'))}
ACTION = 'reach_goal'

UINT8, UINT32, UINT64 = 2**8 - 1, 2**32 - 1, 2**64 - 1
NUMBERS = (0.0, -0.0, 1.0, -1.0, 31.5, 63.0, 64.0, 5000.0, -7000.0, 5.4e8, 1e30, -1e308, 5e-324,
           float('inf'), float('-inf'), float('nan'))
TEXTS = ('', 'red', 'green', 'gripper_x', 'push2', 'direct', 'subgoal', 'forward', 'a\nb',
         '\x1b[31m', 'x' * 1000, '\u202e', '\x00')


def numbers():
    """Return finite and other floats, extreme ones often."""
    return st.sampled_from(NUMBERS) | st.floats()


def texts():
    """Return strings that can be sent; with control characters."""
    return st.sampled_from(TEXTS) | st.text(st.characters(codec='utf-8'), max_size=12)


def counts(most):
    """Return integers from 0 to `most`, the edges often."""
    return st.sampled_from((0, 1, 2, 3, 48, 64, 192, most)) | st.integers(0, most)


def stamps():
    """Return stamps, extreme ones often."""
    return st.fixed_dictionaries({
        'sec': st.sampled_from((0, 1, -1, 2**31 - 1, -2**31)) | st.integers(0, 100),
        'nanosec': st.sampled_from((0, 1, 10**9 - 1, UINT32))})


def headers():
    """Return headers with any stamp."""
    return st.fixed_dictionaries({'stamp': stamps(), 'frame_id': texts()})


def vectors():
    """Return three numbers x, y, z."""
    return st.fixed_dictionaries({axis: numbers() for axis in 'xyz'})


def images():
    """Return pictures: whole ones, and such whose fields do not fit together."""
    def whole(side, header, value):
        return {'header': header, 'width': side, 'height': side, 'encoding': PICTURE_ENCODING,
                'step': 3 * side, 'data': [value] * (3 * side * side)}
    return st.builds(whole, st.sampled_from((64, 64, 1, 16, 65)), headers(),
                     st.integers(0, UINT8)) | st.fixed_dictionaries({
                         'header': headers(), 'width': counts(UINT32), 'height': counts(UINT32),
                         'encoding': st.sampled_from((*ENCODINGS, MAP_ENCODING)) | texts(),
                         'step': counts(UINT32), 'is_bigendian': counts(UINT8),
                         'data': st.lists(st.integers(0, UINT8), max_size=12)})


def masks():
    """Return robot masks: whole ones, often with values of one, and other pictures."""
    def whole(side, header, values, padding):
        row = (values * side)[:side] + [0] * padding
        return {'header': header, 'width': side, 'height': side, 'encoding': MASK_ENCODING,
                'step': len(row), 'data': row * side}
    values = st.sampled_from((ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM))
    return st.builds(
        whole, st.sampled_from((64, 64, 1, 65)), headers(),
        st.lists(values | st.integers(0, UINT8), min_size=1, max_size=4),
        st.integers(0, 2)) | images()


def joint_states():
    """Return the joints of the gripper, of the arm whole and in any order, and any others."""
    names = st.permutations(JOINTS) | st.lists(
        st.sampled_from(GRIPPER_JOINTS + JOINTS) | texts(), max_size=6)
    likely = st.floats(-3, 3)
    return st.fixed_dictionaries({
        'header': headers(), 'name': names.map(list),
        'position': st.lists(likely, min_size=6, max_size=6) | st.lists(
            likely | numbers(), max_size=7),
        'velocity': st.lists(numbers(), max_size=2)})


def descriptions():
    """Return robot descriptions: the simulator's, whole or with one word replaced or cut."""
    whole = robot_description()
    words = ('', 'mesh', 'sphere', 'world', 'base', 'nan', '1e308', '-1', '0 0 0', '<link/>',
             'shoulder_pan_joint', '&a;', '\x01')

    def spoilt(old, new, times, end):
        return whole.replace(old, new, times)[:end]

    found = sorted(set(whole.replace('"', ' ').replace('<', ' ').split()))
    return st.fixed_dictionaries({'data': st.just(whole) | texts() | st.builds(
        spoilt, st.sampled_from(found), st.sampled_from(words) | texts(), st.integers(1, 3),
        st.just(len(whole)) | st.integers(0, len(whole)))})


def likely_objects():
    """Return lists with the names that the simulator's objects have, at any pixels."""
    names = first_pictures()[0].object_names
    return st.lists(numbers(), min_size=2 * len(names), max_size=2 * len(names)).map(
        lambda pixels: {'objects': [
            {'name': name, 'u': u, 'v': v}
            for name, u, v in zip(names, pixels[::2], pixels[1::2])]})


def objects():
    """Return lists of objects."""
    pose = st.fixed_dictionaries({'position': st.fixed_dictionaries(
        {axis: numbers() for axis in 'xyz'})})
    return st.fixed_dictionaries({'header': headers(), 'source': texts(), 'objects': st.lists(
        st.fixed_dictionaries({'name': texts(), 'u': numbers(), 'v': numbers(), 'pose': pose}),
        max_size=4)})


def entities():
    """Return names of objects, often of one that is there."""
    return st.sampled_from(('object_0', 'object_1')) | texts()


def filters():
    """Return filters of entities."""
    points = st.lists(vectors(), max_size=3)
    return st.fixed_dictionaries({
        'filter': st.sampled_from(('', 'object', '(', '(.*)*$', 'a{99999}')) | texts(),
        'tags': st.fixed_dictionaries({
            'tags': st.lists(texts(), max_size=2), 'filter_mode': counts(UINT8)}),
        'bounds': st.fixed_dictionaries({
            'type': st.integers(0, 4) | counts(UINT8), 'points': points})})


def entity_states():
    """Return states of entities: likely places, and any numbers."""
    places = st.fixed_dictionaries({axis: st.floats(-0.3, 0.3) for axis in 'xyz'})
    return st.fixed_dictionaries({
        'header': few(headers(), {}), 'pose': st.fixed_dictionaries({
            'position': places | vectors(),
            'orientation': st.sampled_from(({}, {'w': 0.0})) | vectors()}),
        'twist': few(st.fixed_dictionaries({'linear': vectors(), 'angular': vectors()}), {})})


def few(values, empty):
    """Return these values, or more often what is left empty."""
    return st.just(empty) | st.just(empty) | values


def fields(type_name):
    """Return the strategy of a type, for its fields as a dict."""
    vector = vectors()
    amounts = st.sampled_from((0, 1, 2, 0, 1, 101, UINT32))
    request = {'num_samples': amounts, 'recursion_depth': amounts,
               'seed': st.sampled_from((0, 1, 2, -1, 2**63 - 1, -2**63)),
               'mode': st.sampled_from(('', 'direct', 'subgoal', 'bidirectional')) | texts()}
    return {
        'sensor_msgs/Image': images(), 'tap_msgs/ObjectStates': objects(),
        MASK: masks(), 'std_msgs/String': descriptions(),
        'sensor_msgs/JointState': joint_states(),
        'geometry_msgs/TwistStamped': st.fixed_dictionaries({
            'header': headers(), 'twist': st.fixed_dictionaries(
                {'linear': vector, 'angular': few(vector, {})})}),
        'std_msgs/Float64': st.fixed_dictionaries({'data': numbers()}),
        'tap_msgs/CommandRefused': st.fixed_dictionaries({
            'header': headers(), 'message': texts()}),
        'std_msgs/Header': headers(),
        'rosgraph_msgs/Clock': st.fixed_dictionaries({'clock': stamps()}),
        'sensor_msgs/CameraInfo': st.fixed_dictionaries({
            'header': headers(), 'height': counts(UINT32), 'width': counts(UINT32),
            'distortion_model': texts(), 'd': st.lists(numbers(), max_size=8),
            'k': st.lists(numbers(), min_size=9, max_size=9)}),
        'tap_msgs/Episode': st.fixed_dictionaries({
            'header': headers(), 'event': counts(UINT8), 'task': texts(),
            'seed': counts(UINT64), 'outcome': texts()}),
        'tap_msgs/srv/PredictSubgoal': st.fixed_dictionaries({
            **request, 'start': few(images(), {}), 'goal': few(images(), {}),
            'start_objects': few(objects(), {}) | likely_objects(),
            'goal_objects': few(objects(), {}) | likely_objects()}),
        'tap_msgs/srv/ResetScene': st.fixed_dictionaries({
            'task': texts(), 'seed': counts(UINT64), 'hide_arm': st.booleans()}),
        'tap_msgs/srv/SetGoal': st.fixed_dictionaries({'objects': objects() | likely_objects()}),
        'tap_msgs/srv/StepScene': st.fixed_dictionaries({'num_periods': counts(UINT32)}),
        'simulation_interfaces/srv/GetEntities': st.fixed_dictionaries({'filters': filters()}),
        'simulation_interfaces/srv/GetEntityState': st.fixed_dictionaries({'entity': entities()}),
        'simulation_interfaces/srv/SetEntityState': st.fixed_dictionaries({
            'entity': entities(), 'state': entity_states()}),
        'simulation_interfaces/srv/StepSimulation': st.fixed_dictionaries({
            'steps': counts(UINT64)}),
        'simulation_interfaces/srv/ResetSimulation': st.fixed_dictionaries({
            'scope': st.sampled_from((0, 1, 2, 4, UINT8)) | counts(UINT8)}),
        'simulation_interfaces/srv/SetSimulationState': st.fixed_dictionaries({
            'state': st.fixed_dictionaries({  # but quitting
                'state': st.sampled_from((0, 1, 2, 4, 5, UINT8))})}),
        'std_srvs/srv/SetBool': st.fixed_dictionaries({'data': st.booleans()}),
        ACTION: st.fixed_dictionaries({
            **request, 'step_budget': amounts, 'goal_image': few(images(), {}),
            'goal_objects': few(objects(), {}) | likely_objects()})}[type_name]


def cases():
    """Return pairs of where to send something and its fields; mostly topics."""
    topics = st.one_of([st.tuples(st.just(name), fields(kind)) for name, kind in TOPICS.items()])
    calls = st.one_of([st.tuples(st.just(name), fields(kind)) for name, kind in
                       [*SERVICES.items(), (ACTION, ACTION)]])
    return st.integers(0, 24).flatmap(lambda number: calls if number == 24 else topics)


def message_type(name):
    """Import a type such as sensor_msgs/Image or tap_msgs/srv/ResetScene."""
    name = name.split()[0]
    if name == ACTION:
        from tap_msgs.action import ReachGoal
        return ReachGoal
    package, *kind, last = name.split('/')
    try:
        return getattr(import_module(f'{package}.{kind[0] if kind else "msg"}'), last)
    except (ImportError, AttributeError) as error:
        raise TapError(f'{name}: no such type is installed') from error


def fill(message, values):
    """Put fields given as nested dicts into a message, and return it."""
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif value and isinstance(value, list) and isinstance(value[0], dict):
            element = message_type(types[name].removeprefix('sequence<').rstrip('>'))
            setattr(message, name, [fill(element(), item) for item in value])
        elif types[name] == 'sequence<uint8>':
            setattr(message, name, array.array('B', value))
        else:
            setattr(message, name, value)
    return message
