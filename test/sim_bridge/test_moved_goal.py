# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of a goal that is put elsewhere: what follows it, what stays, and what is refused."""

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, sample_scene, task_names
from sim_bridge.world.camera import Camera
from sim_bridge.world.looks import OBSERVER
from sim_bridge.world.table import GRIPPER_MARGIN
from tap_ros.contract import ROBOT_MASK_FREE
from tap_ros.errors import SceneError

PLACES = np.array([[0.2, 0.1], [-0.15, -0.2]])


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


@pytest.mark.parametrize('camera', [
    Camera(64, 64), OBSERVER, Camera(80, 48, tilt=0.3, fovy=50, position=(0.2, -1, 2), turn=-0.4)])
def test_a_pixel_at_a_height_is_one_place_and_back(camera):
    rng = np.random.default_rng(0)
    pixels, heights = rng.uniform(20, 45, (10, 2)), rng.uniform(0, 0.5, 10)
    for height in (heights, 0.03, 0.0):
        places = camera.on_table(pixels, height)
        points = np.column_stack([places, np.broadcast_to(height, 10)])
        np.testing.assert_allclose(camera.project(points), pixels, atol=1e-9)
    np.testing.assert_array_equal(camera.on_table(pixels), camera.on_table(pixels, 0.0))


def test_distances_outcome_and_pictures_follow_the_goal(simulator):
    start = simulator.reset(3)
    before, drawn = simulator.goal(), simulator.scene
    simulator.set_goal(PLACES)
    goal, bare = simulator.goal(), simulator.goal(hide_arm=True)
    assert simulator.scene is drawn
    for seen in (goal, bare):
        np.testing.assert_allclose(seen.object_poses[:, :2], PLACES)
        np.testing.assert_allclose(  # heights and yaws
            seen.object_poses[:, 2:], before.object_poses[:, 2:], atol=1e-12)
        np.testing.assert_allclose(
            seen.object_pixels, simulator.camera.project(goal.object_poses[:, :3]), atol=1e-4)
        assert (seen.image != before.image).any()
    assert (goal.robot_mask != ROBOT_MASK_FREE).any() and (goal.image != bare.image).any()
    assert (bare.robot_mask == ROBOT_MASK_FREE).all()
    assert np.linalg.norm(PLACES - goal.gripper[:2], axis=1).min() > GRIPPER_MARGIN
    np.testing.assert_allclose(simulator.distances(), np.linalg.norm(
        PLACES - start.object_poses[:, :2], axis=1), atol=1e-6)
    assert simulator.outcome() == 'failure'
    simulator.set_goal(start.object_poses[:, :2])
    np.testing.assert_allclose(simulator.distances(), 0, atol=1e-6)
    assert simulator.outcome() == 'success'
    simulator.reset(3)
    np.testing.assert_array_equal(simulator.goal().image, before.image)
    np.testing.assert_array_equal(simulator.goal().object_poses, before.object_poses)


def pushing(simulator):
    """Return actions that go behind the first object of scene 3 and push it."""
    place, hand = simulator.reset(3).object_poses[0, :2], simulator.target[:3].copy()
    actions = []
    for goal in ([*hand[:2], 0.14], [place[0] - 0.13, place[1], 0.14],
                 [place[0] - 0.13, place[1], 0.01], [*place, 0.01]):
        while np.abs(gap := goal - hand).max() > 1e-6:
            move = np.clip(gap, [-0.08, -0.08, -0.15], [0.08, 0.08, 0.15])
            actions.append([*move, 0])
            hand = hand + move
    return np.array(actions)


def test_nothing_moves_to_the_bit_also_while_the_arm_pushes(simulator):
    actions, runs = pushing(simulator), []
    for moved in (False, True):
        simulator.reset(3)
        run = []
        for action in actions:
            run.append(simulator.step(action))
            if moved:
                state, target = simulator.state(), simulator.target.copy()
                simulator.set_goal(PLACES)
                with pytest.raises(SceneError):
                    simulator.set_goal(np.zeros((2, 2)))
                np.testing.assert_array_equal(simulator.state(), state)
                np.testing.assert_array_equal(simulator.target, target)
                np.testing.assert_array_equal(simulator.observe().image, run[-1].image)
        runs.append(run)
    assert np.linalg.norm(runs[0][-1].object_poses[0] - runs[0][0].object_poses[0]) > 0.03
    for a, b in zip(*runs):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.object_poses, b.object_poses)
        np.testing.assert_array_equal(a.gripper, b.gripper)
        assert a.stamp_ns == b.stamp_ns


