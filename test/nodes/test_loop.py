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
from processes import LocalNode, Newest, until
import pytest
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_ros.contract import NODE_MODULES
from tap_ros.errors import TapError
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.messages.images import decode_image, decode_map
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import call, send_goal
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.nodes.planner.plan_view import CHOSEN
from tap_ros.nodes.predictor.node import OVERLAY_SCALE, PredictorNode
from tap_ros.nodes.topics import STREAM
from tap_ros.recording.reader import iter_episodes
from tap_ros.weights import FORWARD_MODEL

pytestmark = pytest.mark.slow


def positions(message):
    return np.array([(o.pose.position.x, o.pose.position.y) for o in message.objects])


def test_an_empty_request_predicts_from_what_was_seen_last(loop):
    loop.reset()
    response = loop.predict()
    assert response.success and response.model_time_ms > 0, response.message
    subgoal, = response.subgoals
    assert subgoal.header.stamp == loop.image.wait(1).header.stamp
    assert decode_image(subgoal.image, 'subgoal', (64, 64)).std() > 5
    assert list(subgoal.object_names) == [o.name for o in loop.objects.wait(1).objects]
    v, u = np.mgrid[:64, :64]
    for message, point in zip(subgoal.object_maps, subgoal.expected_pixels, strict=True):
        values = decode_map(message, 'map')
        assert values.shape == (64, 64) and values.min() >= 0
        assert values.sum() == pytest.approx(1, abs=1e-3)
        assert (values * u).sum() == pytest.approx(point.x, abs=0.01)
        assert (values * v).sum() == pytest.approx(point.y, abs=0.01)
    published = loop.subgoal.wait(10, lambda m: m.header.stamp == subgoal.header.stamp)
    assert published.image.data == subgoal.image.data
    overlay = loop.overlay.wait(10, lambda m: m.header.stamp == subgoal.header.stamp)
    assert (overlay.width, overlay.height) == (64 * OVERLAY_SCALE, 64 * OVERLAY_SCALE)


def test_reaching_by_the_subgoal_moves_the_arm_and_an_object(loop):
    loop.reset()
    arm, objects = loop.joints.wait(1), positions(loop.objects.wait(1))
    feedback = []
    budget = 10
    result = loop.reached(feedback.append, step_budget=budget, seed=1)
    assert result.steps == budget and len(loop.moves()) == budget
    assert [f.step for f in feedback] == list(range(1, budget + 1))
    stages = [f.stage for f in feedback]
    assert stages == sorted(stages, reverse=True) and set(stages) == {'subgoal', 'goal'}
    assert all(f.planning_ms > 0 and np.isfinite(f.expected_distance) for f in feedback)
    assert (np.abs(loop.moves()) <= np.array([0.08, 0.08, 0.15]) + 1e-6).all()
    last = loop.image.wait(10)
    joints = loop.joints.wait(10, lambda m: m.header.stamp == last.header.stamp)
    assert np.abs(np.array(joints.position[:2]) - arm.position[:2]).max() > 0.02
    moved = positions(loop.objects.wait(10, lambda m: m.header.stamp == last.header.stamp))
    assert np.linalg.norm(moved - objects, axis=1).max() > 0.02
    _, pixels = decode_objects(loop.objects.wait(1), 'objects')
    _, goals = decode_objects(loop.goal_objects.wait(1), 'goal_objects')
    assert result.expected_distance == pytest.approx(
        np.linalg.norm(pixels - goals, axis=1).mean(), abs=1e-3)
    assert loop.stopped()
    assert until(lambda: len(loop.distances) > budget)  # the last may come after the result
    assert len(loop.distances) == budget + 1 and loop.distances[-1] == result.expected_distance
    assert loop.distances[0] > loop.distances[-1]


def test_plans_are_drawn_for_whoever_listens(loop):
    loop.reset()
    overlay = Newest(loop.node, Image, 'plan/overlay', STREAM)
    while not overlay.count:  # until the planner knows of the listener
        loop.reached(mode='direct', step_budget=2)
    picture = overlay.wait(10)
    assert picture.header.frame_id == loop.image.wait(1).header.frame_id
    shown = decode_image(picture, 'plan/overlay', (384, 384))
    assert (shown == CHOSEN).all(-1).sum() > 30
    _, goals = decode_objects(loop.goal_objects.wait(1), 'goal_objects')
    for (u, v), colour in zip((6 * (goals + 0.5)).astype(int), OBJECT_COLOURS):
        assert tuple(shown[v, u]) == colour


def test_every_node_tells_how_it_is(loop):
    loop.reset()
    assert loop.predict().success
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
    recorder = loop.node.create_client(SetBool, 'recorder/record')
    call(recorder, SetBool.Request(data=False), 30)
    bag = Path(call(recorder, SetBool.Request(data=True), 30).message.removeprefix(
        'recording to '))
    loop.reset()
    assert loop.predict().success
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
