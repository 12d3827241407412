# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of every arm: kinematics, limits, the pictures and the mask; and an arm that is added."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.base import plugins
from tap_ros.base.contract import CONTROL_PERIOD, ROBOT_MASK_ARM
from tap_ros.base.errors import ConfigError, KinematicsError
from tap_ros.robots.arm import find_joints, get_arm, known_arms, TIP_FRAME, turned
from tap_ros.robots.description import robot_description
from tap_ros.robots.from_urdf import arm_from_urdf, origin_of
from tap_ros.robots.ur10e import UR10E
from tap_ros.robots.urdf import read_urdf
from test_urdf import in_mujoco

OFFSETS = np.array([0.3, -0.8, 0.5, 1.1, -0.4, 0.7])


def found(arm):
    """Return an arm as its URDF tells it, whose inverse kinematics is a search."""
    middle = (np.array(arm.low) + arm.high) / 2
    return arm_from_urdf(
        f'{arm.name}_found', robot_description(arm), arm.joints, TIP_FRAME,
        arm.joints_at(middle), replace(arm.mount, tool=0.0), low=arm.low, high=arm.high,
        action_limit=arm.action_limit)


def crooked():
    """Return the UR10e with zeros of its joints elsewhere, so that frames have three angles."""
    origins = [*(origin_of(turned(*origin, offset)) for origin, offset in zip(
        UR10E.origins, OFFSETS)), UR10E.origins[-1]]
    return replace(UR10E, name='crooked', origins=tuple(origins), limits=2 * UR10E.limits,
                   inverse=lambda pose: UR10E.inverse(pose) - OFFSETS)


KNOWN = [get_arm(name) for name in plugins.names('tap_ros.arms')]
ARMS = [*KNOWN, *map(found, KNOWN), crooked()]
each_arm = pytest.mark.parametrize('arm', ARMS, ids=lambda arm: arm.name)


def places(arm, number, seed=0):
    """Draw places of the gripper, the corners of what the arm reaches first."""
    corners = np.array(list(product(*zip(arm.low, arm.high, strict=True))))
    rng = np.random.default_rng(seed)
    return np.concatenate([corners, rng.uniform(arm.low, arm.high, (number, 3))])


@each_arm
def test_the_hand_points_down_wherever_the_gripper_may_be(arm):
    joints = np.array([arm.joints_at(place) for place in places(arm, 50)])
    np.testing.assert_allclose(arm.gripper_at(joints), places(arm, 50), atol=1e-9)
    flange = arm.mount.pose @ arm.forward(joints)
    assert np.allclose(flange[:, :3, :3], np.diag([1, -1, -1]), atol=1e-9)
    assert (joints >= arm.limits[:, 0]).all() and (joints <= arm.limits[:, 1]).all()


def test_the_search_finds_what_the_closed_form_says():
    arm = found(UR10E)
    for place in places(arm, 50, seed=2):
        np.testing.assert_allclose(arm.joints_at(place), UR10E.joints_at(place), atol=1e-6)


@each_arm
def test_every_command_within_the_limits_is_within_the_joint_speeds(arm):
    signs = np.array(list(product((-1, 0, 1), repeat=3)))
    for place in places(arm, 20, seed=4):
        before = arm.joints_at(place)
        for sign in signs:
            after = np.clip(place + sign * arm.action_limit, arm.low, arm.high)
            arm.check_motion(before, arm.joints_at(after), CONTROL_PERIOD)


@each_arm
def test_urdf_transforms_and_kinematics_agree(arm):
    text = robot_description(arm)
    robot, (base, tip) = read_urdf(text, 'own'), arm.fixed_transforms
    for joints in np.random.default_rng(0).uniform(-3, 3, (5, len(arm.joints))):
        poses, positions = {'world': np.eye(4)}, dict(zip(arm.joints, joints))
        for one in (base, *arm.transforms(joints), tip):
            poses[one.child] = poses[one.parent] @ one.pose
        np.testing.assert_allclose(poses[TIP_FRAME][:3, 3], arm.gripper_at(joints))
        wanted, seen = robot.poses(positions), in_mujoco(text, positions)
        assert set(poses) == set(wanted) == set(seen) == {'world', *arm.links, TIP_FRAME}
        for name, pose in poses.items():
            np.testing.assert_allclose(pose, wanted[name], atol=1e-12, err_msg=name)
            np.testing.assert_allclose(pose, seen[name], atol=1e-6, err_msg=name)


def test_another_package_adds_an_arm_in_a_few_lines(monkeypatch):
    taller = replace(UR10E, name='taller', mount=replace(UR10E.mount, position=(0.0, 0.7, 0.1)))
    for arm in (taller, found(UR10E), crooked()):
        monkeypatch.setattr(plugins, arm.name, arm, raising=False)
        monkeypatch.setitem(plugins.BUILT_IN['tap_ros.arms'], arm.name,
                            f'tap_ros.base.plugins:{arm.name}')
    masks = {}
    for name in ('panda', 'taller', 'ur10e', 'ur10e_found', 'crooked'):
        simulator = Simulator('push2', 64, 'arm', arm=name)
        masks[name] = simulator.reset(0).robot_mask == ROBOT_MASK_ARM
        simulator.close()
        assert masks[name].mean() > 0.02, name
    assert (masks['taller'] != masks['ur10e']).any()
    assert (masks['crooked'] == masks['ur10e']).mean() > 0.999
    assert (masks['ur10e_found'] == masks['ur10e']).mean() > 0.95  # it is thinner
    with pytest.raises(ConfigError, match="did you mean 'panda'"):
        Simulator(arm='pandas')


def test_an_arm_limits_what_the_gripper_does_and_which_scenes_are_drawn():
    simulator, arm = Simulator('push2', arm='panda'), get_arm('panda')
    for seed in range(5):
        simulator.reset(seed)
        for poses in (simulator.scene.start_poses, simulator.scene.goal_poses):
            assert (np.abs(poses[:, :2]) <= arm.high[:2]).all()
    for _ in range(10):
        before = simulator.target
        gripper = simulator.step([0.08, 0.08, 0.15, 0]).gripper
        arm.check_motion(arm.joints_at(before), arm.joints_at(simulator.target), CONTROL_PERIOD)
    np.testing.assert_allclose(gripper[1:3], arm.high[1:], atol=0.005)
    simulator.close()


@each_arm
def test_out_of_reach_and_too_fast_is_refused_with_the_reason(arm):
    for place in ((0, -0.9, 0.1), (0, 0.6, -0.5), (0, 0, 1.5)):
        with pytest.raises(KinematicsError, match=r'cannot reach .* m|of its limit'):
            arm.joints_at(place)
    for joint, name in enumerate(arm.joints):
        moved = np.zeros(len(arm.joints))
        moved[joint] = arm.speeds[joint] * CONTROL_PERIOD
        arm.check_motion(np.zeros(len(moved)), 0.99 * moved, CONTROL_PERIOD)
        with pytest.raises(KinematicsError, match=name):
            arm.check_motion(np.zeros(len(moved)), 1.01 * moved, CONTROL_PERIOD)


@each_arm
def test_joints_are_found_whatever_their_names_begin_with(arm):
    named = {f'left_{name}': float(i) for i, name in enumerate(arm.joints)}
    assert find_joints(dict(reversed(named.items())), known_arms()) == list(range(len(arm.joints)))
    assert find_joints(
        named | {f'right_{name}': 0.0 for name in arm.joints}, known_arms()) is None
    named.popitem()
    assert find_joints(named, known_arms()) is None
