# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""visual_mpc_node with an arm that refuses, and drivers that are late, silent or repeat."""

import threading
import time

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import LocalNode, until
import pytest
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState
from tap_msgs.action import ReachGoal
from tap_msgs.msg import CommandRefused, ObjectStates
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import send_goal, wait_for_result
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.nodes.ros_messages import encode_image, encode_joints, encode_objects
from tap_ros.nodes.topics import STREAM, to_stamp
from tap_ros.planning.reach import MOST_REFUSED

pytestmark = pytest.mark.slow
PICTURE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)


class Rig:
    """
    A planner, and camera, objects and arm of the test's own, which publish ten times a second.

    :ivar frozen: topics that repeat one stamp; clock: whether one says so; silent: topics.
    :ivar refuses: whether the arm refuses every command.
    :ivar joints_at: seconds from the picture at which the two joint states beside it are stamped.
    """

    def __init__(self, client):
        self.twists = []
        self.behave()
        self._publishers = {topic: client.create_publisher(kind, f'stubborn/{topic}', STREAM)
                            for topic, kind in (
                                ('clock', Clock), ('joint_states', JointState),
                                ('objects', ObjectStates), ('camera/image_raw', Image))}
        self._refused = client.create_publisher(CommandRefused, 'stubborn/arm/refused', STREAM)
        client.create_subscription(
            TwistStamped, 'stubborn/arm/delta_twist_cmds', self._on_twist, STREAM)
        client.create_timer(0.1, self._publish)
        self.planner = LocalNode(VisualMpcNode, '/stubborn', num_threads=4, image_timeout=2.0,
                                 max_silence=1.0)
        self.threads, plans, mpc = set(), [], self.planner.node._mpc
        plan = mpc.plan

        def plan_once(*args):  # the same from then on, so that a busy machine is fast enough
            self.threads.add(threading.get_ident())
            plans.extend([] if plans else [plan(*args)])
            return plans[0]

        mpc.plan = plan_once
        self._action = ActionClient(client, ReachGoal, 'stubborn/reach_goal')
        assert self._action.wait_for_server(30)
        self.goal = encode_objects(['cup'], [(40, 40)], np.zeros((1, 7)), to_stamp(1), 'world',
                                   ObjectStates.SOURCE_TRACKED)

    def behave(self, frozen=(), clock=False, silent=(), refuses=False, joints_at=(-0.007, 0.003)):
        self.frozen, self.clock, self.silent, self.refuses = frozen, clock, silent, refuses
        self.joints_at, self._begun = joints_at, time.time_ns()

    def _publish(self):
        now = time.time_ns()
        if self.clock:
            self._publishers['clock'].publish(Clock(clock=to_stamp(self._begun)))
        for offset in () if 'joint_states' in self.silent else self.joints_at:
            stamp = (self._begun if 'joint_states' in self.frozen else now) + int(1e9 * offset)
            for state in (encode_joints([0, 0, 0.1, 0], to_stamp(stamp), 'world'),
                          JointState(name=['finger_joint'], position=[0.3])):  # another driver's
                state.header.stamp = to_stamp(stamp)
                self._publishers['joint_states'].publish(state)
        for topic, encode in (
                ('objects', lambda at: encode_objects(
                    ['cup'], [(20, 20)], np.zeros((1, 7)), at, 'world',
                    ObjectStates.SOURCE_TRACKED)),
                ('camera/image_raw', lambda at: encode_image(PICTURE, at, 'eye'))):
            stamp = self._begun if topic in self.frozen else now
            if topic not in self.silent:
                self._publishers[topic].publish(encode(to_stamp(stamp)))

    def _on_twist(self, message):
        self.twists.append(message)
        if self.refuses and to_nanoseconds(message.header.stamp):
            self._refused.publish(CommandRefused(header=message.header, message='emergency stop'))

    def moves(self):
        return sum(1 for twist in list(self.twists) if to_nanoseconds(twist.header.stamp))

    def reach(self, on_feedback=None, **fields):
        """Pursue a goal to its end; return status and result once the arm stands."""
        time.sleep(0.3)
        self.twists.clear()
        goal = ReachGoal.Goal(mode='direct', goal_objects=self.goal, **fields)
        found = wait_for_result(send_goal(self._action, goal, 30, on_feedback), 100)
        assert until(lambda: self.twists and not to_nanoseconds(self.twists[-1].header.stamp), 5)
        return found


@pytest.fixture(scope='module')
def rig():
    from processes import Client
    with Client() as client:
        rig = Rig(client)
        yield rig
        assert rig.planner.end() == 0


def test_an_arm_that_refuses_everything_ends_the_goal_and_the_next_one_is_served(rig):
    rig.behave(refuses=True)
    status, result = rig.reach(step_budget=3)
    assert status == GoalStatus.STATUS_ABORTED and result.steps == 0
    assert f'{MOST_REFUSED} commands in a row' in result.message
    assert 'emergency stop' in result.message and rig.moves() == MOST_REFUSED
    rig.behave()
    for _ in range(3):
        status, result = rig.reach(step_budget=2)
        assert status == GoalStatus.STATUS_SUCCEEDED and result.steps == rig.moves() == 2
    assert len(rig.threads) == 1, 'each one that has planned keeps memory of its own'


def test_drivers_that_repeat_one_stamp_move_nothing_unless_a_clock_stands_still(rig):
    everything = 'joint_states', 'objects', 'camera/image_raw'
    for frozen in (everything, everything[2:], everything[:1]):
        rig.behave(frozen)
        status, result = rig.reach(step_budget=2)
        assert status == GoalStatus.STATUS_ABORTED and rig.moves() == 0, result.message
        assert 'repeat one stamp' in result.message or frozen == everything[:1]
    rig.behave(everything, clock=True, joints_at=(0,))
    rig.reach(step_budget=1)
    assert rig.moves() == 1


def test_joints_of_another_time_than_the_picture_move_nothing(rig):
    rig.behave(joints_at=(-5.0, -4.99))
    status, result = rig.reach(step_budget=2)
    assert status == GoalStatus.STATUS_ABORTED and rig.moves() == 0
    assert 'older than the picture' in result.message and '/joint_states' in result.message


def test_an_input_that_falls_silent_stops_the_arm(rig):
    for topic in ('joint_states', 'objects', 'camera/image_raw'):
        rig.behave()
        status, result = rig.reach(
            lambda feedback, topic=topic: rig.behave(silent=(topic,)), step_budget=40)
        assert status == GoalStatus.STATUS_ABORTED and topic in result.message, result.message
        assert 1 <= rig.moves() == result.steps < 40
