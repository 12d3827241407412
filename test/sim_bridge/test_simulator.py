# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the simulator: determinism, kinematics, limits."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import sample_scene
from sim_bridge.world.scene import FINGER_TRAVEL
from sim_bridge.world.table import ramp_controls
from tap_ros.contract import ACTION_LIMIT, CONTROL_PERIOD, WORKSPACE_HIGH
from tap_ros.errors import SceneError
from tap_ros.planning.mpc_inputs import GRIPPER_HIGH, GRIPPER_LOW


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


def test_the_same_actions_give_the_same_pictures_to_the_bit(simulator):
    actions = np.random.default_rng(0).uniform(-1, 1, (15, 4)) * [0.08, 0.08, 0.15, 1]
    runs = []
    for _ in range(2):
        first = simulator.reset(3)
        runs.append([first] + [simulator.step(a) for a in actions])
    for a, b in zip(*runs):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.object_poses, b.object_poses)
        assert a.stamp_ns == b.stamp_ns


def test_the_arm_goes_where_the_action_says(simulator):
    before = simulator.reset(0)
    simulator.step([0, 0, 0.15, 0])
    after = simulator.step([0.05, -0.03, 0, 0])
    moved = after.gripper[:2] - before.gripper[:2]
    np.testing.assert_allclose(moved, [0.05, -0.03], atol=0.004)
    assert after.stamp_ns == round(2 * CONTROL_PERIOD * 1e9)


def test_actions_are_limited_and_the_arm_stays_in_the_workspace(simulator):
    simulator.reset(0)
    for _ in range(15):
        seen = simulator.step([1, 0, 1, 0])
    np.testing.assert_allclose(seen.gripper[[0, 2]], np.take(WORKSPACE_HIGH, [0, 2]), atol=0.005)
    _, targets = ramp_controls(np.zeros(4), np.array([[*ACTION_LIMIT, 0.0]]))
    np.testing.assert_allclose(targets[0, :3], ACTION_LIMIT)


def test_an_impossible_action_is_refused_and_nothing_moves(simulator):
    simulator.reset(0)
    before = simulator.state()
    for action in ([0, 0, 0], [0, 0, np.nan, 0], [0, np.inf, 0, 0]):
        with pytest.raises(SceneError, match='action'):
            simulator.step(action)
    np.testing.assert_array_equal(simulator.state(), before)


def test_the_arm_can_be_left_out_of_the_picture(simulator):
    simulator.reset(2)
    with_arm, without = simulator.observe(), simulator.observe(hide_arm=True)
    u, v = simulator.camera.project(with_arm.gripper[:3].astype(float)).round().astype(int)
    fingers, table = (seen.image[v - 2, u].astype(int) for seen in (with_arm, without))
    assert np.ptp(fingers) < 20 and np.ptp(table) > 40, 'grey on brown'


def test_a_disc_on_its_rim_comes_to_rest(simulator):
    seed = next(s for s in range(100) if sample_scene(
        simulator.task, s).shapes[0].kind == 'disc')
    simulator.reset(seed)
    disc = simulator.data.joint('object_0')
    radius = simulator.model.geom('object_0_part_0').size[0]
    disc.qpos[2:] = [radius, np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    disc.qvel[:] = [0.3, 0, 0, 0, 0, -0.3 / radius]
    for _ in range(8):
        before, after = simulator.object_poses()[0, :2], simulator.step(np.zeros(4))
    assert np.linalg.norm(after.object_poses[0, :2] - before) < 0.005


def test_fingers_pressed_beyond_their_ends_are_told_as_a_planner_accepts_them(simulator):
    simulator.reset(2)
    for pressed, end in ((-0.3, 0), (1.3, 1)):
        simulator.data.qpos[3:5] = pressed * FINGER_TRAVEL
        gripper = simulator.observe().gripper
        assert (gripper >= GRIPPER_LOW).all() and (gripper <= GRIPPER_HIGH).all()
        assert abs(gripper[3] - end) == pytest.approx(0.1)


def test_a_dropped_simulator_leaves_the_pictures_of_others_alone(simulator):
    before = simulator.reset(3).image
    other = Simulator('push2')
    other.reset(4)
    simulator.observe()  # whose context is the current one when the other is dropped
    del other
    np.testing.assert_array_equal(simulator.observe().image, before)
    made = [Simulator('push2')]
    made[0].reset(5)
    with ThreadPoolExecutor(1) as pool:  # in a thread that cannot draw with that context
        pool.submit(made.clear).result()
    np.testing.assert_array_equal(simulator.observe().image, before)
