# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole path from clicks and a goal picture alone: no node is told the truth."""

from driven import first_pictures, SEED, select
from loop import Loop
from processes import NodeProcess, until
import pytest
from tap_ros.base.contract import CAMERA_SIZE

pytestmark = pytest.mark.slow
PULLED = [word for topic in ('truth/objects', 'truth/goal/objects')
          for word in ('-r', f'{topic}:=pulled_away/{topic}')]


def test_clicks_and_a_goal_picture_are_enough(tmp_path, client):
    assert until(lambda: 'visual_mpc_node' not in client.get_node_names()), 'of an earlier test'
    loop, (first, _) = Loop(client, tmp_path), first_pictures(CAMERA_SIZE)
    loop.processes['sim_node'] = NodeProcess('sim_node', tmp_path / 'sim.log', {
        'lock_step': True, 'seed': SEED, 'objects': 'tracked'}, PULLED)
    try:
        loop.start('tracker_node')
        loop.start('predictor_node')
        loop.start('visual_mpc_node', image_timeout=10.0, preset='quick')
        for process in loop.processes.values():
            process.wait_for('ready', 120)
        assert not client.count_publishers('truth/objects')
        clicks = dict(zip(first.object_names, first.object_pixels.tolist()))
        select(loop.client, clicks)
        told = loop.goal_objects.wait(30)
        assert list(told.states) == ['seen', 'seen'] and told.source == 'tracked'
        assert loop.client.goals.action.wait_for_server(30)
        loop.wait_until_seen()
        result = loop.reached(step_budget=3, seed=SEED)
        assert result.steps == 3 and len(loop.moves()) == 3 and loop.stopped()

        told.states[0] = 'lost'
        result = loop.begin(goal_objects=told, step_budget=3, mode='direct').result()
        assert result.end == 'aborted' and 'object_0 not found' in result.message
        assert not result.steps and len(loop.moves()) == 3
    finally:
        for process in loop.processes.values():
            process.end()
