# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The action reach_goal: the same acts as in one process, limits, and every way to stop."""

from contextlib import suppress
import signal
import threading

from action_msgs.msg import GoalStatus
from lifecycle import Lifecycle
from lively import lively_network
from loop import acts_like, SEED
import numpy as np
from processes import Newest
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool
from tap_msgs.action import ReachGoal
from tap_msgs.srv import ResetScene
from tap_ros.nodes.calls import call, CallError, cancel_goal, send_goal
from tap_ros.nodes.topics import LATCHED, STREAM
from tap_ros.training.weights import save_weights, stored_digest
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL

pytestmark = pytest.mark.slow


def served(loop, steps=1):
    """Check that a goal is served now, as soon as the machine lets the planner go on."""
    for _ in range(3):
        status, result = loop.reach(mode='direct', step_budget=steps)
        if 'stood still' not in result.message:
            break
    assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == steps, result.message


def aborted(loop, *words, moves=False, **fields):
    """Check that a goal is aborted for this reason before a step, or even a command."""
    count = len(loop.moves())
    status, result = loop.reach(**fields)
    assert status == GoalStatus.STATUS_ABORTED and not result.success and result.steps == 0
    assert all(word in result.message for word in words), result.message
    assert loop.stopped() and (moves or len(loop.moves()) == count)


# The same acts as in one process


def test_the_nodes_go_directly_as_one_process_does_and_within_limits(loop):
    acts_like(loop, 'direct', DEFAULT_PREDICTOR, mode='direct', step_budget=3)
    with loop.set('visual_mpc_node', max_step_xy=0.02, max_step_z=0.04):
        loop.reset()
        loop.reached(mode='direct', step_budget=2, seed=5)
    limit = np.array([0.02, 0.02, 0.04])
    assert (np.abs(loop.moves()) <= limit + 1e-6).all()
    assert (np.abs(loop.moves()).max(0) > 0.5 * limit).any(), 'it plans within them'


def test_the_nodes_go_by_subgoals_as_one_process_does(loop):
    run, stages = acts_like(loop, 'shipped:recursion2', DEFAULT_PREDICTOR, recursion_depth=2,
                            num_samples=3, step_budget=3)  # these weights have but one sample
    chain = ['subgoal 1 of 2', 'subgoal 2 of 2', 'goal']  # one that is reached already is left out
    assert stages == sorted(stages, key=chain.index) and len(set(stages)) > 1
    assert stages[-1] == 'goal' and run.switches[-1] > 0
    with loop.set('visual_mpc_node', subgoal_rounds=2, switch='half'):
        run, stages = acts_like(loop, 'shipped:rounds2:half', DEFAULT_PREDICTOR, step_budget=4)
    assert run.switches == [2, 3] and len(run.subgoals) == 2
    assert stages == ['subgoal', 'subgoal', 'subgoal 2 of 2', 'goal']
    with loop.set('visual_mpc_node', switch='half', goal_tolerance=30.0):
        feedback = []
        loop.reset()
        result = loop.reached(feedback.append, step_budget=4, seed=SEED)
    assert result.success and not feedback


def test_the_nodes_choose_among_samples_as_one_process_does(loop, tmp_path):
    network = lively_network(image_size=64, latent_size=8)
    weights = tmp_path / 'sampling.safetensors'
    save_weights(weights, network, 'predictor', network.config, {})
    loop.use_weights('predictor_node', weights)
    try:
        run, stages = acts_like(
            loop, 'sampling:samples3', weights, num_samples=3, step_budget=2)
        loop.reset()
        handle = send_goal(loop.reach_client, ReachGoal.Goal(num_samples=32), 30)
        threading.Event().wait(1)  # it would make 64 plans before it moves
        cancel_goal(handle)
        assert loop.ended(handle, GoalStatus.STATUS_CANCELED).steps == 0
    finally:
        loop.use_weights('predictor_node', DEFAULT_PREDICTOR)
    assert stages == ['subgoal', 'goal'] and run.subgoals[0].sample > 0


def test_objects_are_followed_as_in_one_process_when_their_pixels_come_once(loop):
    with loop.set('visual_mpc_node', tracking='carried'):
        run, _ = acts_like(loop, 'direct:carried', DEFAULT_PREDICTOR, mode='direct', step_budget=5)
    assert run.tracking_error() > 0  # it was not told where they are


# Every way to end

def test_a_bad_goal_is_aborted_with_the_reason_and_moves_nothing(loop):
    loop.reset()
    for fields, words in (
            ({'mode': 'sideways'}, ['mode', 'sideways', 'subgoal, direct']),
            ({'step_budget': 100_000}, ['step_budget', '100000', '1000']),
            ({'seed': -1}, ['seed', '-1']),
            ({'recursion_depth': 99}, ['/predict_subgoal', 'recursion_depth', '99', '1 to 8']),
            ({'num_samples': 1000}, ['num_samples', '1000', 'at most 64']),
            ({'goal_image': Image(width=64, height=64, encoding='nope')},
             ['goal', 'nope', 'rgb8'])):
        aborted(loop, *words, **fields)


