# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole loop over DDS: simulate, predict a subgoal, plan, push, record; all of it real."""

from collections import Counter
from pathlib import Path
import sys
import threading

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
from mcap.reader import make_reader
import numpy as np
import pytest
from rclpy.action import ActionClient
from sensor_msgs.msg import Image, JointState
from sim_bridge.simulator import Simulator
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal, ResetScene
from tap_ros.evaluation.planning.episode import run_episode
from tap_ros.evaluation.planning.methods import parse_method
from tap_ros.nodes.clients import call, CallError, Newest, send_goal, wait_for_result
from tap_ros.nodes.image_messages import decode_image, decode_map, encode_image
from tap_ros.nodes.object_messages import decode_objects
from tap_ros.nodes.predictor_node import OVERLAY_SCALE
from tap_ros.nodes.topics import LATCHED, STREAM, to_nanoseconds, to_stamp
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.weights import save_weights
from tap_ros.recording.reader import iter_episodes
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL
import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / 'prediction')]
from lively import lively_network  # noqa: E402
from processes import Client, NodeProcess  # noqa: E402

pytestmark = [pytest.mark.ros, pytest.mark.slow]
SEED = 1_000_003
MODULES = {
    'sim_node': 'sim_bridge.sim_node', 'predictor_node': 'tap_ros.nodes.predictor_node',
    'visual_mpc_node': 'tap_ros.nodes.visual_mpc_node',
    'recorder_node': 'tap_ros.nodes.recorder_node'}


class Loop:
    """All nodes as processes, and a client that knows their topics, services and actions."""

    def __init__(self, node, folder):
        self.node, self.folder, self.processes = node, folder, {}
        self.reset_client = node.create_client(ResetScene, 'sim/reset')
        self.pause_client = node.create_client(SetBool, 'sim/pause')
        self.predict_client = node.create_client(PredictSubgoal, 'predict_subgoal')
        self.reach_client = ActionClient(node, ReachGoal, 'reach_goal')
        self.image = Newest(node, Image, 'camera/image_raw', STREAM)
        self.objects = Newest(node, ObjectStates, 'objects', STREAM)
        self.joints = Newest(node, JointState, 'joint_states', STREAM)
        self.goal_image = Newest(node, Image, 'goal/image', LATCHED)
        self.goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        self.subgoal = Newest(node, Subgoal, 'subgoal', LATCHED)
        self.overlay = Newest(node, Image, 'subgoal/overlay', LATCHED)
        self.twists = []
        node.create_subscription(
            TwistStamped, 'arm/delta_twist_cmds', self.twists.append, STREAM)

    def start(self, name, **parameters):
        self.processes[name] = NodeProcess(
            MODULES[name], self.folder / f'{name}.log', parameters)

    def reset(self, seed=SEED):
        """Start a scene, and wait for what is published at its start."""
        before = to_nanoseconds(self.image.wait(30).header.stamp)  # in lock-step one always comes
        response = call(self.reset_client, ResetScene.Request(task='push2', seed=seed), 30)
        assert response.success, response.message
        image = self.image.wait(30, lambda m: to_nanoseconds(m.header.stamp) > before)
        for topic in (self.objects, self.joints, self.goal_image, self.goal_objects):
            topic.wait(30, lambda m: m.header.stamp == image.header.stamp)
        self.twists.clear()

    def predict(self, **fields):
        return call(self.predict_client, PredictSubgoal.Request(**fields), 60)

    def reach(self, on_feedback=None, **fields):
        """Send a goal and wait for its end."""
        handle = send_goal(self.reach_client, ReachGoal.Goal(**fields), 30, on_feedback)
        return wait_for_result(handle, 300)

    def moves(self):
        """Return the commands (N, 3) so far, without the stops."""
        return np.array([
            [t.twist.linear.x, t.twist.linear.y, t.twist.linear.z]
            for t in list(self.twists) if to_nanoseconds(t.header.stamp)])

    def stopped(self):
        """Tell whether the last command is zero, once it has come."""
        for _ in range(100):
            last = self.twists[-1].twist.linear if self.twists else None
            if last and (last.x, last.y, last.z) == (0, 0, 0):
                return True
            threading.Event().wait(0.05)
        return False


