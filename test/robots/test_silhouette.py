# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Masks cover what MuJoCo draws of the arm, and the shadow that points of it throw."""

import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.world.studio import Studio
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.robots.description import robot_description
from tap_ros.robots.silhouette import Body, draw_mask, Light, PinholeCamera
from tap_ros.robots.ur10e import UR10E
from tap_ros.robots.urdf import read_urdf

ARM, HAND = ROBOT_MASK_ARM, ROBOT_MASK_HAND
K = np.array([[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]])
DOWN = np.diag([1.0, -1, -1, 1])  # a camera that looks down the world's z
SIZE = (64, 64)


def camera_at(height):
    pose = DOWN.copy()
    pose[2, 3] = height
    return PinholeCamera(K, SIZE, pose)


def cube(x, y, z, half):
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    return np.array([x, y, z]) + half * signs


def test_the_arm_is_covered_and_the_rest_is_free(monkeypatch):
    add_shadows = Studio._add_shadows

    def bodies_only(self, own):
        labels = add_shadows(self, own)
        labels[labels[:, 1] == 1] = ROBOT_MASK_FREE
        return labels

    monkeypatch.setattr(Studio, '_add_shadows', bodies_only)
    simulator, robot = Simulator('push2', 64, 'arm'), read_urdf(robot_description(UR10E), 'own')
    view = PinholeCamera(simulator.camera_matrix, SIZE, simulator.camera_pose)
    seen = [simulator.reset(seed) for seed in range(6)]
    simulator.close()
    for dilation, overlap, free in ((0, 0.75, 0.96), (1, 0.55, 0.9)):
        overlaps, left = [], []
        for one in seen:
            poses = robot.poses(dict(zip(UR10E.joints, one.arm_joints)))
            mask = draw_mask([
                Body(s.corners @ poses[s.link][:3, :3].T + poses[s.link][:3, 3], ARM)
                for s in robot.shapes], view, dilation)
            arm, rest = one.robot_mask == ARM, one.robot_mask == ROBOT_MASK_FREE
            covered = mask[arm] == ARM  # a pixel is the arm's if one of its samples is
            assert covered.all() if dilation else covered.mean() > 0.99
            overlaps.append(arm.sum() / (arm | (mask == ARM) & rest).sum())
            left.append((mask[rest] == ROBOT_MASK_FREE).mean())
        assert np.mean(overlaps) > overlap and np.mean(left) > free


def test_what_is_beside_or_behind_the_camera_is_cut_off():
    assert not draw_mask([Body(cube(0, 0, 3, 0.1), ARM)], camera_at(2), 3).any()
    mask = draw_mask([Body(cube(1.2, 0, 2, 1.0), ARM)], camera_at(2), 0)
    assert (mask[:, 50:] == ARM).all() and not mask[:, :30].any()


def test_shadows_lie_where_light_through_the_body_meets_the_table():
    rng = np.random.default_rng(0)
    corners, light = cube(-0.2, 0.1, 0.3, 0.08), Light(np.array([0.5, -0.4, -1.0]), 0.05)
    view = camera_at(2)
    mask = draw_mask([Body(corners, ARM)], view, 0, light)
    inside = rng.dirichlet(np.ones(8), 3000) @ corners
    thrown = inside + (inside[:, 2:] - 0.05) * light.direction
    assert np.allclose(thrown[:, 2], 0.05)
    for points in (inside, thrown):
        rays = (points * [1, -1, -1] + [0, 0, 2]) @ K.T
        u, v = np.rint(rays[:, :2] / rays[:, 2:]).astype(int).T
        assert (mask[v, u] == ARM).all()
    assert mask.astype(bool).sum() < 2 * draw_mask(
        [Body(corners, ARM)], view, 0).astype(bool).sum() + 20
    below = Body(cube(0, 0, -0.5, 0.1), ARM)  # the table: it throws none
    np.testing.assert_array_equal(
        draw_mask([below], view, 0, light), draw_mask([below], view, 0))
