# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator's services of simulation_interfaces: what they promise."""

from copy import deepcopy
from operator import attrgetter
import re

from made_bags import decode_gripper
import numpy as np
from processes import Client, NodeProcess
import pytest
from tap_msgs.msg import Episode
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import call
from test_sim_node import PERIOD_NS
from test_sim_node import Rig as SimRig

srv = pytest.importorskip('simulation_interfaces.srv', reason='no simulation_interfaces here')
from simulation_interfaces.msg import (  # noqa: E402
    EntityFilters,
    Result,
    SimulationState,
    SimulatorFeatures,
)

OK, FAILED = Result.RESULT_OK, Result.RESULT_OPERATION_FAILED
UNSUPPORTED, NOT_FOUND = Result.RESULT_FEATURE_UNSUPPORTED, Result.RESULT_NOT_FOUND
INVALID_POSE, ALREADY = 101, 101
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
SEED = 4


class Rig(SimRig):
    """Also its standard services, by name."""

    def __init__(self, node, process):
        super().__init__(node, process)
        self.clients = {name: node.create_client(
            getattr(srv, name.title().replace('_', '')), f'sim_node/{name}') for name in (
                'get_simulator_features', 'get_entities', 'get_entities_states',
                'get_entity_state', 'set_entity_state', 'reset_simulation',
                'get_simulation_state', 'set_simulation_state', 'step_simulation')}
        assert all(client.wait_for_service(20) for client in self.clients.values())

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

    def begin(self):
        """Have the first scene at its start, paused; return picture, objects and joints."""
        self.set_state(STOPPED)
        assert self.code('reset_simulation') == self.set_state(PAUSED) == OK
        return self.seen(self.stamp())

    def seen(self, stamp):
        """Return picture, objects and joints of a stamp, once they have come."""
        return [topic.wait(20, lambda m: to_nanoseconds(m.header.stamp) == stamp)
                for topic in (self.image, self.objects, self.joints)]


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    process = NodeProcess(
        'sim_node', tmp_path_factory.mktemp('sim') / 'log.txt',
        {'seed': SEED, 'lock_step': True})
    try:
        with Client() as node:
            rig = Rig(node, process.wait_for('ready'))
            yield rig
            # Quitting is answered, then the episode and the process end.
            assert rig.set_state(QUITTING) == OK
            assert process.process.wait(20) == 0, process.text
            assert rig.marks[-1].event == Episode.END
        assert not re.search('Traceback|RuntimeWarning', process.text), process.text
    finally:
        process.end()


def test_features_are_those_of_the_services_that_are_there(rig):
    features = set(rig.ask('get_simulator_features').features.features)
    offered = {kind.split('/')[-1] for _, kinds in rig.node.get_service_names_and_types_by_node(
        'sim_node', '/') for kind in kinds if kind.startswith('simulation_interfaces/')}
    for feature, kind in (
            ('SPAWNING', 'SpawnEntity'), ('ENTITY_STATE_GETTING', 'GetEntityState'),
            ('ENTITY_STATE_SETTING', 'SetEntityState'), ('SIMULATION_RESET', 'ResetSimulation'),
            ('SIMULATION_STATE_SETTING', 'SetSimulationState'),
            ('STEP_SIMULATION_SINGLE', 'StepSimulation')):
        assert (getattr(SimulatorFeatures, feature) in features) == (kind in offered), feature


def test_entities_are_the_objects_where_the_topic_has_them(rig):
    *_, objects, _ = rig.begin()
    answer = rig.ask('get_entities_states')
    assert answer.result.result == OK
    assert list(answer.entities) == [o.name for o in objects.objects] == ['object_0', 'object_1']
    assert rig.ask('get_entities').entities == answer.entities
    for name, state, told in zip(answer.entities, answer.states, objects.objects):
        assert (state.header, state.pose) == (objects.header, told.pose)
        assert rig.ask('get_entity_state', entity=name).state == state
    assert rig.code('get_entity_state', 'object_0, object_1', entity='\x1bcup') == NOT_FOUND
    filters = EntityFilters(filter='[1-9]$')
    assert rig.code('get_entities', 'expected none', filters=filters) == UNSUPPORTED


