# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The action reach_goal: the same acts as in one process, limits, and every way to stop."""

from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from geometry_msgs.msg import TwistStamped
from lively import lively_network
from loop import acts_like, SEED
import numpy as np
from processes import Client, Lifecycle, Newest, until
import pytest
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.task import Future
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool, String
from tap_msgs.action import ReachGoal
import tap_ros
from tap_ros.apps.node_processes import NodeProcesses
from tap_ros.messages.images import decode_image
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.planner.plan_view import CHOSEN
from tap_ros.planning.mpc_config import PRESETS
from tap_ros.ros import reaching
from tap_ros.ros.calls import CallError
from tap_ros.ros.goal_senders import watch_sender
from tap_ros.ros.reaching import Reaching
from tap_ros.ros.topics import LATCHED, LOCK_STEP, STREAM
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL
from tap_ros.weights.weights import save_weights, stored_digest

pytestmark = pytest.mark.slow
CLIENT = """
import os, signal, sys, tap_ros
for feedback in tap_ros.Client().reach(mode='direct', step_budget=1000):
"""


def served(loop, steps=1):
    """Check that a goal is served now, as soon as the machine lets the planner go on."""
    for _ in range(3):
        result = loop.begin(mode='direct', step_budget=steps).result()
        if not re.search('stood still|no command could be sent', result.message):
            break
    assert result.end == 'succeeded' and result.steps == steps, result.message


def test_how_far_objects_are_is_told_in_cm_whatever_the_goal_was_made_of(loop):
    loop.reset()
    goal = loop.client.goal()
    for pixels in (None, dict(zip(goal.names, goal.pixels))):  # sent along: without positions
        result = loop.client.reach(goal_pixels=pixels, mode='direct', step_budget=1).result()
        told, = re.findall(r'average ([\d.]+) cm from their goals', result.message)
        gaps = np.linalg.norm(loop.client.camera().positions - goal.positions, axis=1)
        assert float(told) == pytest.approx(100 * gaps.mean(), abs=0.5)


def aborted(loop, *words, **fields):
    """Check that a goal is aborted for this reason before a command."""
    count = len(loop.moves())
    result = loop.begin(**fields).result()
    assert result.end == 'aborted' and not result.success and result.steps == 0
    assert all(word in result.message for word in words), result.message
    assert loop.stopped() and len(loop.moves()) == count


# Time


@pytest.mark.parametrize('lock_step', [False, True])
def test_plans_end_in_time_or_the_goal_does_unless_the_simulator_waits(tmp_path, lock_step):
    namespace, search = f'/hurry_{lock_step}', PRESETS['large'].search
    with NodeProcesses(tmp_path, namespace) as nodes, tap_ros.Client(namespace) as client:
        nodes.start('sim_node', lock_step=lock_step)
        nodes.start('visual_mpc_node', max_age=0.1, preset='large', image_timeout=60.0,
                    max_silence=5.0)
        nodes.wait_until_ready()
        client.wait_until_ready('sim_node', 'visual_mpc_node')
        # Only who moves the arm is believed that time waits.
        if not lock_step:
            stray = client.node.create_publisher(Bool, LOCK_STEP, LATCHED)
            stray.publish(Bool(data=True))
            assert until(stray.get_subscription_count)
        client.reset(seed=3)
        told = []
        result = client.reach(
            mode='direct', step_budget=2, timeout_s=120, on_feedback=told.append).result()
        until(lambda: len(told) >= result.steps)  # the last one may come after the result
    samples = [feedback.plan_samples for feedback in told]
    if lock_step:
        assert (result.end, result.steps) == ('succeeded', 2), result.message
        assert samples == [search.num_samples * search.num_iterations] * 2
    else:
        assert all(0 < count < search.num_samples * search.num_iterations for count in samples)
        assert result.steps == 2 or re.search(
            r'took \d.* and max_age is 0.1 s', result.message), result.message


# The same acts as in one process


def test_the_nodes_go_directly_as_one_process_does_and_within_limits(loop):
    acts_like(loop, 'direct', DEFAULT_PREDICTOR, mode='direct', step_budget=4)
    with loop.set(max_step_xy=0.02, max_step_z=0.04):
        loop.reset()
        loop.reached(mode='direct', step_budget=2, seed=5)
    limit = np.array([0.02, 0.02, 0.04])
    assert (np.abs(loop.moves()) <= limit + 1e-6).all()
    assert (np.abs(loop.moves()).max(0) > 0.5 * limit).any(), 'it plans within them'


