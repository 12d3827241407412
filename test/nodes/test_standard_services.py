# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator's services of simulation_interfaces: what they promise, and that pausing holds."""

from copy import deepcopy
import re
import threading

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped, Vector3
import numpy as np
from processes import Client, Newest, NodeProcess
import pytest
from rclpy.action import ActionClient
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool
from tap_msgs.msg import CommandRefused, Episode, ObjectStates
from tap_msgs.srv import ResetScene, StepScene
from tap_ros.contract import CONTROL_PERIOD
from tap_ros.messages.joints import decode_gripper
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import call, cancel_goal, send_goal, wait_for_future, wait_for_result
from tap_ros.nodes.topics import STREAM

srv = pytest.importorskip('simulation_interfaces.srv', reason='no simulation_interfaces here')
from simulation_interfaces.action import SimulateSteps  # noqa: E402
from simulation_interfaces.msg import (  # noqa: E402
    Bounds,
    EntityCategory,
    EntityFilters,
    EntityState,
    Result,
    SimulationState,
    SimulatorFeatures,
    TagsFilter,
)

PERIOD_NS = round(CONTROL_PERIOD * 1e9)
OK, FAILED = Result.RESULT_OK, Result.RESULT_OPERATION_FAILED
UNSUPPORTED, NOT_FOUND = Result.RESULT_FEATURE_UNSUPPORTED, Result.RESULT_NOT_FOUND
INVALID_POSE, ALREADY = 101, 101
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
SEED = 4  # its objects are of two kinds


class Rig:
    """A simulator process, its standard services by name, and topics that show what happens."""

    def __init__(self, node, process):
        self.node, self.process = node, process
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.objects = Newest(node, ObjectStates, 'objects', STREAM)
        self.joints = Newest(node, JointState, 'joint_states', STREAM)
        self.refused = Newest(node, CommandRefused, 'arm/refused', STREAM)
        self.marks = []
        node.create_subscription(Episode, 'episode', self.marks.append, STREAM)
        self.twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
        self.gripper = node.create_publisher(Float64, 'gripper/command', STREAM)
        self.own = {name: node.create_client(kind, f'sim/{name}') for name, kind in (
            ('reset', ResetScene), ('step', StepScene), ('pause', SetBool))}
        self.clients = {name: node.create_client(kind, f'sim_node/{name}') for name, kind in (
            ('get_simulator_features', srv.GetSimulatorFeatures),
            ('get_entities', srv.GetEntities), ('get_entities_states', srv.GetEntitiesStates),
            ('get_entity_state', srv.GetEntityState), ('get_entity_info', srv.GetEntityInfo),
            ('get_entity_bounds', srv.GetEntityBounds),
            ('set_entity_state', srv.SetEntityState), ('reset_simulation', srv.ResetSimulation),
            ('get_simulation_state', srv.GetSimulationState),
            ('set_simulation_state', srv.SetSimulationState),
            ('step_simulation', srv.StepSimulation))}
        self.steps = ActionClient(node, SimulateSteps, 'sim_node/simulate_steps')

    def ask(self, name, **fields):
        """Call a standard service, and have an answer."""
        client = self.clients[name]
        return call(client, client.srv_type.Request(**fields), 30)

    def code(self, name, words='', **fields):
        """Return the code of an answer that says why it is not OK."""
        result = self.ask(name, **fields).result
        assert words in result.error_message and (result.result == OK or result.error_message)
        assert '\n' not in result.error_message and len(result.error_message) < 500
        return result.result

    def set_state(self, state):
        return self.code('set_simulation_state', state=SimulationState(state=state))

    def state(self):
        return self.ask('get_simulation_state').state.state

    def stamp(self):
        """Return the stamp of the moment in ns, by a service that lets no time pass."""
        return to_nanoseconds(self.ask(
            'get_entity_state', entity='object_0').state.header.stamp)

    def begin(self, state=PAUSED):
        """Have the first scene at its start."""
        self.set_state(STOPPED)
        assert self.code('reset_simulation') == OK
        if state != STOPPED:
            assert self.set_state(state) == OK
        return self.seen(self.stamp())

    def seen(self, stamp):
        """Return picture, objects and joints of a stamp, once they have come."""
        return [topic.wait(20, lambda m: to_nanoseconds(m.header.stamp) == stamp)
                for topic in (self.image, self.objects, self.joints)]

    def command(self, header, **move):
        """Send a command for arm and gripper."""
        message = TwistStamped(header=header)
        message.twist.linear = Vector3(**move)
        self.gripper.publish(Float64(data=1.0))
        self.twist.publish(message)

    def reach(self, steps, on_feedback=None):
        return send_goal(self.steps, SimulateSteps.Goal(steps=steps), 30, on_feedback)


