# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""visual_mpc_node with an arm that refuses, and drivers that are late, silent or repeat."""

from collections import ChainMap
import math
import threading
import time
from types import SimpleNamespace

from driven import Arm, first_pictures, goal_fields, TOPICS, World
import numpy as np
from processes import Client, LocalNode, until
import pytest
from rclpy.parameter import Parameter
from std_msgs.msg import Float64
import tap_ros
from tap_ros.nodes.planner.node import VisualMpcNode
from tap_ros.planning.reach import MOST_REFUSED, Reach
from tap_ros.planning.visual_mpc import Scene
from tap_ros.robots.ur10e import UR10E
from tap_ros.ros.topics import LATCHED
from test_frames import told

pytestmark = pytest.mark.slow


class Rig:
    """
    A planner of this process, and a World and an Arm for it.

    :ivar threads: that have planned.
    :ivar plan: what they answer; scenes: from which they did.
    """

    def __init__(self, node, world):
        self.world, self.arm, self.threads, self.scenes = world, Arm(node), set(), []
        self.client = tap_ros.Client(node=node)
        self.planner = LocalNode(VisualMpcNode, num_threads=4, max_age=30.0)
        mpc, (seen, goal) = self.planner.node._mpc, first_pictures()
        self.plan = mpc.plan(Scene(seen.image, seen.gripper, seen.object_pixels),
                             mpc.goal(goal.object_pixels))

        def planned(scene, *_):  # at once, so that a busy machine is fast enough
            self.threads.add(threading.get_ident())
            self.scenes.append(scene)
            return self.plan

        mpc.plan = planned
        self.client.wait_until_ready('visual_mpc_node')

    def reach(self, step_budget, on_feedback=None, image_timeout=60.0):
        """Pursue a goal to its end; return end and reason, and the moves, once the arm stands."""
        self.planner.node.set_parameters([Parameter('image_timeout', value=image_timeout)])
        begin = time.monotonic()
        result = self.client.reach(**goal_fields(step_budget=step_budget),
                                   on_feedback=on_feedback or (lambda feedback: None)).result()
        assert until(lambda: self.arm.seconds_to_stop(begin) < float('inf'), 5)
        return result, len(self.arm.moves(begin))

    def aborted(self, words):
        """Check that a goal is aborted for this reason, and nothing moves."""
        time.sleep(0.5)  # what was published before is old by now
        result, moves = self.reach(2, image_timeout=0.5)
        assert result.end == 'aborted' and words in result.message and not moves, result.message


@pytest.fixture(scope='module')
def rig():
    with Client() as node, World(node) as world:
        rig = Rig(node, world)
        yield rig
        rig.client.close()
        assert rig.planner.end() == 0


@pytest.fixture(autouse=True)
def restored(rig):
    rig.arm.refusing = False
    rig.world.restore()


def test_an_arm_that_refuses_everything_ends_the_goal_and_the_next_one_is_served(rig):
    rig.arm.refusing = True
    result, moves = rig.reach(3)
    assert result.end == 'aborted' and result.steps == 0 and moves == MOST_REFUSED
    assert f'{MOST_REFUSED} commands in a row' in result.message
    assert 'protective stop' in result.message
    rig.arm.refusing = False
    for _ in range(3):
        result, moves = rig.reach(2)
        assert result.end == 'succeeded' and result.steps == moves == 2, result.message
    assert len(rig.threads) == 1, 'each one that has planned keeps memory of its own'


