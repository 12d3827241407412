# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the simulator publishes beside pictures where its world has a robot."""

from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import Client, NodeProcess
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from tap_ros.contract import CONTROL_PERIOD, ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.messages.joints import decode_gripper
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.clients import Newest
from tap_ros.nodes.topics import LATCHED, STREAM
from tap_ros.robots.ur10e import UR10E


def test_the_world_of_the_arm_tells_where_the_robot_is(tmp_path):
    process = NodeProcess(
        'sim_node', tmp_path / 'log.txt',
        {'lock_step': 'true', 'seed': 3, 'look': 'arm', 'observer': 'true'})
    try:
        process.wait_for('ready')
        with Client() as node:
            image, mask, side = (Newest(node, Image, topic, STREAM) for topic in (
                'camera/image_raw', 'camera/robot_mask', 'observer/image_raw'))
            joints = Newest(node, JointState, 'joint_states', STREAM)
            twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
            description = Newest(node, String, 'robot_description', LATCHED).wait(10)
            assert description.data.startswith('<?xml')
            goal_mask = Newest(node, Image, 'goal/robot_mask', LATCHED).wait(10)
            assert (goal_mask.encoding, goal_mask.height, goal_mask.width) == ('mono8', 64, 64)

            command = TwistStamped(header=image.wait(10).header)
            command.twist.linear.x = 0.05
            before = decode_gripper(joints.wait(10))
            twist.publish(command)
            then = to_nanoseconds(command.header.stamp) + round(CONTROL_PERIOD * 1e9)

            def next_one(message):
                return to_nanoseconds(message.header.stamp) == then

            image.wait(10, next_one)
            shown = mask.wait(10, next_one)
            assert (shown.encoding, shown.height, shown.width) == ('mono8', 64, 64)
            assert set(np.unique(shown.data)) == {
                ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM}
            assert side.wait(10, next_one).height == 360
            told = joints.wait(10, next_one)
            angles = dict(zip(told.name, told.position, strict=True))
            gripper = UR10E.gripper_at([angles[name] for name in UR10E.joints])
            assert np.allclose(gripper, decode_gripper(told)[:3], atol=1e-6)
            assert gripper[0] - before[0] > 0.03
    finally:
        process.kill()


def test_tf_has_the_camera_and_the_arm(tmp_path):
    TFMessage = pytest.importorskip('tf2_msgs.msg').TFMessage
    process = NodeProcess('sim_node', tmp_path / 'log.txt', {'lock_step': 'true'})
    try:
        process.wait_for('ready')
        with Client() as node:
            image = Newest(node, Image, 'camera/image_raw', STREAM)
            moving = Newest(node, TFMessage, '/tf', QoSProfile(depth=100))
            twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
            fixed = Newest(node, TFMessage, '/tf_static', LATCHED).wait(10).transforms
            assert {(one.header.frame_id, one.child_frame_id) for one in fixed} == {
                ('world', 'camera_optical_frame'), ('world', 'observer_optical_frame'),
                ('world', 'base'), ('wrist_3_link', 'gripper_tip')}
            first = image.wait(10)
            assert first.header.frame_id == 'camera_optical_frame'
            twist.publish(TwistStamped(header=first.header))
            arm = moving.wait(10).transforms
            assert len(arm) == 6
            assert {to_nanoseconds(one.header.stamp) for one in arm} == {
                to_nanoseconds(first.header.stamp) + round(CONTROL_PERIOD * 1e9)}
    finally:
        process.kill()