@pytest.fixture(scope='module')
def loop(tmp_path_factory):
    folder = tmp_path_factory.mktemp('loop')
    # With more threads the predictor's last digits differ from process to process.
    with pytest.MonkeyPatch.context() as patch, Client() as node:
        patch.setenv('OMP_NUM_THREADS', '1')
        loop = Loop(node, folder)
        try:
            loop.start('recorder_node', folder=folder / 'bag')
            loop.start('sim_node', lock_step='true')
            loop.start('predictor_node')
            loop.start('visual_mpc_node', image_timeout=4.0)
            for process in loop.processes.values():
                process.wait_for('ready', 120)
            assert loop.predict_client.wait_for_service(30)
            assert loop.reach_client.wait_for_server(30)
            yield loop
        finally:
            for process in loop.processes.values():
                process.kill()


def positions(message):
    return np.array([(o.pose.position.x, o.pose.position.y) for o in message.objects])


def test_an_empty_request_predicts_from_what_was_seen_last(loop):
    loop.reset()
    response = loop.predict()
    assert response.success, response.message
    assert response.model_time_ms > 0
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


def test_recursion_gives_as_many_subgoals_and_a_bad_request_says_why(loop):
    loop.reset()
    start, goal = loop.image.wait(1), loop.goal_image.wait(1)
    objects, goal_objects = loop.objects.wait(1), loop.goal_objects.wait(1)
    asked = {'start': start, 'goal': goal, 'start_objects': objects, 'goal_objects': goal_objects}
    by_hand, empty = loop.predict(**asked), loop.predict()
    assert by_hand.subgoals == empty.subgoals
    assert len(loop.predict(recursion_depth=2, **asked).subgoals) == 2

    def changed(message, **fields):
        copy = type(message)(**{
            name: getattr(message, name) for name in message.get_fields_and_field_types()})
        for name, value in fields.items():
            setattr(copy, name, value)
        return copy

    small = encode_image(np.zeros((32, 48, 3), np.uint8), to_stamp(0), 'camera')
    unknown = ObjectStates(objects=[
        changed(objects.objects[0], u=float('nan')), objects.objects[1]])
    one = ObjectStates(objects=goal_objects.objects[:1])
    name = objects.objects[1].name
    for fields, words in (
            ({'start': changed(start, encoding='yuv422')}, ['start', 'yuv422', 'rgb8', 'bgr8']),
            ({'goal': changed(goal, step=64)}, ['goal', 'step', '64', '192']),
            ({'goal': changed(goal, data=goal.data[:-1])}, ['goal', 'data', '12287', '12288']),
            ({'start': small}, ['start', '64x64', '48x32']),
            ({'start_objects': unknown}, ['start_objects', objects.objects[0].name, 'nan']),
            ({'goal_objects': one}, ['goal_objects', name]),
            ({'num_samples': 1000}, ['num_samples', '1000', '100']),
            ({'recursion_depth': 99}, ['recursion_depth', '99'])):
        response = loop.predict(**{**asked, **fields})
        assert not response.success and not response.subgoals
        for word in words:
            assert word in response.message
        assert loop.predict(**asked).subgoals == by_hand.subgoals


def test_without_objects_there_is_a_picture_but_no_maps(loop):
    loop.reset()
    response = loop.predict(start=loop.image.wait(1))
    assert response.success and 'no object maps' in response.message
    assert response.subgoals[0].image.data and not response.subgoals[0].object_maps


def test_reaching_by_the_subgoal_moves_the_arm_and_an_object(loop):
    loop.reset()
    arm, objects = loop.joints.wait(1), positions(loop.objects.wait(1))
    feedback = []
    budget = 10
    status, result = loop.reach(feedback.append, step_budget=budget, seed=1)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
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