def test_the_gripper_does_not_leave_the_workspace_that_it_is_given(loop):
    def go(**limits):
        """Return where the gripper began and where the commands of four steps led, x and y."""
        loop.reset()
        stamp = loop.client.camera().stamp_ns
        state = joints.wait(10, lambda found: to_nanoseconds(found.header.stamp) >= stamp)
        here = np.array([state.position[state.name.index(f'gripper_{axis}')] for axis in 'xy'])
        with loop.set(**limits):
            assert loop.reached(mode='direct', step_budget=4, seed=5).steps == 4
        return here, here + loop.moves()[:, :2].cumsum(0)

    joints = Newest(loop.node, JointState, 'joint_states', STREAM)
    here, free = go()
    way = free[-1] - here
    axis = int(np.abs(way).argmax())
    end = here[axis] + 0.3 * way[axis]
    name = 'xy'[axis] + ('_max' if way[axis] > 0 else '_min')
    _, bound = go(**{name: float(end)})
    assert ((bound[:, axis] - end) * np.sign(way[axis]) < 1e-3).all()
    assert np.abs(bound - here).max() > 0.01, 'it plans within it'
    with loop.set(x_min=0.1, x_max=0.12):
        aborted(loop, 'x_min and x_max', '0.1 to 0.12 m', 'less than 0.05 m')


def test_the_nodes_go_by_subgoals_as_one_process_does_and_tell_what_they_do(loop):
    overlay = Newest(loop.node, Image, 'plan/overlay', STREAM)
    with loop.set(subgoal_rounds=2, switch='half'):
        run, told, result = acts_like(loop, 'shipped:rounds2:half', DEFAULT_PREDICTOR,
                                      step_budget=4)
    assert run.switches == [2, 3] and len(run.subgoals) == 2
    assert [each.stage for each in told] == ['subgoal', 'subgoal', 'subgoal 2 of 2', 'goal']
    assert [each.step for each in told] == [1, 2, 3, 4]
    assert all(each.planning_ms > 0 for each in told)
    assert loop.stopped() and until(lambda: len(loop.distances) > 4)
    here, goal = loop.client.camera(), loop.client.goal()
    away = np.linalg.norm(here.pixels - goal.pixels, axis=1).mean()
    assert loop.distances[-1] == result.expected_distance == pytest.approx(away, abs=1e-3)
    shown = decode_image(overlay.wait(10), 'plan/overlay', (384, 384))
    assert (shown == CHOSEN).all(-1).sum() > 30
    with loop.set(switch='half', goal_tolerance=30.0):
        loop.reset()
        result = loop.reached(step_budget=4, seed=SEED)
    assert result.success and not len(loop.moves())


def test_the_nodes_choose_among_chains_of_samples_as_one_process_does(loop, tmp_path):
    network = lively_network(image_size=64, latent_size=8)
    weights = tmp_path / 'sampling.safetensors'
    save_weights(weights, network, 'predictor', network.config, {})
    loop.client.use_weights(str(weights))
    try:
        run, told, _ = acts_like(loop, 'sampling:samples2:recursion2', weights, num_samples=2,
                                 recursion_depth=2, step_budget=2)
        loop.reset()
        reaching = loop.begin(num_samples=32)
        threading.Event().wait(0.5)  # it would make 64 plans before it moves
        reaching.cancel()
        assert loop.ended(reaching, 'cancelled').steps == 0
    finally:
        loop.client.use_weights(DEFAULT_PREDICTOR)
    assert len(run.subgoals) == 2 and told[-1].stage == 'goal'


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
    reaching = loop.begin_moving(step_budget=40)
    with pytest.raises(CallError, match='rejected'):
        loop.begin()
    assert 'another goal is in progress' in loop.processes['visual_mpc_node'].text
    reaching.cancel()
    result = loop.ended(reaching, 'cancelled', 'cancelled')
    assert 1 <= result.steps < 40
    count = len(loop.moves())
    threading.Event().wait(0.6)  # more than two control periods
    assert len(loop.moves()) == count == result.steps
    served(loop)  # right after a cancel, and right after a reset
    loop.client.call('reset', seed=SEED)
    served(loop)


