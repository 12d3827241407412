# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of finding joints, and by them the gripper, at the moment of a picture."""

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from tap_ros.errors import KinematicsError, PlanningError
from tap_ros.nodes.joint_history import JointHistory
from tap_ros.nodes.object_messages import decode_gripper, encode_joints
from tap_ros.nodes.planner.arm_joints import ArmJoints, tells_gripper
from tap_ros.nodes.topics import to_nanoseconds, to_stamp
from tap_ros.robots import ur10e

MS = 10**6
PARAMS = {'mount_x': 0.2, 'mount_y': 0.6, 'mount_z': -0.05, 'mount_turn': 0.4,
          'tool_length': 0.15, 'fixed_opening': 0.25, 'joint_prefix': 'left_', 'max_silence': 0.35}


def joints(stamp_ns, **positions):
    message = JointState(name=list(positions), position=list(positions.values()))
    message.header.stamp = to_stamp(stamp_ns)
    return message


def test_joints_are_found_between_the_states_before_and_after():
    history = JointHistory(['a', 'b'])
    for ms, a, b in ((100, 1, 5), (110, 2, 3), (120, 4, 3)):
        history.add(joints(ms * MS, a=a, other=9.0), ms)
        history.add(joints(ms * MS, b=b), ms + 1)  # another driver
    found = history.at(104 * MS, 1)
    np.testing.assert_allclose(found.positions, [1.4, 4.2])
    assert found.received == 100  # of the oldest that it comes from
    np.testing.assert_array_equal(history.at(120 * MS, 1).positions, [4, 3])
    assert history.at(120 * MS, 1).received == 120
    assert history.received == 120


@pytest.mark.parametrize('ms, words', [
    (90, 'the first state of a is 0.010 s newer than the picture'),
    (190, 'the newest state of a is 0.090 s older than the picture'),
    (140, 'the nearest newer state of a is 0.060 s from the picture; expected at most 0.05 s')])
def test_a_picture_without_states_around_it_is_refused_with_the_reason(ms, words):
    history = JointHistory(['a'])
    for at in (100, 100, 200):
        history.add(joints(at * MS, a=1.0), 0)
    if ms == 190:
        history = JointHistory(['a'])
        history.add(joints(100 * MS, a=1.0), 0)
    with pytest.raises(KinematicsError, match=words):
        history.at(ms * MS, 0.05)


def test_a_joint_that_nobody_tells_of_is_named():
    history = JointHistory(['a', 'b'])
    history.add(joints(100 * MS, a=1.0), 7)
    assert history.missing() == ['b'] and history.received == -np.inf
    with pytest.raises(KinematicsError, match='nothing is known of b'):
        history.at(100 * MS, 1)


def test_new_states_are_told_from_those_sent_again():
    history = JointHistory(['a'])
    assert history.add(joints(100 * MS, a=1.0), 1)
    assert history.add(joints(110 * MS, a=1.0), 2)
    assert not history.add(joints(110 * MS, a=1.0), 3)
    assert not history.add(joints(100 * MS, a=1.0), 4)
    assert history.at(105 * MS, 1).received == 3
    assert not history.add(joints(120 * MS, other=1.0), 5)


def test_a_clock_that_goes_back_is_believed_when_it_says_so_again():
    history = JointHistory(['a'])
    history.add(joints(5000 * MS, a=1.0), 0)
    assert not history.add(joints(100 * MS, a=2.0), 1)
    assert not history.add(joints(110 * MS, a=2.0), 2)
    assert history.at(5000 * MS, 1).positions == [1]
    assert history.add(joints(120 * MS, a=2.0), 3)
    assert history.at(120 * MS, 1).positions == [2]


@pytest.mark.parametrize('position', [np.nan, np.inf, 1e30])
def test_a_position_that_no_joint_has_is_refused(position):
    history = JointHistory(['a', 'b'])
    with pytest.raises(KinematicsError, match='b is at '):
        history.add(joints(100 * MS, a=1.0, b=position), 0)
    assert history.missing() == ['a', 'b']


def arm_message(angles, stamp_ns, **more):
    named = {f'left_{name}': angle for name, angle in zip(ur10e.JOINTS, angles)}
    return joints(stamp_ns, **dict(reversed(named.items())), **more)


def test_the_gripper_is_where_the_mounted_arm_holds_it():
    arm = ArmJoints(PARAMS)
    mount = ur10e.Mount((0.2, 0.6, -0.05), 0.4, 0.15)
    place = [-0.1, 0.05, 0.08]
    angles = ur10e.joints_at(place, mount)
    assert arm.take(arm_message(angles, 98 * MS), 1) and arm.used
    arm.take(arm_message(angles, 102 * MS), 2)
    message, received = arm.state(100 * MS)
    np.testing.assert_allclose(decode_gripper(message), [*place, 0.25], atol=1e-6)
    assert (to_nanoseconds(message.header.stamp), received) == (100 * MS, 1)
    arm.take(joints(100 * MS, gripper_opening=0.7), 3)
    assert decode_gripper(arm.state(100 * MS)[0])[3] == np.float32(0.7)
    with pytest.raises(KinematicsError, match='left_shoulder_pan_joint is 0.098 s older'):
        arm.state(200 * MS)


def test_joint_states_of_neither_gripper_nor_arm_are_named():
    arm = ArmJoints(PARAMS)
    with pytest.raises(PlanningError, match=r'neither gripper_x.* nor left_shoulder_.* has wheel'):
        arm.take(joints(1, wheel=0.5), 0)
    assert not arm.used
    assert not tells_gripper(joints(1, gripper_opening=1.0))
    assert tells_gripper(encode_joints([0, 0, 0, 1], to_stamp(1), 'world'))
