# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The looks of the world: cameras, pictures and robot masks, beside unchanged physics."""

from dataclasses import replace
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.world.camera import Camera
from sim_bridge.world.looks import LOOKS
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import KinematicsError
from tap_ros.robots.ur10e import UR10E

TASKS = ('push2', 'pick_place')
ACTIONS = np.array([[0.06, -0.03, -0.05, 1], [-0.08, 0.05, 0, 1], [0, 0.08, 0.1, 0]])


@pytest.fixture(scope='module')
def simulators():
    """Return {(task, look): Simulator}."""
    made = {(task, look): Simulator(task, 64, look) for task in TASKS for look in LOOKS}
    yield made
    for simulator in made.values():
        simulator.close()


@pytest.mark.parametrize('task', TASKS)
def test_the_arm_changes_nothing_that_moves(simulators, task):
    states = []
    for look in LOOKS:
        simulator = simulators[task, look]
        observation = simulator.reset(3)
        for action in ACTIONS:
            assert np.allclose(UR10E.gripper_at(observation.arm_joints),
                               observation.gripper[:3], atol=1e-6), 'the joints carry the gripper'
            observation = simulator.step(action)
        states.append(simulator.state())
    assert all(np.array_equal(a, b) for a, b in pairwise(states))


@pytest.mark.parametrize('look', LOOKS)
@pytest.mark.parametrize('task', TASKS)
def test_pictures_differ_from_those_without_the_robot_in_the_mask_alone(simulators, task, look):
    simulator = simulators[task, look]
    labels = {ROBOT_MASK_FREE, ROBOT_MASK_HAND} | ({ROBOT_MASK_ARM} if look == 'arm' else set())
    for seed in range(2):
        shown = simulator.reset(seed)
        hidden = simulator.observe(hide_arm=True)
        robot = shown.robot_mask != ROBOT_MASK_FREE
        differ = (shown.image != hidden.image).any(-1)
        assert not (differ & ~robot).any()
        assert differ[robot].mean() > 0.5
        assert not hidden.robot_mask.any()
        assert set(np.unique(shown.robot_mask)) == labels
        u, v = np.rint(simulator.camera.project(shown.gripper[:3] + [0, 0, 0.03])).astype(int)
        assert shown.robot_mask[v, u] == ROBOT_MASK_HAND


def test_what_the_arm_cannot_do_moves_nothing(simulators, monkeypatch):
    simulator = simulators['push2', 'arm']
    simulator.reset(1)
    before, target = simulator.state(), simulator.target.copy()
    monkeypatch.setattr(simulator, 'arm', replace(UR10E, speeds=UR10E.speeds / 10))
    for attempt in (simulator.check_action, simulator.step):
        with pytest.raises(KinematicsError, match='_joint'):
            attempt(ACTIONS[1])
    assert np.array_equal(simulator.state(), before)
    assert np.array_equal(simulator.target, target)


def test_only_the_picture_changes_with_the_appearance():
    usual, other, light = (Simulator('push2', 64, 'hand', name) for name in (
        'usual', 'random', 'lighter_table'))
    pictures = []
    for seed in (1, 2, 1):
        a, b, c = usual.reset(seed), other.reset(seed), light.reset(seed)
        assert np.array_equal(usual.state(), other.state())
        assert np.abs(a.image.astype(int) - b.image).mean() > 2
        moved = np.linalg.norm(a.object_pixels - b.object_pixels, axis=-1)
        assert 0 < moved.max() < 4
        pictures.append(b.image)
        assert (c.image[40:].astype(int) - a.image[40:]).mean() > 15
    assert np.array_equal(pictures[0], pictures[2])
    for simulator in (usual, other, light):
        simulator.close()


@pytest.mark.parametrize('camera', [
    Camera(64, 64), Camera(80, 48, tilt=0.3, fovy=50, position=(0.2, -1, 2), turn=-0.4)])
def test_the_camera_projects_as_mujoco_does_and_back(camera):
    spec = mujoco.MjSpec()
    spec.worldbody.add_camera(name='c', pos=camera.position, quat=camera.quaternion)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # MuJoCo's camera looks along -z, with y up.
    rotation = np.diag([1, -1, -1]) @ data.cam('c').xmat.reshape(3, 3).T
    assert np.allclose(camera.extrinsics[:, :3], rotation)
    assert np.allclose(camera.extrinsics[:, 3], -rotation @ data.cam('c').xpos)
    rng = np.random.default_rng(0)
    pixels, heights = rng.uniform(20, 45, (10, 2)), rng.uniform(0, 0.5, 10)
    for height in (heights, 0.0):
        places = camera.on_table(pixels, height)
        points = np.column_stack([places, np.broadcast_to(height, 10)])
        np.testing.assert_allclose(camera.project(points), pixels, atol=1e-9)
