# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The looks of the world: pictures, robot masks and the URDF, beside unchanged physics."""

from dataclasses import replace
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import run_episode
from sim_bridge.world.appearance import Appearance, choose_appearance, USUAL
from sim_bridge.world.camera import Camera
from sim_bridge.world.looks import LOOKS, OBSERVER
from sim_bridge.world.studio import Studio
from tap_ros.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.errors import KinematicsError, SceneError
from tap_ros.recording.reader import iter_episodes
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
        simulator.reset(3)
        for action in ACTIONS:
            simulator.step(action)
        states.append(simulator.state())
    assert all(np.array_equal(a, b) for a, b in pairwise(states))


@pytest.mark.parametrize('look', LOOKS)
@pytest.mark.parametrize('task', TASKS)
def test_pictures_differ_from_those_without_the_robot_in_the_mask_alone(simulators, task, look):
    simulator = simulators[task, look]
    for seed in range(4):
        shown = simulator.reset(seed)
        hidden = simulator.observe(hide_arm=True)
        robot = shown.robot_mask != ROBOT_MASK_FREE
        differ = (shown.image != hidden.image).any(-1)
        assert not (differ & ~robot).any()
        assert differ[robot].mean() > 0.5
        assert not hidden.robot_mask.any()


@pytest.mark.parametrize('task', TASKS)
def test_the_mask_tells_hand_and_arm_apart(simulators, task):
    hand = simulators[task, 'hand'].reset(5)
    whole = simulators[task, 'arm'].reset(5)
    assert set(np.unique(hand.robot_mask)) == {ROBOT_MASK_FREE, ROBOT_MASK_HAND}
    assert set(np.unique(whole.robot_mask)) == {
        ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM}
    for observation, look in ((hand, 'hand'), (whole, 'arm')):
        camera = simulators[task, look].camera
        u, v = np.rint(camera.project(observation.gripper[:3] + [0, 0, 0.03])).astype(int)
        assert observation.robot_mask[v, u] == ROBOT_MASK_HAND


@pytest.mark.parametrize('look', ['hand', 'arm'])
def test_the_joints_that_are_told_carry_the_gripper(simulators, look):
    simulator = simulators['push2', look]
    observation = simulator.reset(1)
    for action in (*ACTIONS, np.zeros(4)):
        assert np.allclose(
            UR10E.gripper_at(observation.arm_joints), observation.gripper[:3], atol=1e-6)
        observation = simulator.step(action)


@pytest.mark.parametrize('look', ['hand', 'arm'])
def test_what_the_arm_cannot_do_moves_nothing(simulators, monkeypatch, look):
    simulator = simulators['push2', look]
    simulator.reset(1)
    before, target = simulator.state(), simulator.target.copy()
    monkeypatch.setattr(simulator, 'arm', replace(UR10E, speeds=UR10E.speeds / 10))
    for attempt in (simulator.check_action, simulator.step):
        with pytest.raises(KinematicsError, match='_joint'):
            attempt(ACTIONS[1])
    assert np.array_equal(simulator.state(), before)
    assert np.array_equal(simulator.target, target)


def test_only_the_picture_changes_with_the_appearance():
    usual, other = (Simulator('push2', 64, 'hand', name) for name in ('usual', 'random'))
    pictures = []
    for seed in (1, 2, 1):
        a, b = usual.reset(seed), other.reset(seed)
        assert np.array_equal(usual.state(), other.state())
        assert np.abs(a.image.astype(int) - b.image).mean() > 2
        moved = np.linalg.norm(a.object_pixels - b.object_pixels, axis=-1)
        assert 0 < moved.max() < 4
        pictures.append(b.image)
    assert np.array_equal(pictures[0], pictures[2])
    usual.close()
    other.close()


def test_a_lighter_table_is_lighter_and_objects_stay_where_they_are():
    dark, light = (Simulator('push2', 64, 'hand', name) for name in ('usual', 'lighter_table'))
    a, b = dark.reset(1), light.reset(1)
    assert (b.image[40:].astype(int) - a.image[40:]).mean() > 15
    assert np.array_equal(a.object_pixels, b.object_pixels)
    dark.close()
    light.close()


@pytest.mark.parametrize('bad', [
    {'look': 'cartoon'}, {'look': 'hand', 'appearance': 'pink'}])
