# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The action reach_goal: the same acts as in one process, limits, and every way to stop."""

from contextlib import suppress
import signal
import threading

from action_msgs.msg import GoalStatus
from lively import lively_network
from loop import acts_like, SEED
import numpy as np
import pytest
from sensor_msgs.msg import Image
from sim_bridge.simulator import Simulator
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_msgs.srv import ResetScene
from tap_ros.nodes.clients import call, CallError, cancel_goal, send_goal, wait_for_result
from tap_ros.nodes.topics import STREAM
from tap_ros.planning.action_sequences import Limits
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.visual_mpc import Memory, VisualMPC
from tap_ros.training.weights import save_weights
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL

pytestmark = pytest.mark.slow


def test_the_nodes_act_as_the_same_classes_do_in_one_process(loop):
    loop.reset()
    status, result = loop.reach(mode='direct', step_budget=3, seed=5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    sim, mpc = Simulator('push2'), VisualMPC.load(FORWARD_MODEL)
    try:
        seen = sim.reset(SEED)
        goal, memory, actions = mpc.goal(sim.goal().object_pixels), Memory(5), []
        for _ in range(3):
            plan = mpc.plan(Scene(seen.image, seen.gripper, seen.object_pixels), goal, memory)
            memory = plan.memory
            actions.append(plan.action[:3])
            seen = sim.step(plan.action)
    finally:
        sim.close()
    assert np.array_equal(loop.moves().astype(np.float32), np.array(actions))


def test_the_nodes_go_through_a_chain_as_one_process_does(loop):
    run, stages = acts_like(loop, 'shipped:recursion2', DEFAULT_PREDICTOR, recursion_depth=2,
                            num_samples=3, step_budget=3)  # these weights have but one sample
    chain = ['subgoal 1 of 2', 'subgoal 2 of 2', 'goal']  # one that is reached already is left out
    assert stages == sorted(stages, key=chain.index) and len(set(stages)) > 1
    assert stages[-1] == 'goal' and run.switches[-1] > 0


def test_the_nodes_predict_again_as_one_process_does(loop):
    with loop.set('visual_mpc_node', subgoal_rounds=2, switch='half'):
        run, stages = acts_like(loop, 'shipped:rounds2:half', DEFAULT_PREDICTOR, step_budget=4)
    assert run.switches == [2, 3] and len(run.subgoals) == 2
    assert stages == ['subgoal', 'subgoal', 'subgoal 2 of 2', 'goal']


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
        handle = send_goal(loop.reach_client, ReachGoal.Goal(num_samples=32), 30)
        threading.Event().wait(3)  # it would make 64 plans before it moves
        cancel_goal(handle)
        status, result = wait_for_result(handle, 20)
        assert status == GoalStatus.STATUS_CANCELED and result.steps == 0
    finally:
        loop.processes['predictor_node'].end()
        loop.start('predictor_node')
        loop.processes['predictor_node'].wait_for('ready', 120)
    assert stages == ['subgoal', 'goal'] and run.subgoals[0].sample > 0


def begin_moving(loop):
    """Start a scene and a goal; return its handle once the arm was moved."""
    loop.reset()
    moving = threading.Event()
    handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct'), 30,
                       lambda feedback: moving.set())
    assert moving.wait(120)
    return handle


def test_cancelling_stops_the_arm_and_the_next_goal_is_served(loop):
    loop.reset()
    moving = threading.Event()
    handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct', step_budget=40), 30,
                       lambda feedback: moving.set())
    assert moving.wait(120)
    with pytest.raises(CallError, match='rejected'):
        send_goal(loop.reach_client, ReachGoal.Goal(), 30)
    assert 'another goal is in progress' in loop.processes['visual_mpc_node'].text
    cancel_goal(handle)
    status, result = wait_for_result(handle, 60)
    assert status == GoalStatus.STATUS_CANCELED
    assert 'cancelled' in result.message and 1 <= result.steps < 40
    assert loop.stopped()
    count = len(loop.moves())
    threading.Event().wait(1.0)
    assert len(loop.moves()) == count == result.steps
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert len(loop.moves()) == count + 1


