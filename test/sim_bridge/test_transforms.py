# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where frames are."""

import numpy as np
import pytest
from sim_bridge.world.looks import get_look, OBSERVER
from sim_bridge.world.robot_description import robot_description, TIP_FRAME
from sim_bridge.world.transforms import (
    arm_transforms,
    fixed_arm_transforms,
    Transform,
)
from tap_ros.robots import ur10e
from tap_ros.robots.urdf import read_urdf


def test_the_arm_is_where_its_urdf_has_it():
    joints = np.random.default_rng(0).uniform(-3, 3, 6)
    poses = {'world': np.eye(4)}
    base, tip = fixed_arm_transforms()
    for transform in (base, *arm_transforms(joints), tip):
        poses[transform.child] = poses[transform.parent] @ transform.pose
    wanted = read_urdf(robot_description(), 'own').poses(dict(zip(ur10e.JOINTS, joints)))
    assert set(poses) == {'world', 'base', TIP_FRAME, *(
        name.replace('_joint', '_link') for name in ur10e.JOINTS)}
    for name, pose in poses.items():
        np.testing.assert_allclose(pose, wanted[name], atol=1e-12, err_msg=name)
    np.testing.assert_allclose(poses[TIP_FRAME][:3, 3], ur10e.gripper_at(joints), atol=1e-12)


@pytest.mark.parametrize('camera', [OBSERVER, get_look('hand').camera(False, 64, 64)])
def test_a_camera_sees_in_its_optical_frame_what_it_projects(camera):
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (5, 3))
    pose = camera.pose
    x, y, z = np.linalg.inv(pose)[:3] @ np.column_stack([points, np.ones(5)]).T
    pixels = np.column_stack([x / z, y / z]) * camera.K[0, 0] + camera.K[:2, 2]
    assert (z > 0).all()
    np.testing.assert_allclose(pixels, camera.project(points))


def test_quaternions_have_w_last():
    c = np.cos(0.3)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -np.sin(0.3)], [np.sin(0.3), c]]
    np.testing.assert_allclose(
        Transform('world', 'turned', pose).quaternion, [0, 0, np.sin(0.15), np.cos(0.15)])