@pytest.fixture(scope='module', params=['real time', 'lock-step'])
def rig(request, tmp_path_factory):
    process = NodeProcess(
        'sim_node', tmp_path_factory.mktemp('sim') / 'log.txt',
        {'seed': SEED, 'lock_step': str(request.param == 'lock-step').lower()})
    try:
        with Client() as node:
            rig = Rig(node, process.wait_for('ready'))
            rig.lock_step = request.param == 'lock-step'
            assert all(c.wait_for_service(20) for c in [*rig.clients.values(), *rig.own.values()])
            assert rig.steps.wait_for_server(20)
            yield rig
        assert not re.search('Traceback|RuntimeWarning', process.text), process.text
    finally:
        process.kill()


def test_features_are_those_of_the_services_that_are_there(rig):
    features = set(rig.ask('get_simulator_features').features.features)
    offered = {kind.split('/')[-1] for _, kinds in rig.node.get_service_names_and_types_by_node(
        'sim_node', '/') for kind in kinds if kind.startswith('simulation_interfaces/')}
    for feature, kind in (
            ('SPAWNING', 'SpawnEntity'), ('DELETING', 'DeleteEntity'),
            ('NAMED_POSES', 'GetNamedPoses'), ('POSE_BOUNDS', 'GetNamedPoseBounds'),
            ('ENTITY_TAGS', 'GetEntities'), ('ENTITY_BOUNDS', 'GetEntityBounds'),
            ('ENTITY_STATE_GETTING', 'GetEntityState'),
            ('ENTITY_STATE_SETTING', 'SetEntityState'), ('ENTITY_INFO_GETTING', 'GetEntityInfo'),
            ('ENTITY_INFO_SETTING', 'SetEntityInfo'), ('SPAWNABLES', 'GetSpawnables'),
            ('SIMULATION_RESET', 'ResetSimulation'),
            ('SIMULATION_STATE_GETTING', 'GetSimulationState'),
            ('SIMULATION_STATE_SETTING', 'SetSimulationState'),
            ('STEP_SIMULATION_SINGLE', 'StepSimulation'),
            ('STEP_SIMULATION_ACTION', 'SimulateSteps_SendGoal'),
            ('WORLD_LOADING', 'LoadWorld'), ('WORLD_INFO_GETTING', 'GetCurrentWorld')):
        assert (getattr(SimulatorFeatures, feature) in features) == (kind in offered), feature
    assert not features & {SimulatorFeatures.SIMULATION_RESET_TIME,
                           SimulatorFeatures.SIMULATION_RESET_SPAWNED,
                           SimulatorFeatures.ENTITY_BOUNDS_CONVEX}


def test_entities_are_the_objects_where_the_topic_has_them(rig):
    *_, objects, _ = rig.begin()
    answer = rig.ask('get_entities_states')
    assert answer.result.result == OK
    assert list(answer.entities) == [o.name for o in objects.objects] == ['object_0', 'object_1']
    for name, state, told in zip(answer.entities, answer.states, objects.objects):
        assert (state.header, state.pose) == (objects.header, told.pose)
        assert rig.ask('get_entity_state', entity=name).state == state
        bounds, info = (rig.ask(f'get_entity_{what}', entity=name) for what in ('bounds', 'info'))
        highest, lowest = bounds.bounds.points
        assert bounds.bounds.type == Bounds.TYPE_BOX
        assert highest.z == -lowest.z == 0.03 and 0.02 < highest.x < 0.15 and -0.15 < lowest.y < 0
        assert info.info.category.category == EntityCategory.CATEGORY_OBJECT
        assert list(info.info.tags) == [info.info.description.split(',')[0]]
    for what in ('state', 'info', 'bounds'):
        assert rig.code(f'get_entity_{what}', 'object_0, object_1', entity='\x1bcup') == NOT_FOUND