@pytest.mark.parametrize('fields, words', [
    ({'mode': 'sideways'}, ['mode', 'sideways', 'subgoal, direct']),
    ({'step_budget': 100_000}, ['step_budget', '100000', '1000']),
    ({'seed': -1}, ['seed', '-1']),
    ({'recursion_depth': 99}, ['/predict_subgoal', 'recursion_depth', '99', '1 to 8']),
    ({'num_samples': 1000}, ['num_samples', '1000', 'at most 64']),
    ({'goal_image': Image(width=64, height=64, encoding='nope')}, ['goal', 'nope', 'rgb8']),
])
def test_a_bad_goal_is_aborted_with_the_reason_and_moves_nothing(loop, fields, words):
    loop.reset()
    status, result = loop.reach(**fields)
    assert status == GoalStatus.STATUS_ABORTED and not result.success and result.steps == 0
    for word in words:
        assert word in result.message
    assert loop.stopped() and len(loop.moves()) == 0


@pytest.mark.parametrize('_', range(5))
def test_a_goal_right_after_a_cancel_or_a_reset_is_served(loop, _):
    handle = begin_moving(loop)
    cancel_goal(handle)
    status, _ = wait_for_result(handle, 60)
    assert status == GoalStatus.STATUS_CANCELED
    status, result = loop.reach(mode='direct', step_budget=2)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == 2, result.message
    response = call(loop.reset_client, ResetScene.Request(task='push2', seed=SEED), 30)
    assert response.success
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == 1, result.message


def test_a_reset_during_a_goal_aborts_it(loop):
    handle = begin_moving(loop)
    call(loop.reset_client, ResetScene.Request(task='push2', seed=SEED + 1), 30)
    status, result = wait_for_result(handle, 60)
    assert status == GoalStatus.STATUS_ABORTED and 'the scene has changed' in result.message
    assert loop.stopped()


def test_a_second_camera_during_a_goal_aborts_it(loop):
    handle = begin_moving(loop)
    publisher = loop.node.create_publisher(Image, 'camera/image_raw', STREAM)
    try:
        status, result = wait_for_result(handle, 60)
    finally:
        loop.node.destroy_publisher(publisher)
    assert status == GoalStatus.STATUS_ABORTED
    assert '2 nodes publish on /camera/image_raw' in result.message
    assert loop.stopped()


def test_an_arm_that_refuses_is_waited_for_and_then_the_goal_ends(loop):
    loop.reset()
    call(loop.pause_client, SetBool.Request(data=True), 10)
    try:
        with loop.set('visual_mpc_node', image_timeout=2.0):
            status, result = loop.reach(mode='direct', step_budget=10)
    finally:
        call(loop.pause_client, SetBool.Request(data=False), 10)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert 'refused' in result.message and 'paused' in result.message
    assert loop.stopped()


def test_when_images_stop_coming_the_arm_is_stopped_and_no_goal_begins(loop):
    loop.reset()
    simulator = loop.processes['sim_node'].process
    acting = threading.Event()
    with loop.set('visual_mpc_node', image_timeout=2.0):
        handle = send_goal(loop.reach_client, ReachGoal.Goal(mode='direct', step_budget=10), 30,
                           lambda feedback: acting.set())
        assert acting.wait(60)
        simulator.send_signal(signal.SIGSTOP)
        try:
            status, result = wait_for_result(handle, 60)
            assert status == GoalStatus.STATUS_ABORTED
            assert '/camera/image_raw' in result.message
            assert loop.stopped()
            count = len(loop.moves())
            status, result = loop.reach(mode='direct', step_budget=1)
            assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
            assert '/camera/image_raw' in result.message
            assert len(loop.moves()) == count
        finally:
            simulator.send_signal(signal.SIGCONT)
    # It stood still for longer than DDS keeps it: of what it publishes next, some may be lost.
    with suppress(CallError):
        loop.reset(patience=5.0)
    loop.reset()
    status, result = loop.reach(mode='direct', step_budget=1)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message


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
    assert loop.predictor_alive.wait_until_alive(30)
    loop.wait_until_seen()