def test_cancelling_stops_the_arm_and_the_next_goal_is_served(loop):
    handle = loop.begin_moving(step_budget=40)
    with pytest.raises(CallError, match='rejected'):
        send_goal(loop.reach_client, ReachGoal.Goal(), 30)
    assert 'another goal is in progress' in loop.processes['visual_mpc_node'].text
    cancel_goal(handle)
    result = loop.ended(handle, GoalStatus.STATUS_CANCELED, 'cancelled')
    assert 1 <= result.steps < 40
    count = len(loop.moves())
    threading.Event().wait(0.6)  # more than two control periods
    assert len(loop.moves()) == count == result.steps
    served(loop)  # right after a cancel, and right after a reset
    assert call(loop.reset_client, ResetScene.Request(task='push2', seed=SEED), 30).success
    served(loop)


def test_another_scene_or_camera_during_a_goal_aborts_it(loop):
    handle = loop.begin_moving()
    call(loop.reset_client, ResetScene.Request(task='push2', seed=SEED + 1), 30)
    loop.ended(handle, GoalStatus.STATUS_ABORTED, 'the scene has changed')
    handle = loop.begin_moving()
    publisher = loop.node.create_publisher(Image, 'camera/image_raw', STREAM)
    try:
        loop.ended(handle, GoalStatus.STATUS_ABORTED, '2 nodes publish on /camera/image_raw')
    finally:
        loop.node.destroy_publisher(publisher)


def test_an_arm_that_refuses_is_waited_for_and_then_the_goal_ends(loop):
    loop.reset()
    call(loop.pause_client, SetBool.Request(data=True), 10)
    try:
        with loop.set('visual_mpc_node', image_timeout=2.0):
            aborted(loop, 'refused', 'paused', mode='direct', step_budget=10, moves=True)
    finally:
        call(loop.pause_client, SetBool.Request(data=False), 10)


def test_when_images_stop_coming_the_arm_is_stopped_and_no_goal_begins(loop):
    simulator = loop.processes['sim_node'].process
    with loop.set('visual_mpc_node', image_timeout=2.0):
        handle = loop.begin_moving(step_budget=10)
        simulator.send_signal(signal.SIGSTOP)
        try:
            loop.ended(handle, GoalStatus.STATUS_ABORTED, '/camera/image_raw')
            aborted(loop, '/camera/image_raw', mode='direct', step_budget=1)
        finally:
            simulator.send_signal(signal.SIGCONT)
    # It stood still for longer than DDS keeps it: of what it publishes next, some may be lost.
    with suppress(CallError):
        loop.reset(patience=5.0)
    loop.reset()
    served(loop)


def test_when_the_predictor_hangs_or_dies_the_arm_stays_and_the_planner_lives(loop):
    loop.reset()
    predictor = loop.processes['predictor_node'].process
    predictor.send_signal(signal.SIGSTOP)
    try:
        with loop.set('visual_mpc_node', predictor_timeout=1.0):
            aborted(loop, '/predict_subgoal', step_budget=2)
    finally:
        predictor.send_signal(signal.SIGCONT)
    loop.processes['predictor_node'].kill()
    aborted(loop, '/predict_subgoal', step_budget=4)
    served(loop)
    loop.start('predictor_node')
    loop.processes['predictor_node'].wait_for('ready', 120)
    assert loop.predictor_alive.wait_until_alive(30)
    loop.wait_until_seen()


def test_a_planner_with_a_robot_mask_waits_for_masks_and_stops_when_it_is_deactivated(loop):
    masks = loop.node.create_publisher(Image, 'own_mask', STREAM)
    sending = threading.Event()

    def answer(image):
        """Publish a mask for a picture: the robot hides nothing."""
        if sending.is_set():
            masks.publish(Image(header=image.header, height=image.height, width=image.width,
                                step=image.width, encoding='mono8',
                                data=bytes(image.height * image.width)))

    images = loop.node.create_subscription(Image, 'camera/image_raw', answer, STREAM)
    card = Newest(loop.node, String, 'other_node/model_card', LATCHED)
    try:
        with loop.other_planner(robot_mask='all', image_timeout=2.0):
            states = Lifecycle(loop.node, 'other_node')
            assert stored_digest(FORWARD_MODEL) in card.wait(20).data
            loop.reset()
            aborted(loop, '/own_mask', mode='direct', step_budget=2)
            sending.set()
            handle = loop.begin_moving()
            assert states.to('deactivate')
            loop.ended(handle, GoalStatus.STATUS_ABORTED, 'deactivated')
            aborted(loop, 'ros2 lifecycle set /other_node activate', mode='direct', step_budget=1)
            assert 'cleanup' in states.set('weights', loop.folder / 'none.safetensors')
            assert states.to('cleanup') and states.set('weights', FORWARD_MODEL) == ''
            assert states.to('configure') and states.to('activate')
            loop.reset()
            served(loop, 2)
            handle = loop.begin_moving()
            assert states.to('active_shutdown')
            loop.ended(handle, GoalStatus.STATUS_ABORTED, 'deactivated')
            aborted(loop, 'start it again', mode='direct', step_budget=1)
    finally:
        loop.node.destroy_subscription(images)
        loop.node.destroy_publisher(masks)
