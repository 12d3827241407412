# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where an arm stands: by parameters, by tf_static, and what is said where these disagree."""

from contextlib import suppress
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from processes import LocalNode
import pytest
from rclpy.node import Node
from tap_ros.base.errors import KinematicsError
from tap_ros.nodes.robot_mask.node import RobotMaskNode
from tap_ros.robots.ur10e import UR10E
from tap_ros.ros.arm_place import ArmPlace
from tap_ros.ros.parameters import MOUNT, Parameters
from tap_ros.ros.topics import encode_camera_info, encode_joints, to_stamp
from test_frames import told
from test_robot_mask_node import CAMERA
import yaml

TABLE = (0.0, 0.7, -0.1)  # of the simulated arm, turned to the right


def turned(angle, axis='z'):
    """Return a quaternion x, y, z, w."""
    return [math.sin(angle / 2) * (axis == each) for each in 'xyz'] + [math.cos(angle / 2)]


class Standing(Node):
    """A node with an arm."""

    def __init__(self, **options):
        super().__init__('standing', automatically_declare_parameters_from_overrides=True,
                         **options)
        params = Parameters(self)
        params.declare_shared('joint_prefix')
        params.declare_arm()
        self.place = ArmPlace(self, params)

    def tell(self, at, turn, frame='base'):
        self.place._frames._take(SimpleNamespace(transforms=[told('world', frame, at, turn)]))

    def close(self):
        """Do nothing."""


@pytest.fixture
def standing():
    nodes = []

    def start(**given):
        nodes.append(LocalNode(Standing, **given))
        return nodes[-1].node
    yield start
    for node in nodes:
        node.end()


def test_parameters_that_were_given_or_else_tf_static_say_where_it_stands(standing):
    node = standing(tool_length=0.15)
    with pytest.raises(KinematicsError, match='nothing tells where the arm stands: set mount_x'):
        node.place.mount()
    assert node.place.usual().position == TABLE
    node.tell((0.5, -0.25, 0.02), turned(2.0))
    found = node.place.mount()
    assert found.position == (0.5, -0.25, 0.02) and found.tool == 0.15
    assert found.yaw == pytest.approx(2.0)
    typed = standing(**dict(zip(MOUNT, (*TABLE, -math.pi / 2))))
    assert typed.place.mount().position == TABLE
    typed.tell((*TABLE[:2], -0.099), turned(-math.pi / 2 + 2 * math.pi))
    assert typed.place.mount().position == TABLE, 'to the bit, where they agree'
    left = standing(joint_prefix='left_')
    left.tell((1.0, 0.0, 0.0), turned(0.0))
    assert left.place.told() is None
    left.tell((1.0, 0.0, 0.0), turned(0.0), 'left_base')
    assert left.place.mount().position == (1.0, 0.0, 0.0)
    named = standing(mount_frame='link0')
    named.tell((1.0, 0.0, 0.0), turned(0.0), 'link0')
    assert named.place.mount().position == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(('at', 'turn', 'words'), [
    ((0.0, 0.6, -0.1), turned(-math.pi / 2), r'0\.600, -0\.100.*but by mount_x to mount_turn'),
    (TABLE, turned(0.0), r'turned by 0\.000 rad, but.*turned by -1\.571 rad'),
    (TABLE, turned(0.5, 'x'), 'tilted by 29 degrees')])
def test_what_disagrees_is_refused_and_logged_once(standing, capfd, at, turn, words):
    node = standing(**dict(zip(MOUNT, (*TABLE, -math.pi / 2))))
    node.tell(at, turn)
    for _ in range(3):
        with pytest.raises(KinematicsError, match=words):
            node.place.mount()
    assert capfd.readouterr().err.count('by tf_static base is in world at') == 1


def test_a_place_that_cannot_be_or_changes_or_is_told_in_part_is_refused(standing):
    node = standing()
    node.tell((0.0, 0.0, 0.0), turned(math.pi))  # as a driver whose world is the robot's
    with pytest.raises(KinematicsError, match='in the middle of the table; world is'):
        node.place.mount()
    node.tell(TABLE, turned(-math.pi / 2))
    assert node.place.mount().position == TABLE
    node.tell((0.5, 0.6, 0.0), turned(-math.pi / 2))
    with pytest.raises(KinematicsError, match=r'0\.500, 0\.600.*before at \(0\.000, 0\.700'):
        node.place.mount()
    with pytest.raises(KinematicsError, match='^mount_turn: not set'):
        standing(mount_x=0.2, mount_y=0.7, mount_z=0.0).place.mount()


def test_the_shipped_file_does_not_say_where_an_arm_stands(standing):
    shipped = yaml.safe_load((Path(__file__).parents[2] / 'config/tap_ros.yaml').read_text())
    for values in shipped.values():
        own = {key: value for key, value in values['ros__parameters'].items()
               if key in ('arm', 'tool_length', 'mount_frame', 'joint_prefix', *MOUNT)}
        if 'tool_length' in own:
            with pytest.raises(KinematicsError, match='nothing tells where the arm stands'):
                standing(**own).place.mount()


def test_the_mask_of_a_named_arm_is_where_tf_static_says_that_it_stands():
    local = LocalNode(RobotMaskNode, '/elsewhere', urdf='ur10e', **CAMERA)
    try:
        node, middles = local.node, []
        camera = encode_camera_info(np.array([[64., 0, 32], [0, 64, 32], [0, 0, 1]]), (64, 64),
                                    to_stamp(10**9), 'eye')
        angles = UR10E.joints_at([0.0, 0.0, 0.1])
        for transforms in ([], [told('world', 'base', (0.2, *TABLE[1:]), turned(-math.pi / 2))]):
            node._frames._take(SimpleNamespace(transforms=transforms))
            with suppress(KinematicsError):  # joints are told again to the arm that is elsewhere
                node._mask(camera)
            for second in (0.9, 1.1):
                node._history.add(encode_joints(
                    np.zeros(4), to_stamp(round(second * 1e9)), 'world',
                    dict(zip(UR10E.joints, angles))), 0.0)
            middles.append(np.argwhere(node._mask(camera))[:, 1].mean())
        assert middles[1] > middles[0] + 3, 'to the right'
    finally:
        local.end()