def test_what_there_is_not_is_refused(bad):
    with pytest.raises(SceneError, match='cartoon|pink'):
        Simulator('push2', 64, **bad).reset(0)


@pytest.mark.parametrize('camera', [
    Camera(64, 64), OBSERVER, Camera(80, 48, tilt=0.3, fovy=50, position=(0.2, -1, 2), turn=-0.4)])
def test_the_camera_projects_as_mujoco_does(camera):
    spec = mujoco.MjSpec()
    spec.worldbody.add_camera(name='c', pos=camera.position, quat=camera.quaternion)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # MuJoCo's camera looks along -z, with y up.
    rotation = np.diag([1, -1, -1]) @ data.cam('c').xmat.reshape(3, 3).T
    assert np.allclose(camera.extrinsics[:, :3], rotation)
    assert np.allclose(camera.extrinsics[:, 3], -rotation @ data.cam('c').xpos)
    pixels = np.random.default_rng(0).uniform(20, 45, (10, 2))
    places = camera.on_table(pixels)
    assert np.allclose(camera.project(np.column_stack([places, np.zeros(10)])), pixels)


@pytest.mark.parametrize('camera', [OBSERVER, Camera(64, 64)])
def test_a_camera_sees_in_its_optical_frame_what_it_projects(camera):
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (5, 3))
    x, y, z = np.linalg.inv(camera.pose)[:3] @ np.column_stack([points, np.ones(5)]).T
    pixels = np.column_stack([x / z, y / z]) * camera.K[0, 0] + camera.K[:2, 2]
    assert (z > 0).all()
    np.testing.assert_allclose(pixels, camera.project(points))


def test_rays_above_the_horizon_meet_no_table():
    camera = Camera(64, 64, tilt=np.pi / 2)
    assert not np.isfinite(camera.on_table([[32.0, 5.0]])).all()


def test_the_view_from_the_side_shows_the_scene(simulators):
    simulator = simulators['push2', 'arm']
    simulator.reset(1)
    before = simulator.observer_picture()
    assert before.shape == (360, 480, 3)
    assert np.array_equal(simulator.observer_picture(), before)
    camera_before = simulator.observe().image
    simulator.step(ACTIONS[0])
    assert (simulator.observer_picture() != before).any()
    simulator.reset(1)
    assert np.array_equal(simulator.observe().image, camera_before)  # undisturbed


def test_shadows_fall_onto_the_table_only(simulators):
    simulator = simulators['push2', 'hand']
    simulator.reset(2)
    camera = LOOKS['arm'].camera(False, 64, 64)  # what lies behind the table is in view
    studio = Studio(camera, UR10E, links=False)
    studio.use(simulator.model)
    simulator.data.qpos[:3] = 0.0, 0.45, 0.1  # beside the far edge
    mujoco.mj_forward(simulator.model, simulator.data)
    studio.dress(Appearance(light=(0.0, 0.0, -1.0)))
    own = studio.render(simulator.data).robot_mask != ROBOT_MASK_FREE
    studio.dress(Appearance(light=(0.0, 2.0, -1.0)))  # its shadow reaches beyond
    seen, free = studio.render(simulator.data), studio.render(simulator.data, hide_arm=True)
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    beside = (np.abs(camera.on_table(np.stack([u, v], -1))) > 0.6).any(-1) & ~own
    assert (seen.robot_mask[beside] != ROBOT_MASK_FREE).any()
    assert np.array_equal(seen.picture[beside], free.picture[beside])
    studio.close()


def test_appearances_are_drawn_from_the_seed():
    assert choose_appearance('usual', 7) == USUAL
    assert choose_appearance('random', 7) == choose_appearance('random', 7)
    assert choose_appearance('random', 7) != choose_appearance('random', 8)


def test_a_recording_carries_the_masks_of_its_pictures(tmp_path):
    collect(tmp_path / 'bag', CollectConfig(
        task='pick_place', episodes=1, look='arm', appearance='random'), progress=False)
    episode, = iter_episodes(tmp_path / 'bag')
    simulator = Simulator('pick_place', 64, 'arm', 'random')
    observations, *_ = run_episode(simulator, 0)
    assert np.array_equal(episode.frames, [o.image for o in observations])
    assert np.array_equal(episode.robot_masks, [o.robot_mask for o in observations])
    assert np.array_equal(episode.goal_mask, observations[-1].robot_mask)
    simulator.close()