def test_another_scene_or_camera_during_a_goal_aborts_it(loop):
    reaching = loop.begin_moving()
    loop.client.call('reset', seed=SEED + 1)
    loop.ended(reaching, 'aborted', 'the scene has changed')
    reaching = loop.begin_moving()
    publisher = loop.node.create_publisher(Image, 'camera/image_raw', STREAM)
    try:
        loop.ended(reaching, 'aborted', '2 nodes publish on /camera/image_raw')
        result = loop.ended(loop.begin(), 'aborted', '2 nodes publish on /camera/image_raw')
        assert not result.steps
    finally:
        loop.node.destroy_publisher(publisher)


def test_when_the_predictor_hangs_or_dies_the_arm_stays_and_the_planner_lives(loop):
    loop.reset()
    predictor = loop.processes['predictor_node']
    maps = Path(f'/proc/{predictor.process.pid}/maps').read_text()
    assert 'libfastrtps' in maps and '/dev/shm/fast' not in maps, 'no shared memory'
    predictor.send(signal.SIGSTOP)
    try:
        with loop.set(predictor_timeout=1.5):  # silent is not dead
            aborted(loop, '/predict_subgoal', 'predictor_node has been silent', step_budget=2)
        with pytest.raises(CallError, match='has left the ROS graph .* ended or stands still'):
            loop.client.call('predict')
    finally:
        predictor.send(signal.SIGCONT)
    predictor.kill()
    aborted(loop, '/predict_subgoal', step_budget=4)
    served(loop)
    predictor.start().wait_for('ready', 120)  # soon: Fast DDS has not given up the one before
    loop.wait_until_seen()


def test_a_planner_that_stood_still_goes_on_where_time_waits_for_it(loop):
    reaching = loop.begin_moving(step_budget=4)
    loop.processes['visual_mpc_node'].send(signal.SIGSTOP)
    time.sleep(2.3)  # less than the lease of a process
    loop.processes['visual_mpc_node'].send(signal.SIGCONT)
    assert reaching.result().end == 'succeeded' and reaching.result().steps == 4


@pytest.mark.parametrize('stands_s', [1.5, 5.0])
def test_a_goal_whose_client_gave_up_moves_nothing(loop, stands_s):
    loop.reset()
    planner = loop.processes['visual_mpc_node']
    log_bytes = len(planner.text)
    planner.send(signal.SIGSTOP)
    try:
        with pytest.raises(CallError, match='visual_mpc_node has been silent for'):
            Reaching(loop.client.goals, ReachGoal.Goal(mode='direct'), 300, 1.2)
        threading.Event().wait(stands_s - 1.2)
    finally:
        planner.send(signal.SIGCONT)
    assert until(lambda: 'reach_goal ended after 0 steps' in planner.text[log_bytes:], 60)
    served(loop)
    assert until(lambda: len(loop.moves()), 10) == 1


@pytest.fixture
def lost(monkeypatch):
    """Lose the answer to the first goal; return the answers so far."""
    monkeypatch.setattr(reaching, 'ANSWER_S', 0.5)
    send, answers = ActionClient.send_goal_async, []

    def lose(self, *args):
        answers.append(send(self, *args))
        return answers[-1] if len(answers) > 1 else Future()

    monkeypatch.setattr(ActionClient, 'send_goal_async', lose)
    return answers


def test_a_goal_whose_answer_is_lost_is_cancelled_and_sent_anew(loop, lost):
    loop.reset()
    told = []
    result = loop.reached(told.append, mode='direct', step_budget=2)
    assert result.steps == 2 and [each.step for each in told][-2:] == [1, 2]
    assert lost[0].result().accepted and len(lost) > 1
    served(loop)


def test_a_goal_that_the_planner_could_not_answer_is_sent_anew(lost):
    """A goal whose answer could not be sent is never executed by rclpy."""
    space, executed = '/unanswered', []

    def execute(handle):
        executed.append(bytes(handle.goal_id.uuid))
        handle.succeed()
        return ReachGoal.Result(success=True)

    with Client('planner', namespace=space) as planner, tap_ros.Client(space) as client:
        server = ActionServer(
            planner, ReachGoal, 'reach_goal', execute,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
            handle_accepted_callback=lambda handle: len(lost) > 1 and handle.execute())
        assert client.reach(mode='direct').result().success
        assert len(executed) == 1 and len(lost) == 2
        server.destroy()