@pytest.mark.parametrize('places, words', [
    (PLACES[:1], ['shape', r'\(2, 2\)', r'\(1, 2\)']),
    (np.zeros((2, 3)), ['shape', r'\(2, 3\)']),
    ([[0.2, 0.1], [0.1, -0.351]], ['object_1', '-0.351', '0.35 m']),
    ([[np.nan, 0.1], [0.1, 0.1]], ['object_0', 'nan', '0.35 m']),
    ([[0.1, np.inf], [0.1, 0.1]], ['object_0', 'inf', '0.35 m']),
    ([[0.1, 0.1], [0.1, 0.1]], ['object_0', 'object_1', 'overlap']),
])
def test_a_goal_that_cannot_be_is_refused_and_the_old_one_stays(simulator, places, words):
    simulator.reset(3)
    simulator.set_goal(PLACES)
    before, state = simulator.goal(), simulator.state()
    with pytest.raises(SceneError) as caught:
        simulator.set_goal(places)
    for word in words:
        caught.match(word)
    assert simulator.goal() is before
    np.testing.assert_array_equal(simulator.state(), state)


@pytest.mark.parametrize('task', ['grasp', 'pick_place', 'stack2'])
def test_only_tasks_that_push_have_a_goal_that_can_be_moved(task):
    simulator = Simulator(task)
    try:
        simulator.reset(0)
        before = simulator.goal()
        with pytest.raises(SceneError, match=f'{task}.*push2, push3'):
            simulator.set_goal(before.object_poses[:, :2])
        assert simulator.goal() is before
    finally:
        simulator.close()


def test_a_goal_may_be_wherever_scenes_have_an_object():
    for task in map(get_task, task_names()):
        if task.kind == 'push':
            for seed in range(50):
                scene = sample_scene(task, seed)
                places = np.abs([scene.start_poses[:, :2], scene.goal_poses[:, :2]])
                assert (places <= task.object_range).all()


def test_where_the_order_matters_objects_may_be_as_far_out_as_there():
    simulator = Simulator('order2')
    try:
        simulator.reset(0)
        simulator.set_goal([[0.38, 0.0], [0.0, -0.38]])
        with pytest.raises(SceneError, match='0.38 m'):
            simulator.set_goal([[0.381, 0.0], [0.0, -0.38]])
    finally:
        simulator.close()


@pytest.mark.parametrize('kinds', [('disc', 'disc'), ('L', 'T'), ('bar', 'disc'), ('L', 'L')])
def test_objects_overlap_wherever_one_reaches_into_the_other(simulator, kinds):
    seed = next(seed for seed in range(2000) if tuple(
        shape.kind for shape in sample_scene(get_task('push2'), seed).shapes) == kinds)
    simulator.reset(seed)
    refused = []
    for gap in np.arange(0, 0.35, 0.005):
        try:
            simulator.set_goal([[-gap / 2, 0.01], [gap / 2, 0.01]])
            refused.append(False)
        except SceneError:
            refused.append(True)
    # One in the other is the worst; from some distance on they are apart.
    nearest = refused.index(False)
    assert all(refused[:nearest]) and not any(refused[nearest:])
    assert 0.04 < 0.005 * nearest < 0.3
    if kinds == ('disc', 'disc'):
        reach = sum(shape.half_sizes[0][0] for shape in simulator.scene.shapes)
        simulator.set_goal([[0, 0], [reach + 1e-3, 0]])
        with pytest.raises(SceneError, match='object_0 and object_1 would overlap'):
            simulator.set_goal([[0, 0], [reach - 1e-3, 0]])


def test_objects_that_are_not_named_stay_and_pixels_are_those_of_the_goal_picture(simulator):
    simulator.reset(3)
    goal = simulator.goal()
    poses, names = goal.object_poses, goal.object_names
    simulator.move_goal(names[::-1], goal.object_pixels[::-1])
    np.testing.assert_allclose(simulator.goal_poses[:, :2], poses[:, :2], atol=1e-6)
    simulator.move_goal(names[1:], np.array([[15.25, 30.5]]))
    np.testing.assert_allclose(simulator.goal_poses[0, :2], poses[0, :2], atol=1e-6)
    np.testing.assert_allclose(simulator.goal().object_pixels[1], [15.25, 30.5], atol=1e-5)
    for unfit, words in (((), 'empty.*object_0'), (('cup',), 'cup.*object_0, object_1')):
        with pytest.raises(SceneError, match=words):
            simulator.move_goal(unfit, np.zeros((len(unfit), 2)))