def test_the_nodes_act_as_the_same_classes_do_in_one_process(loop):
    loop.reset()
    status, result = loop.reach(mode='direct', step_budget=3, seed=5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    sim, mpc = Simulator('push2'), VisualMPC.load(FORWARD_MODEL)
    try:
        seen = sim.reset(SEED)
        goals = sim.goal().object_pixels
        mpc.reset(5)
        actions = []
        for _ in range(3):
            plan = mpc.act(seen.image, seen.gripper, seen.object_pixels, goal_pixels=goals)
            actions.append(plan.action[:3])
            seen = sim.step(plan.action)
    finally:
        sim.close()
    assert np.array_equal(loop.moves().astype(np.float32), np.array(actions))


def acts_like(loop, method, weights, **fields):
    """
    Reach a goal by the nodes and in this process, and compare.

    Where a plan is expected to end shows what it was for, as first actions often do not.

    :return: the PlannedEpisode and the stages that feedback told.
    """
    feedback = []
    loop.reset()
    status, result = loop.reach(feedback.append, seed=SEED, **fields)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    sim, mpc = Simulator('push2'), VisualMPC.load(FORWARD_MODEL)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    plans, act = [], mpc.act
    mpc.act = lambda *args, **goal: plans.append(act(*args, **goal)) or plans[-1]
    try:
        run = run_episode(sim, mpc, parse_method(method), fields['step_budget'], SEED,
                          SubgoalPredictor.load(weights))
    finally:
        torch.set_num_threads(threads)
        sim.close()
    assert np.array_equal(loop.moves().astype(np.float32), run.actions[:, :3])
    made = plans[-len(run.actions):]  # before these come plans to choose by
    assert [f.expected_distance for f in feedback] == [p.expected_distance for p in made]
    return run, [f.stage for f in feedback]


def test_the_nodes_go_through_a_chain_as_one_process_does(loop):
    run, stages = acts_like(loop, 'shipped:recursion2', DEFAULT_PREDICTOR, recursion_depth=2,
                            num_samples=3, step_budget=3)  # these weights have but one sample
    assert stages == ['subgoal 1 of 2', 'subgoal 2 of 2', 'goal'] and run.switches == [1, 2]


def test_the_nodes_choose_among_samples_as_one_process_does(loop, tmp_path):
    network = lively_network(image_size=64, latent_size=8)
    weights = tmp_path / 'sampling.safetensors'
    save_weights(weights, network, 'predictor', network.config, {})
    assert loop.processes['predictor_node'].end() == 0
    loop.start('predictor_node', weights=weights)
    try:
        loop.processes['predictor_node'].wait_for('ready', 120)
        run, stages = acts_like(
            loop, 'sampling:samples3', weights, num_samples=3, step_budget=2)
        loop.reset()
        handle = send_goal(loop.reach_client, ReachGoal.Goal(num_samples=100), 30)
        threading.Event().wait(3)  # it would make 200 plans before it moves
        handle.cancel_goal_async()
        status, result = wait_for_result(handle, 20)
        assert status == GoalStatus.STATUS_CANCELED and result.steps == 0
    finally:
        loop.processes['predictor_node'].end()
        loop.start('predictor_node')
        loop.processes['predictor_node'].wait_for('ready', 120)
    assert stages == ['subgoal', 'goal'] and run.subgoals[0].sample > 0


def test_cancelling_stops_the_arm_and_the_next_goal_is_served(loop):
    loop.reset()
    moving = threading.Event()
    handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct', step_budget=40), 30,
                       lambda feedback: moving.set())
    assert moving.wait(120)
    with pytest.raises(CallError, match='rejected'):
        send_goal(loop.reach_client, ReachGoal.Goal(), 30)
    assert 'another goal is in progress' in loop.processes['visual_mpc_node'].text
    handle.cancel_goal_async()
    status, result = wait_for_result(handle, 60)
    assert status == GoalStatus.STATUS_CANCELED
    assert 'cancelled' in result.message and 1 <= result.steps < 40
    assert loop.stopped()
    count = len(loop.twists)
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert len(loop.moves()) == count  # the cancelled goal's, its stop taken off, and one more


@pytest.mark.parametrize('fields, words', [
    ({'mode': 'sideways'}, ['mode', 'sideways', 'subgoal, direct']),
    ({'step_budget': 100_000}, ['step_budget', '100000', '1000']),
    ({'seed': -1}, ['seed', '-1']),
    ({'recursion_depth': 99}, ['/predict_subgoal', 'recursion_depth', '99', '1 to 8']),
    ({'num_samples': 1000}, ['/predict_subgoal', 'num_samples', '1000', '1 to 100']),
    ({'goal_image': Image(width=64, height=64, encoding='nope')}, ['goal', 'nope', 'rgb8']),
])
def test_a_bad_goal_is_aborted_with_the_reason_and_moves_nothing(loop, fields, words):
    loop.reset()
    status, result = loop.reach(**fields)
    assert status == GoalStatus.STATUS_ABORTED and not result.success and result.steps == 0
    for word in words:
        assert word in result.message
    assert loop.stopped() and len(loop.moves()) == 0


def test_when_images_stop_coming_the_arm_is_stopped(loop):
    loop.reset()
    call(loop.pause_client, SetBool.Request(data=True), 10)
    status, result = loop.reach(mode='direct', step_budget=10)
    call(loop.pause_client, SetBool.Request(data=False), 10)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 1
    assert '/camera/image_raw' in result.message
    assert loop.stopped()


