# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinematics of the UR10e."""

from itertools import product

import numpy as np
import pytest
from tap_ros.contract import ACTION_LIMIT, CONTROL_PERIOD, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.errors import KinematicsError
from tap_ros.robots import ur10e

BRANCHES = list(product((1, -1), repeat=3))


def places(number, seed=0):
    """Draw places of the gripper, the corners of its workspace first."""
    corners = np.array(list(product(*zip(WORKSPACE_LOW, WORKSPACE_HIGH, strict=True))))
    rng = np.random.default_rng(seed)
    return np.concatenate([corners, rng.uniform(WORKSPACE_LOW, WORKSPACE_HIGH, (number, 3))])


@pytest.mark.parametrize('branch', BRANCHES)
def test_forward_of_inverse_is_the_identity(branch):
    rng = np.random.default_rng(1)
    solved = 0
    for joints in rng.uniform(-np.pi, np.pi, (100, 6)):
        pose = ur10e.forward(joints)
        try:
            found = ur10e.inverse(pose, branch)
        except KinematicsError:
            continue
        solved += 1
        assert np.allclose(ur10e.forward(found), pose, atol=1e-9)
    assert solved > 50


def test_some_branch_finds_the_joints_again():
    for joints in np.random.default_rng(2).uniform(-3, 3, (100, 6)):
        found = []
        for branch in BRANCHES:
            try:
                found.append(ur10e.inverse(ur10e.forward(joints), branch))
            except KinematicsError:
                continue
        assert min(np.abs(ur10e.wrapped(f - joints)).max() for f in found) < 1e-6


def test_forward_takes_many_joints_at_once():
    joints = np.random.default_rng(3).uniform(-3, 3, (2, 5, 6))
    poses = ur10e.forward(joints)
    assert poses.shape == (2, 5, 4, 4)
    assert np.allclose(poses[1, 3], ur10e.forward(joints[1, 3]))


def test_the_hand_points_down_wherever_the_gripper_may_be():
    for place in places(50):
        joints = ur10e.joints_at(place)
        assert np.allclose(ur10e.gripper_at(joints), place, atol=1e-9)
        flange = ur10e.SIMULATED.pose @ ur10e.forward(joints)
        assert np.allclose(flange[:3, :3], np.diag([1, -1, -1]), atol=1e-9)


def test_the_mount_moves_the_gripper_with_it():
    joints = ur10e.joints_at((0.1, -0.2, 0.05))
    x, y, z = ur10e.SIMULATED.position
    moved = ur10e.Mount((x + 1, y - 2, z + 0.5), ur10e.SIMULATED.yaw, ur10e.SIMULATED.tool + 0.1)
    assert np.allclose(ur10e.gripper_at(joints, moved), [1.1, -2.2, 0.45])
    turned = ur10e.Mount((0, 0, 0), 0.0, ur10e.SIMULATED.tool)
    place = ur10e.gripper_at(joints, turned)
    assert np.allclose(ur10e.joints_at(ur10e.gripper_at(joints)), joints)
    assert place[2] == pytest.approx(0.05 - z)
    assert np.hypot(*place[:2]) == pytest.approx(np.hypot(0.1 - x, -0.2 - y))


@pytest.mark.parametrize('place', [(0, -0.9, 0.1), (0, 0.7, 0.1), (0, 0, 1.5)])
def test_out_of_reach_is_refused(place):
    with pytest.raises(KinematicsError, match=r'cannot reach .* m'):
        ur10e.joints_at(place)


def test_every_command_within_the_limits_is_within_the_joint_speeds():
    signs = np.array(list(product((-1, 0, 1), repeat=3)))
    for place in places(20, seed=4):
        before = ur10e.joints_at(place)
        for sign in signs:
            after = np.clip(place + sign * ACTION_LIMIT, WORKSPACE_LOW, WORKSPACE_HIGH)
            ur10e.check_motion(before, ur10e.joints_at(after), CONTROL_PERIOD)


@pytest.mark.parametrize('joint', range(6))
def test_a_joint_that_would_be_too_fast_is_named(joint):
    joints = np.zeros(6)
    for share, refused in ((0.99, False), (1.01, True)):
        moved = joints.copy()
        moved[joint] = share * ur10e.SPEED_LIMITS[joint] * CONTROL_PERIOD
        if refused:
            with pytest.raises(KinematicsError, match=ur10e.JOINTS[joint]):
                ur10e.check_motion(joints, moved, CONTROL_PERIOD)
        else:
            ur10e.check_motion(joints, moved, CONTROL_PERIOD)


def test_a_motion_across_the_turn_of_a_joint_is_short():
    ur10e.check_motion([3.1, 0, 0, 0, 0, 0], [-3.1, 0, 0, 0, 0, 0], CONTROL_PERIOD)