def test_entities_are_filtered_by_all_filters_together(rig):
    rig.begin()
    states = rig.ask('get_entities_states').states
    place = states[1].pose.position
    tags = [rig.ask('get_entity_info', entity=f'object_{i}').info.tags[0] for i in range(2)]

    def found(**fields):
        answers = [rig.ask(name, filters=EntityFilters(**fields))
                   for name in ('get_entities', 'get_entities_states')]
        assert answers[0].result == answers[1].result
        assert answers[0].entities == answers[1].entities
        assert len(answers[1].states) == len(answers[1].entities)
        code = answers[0].result.result
        return list(answers[0].entities) if code == OK else code

    def around(kind, *points):
        return Bounds(type=kind, points=[
            Vector3(x=float(x), y=float(y), z=float(z)) for x, y, z in points])

    nan = float('nan')
    assert tags[0] != tags[1]
    both, one = ['object_0', 'object_1'], ['object_1']
    centre = (place.x, place.y, place.z)
    ball = around(Bounds.TYPE_SPHERE, centre, (0.01, nan, nan))
    robots = EntityCategory(category=EntityCategory.CATEGORY_ROBOT)
    for fields, wanted in (
            ({}, both), ({'filter': '[1-9]$'}, one), ({'filter': 'cup'}, []),
            ({'filter': '('}, FAILED), ({'filter': '(a{9}){9}'}, FAILED),
            ({'categories': [EntityCategory(), robots]}, both), ({'categories': [robots]}, []),
            ({'tags': TagsFilter(tags=['x', tags[1]])}, one),
            ({'tags': TagsFilter(tags=['x', tags[1]], filter_mode=1)}, []),
            ({'tags': TagsFilter(tags=[tags[1]], filter_mode=1), 'filter': '1'}, one),
            ({'tags': TagsFilter(tags=[tags[1]]), 'filter': '0'}, []),
            ({'tags': TagsFilter(tags=[tags[1]], filter_mode=2)}, UNSUPPORTED),
            ({'bounds': ball}, one), ({'bounds': ball, 'categories': [robots]}, []),
            ({'bounds': around(Bounds.TYPE_SPHERE, (1e308, 0, 0), (1, 0, 0))}, []),
            ({'bounds': around(Bounds.TYPE_BOX, (1, 1, 1), (-1, -1, -1))}, both),
            ({'bounds': around(Bounds.TYPE_BOX, centre, centre)}, one),
            ({'bounds': around(Bounds.TYPE_BOX, (9, 9, 9), (8, 8, 8))}, []),
            ({'bounds': around(Bounds.TYPE_BOX, (-1, 1, 1), (1, -1, -1))}, FAILED),
            ({'bounds': around(Bounds.TYPE_BOX, (nan, 1, 1), (-1, -1, -1))}, FAILED),
            ({'bounds': around(Bounds.TYPE_SPHERE, centre)}, FAILED),
            ({'bounds': around(Bounds.TYPE_SPHERE, centre, (-1, 0, 0))}, FAILED),
            ({'bounds': around(Bounds.TYPE_SPHERE, centre, (nan, 0, 0))}, FAILED),
            ({'bounds': around(Bounds.TYPE_CONVEX_HULL, centre, centre, centre)}, UNSUPPORTED),
            ({'bounds': Bounds(type=77)}, UNSUPPORTED)):
        assert found(**fields) == wanted, fields


def test_an_entity_that_is_put_elsewhere_is_seen_there(rig):
    before, *_ = rig.begin()
    state = rig.ask('get_entity_state', entity='object_1').state
    state.header.stamp.sec += 99  # does not count
    state.pose.position.x, state.pose.position.y = -0.3, 0.3
    assert rig.code('set_entity_state', entity='object_1', state=state) == OK
    stamp = rig.stamp()
    assert 0 < stamp - to_nanoseconds(before.header.stamp) < PERIOD_NS
    image, objects, _ = rig.seen(stamp)
    assert objects.objects[1].pose == state.pose and image.data != before.data
    assert rig.code('step_simulation', steps=1) == OK
    again = rig.ask('get_entity_state', entity='object_1').state
    assert again.pose.position.x == pytest.approx(-0.3, abs=1e-3)
    state = EntityState(pose=again.pose)
    state.pose.position.z = 0.2
    state.twist.linear.x = 0.5
    assert rig.code('set_entity_state', entity='object_1', state=state) == OK
    assert rig.ask('get_entity_state', entity='object_1').state.twist.linear.x == 0.5
    assert rig.code('step_simulation', steps=4) == OK
    fallen = rig.ask('get_entity_state', entity='object_1').state.pose.position
    assert fallen.z < 0.1 and fallen.x > -0.25