def test_an_arm_that_begins_late_is_commanded_from_where_it_comes_to(rig, monkeypatch):
    there = first_pictures()[0].gripper + np.append(rig.plan.action[:3], 0)
    period_ns = int(1e9 * rig.planner.node.params['control_period'])
    begins, messages, sent = [], rig.world.messages, Reach.sent
    monkeypatch.setattr(Reach, 'sent', lambda self, after_ns, *rest: (
        begins.append(after_ns + period_ns // 2), sent(self, after_ns, *rest)))

    def late(now_ns):
        if begins and now_ns > begins[0]:
            rig.world.gripper = there
        return messages(now_ns)

    monkeypatch.setattr(rig.world, 'messages', late)
    rig.scenes.clear()
    result, moves = rig.reach(2)
    assert result.end == 'succeeded' and moves == 2, result.message
    assert np.linalg.norm((rig.scenes[0].gripper - there)[:3]) > 0.02
    np.testing.assert_allclose(rig.scenes[-1].gripper, there, atol=0.005)


def test_refused_commands_that_are_stamped_with_now_do_not_count(rig, monkeypatch):
    arm = rig.planner.node._arm
    monkeypatch.setattr(arm, '_params', ChainMap({'stamp_with_now': True}, arm._params))
    rig.arm.refusing = True
    result, moves = rig.reach(3)
    assert result.end == 'aborted' and result.steps == 0 and moves == MOST_REFUSED
    assert 'protective stop' in result.message


def test_drivers_that_repeat_one_stamp_move_nothing_unless_a_clock_stands_still(rig):
    for topics, words in ((TOPICS, 'repeat one stamp'), (['image'], 'repeat one stamp'),
                          (['joints'], '/joint_states')):
        rig.world.restore()
        rig.world.frozen = dict.fromkeys(topics, time.time_ns())
        rig.aborted(words)
    rig.world.restore()
    result, moves = rig.reach(40, lambda _: rig.world.frozen or rig.world.frozen.update(
        dict.fromkeys(TOPICS, time.time_ns())), 1.0)  # from the first command on
    assert result.end == 'aborted' and 1 <= moves < 40, result.message
    rig.world.restore()
    now = time.time_ns()
    rig.world.frozen, rig.world.clock_ns = dict.fromkeys(TOPICS, now), now
    _, moves = rig.reach(1, image_timeout=5.0)  # then nothing new comes
    assert moves == 1


def test_an_arm_that_takes_another_time_for_a_command_is_not_moved(rig):
    arm = rig.client.node.create_publisher(Float64, 'arm/control_period', LATCHED)
    assert until(arm.get_subscription_count)
    for period in (float('nan'), 0.5):
        arm.publish(Float64(data=period))
    assert until(lambda: rig.planner.node._arm._period == 0.5)
    rig.aborted('by arm/control_period the arm takes 0.5 s')
    arm.publish(Float64(data=0.25))
    assert until(lambda: rig.planner.node._arm._period == 0.25)
    _, moves = rig.reach(1)
    assert moves == 1


def test_an_arm_that_comes_to_take_another_time_for_a_command_is_moved_no_more(rig):
    arm = rig.client.node.create_publisher(Float64, 'arm/control_period', LATCHED)
    assert until(arm.get_subscription_count)
    result, moves = rig.reach(40, lambda _: arm.publish(Float64(data=0.5)))
    assert result.end == 'aborted' and 'the arm takes 0.5 s' in result.message, result.message
    assert 1 <= moves < 40
    arm.publish(Float64(data=0.25))
    assert until(lambda: rig.planner.node._arm._period == 0.25)


def test_joints_of_another_time_than_the_picture_move_nothing(rig):
    rig.world.late_s = 5.0
    rig.aborted('older than the picture')


def test_an_input_that_falls_silent_stops_the_arm_and_no_goal_begins(rig):
    for topic, (_, name) in TOPICS.items():
        rig.world.restore()
        result, moves = rig.reach(40, lambda _, topic=topic: rig.world.silent.add(topic), 1.0)
        assert result.end == 'aborted' and name in result.message, result.message
        assert 1 <= moves == result.steps < 40
    rig.aborted(name)


def test_an_object_in_doubt_ends_the_goal_with_its_name(rig):
    for state in ('unsure', 'lost'):
        rig.world.states = ['seen', 'hidden']  # it goes on

        def doubt(_, state=state):
            rig.world.states = ['seen', state]
        result, moves = rig.reach(40, doubt)
        assert result.end == 'aborted' and 1 <= result.steps == moves < 40
        assert f'object_1 {"is " * (state == "unsure")}{state}' in result.message


def test_an_arm_that_is_nowhere_or_comes_to_stand_elsewhere_is_moved_no_more(rig):
    place = first_pictures()[0].gripper[:3]
    rig.world.joints = dict(zip(UR10E.joints, map(float, UR10E.joints_at(place))))
    rig.aborted('nothing tells where the arm stands')
    frames = rig.planner.node._inputs._gripper._mount.__self__._frames  # needs no tf2_msgs
    mount, turn = UR10E.mount, [0, 0, math.sin(UR10E.mount.yaw / 2), math.cos(UR10E.mount.yaw / 2)]

    def stand(x):
        frames._take(SimpleNamespace(transforms=[
            told('world', 'base', (x, *mount.position[1:]), turn)]))

    stand(mount.position[0])
    assert until(lambda: rig.planner.node._inputs.look()[0])
    result, moves = rig.reach(40, lambda _: stand(mount.position[0] + 0.1), 1.0)
    assert result.end == 'aborted' and 1 <= moves < 40, result.message
    assert 'restart the node if the arm was moved' in result.message