def test_feedback_that_comes_after_the_result_is_not_lost():
    space, handles = '/late', []

    def execute(handle):
        handles.append(handle)
        handle.publish_feedback(ReachGoal.Feedback(step=1))
        handle.succeed()
        return ReachGoal.Result(success=True, steps=2)

    with Client('planner', namespace=space) as planner, tap_ros.Client(space) as client:
        server = ActionServer(planner, ReachGoal, 'reach_goal', execute)
        reaching, steps = client.reach(mode='direct'), []
        reaching.result()
        for feedback in reaching:
            steps.append(feedback.step)
            if feedback.step == 1:
                handles[0].publish_feedback(ReachGoal.Feedback(step=2))
        assert steps == [1, 2]
        server.destroy()


@pytest.mark.parametrize('end, why', [
    ('os.kill(os.getpid(), signal.SIGKILL)', 'has left the ROS graph'),
    ('os.kill(os.getpid(), signal.SIGINT)', 'cancelled'), ('sys.exit(0)', 'cancelled')])
def test_a_goal_ends_with_its_client(loop, end, why):
    loop.reset()
    planner = loop.processes['visual_mpc_node']
    log_bytes = len(planner.text)
    with loop.set(goal_tolerance=0.01):  # it is never reached
        client = subprocess.run([sys.executable, '-c', f'{CLIENT}    {end}'], timeout=120,
                                stderr=subprocess.PIPE, text=True)
        assert 'terminate called' not in client.stderr
        assert until(lambda: 'reach_goal ended after' in planner.text[log_bytes:], 60)
    assert why in planner.text[log_bytes:] and len(loop.moves()) and loop.stopped()
    served(loop)


def test_a_goal_of_another_program_is_alone_when_nobody_takes_feedback_any_more():
    topic, space = 'reach_goal/_action/feedback', '/alone'
    with Client('planner', namespace=space) as planner, tap_ros.Client(space) as ours:
        with Client('theirs', namespace=space) as theirs:
            theirs.create_subscription(String, topic, print, STREAM)
            assert ours.goals and until(lambda: {'theirs', ours.node.get_name()} == {
                one.node_name for one in planner.get_subscriptions_info_by_topic(
                    planner.resolve_topic_name(topic))})  # a name comes later than what it has
            gone = watch_sender(planner, bytes(16))
            assert not gone()
        assert until(gone), 'ours listens, too, and has sent no such goal'


def test_a_goal_whose_feedback_cannot_be_taken_is_cancelled(loop, capfd):
    def fail(feedback):
        raise RuntimeError('of the user')

    loop.reset()
    loop.ended(loop.begin(mode='direct', step_budget=1000, on_feedback=fail), 'cancelled')
    assert 'of the user' in capfd.readouterr().err
    served(loop)


def test_a_planner_whose_arm_another_node_commands_refuses_goals(loop):
    loop.reset()
    publisher = loop.node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
    try:
        assert until(lambda: loop.node.count_publishers('arm/delta_twist_cmds') == 2)
        aborted(loop, '/test_client may command this arm', '/arm/delta_twist_cmds', mode='direct')
    finally:
        loop.node.destroy_publisher(publisher)
    served(loop)


def test_a_planner_that_is_deactivated_stops_the_arm_and_serves_again_later(loop):
    states = Lifecycle(loop.node, 'visual_mpc_node')
    card = Newest(loop.node, String, 'visual_mpc_node/model_card', LATCHED)
    assert stored_digest(FORWARD_MODEL) in card.wait(20).data
    reaching = loop.begin_moving()
    assert states.to('deactivate')
    loop.ended(reaching, 'aborted', 'deactivated')
    aborted(loop, 'ros2 lifecycle set /visual_mpc_node activate', mode='direct', step_budget=1)
    assert 'cleanup' in states.set('weights', loop.folder / 'none.safetensors')
    assert states.to('cleanup') and states.set('weights', FORWARD_MODEL) == ''
    assert states.to('configure') and states.to('activate')
    loop.reset()
    served(loop, 2)