def test_an_absurd_state_is_refused_and_nothing_changes(rig):
    rig.begin()
    whole = rig.ask('get_entities_states')
    taken = whole.states[0].pose.position

    def changed(**fields):
        state = deepcopy(whole.states[1])
        state.pose.position.x, state.pose.position.y = -0.3, 0.3
        for path, value in fields.items():
            *names, last = path.split('__')
            target = state
            for name in names:
                target = getattr(target, name)
            setattr(target, last, value)
        return state

    for fields, code, words in (
            ({'pose__position__x': float('nan')}, INVALID_POSE, 'finite'),
            ({'pose__position__x': 1e308}, INVALID_POSE, 'out of reach'),
            ({'pose__position__z': -0.5}, INVALID_POSE, 'out of reach'),
            ({'pose__position__z': 0.01}, INVALID_POSE, 'the table'),
            ({'pose__position__x': taken.x, 'pose__position__y': taken.y}, INVALID_POSE,
             'object_0'),
            ({'pose__orientation__w': 5.0}, INVALID_POSE, 'quaternion'),
            ({'pose__orientation__w': -1e308}, INVALID_POSE, 'quaternion'),
            ({'twist__linear__z': float('inf')}, FAILED, 'velocity'),
            ({'twist__angular__z': 1e308}, FAILED, 'velocity'),
            ({'header__frame_id': 'camera_optical_frame'}, UNSUPPORTED, 'world')):
        assert rig.code('set_entity_state', words, entity='object_1',
                        state=changed(**fields)) == code
    assert rig.code('set_entity_state', entity='object_7', state=changed()) == NOT_FOUND
    assert rig.ask('get_entities_states') == whole
    assert rig.code('set_entity_state', entity='object_1', state=changed()) == OK


def test_steps_pass_only_when_paused_and_as_many_as_were_asked_for(rig):
    *_, joints = rig.begin()
    first = rig.stamp()
    for steps in (1, 3):
        assert rig.code('step_simulation', steps=steps) == OK
    assert rig.stamp() == first + 4 * PERIOD_NS and rig.state() == PAUSED
    for steps in (0, 101, 10**12, 2**64 - 1):
        assert rig.code('step_simulation', f'{steps}; expected 1 to 100', steps=steps) == FAILED
    *_, after = rig.seen(first + 4 * PERIOD_NS)
    np.testing.assert_allclose(decode_gripper(after), decode_gripper(joints), atol=1e-3)
    assert rig.stamp() == first + 4 * PERIOD_NS
    assert rig.set_state(PLAYING) == OK
    assert rig.code('step_simulation', 'is playing', steps=1) == FAILED
    rig.set_state(STOPPED)
    assert rig.code('step_simulation', 'is stopped', steps=1) == FAILED


def test_the_action_steps_and_tells_of_each_step(rig):
    rig.begin()
    first, told = rig.stamp(), []
    last = threading.Event()

    def on_feedback(feedback):
        told.append((feedback.completed_steps, feedback.remaining_steps))
        if feedback.remaining_steps == 0:
            last.set()

    status, result = wait_for_result(rig.reach(8, on_feedback), 60)
    assert (status, result.result.result) == (GoalStatus.STATUS_SUCCEEDED, OK)
    assert rig.stamp() == first + 8 * PERIOD_NS and rig.state() == PAUSED
    assert last.wait(20) and told == [(i, 8 - i) for i in range(1, 9)]
    for steps in (0, 100_001, 10**12):
        status, result = wait_for_result(rig.reach(steps), 60)
        assert status == GoalStatus.STATUS_ABORTED and result.result.result == FAILED
        assert f'{steps}; expected 1 to' in result.result.error_message
    rig.set_state(PLAYING)
    status, result = wait_for_result(rig.reach(1), 60)
    assert status == GoalStatus.STATUS_ABORTED and 'is playing' in result.result.error_message