def test_when_the_predictor_dies_the_arm_stays_and_the_planner_lives(loop):
    loop.reset()
    loop.processes['predictor_node'].kill()
    status, result = loop.reach(step_budget=4)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert '/predict_subgoal' in result.message
    assert loop.stopped() and len(loop.moves()) == 0
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    loop.start('predictor_node')
    loop.processes['predictor_node'].wait_for('ready', 120)
    for _ in range(100):  # no new image is sent; the newest one comes once it is discovered
        response = loop.predict()
        if response.success:
            break
        assert '/camera/image_raw' in response.message or '/goal/image' in response.message
        threading.Event().wait(0.1)
    assert response.success and response.subgoals[0].object_maps


def test_every_node_ends_cleanly_and_the_bag_holds_every_episode(loop):
    loop.reset()
    assert loop.predict().success
    loop.reset(seed=7)
    status, result = loop.reach(mode='direct', step_budget=2, seed=3)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    moves = loop.moves()
    loop.reset()
    moving = threading.Event()
    send_goal(loop.reach_client, ReachGoal.Goal(mode='direct'), 30, lambda _: moving.set())
    assert moving.wait(120)
    for name in ('visual_mpc_node', 'predictor_node', 'sim_node', 'recorder_node'):
        process = loop.processes[name]
        assert process.end() == 0, process.text
        assert 'Traceback' not in process.text
        assert loop.stopped()
    bag = loop.folder / 'bag'
    counts = Counter()
    for path in bag.glob('*.mcap'):
        with path.open('rb') as stream:
            counts.update(
                channel.topic for _, channel, _ in make_reader(
                    stream, validate_crcs=True).iter_messages())
    for topic in ('/camera/image_raw', '/camera/camera_info', '/objects', '/joint_states',
                  '/clock', '/goal/image', '/goal/objects', '/episode', '/gripper/command',
                  '/arm/delta_twist_cmds', '/subgoal', '/subgoal/image', '/subgoal/overlay'):
        assert counts[topic] > 0
    episodes = list(iter_episodes(bag))
    whole, cut_short = episodes[-2:]
    assert (whole.task, whole.seed, len(whole.frames)) == ('push2', 7, 3)
    assert (cut_short.seed, cut_short.outcome) == (SEED, 'failure')
    assert np.allclose(whole.actions[:2, :3], moves)
    assert whole.frames.std() > 5 and np.isfinite(whole.object_pixels).all()
    assert whole.goal_frame is not None


def test_a_predictor_alone_says_what_is_missing_and_may_resize(tmp_path):
    process = NodeProcess(MODULES['predictor_node'], tmp_path / 'log.txt',
                          {'resize_images': 'true'}, ['-r __ns:=/alone'])
    try:
        with Client() as node:
            client = node.create_client(PredictSubgoal, '/alone/predict_subgoal')
            process.wait_for('ready', 120)
            response = call(client, PredictSubgoal.Request(), 30)
            assert not response.success
            assert 'start' in response.message and '/alone/camera/image_raw' in response.message
            large = np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8)
            image = encode_image(large, to_stamp(0), 'eye')
            response = call(client, PredictSubgoal.Request(start=image), 30)
            assert not response.success
            assert 'goal' in response.message and '/alone/goal/image' in response.message
            response = call(client, PredictSubgoal.Request(start=image, goal=image), 30)
            assert response.success, response.message
            subgoal, = response.subgoals
            assert (subgoal.image.width, subgoal.image.height) == (64, 64)
            assert subgoal.image.header.frame_id == 'eye'
            assert process.end() == 0, process.text
    finally:
        process.kill()


@pytest.mark.parametrize('name', ['predictor_node', 'visual_mpc_node'])
@pytest.mark.parametrize('damage', ['absent', 'truncated', 'text', 'of another kind'])
def test_bad_weights_end_the_start_with_one_line_that_names_the_file(tmp_path, name, damage):
    shipped = {'predictor_node': 'predictor_push2', 'visual_mpc_node': 'forward_model_push'}
    other = shipped['predictor_node' if name == 'visual_mpc_node' else 'visual_mpc_node']
    weights = tmp_path / 'weights.safetensors'
    if damage == 'truncated':
        whole = FORWARD_MODEL.with_name(f'{shipped[name]}.safetensors').read_bytes()
        weights.write_bytes(whole[:len(whole) // 2])
    elif damage == 'text':
        weights.write_text('these are not weights')
    elif damage == 'of another kind':
        weights.write_bytes(FORWARD_MODEL.with_name(f'{other}.safetensors').read_bytes())
    process = NodeProcess(MODULES[name], tmp_path / 'log.txt', {'weights': weights})
    try:
        assert process.process.wait(120) == 1
        line, = [line for line in process.text.splitlines() if line.strip()]
        assert '[FATAL]' in line and str(weights) in line
    finally:
        process.kill()