def test_a_predictor_that_hangs_is_given_up(loop):
    loop.reset()
    predictor = loop.processes['predictor_node'].process
    predictor.send_signal(signal.SIGSTOP)
    try:
        with loop.set('visual_mpc_node', predictor_timeout=1.0):
            status, result = loop.reach(step_budget=2)
    finally:
        predictor.send_signal(signal.SIGCONT)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert '/predict_subgoal' in result.message
    assert loop.stopped() and len(loop.moves()) == 0


def test_objects_are_followed_as_in_one_process_when_their_pixels_come_once(loop):
    with loop.set('visual_mpc_node', tracking='carried'):
        run, _ = acts_like(loop, 'direct:carried', DEFAULT_PREDICTOR, mode='direct', step_budget=8)
    assert run.tracking_error() > 0  # it was not told where they are


def test_half_of_the_budget_goes_to_the_subgoal_as_in_one_process(loop):
    with loop.set('visual_mpc_node', switch='half', goal_tolerance=30.0):
        feedback = []
        loop.reset()
        status, result = loop.reach(feedback.append, step_budget=4, seed=SEED)
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success and not feedback
    with loop.set('visual_mpc_node', switch='half'):
        run, stages = acts_like(loop, 'shipped:half', DEFAULT_PREDICTOR, step_budget=4)
    assert stages == ['subgoal', 'subgoal', 'goal', 'goal'] and run.switches == [2]


def test_the_planner_keeps_within_the_limits_of_the_parameters(loop):
    loop.reset()
    with loop.set('visual_mpc_node', max_step_xy=0.02, max_step_z=0.04):
        status, result = loop.reach(mode='direct', step_budget=5, seed=5)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    sim, mpc = Simulator('push2'), VisualMPC.load(FORWARD_MODEL)
    try:
        seen, goal = sim.reset(SEED), mpc.goal(sim.goal().object_pixels)
        plan = mpc.plan(Scene(seen.image, seen.gripper, seen.object_pixels), goal, Memory(5),
                        Limits(0.02, 0.04))
    finally:
        sim.close()
    moves = loop.moves().astype(np.float32)
    assert np.array_equal(moves[0], plan.action[:3])  # nothing is cut off what was planned
    assert np.abs(moves[:, :2]).max() <= 0.02 + 1e-6 and np.abs(moves[:, 2]).max() <= 0.04 + 1e-6
    assert np.abs(moves).max() > 0.01


def test_with_a_robot_mask_the_arm_moves_only_where_a_mask_comes(loop):
    assert loop.processes['visual_mpc_node'].end() == 0
    loop.start('visual_mpc_node', ['-r camera/robot_mask:=own_mask'], robot_mask='all',
               image_timeout=2.0)
    masks = loop.node.create_publisher(Image, 'own_mask', STREAM)
    sending = threading.Event()

    def answer(image):
        """Publish a mask for a picture: the robot hides nothing."""
        if sending.is_set():
            message = Image(header=image.header, height=image.height, width=image.width,
                            step=image.width, encoding='mono8',
                            data=bytes(image.height * image.width))
            masks.publish(message)

    images = loop.node.create_subscription(Image, 'camera/image_raw', answer, STREAM)
    try:
        loop.processes['visual_mpc_node'].wait_for('ready', 120)
        loop.reset()
        status, result = loop.reach(mode='direct', step_budget=2)
        assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
        assert '/own_mask' in result.message
        assert loop.stopped()
        sending.set()
        loop.reset()
        status, result = loop.reach(mode='direct', step_budget=2)
        assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == 2, result.message
    finally:
        loop.node.destroy_subscription(images)
        loop.node.destroy_publisher(masks)
        loop.processes['visual_mpc_node'].end()
        loop.start('visual_mpc_node')
        loop.processes['visual_mpc_node'].wait_for('ready', 120)