def test_many_steps_keep_nobody_waiting_and_can_be_ended(rig):
    for end, words in (
            (lambda handle: wait_for_future(cancel_goal(handle), 20), 'cancelled'),
            (lambda _: rig.set_state(PLAYING) == OK, 'set playing'),
            (lambda _: rig.set_state(STOPPED) == OK, 'was reset'),
            (lambda _: rig.code('reset_simulation') == OK, 'was reset'),
            (lambda _: call(rig.own['reset'], ResetScene.Request(seed=SEED), 20).success,
             'was reset'),
            (lambda _: call(rig.own['pause'], SetBool.Request(data=False), 20).success,
             'set playing')):
        rig.begin()
        first = rig.stamp()
        handle = rig.reach(100_000)
        rig.image.wait(20, lambda m, first=first: to_nanoseconds(m.header.stamp) > first)
        assert rig.state() == PAUSED
        assert rig.code('step_simulation', 'in progress', steps=1) == FAILED
        status, result = wait_for_result(rig.reach(1), 60)
        assert status == GoalStatus.STATUS_ABORTED
        assert 'in progress' in result.result.error_message
        assert end(handle)
        status, result = wait_for_result(handle, 60)
        assert status == (GoalStatus.STATUS_CANCELED if words == 'cancelled'
                          else GoalStatus.STATUS_ABORTED)
        message = result.result.error_message
        assert result.result.result == FAILED and words in message
        done = int(re.search(r'after (\d+) of 100000 steps', message)[1])
        assert words != 'cancelled' or rig.stamp() == first + done * PERIOD_NS
    # It was the last: others follow.
    rig.begin()
    assert wait_for_result(rig.reach(1), 60)[0] == GoalStatus.STATUS_SUCCEEDED


def test_states_are_those_of_the_own_services_too(rig):
    rig.begin()
    assert rig.state() == PAUSED and rig.set_state(PAUSED) == ALREADY
    assert call(rig.own['pause'], SetBool.Request(data=False), 20).success
    assert rig.state() == PLAYING and rig.set_state(PLAYING) == ALREADY
    assert call(rig.own['pause'], SetBool.Request(data=True), 20).success
    assert rig.state() == PAUSED
    assert rig.set_state(STOPPED) == OK and rig.state() == STOPPED
    assert rig.set_state(STOPPED) == ALREADY
    assert rig.set_state(PAUSED) == OK and rig.set_state(STOPPED) == OK
    assert call(rig.own['step'], StepScene.Request(), 20).success
    assert rig.state() == PAUSED, 'no longer at its start'
    assert rig.set_state(STOPPED) == OK
    assert rig.code('reset_simulation') == OK and rig.state() == STOPPED
    assert call(rig.own['reset'], ResetScene.Request(seed=SEED + 1), 20).success
    assert rig.state() == PAUSED, 'another scene'
    assert rig.set_state(STOPPED) == OK
    state = rig.ask('get_entity_state', entity='object_0').state
    state.pose.position.z += 0.05
    assert rig.code('set_entity_state', entity='object_0', state=state) == OK
    assert rig.state() == PAUSED, 'another place'
    for state in (SimulationState.STATE_NO_WORLD, SimulationState.STATE_LOADING_WORLD, 200):
        assert rig.set_state(state) == UNSUPPORTED
    assert rig.state() == PAUSED
    assert rig.set_state(PLAYING) == OK


def test_a_reset_starts_the_first_or_the_present_scene_and_no_clock_goes_back(rig):
    def places():
        return [(s.pose.position.x, s.pose.position.y)
                for s in rig.ask('get_entities_states').states]

    rig.begin()
    first = places()
    assert call(rig.own['reset'], ResetScene.Request(task='push3', seed=9), 20).success
    other, stamp = places(), rig.stamp()
    assert len(other) == 3 and rig.state() == PAUSED
    for scope, wanted in ((2, other), (255, first), (2, first), (0, first)):
        assert rig.code('step_simulation', steps=1) == OK
        assert rig.code('reset_simulation', scope=scope) == OK
        assert np.allclose(places(), wanted, atol=1e-9) and rig.state() == PAUSED
        assert rig.stamp() == stamp + 2 * PERIOD_NS
        stamp = rig.stamp()
    for scope in (1, 4, 3, 6, 8, 254):
        assert rig.code('reset_simulation', 'clock', scope=scope) == UNSUPPORTED
    assert call(rig.own['reset'], ResetScene.Request(seed=9), 20).success
    assert rig.set_state(STOPPED) == OK and np.allclose(places(), first, atol=1e-9)
    start = rig.marks[-1]
    assert (start.event, start.seed) == (Episode.START, SEED)