def test_an_entity_that_is_put_elsewhere_is_seen_there_and_an_absurd_state_is_refused(rig):
    before, *_ = rig.begin()
    whole = rig.ask('get_entities_states')
    free = deepcopy(whole.states[1])
    free.header.stamp.sec += 99  # does not count
    free.pose.position.x, free.pose.position.y = -0.3, 0.3
    for place, value, code, words in (
            ('pose.position.x', float('nan'), INVALID_POSE, 'finite'),
            ('twist.linear.z', float('inf'), FAILED, 'velocity'),
            ('header.frame_id', 'camera_optical_frame', UNSUPPORTED, 'world')):
        state = deepcopy(free)
        within, _, field = place.rpartition('.')
        setattr(attrgetter(within)(state), field, value)
        assert rig.code('set_entity_state', words, entity='object_1', state=state) == code
    assert rig.code('set_entity_state', entity='object_7', state=free) == NOT_FOUND
    assert rig.ask('get_entities_states') == whole
    assert rig.code('set_entity_state', entity='object_1', state=free) == OK
    stamp = rig.stamp()
    assert 0 < stamp - to_nanoseconds(before.header.stamp) < PERIOD_NS
    image, objects, _ = rig.seen(stamp)
    assert objects.objects[1].pose == free.pose and image.data != before.data
    assert rig.set_state(PLAYING) == OK
    rig.send(x=0.05, stamp=before.header.stamp)  # for what was seen before
    assert 'the newest is stamped' in rig.refusals.wait(
        20, lambda m: m.header.stamp == before.header.stamp).message
    assert rig.set_state(PAUSED) == OK


def test_steps_pass_only_when_paused_and_as_many_as_were_asked_for(rig):
    *_, joints = rig.begin()
    first = rig.stamp()
    for steps in (1, 3):
        assert rig.code('step_simulation', steps=steps) == OK
    assert rig.stamp() == first + 4 * PERIOD_NS and rig.state() == PAUSED
    for steps in (0, 101, 2**64 - 1):
        assert rig.code('step_simulation', f'{steps}; expected 1 to 100', steps=steps) == FAILED
    *_, after = rig.seen(first + 4 * PERIOD_NS)
    np.testing.assert_allclose(decode_gripper(after), decode_gripper(joints), atol=1e-3)
    for state, word in ((PLAYING, 'playing'), (STOPPED, 'stopped')):
        assert rig.set_state(state) == OK
        assert rig.code('step_simulation', f'is {word}', steps=1) == FAILED


def test_states_are_those_of_the_own_services_too(rig):
    rig.begin()
    assert rig.state() == PAUSED and rig.set_state(PAUSED) == ALREADY
    rig.client.pause(False)
    assert rig.state() == PLAYING and rig.set_state(PLAYING) == ALREADY
    assert rig.set_state(STOPPED) == OK and rig.set_state(STOPPED) == ALREADY
    rig.step(1)
    assert rig.state() == PAUSED, 'no longer at its start'
    assert rig.set_state(STOPPED) == OK
    assert rig.code('reset_simulation') == OK and rig.state() == STOPPED
    rig.reset(seed=SEED + 1)
    assert rig.state() == PAUSED, 'another scene'
    for state in (SimulationState.STATE_NO_WORLD, SimulationState.STATE_LOADING_WORLD, 200):
        assert rig.set_state(state) == UNSUPPORTED
    assert rig.state() == PAUSED


def test_a_reset_starts_the_first_or_the_present_scene_and_no_clock_goes_back(rig):
    def places():
        return [(s.pose.position.x, s.pose.position.y)
                for s in rig.ask('get_entities_states').states]

    rig.begin()
    first = places()
    rig.reset(task='push3', seed=9)
    other, stamp = places(), rig.stamp()
    assert len(other) == 3 and rig.state() == PAUSED
    for scope, wanted in ((2, other), (255, first), (2, first), (0, first)):
        assert rig.code('step_simulation', steps=1) == OK
        assert rig.code('reset_simulation', scope=scope) == OK
        assert np.allclose(places(), wanted, atol=1e-9) and rig.state() == PAUSED
        assert rig.stamp() == stamp + 2 * PERIOD_NS
        stamp = rig.stamp()
    for scope in (1, 4, 3, 254):
        assert rig.code('reset_simulation', 'clock', scope=scope) == UNSUPPORTED
    start = rig.marks[-1]
    assert (start.event, start.seed) == (Episode.START, SEED)
