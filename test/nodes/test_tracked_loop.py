# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole path from clicks and a goal picture alone: no node is told the truth."""

from loop import Loop, SEED
import numpy as np
from processes import NodeProcess, until
import pytest
from sensor_msgs.msg import Image
from sim_bridge.simulator import Simulator
from tap_msgs.msg import ObjectStates
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.ros_messages import encode_objects
from tap_ros.nodes.topics import STREAM

pytestmark = pytest.mark.slow
PULLED = [word for topic in ('truth/objects', 'truth/goal/objects')
          for word in ('-r', f'{topic}:=pulled_away/{topic}')]


@pytest.fixture(scope='module')
def first():
    """Return what a user sees of the scene, and where the clicks go."""
    simulator = Simulator('push2')
    yield simulator.reset(SEED)
    simulator.close()


def test_clicks_and_a_goal_picture_are_enough_and_objects_in_doubt_stop_the_arm(
        tmp_path, client, first):
    loop = Loop(client, tmp_path)
    loop.processes['sim_node'] = NodeProcess('sim_node', tmp_path / 'sim.log', {
        'lock_step': True, 'seed': SEED, 'objects': 'tracked'}, PULLED)
    try:
        loop.start('tracker_node')
        loop.start('predictor_node')
        loop.start('visual_mpc_node', image_timeout=10.0)
        for process in loop.processes.values():
            process.wait_for('ready', 120)
        assert not client.count_publishers('truth/objects')
        clicks = dict(zip(first.object_names, first.object_pixels.tolist()))

        def selected():
            try:
                loop.client.select(clicks)
            except CallError:  # no picture has come yet
                return False
            return True
        assert until(selected)
        told = loop.goal_objects.wait(30)
        assert list(told.states) == ['seen', 'seen'] and told.source == 'tracked'
        assert loop.reach_client.wait_for_server(30)
        loop.wait_until_seen()
        result = loop.reached(step_budget=3, seed=SEED)
        assert result.steps == 3 and len(loop.moves()) == 3 and loop.stopped()

        told.states[0] = 'lost'
        result = loop.begin(goal_objects=told, step_budget=3, mode='direct').result()
        assert result.end == 'aborted' and 'object_0 not found' in result.message
        assert not result.steps and len(loop.moves()) == 3

        assert loop.processes['tracker_node'].end() == 0
        assert 'Traceback' not in loop.processes['tracker_node'].text
        says = client.create_publisher(ObjectStates, 'objects', STREAM)
        states = ['seen', 'hidden']

        def answer(image):
            says.publish(encode_objects(
                clicks, np.array(list(clicks.values())), np.full((2, 7), np.nan),
                image.header.stamp, '', ObjectStates.SOURCE_TRACKED, states))
        client.create_subscription(Image, 'camera/image_raw', answer, STREAM)
        assert until(lambda: client.count_publishers('objects') == 1)
        fields = {'mode': 'direct', 'step_budget': 1000, 'goal_objects': encode_objects(
            clicks, np.full((2, 2), 30.0), np.full((2, 7), np.nan), told.header.stamp, '',
            ObjectStates.SOURCE_TRACKED)}
        for state, steps in (('unsure', 2), ('lost', 1)):
            states[1] = 'hidden'

            def doubt(feedback, state=state):
                states[1] = state
            result = loop.begin(doubt, **fields).result()
            assert result.end == 'aborted' and result.steps >= steps
            assert f'object_1 {"is " * (state == "unsure")}{state}' in result.message
            assert loop.stopped()
    finally:
        for process in loop.processes.values():
            process.end()
