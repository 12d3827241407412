# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole loop over DDS: simulate, predict a subgoal, plan, push, record; all of it real."""

from collections import Counter
from pathlib import Path
import re

from diagnostic_msgs.msg import DiagnosticArray
from loop import SEED
from mcap.reader import make_reader
import numpy as np
from processes import LocalNode, until
import pytest
from tap_msgs.action import ReachGoal
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import send_goal
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.nodes.predictor.node import PredictorNode
from tap_ros.nodes.topics import STREAM
from tap_ros.recording.reader import iter_episodes
from tap_ros.weights import FORWARD_MODEL

pytestmark = pytest.mark.slow


def test_every_node_tells_how_it_is(loop):
    loop.reset()
    loop.client.call('predict')
    told = {}
    loop.node.create_subscription(
        DiagnosticArray, '/diagnostics',
        lambda array: told.update({status.name: status for status in array.status}), STREAM)
    wanted = [*(f'{name}: service' for name in NODE_MODULES
                if name not in ('robot_mask_node', 'explorer_node')),
              'visual_mpc_node: /joint_states', 'predictor_node: /goal/image',
              'sim_node: /arm/delta_twist_cmds', 'recorder_node: /objects']
    assert until(lambda: all(name in told for name in wanted))
    told = {name: {pair.key: pair.value for pair in told[name].values} for name in wanted}
    assert told['visual_mpc_node: /joint_states']['status'] == 'OK'
    assert float(told['recorder_node: /objects']['rate_hz']) > 1  # sent again in lock-step
    assert told['predictor_node: service']['queue'] == '0'
    assert float(told['predictor_node: service']['predict_subgoal p50_ms']) > 0


def test_every_node_ends_cleanly_and_the_bag_holds_every_episode(loop):
    loop.client.record(False)
    bag = Path(loop.client.record().removeprefix('recording to '))
    loop.reset()
    loop.client.call('predict')
    loop.reset(seed=7)
    loop.reached(mode='direct', step_budget=2, seed=3)
    moves = loop.moves()
    loop.reset()
    begin = to_nanoseconds(loop.image.wait(30).header.stamp)
    send_goal(loop.reach_client, ReachGoal.Goal(mode='direct'), 30)
    # A step was made: the stop that the planner sends when it ends may overtake a command.
    loop.image.wait(120, lambda m: to_nanoseconds(m.header.stamp) > begin)
    for name in ('visual_mpc_node', 'predictor_node', 'sim_node', 'recorder_node'):
        process = loop.processes[name]
        assert process.end() == 0, process.text
        assert 'Traceback' not in process.text
        assert loop.stopped()
    counts = Counter()
    for path in bag.glob('*.mcap'):
        with path.open('rb') as stream:
            counts.update(
                channel.topic for _, channel, _ in make_reader(
                    stream, validate_crcs=True).iter_messages())
    for topic in ('/camera/image_raw', '/camera/camera_info', '/objects', '/joint_states',
                  '/clock', '/goal/image', '/goal/objects', '/episode', '/gripper/command',
                  '/arm/delta_twist_cmds', '/subgoal', '/subgoal/image', '/subgoal/overlay',
                  '/plan/distance', '/predictor_node/model_card', '/visual_mpc_node/model_card'):
        assert counts[topic] > 0
    episodes = list(iter_episodes(bag))
    whole, cut_short = episodes[-2:]
    assert (whole.task, whole.seed, len(whole.frames)) == ('push2', 7, 3)
    assert (cut_short.seed, cut_short.outcome) == (SEED, 'failure')
    assert np.allclose(whole.actions[:2, :3], moves)
    assert whole.frames.std() > 5 and np.isfinite(whole.object_pixels).all()
    assert whole.goal_frame is not None


def test_bad_weights_are_refused_by_an_error_that_names_the_file(tmp_path):
    weights = tmp_path / 'weights.safetensors'
    for make, shipped, other in (
            (PredictorNode, 'predictor_push2', 'forward_model_push'),
            (VisualMpcNode, 'forward_model_push', 'predictor_push2')):
        own, others = (FORWARD_MODEL.with_name(f'{name}.safetensors').read_bytes()
                       for name in (shipped, other))
        for content in (None, own[:len(own) // 2], b'these are not weights', others):
            weights.unlink(missing_ok=True)
            if content is not None:
                weights.write_bytes(content)
            with pytest.raises(TapError, match=re.escape(str(weights))):
                LocalNode(make, weights=weights)
