# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""visual_mpc_node with a driver that publishes the arm's six joints alone, at its own times."""

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
from loop import SEED
from processes import Client, LocalNode, NodeProcess, until
import pytest
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from tap_msgs.action import ReachGoal
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import send_goal, wait_for_result
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.nodes.topics import STREAM, to_stamp
from tap_ros.robots.ur10e import UR10E

pytestmark = pytest.mark.slow

MS = 10**6


class Driver:
    """Republish the simulator's arm as a driver would: before and after each picture."""

    def __init__(self, node):
        self.offsets, self.silent = (-7 * MS, 3 * MS), False
        self._publisher = node.create_publisher(JointState, 'joint_states', STREAM)
        node.create_subscription(JointState, 'arm_driver', self._on_joints, STREAM)

    def _on_joints(self, message):
        known = dict(zip(message.name, message.position))
        for offset in () if self.silent else self.offsets:
            stamp = to_stamp(to_nanoseconds(message.header.stamp) + offset)
            arm = JointState(name=UR10E.joints, position=[known[n] for n in UR10E.joints])
            finger = JointState(name=['finger_joint'], position=[0.3])  # another driver's
            arm.header.stamp = finger.header.stamp = stamp
            self._publisher.publish(finger)
            self._publisher.publish(arm)


@pytest.fixture(scope='module')
def driven(tmp_path_factory):
    """Return a driver, a function that sends a goal, and the commands that came."""
    folder, twists = tmp_path_factory.mktemp('driven'), []
    nodes = {}
    with Client() as node, pytest.MonkeyPatch.context() as patch:
        patch.setenv('OMP_NUM_THREADS', '1')
        driver = Driver(node)
        node.create_subscription(TwistStamped, 'arm/delta_twist_cmds', twists.append, STREAM)
        client = ActionClient(node, ReachGoal, 'reach_goal')
        try:
            nodes['sim'] = NodeProcess(
                'sim_node', folder / 'sim.txt', {'lock_step': 'true', 'seed': SEED,
                                                 'look': 'arm'},
                ['-r joint_states:=arm_driver']).wait_for('ready', 180)
            nodes['mpc'] = LocalNode(VisualMpcNode, num_threads=4, image_timeout=4.0)
            assert client.wait_for_server(30)

            def reach(on_feedback=None, **fields):
                twists.clear()
                handle = send_goal(
                    client, ReachGoal.Goal(mode='direct', **fields), 30, on_feedback)
                status, result = wait_for_result(handle, 300)
                # The result may come before the last command.
                assert until(lambda: len(moves(twists)) >= result.steps)
                return status, result

            yield driver, reach, twists
        finally:
            if 'mpc' in nodes:
                nodes['mpc'].end()
            nodes['sim'].kill()


def moves(twists):
    return [[t.twist.linear.x, t.twist.linear.y, t.twist.linear.z]
            for t in list(twists) if to_nanoseconds(t.header.stamp)]


def test_six_joints_alone_tell_the_planner_where_the_gripper_is(driven):
    _, reach, twists = driven
    status, result = reach(step_budget=2)
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert len(moves(twists)) == 2


def test_joints_of_another_time_than_the_picture_move_nothing(driven):
    driver, reach, twists = driven
    before = driver.offsets
    try:
        for driver.offsets, words in (
                ((-800 * MS, -790 * MS),
                 'the newest state of shoulder_pan_joint is 0.790 s older'),
                ((-800 * MS, 3 * MS), '')):  # those that are sent again are not new
            status, result = reach(step_budget=2)
            assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
            assert words in result.message and '/joint_states' in result.message
            assert not moves(twists)
    finally:
        driver.offsets = before


def test_a_driver_that_falls_silent_stops_the_arm(driven):
    driver, reach, twists = driven

    def fall_silent(_):
        driver.silent = True

    try:
        status, result = reach(fall_silent, step_budget=40)
    finally:
        driver.silent = False
    assert status == GoalStatus.STATUS_ABORTED, result.message
    assert '/joint_states' in result.message
    assert 1 <= len(moves(twists)) == result.steps < 40
    last = twists[-1].twist.linear
    assert (last.x, last.y, last.z) == (0, 0, 0)