def test_paused_nothing_moves_and_no_command_is_made_up_for(rig):
    image, _, joints = rig.begin()
    before = decode_gripper(joints)
    rig.command(image.header, x=0.08)
    rig.process.wait_for('gripper/command ignored: the simulation is paused')
    assert 'paused' in rig.refused.wait(20, lambda m: m.header == image.header).message
    # Two requests wait for one that takes long; the command comes while the first of them is
    # carried out, and so is taken after the second, with which time passes again.
    stamp = rig.stamp()
    step, play = rig.clients['step_simulation'], rig.clients['set_simulation_state']
    request = srv.StepSimulation.Request(steps=100)
    waiting = [step.call_async(request)]
    rig.image.wait(30, lambda m: to_nanoseconds(m.header.stamp) > stamp + PERIOD_NS)
    waiting.append(step.call_async(request))
    waiting.append(play.call_async(srv.SetSimulationState.Request(
        state=SimulationState(state=PLAYING))))
    newest = rig.image.wait(
        30, lambda m: to_nanoseconds(m.header.stamp) > stamp + 105 * PERIOD_NS)
    rig.command(newest.header, x=0.08)
    assert all(wait_for_future(future, 60) for future in waiting)
    assert all(future.result().result.result == OK for future in waiting)
    assert 'paused' in rig.refused.wait(20, lambda m: m.header == newest.header).message
    if not rig.lock_step:
        rig.image.wait(30, lambda m: to_nanoseconds(m.header.stamp) > stamp + 205 * PERIOD_NS)
    assert rig.set_state(PAUSED) == OK
    *_, joints = rig.seen(rig.stamp())
    np.testing.assert_allclose(decode_gripper(joints), before, atol=1e-3)


@pytest.mark.parametrize('rig', ['lock-step'], indirect=True)
def test_what_was_commanded_before_a_pause_is_not_made_up_for_after_it(rig):
    *_, joints = rig.begin(PLAYING)
    rig.gripper.publish(Float64(data=1.0))
    assert call(rig.own['pause'], SetBool.Request(data=True), 20).success
    assert rig.code('step_simulation', steps=2) == OK
    assert rig.set_state(PLAYING) == OK
    assert call(rig.own['step'], StepScene.Request(num_periods=2), 20).success
    *_, after = rig.seen(rig.stamp())
    np.testing.assert_allclose(decode_gripper(after), decode_gripper(joints), atol=1e-3)


def test_playing_commands_move_the_arm_again(rig):
    image, _, joints = rig.begin(PLAYING)
    sign = -float(np.sign(decode_gripper(joints)[0]))
    for _ in range(20):  # in real time a command may be late
        image = rig.image.wait(20, lambda m, old=image: rig.lock_step or m is not old)
        rig.command(image.header, x=0.05 * sign)
        last = to_nanoseconds(image.header.stamp)
        after = rig.joints.wait(20, lambda m, last=last: to_nanoseconds(m.header.stamp) > last)
        if sign * (decode_gripper(after) - decode_gripper(joints))[0] > 0.03:
            return
    raise AssertionError('the arm does not move')


@pytest.mark.parametrize('rig', ['lock-step'], indirect=True)
def test_in_lock_step_a_command_for_what_was_seen_before_is_refused(rig):
    image, *_ = rig.begin(PLAYING)
    state = rig.ask('get_entity_state', entity='object_1').state
    state.pose.position.x, state.pose.position.y = -0.3, 0.3
    assert rig.code('set_entity_state', entity='object_1', state=state) == OK
    rig.command(image.header, x=0.05)
    refused = rig.refused.wait(20, lambda m: m.header == image.header)
    assert 'the newest is stamped' in refused.message


@pytest.mark.parametrize('stepping', [False, True])
def test_quitting_is_answered_then_the_episode_and_the_process_end(tmp_path, stepping):
    process = NodeProcess('sim_node', tmp_path / 'log.txt', {}, ['-r __ns:=/quitting'])
    try:
        with Client(namespace='/quitting') as node:
            rig = Rig(node, process.wait_for('ready'))
            rig.image.wait(30)
            if stepping:
                assert rig.set_state(PAUSED) == OK
                first = rig.stamp()
                rig.reach(100_000)
                rig.image.wait(20, lambda m: to_nanoseconds(m.header.stamp) > first)
            assert rig.set_state(QUITTING) == OK
            assert process.process.wait(20) == 0, process.text
            assert 'Traceback' not in process.text
            assert rig.marks[-1].event == Episode.END
    finally:
        process.kill()
