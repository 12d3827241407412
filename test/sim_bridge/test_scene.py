# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the scenes: start and goal rules, camera, determinism."""

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.grasp import (
    GRASP_RANGE,
    GRASP_REACH_RANGE,
    GRASP_YAW,
    PLACE_DISTANCE,
    PLACE_RANGE,
)
from sim_bridge.tasks.push import GOAL_DISTANCE, GOAL_SEPARATION, GOAL_YAW_RANGE, OBJECT_RANGE
from sim_bridge.tasks.tasks import get_task, sample_scene, task_names
from sim_bridge.world.looks import GRIP_SPREAD, LOOKS
from sim_bridge.world.scene import build_scene, random_shape
from tap_ros.contract import WORKSPACE_HIGH
from tap_ros.errors import SceneError

TASKS = [get_task(name) for name in task_names()]
PUSHING = [task for task in TASKS if task.kind == 'push' and not task.ordered]
GRIPPING = [task for task in TASKS if task.kind in ('grasp', 'pick_place')]


def name(task):
    return task.name


@pytest.mark.parametrize('task', PUSHING, ids=name)
def test_scenes_obey_the_start_and_goal_rules(task):
    for seed in range(50):
        scene = sample_scene(task, seed)
        starts, goals = scene.start_poses, scene.goal_poses
        np.testing.assert_allclose(
            np.linalg.norm(goals[:, :2] - starts[:, :2], axis=1), GOAL_DISTANCE)
        assert (np.abs(np.concatenate([starts, goals])[:, :2]) <= OBJECT_RANGE).all()
        assert (np.abs(goals[:, 2] - starts[:, 2]) <= GOAL_YAW_RANGE).all()
        pairs = np.triu_indices(task.num_objects, 1)
        for positions, least in ((starts, task.start_separation), (goals, GOAL_SEPARATION)):
            gaps = np.linalg.norm(positions[:, None, :2] - positions[None, :, :2], axis=-1)
            assert (gaps[pairs] >= least).all()


@pytest.mark.parametrize('task', GRIPPING, ids=name)
def test_scenes_with_a_grasp_obey_their_rules(task):
    for seed in range(50):
        scene = sample_scene(task, seed)
        start, goal, gripper = scene.start_poses[0], scene.goal_poses[0], scene.gripper_start
        assert (np.abs(start[:2]) <= GRASP_RANGE).all()
        assert (np.abs(goal[:2]) <= PLACE_RANGE).all()
        assert task.reach[0] <= np.linalg.norm(gripper[:2] - start[:2]) <= task.reach[1]
        moved = np.linalg.norm(goal[:2] - start[:2])
        if task.kind == 'grasp':
            assert moved == 0
        else:
            assert PLACE_DISTANCE[0] <= moved <= PLACE_DISTANCE[1]
        assert abs(goal[2] - start[2]) <= GRASP_YAW + 1e-9, 'turned by the fingers at most so much'


@pytest.mark.parametrize('look', LOOKS)
def test_the_gripper_and_its_object_stay_in_the_picture(look):
    camera = LOOKS[look].camera(True, 64, 64)
    reach, top = GRIP_SPREAD * GRASP_REACH_RANGE, WORKSPACE_HIGH[2] + 0.02
    corners = np.array([
        [x, y, z] for x in (-reach, reach) for y in (-reach, reach) for z in (0.03, top)])
    pixels = camera.project(corners)
    assert (pixels > 0).all() and (pixels < 63).all()


def test_no_two_tasks_draw_the_same_numbers():
    assert len({task.stream for task in TASKS}) == len(TASKS)
    grasp, pick_place = (sample_scene(get_task(name), 3) for name in ('grasp', 'pick_place'))
    assert not np.allclose(grasp.start_poses, pick_place.start_poses)


def test_the_scenes_of_published_recordings_stay_the_same():
    # Recordings are named by seed: a change here makes them impossible to collect again.
    push2, push3 = (sample_scene(get_task(name), 500000) for name in ('push2', 'push3'))
    np.testing.assert_allclose(
        push2.start_poses,
        [[-0.2823144, 0.1070191, 1.0756113], [0.1355647, -0.047126, 1.3841829]], atol=1e-6)
    np.testing.assert_allclose(
        push3.start_poses[0], [0.1992881, -0.3184266, 5.2459278], atol=1e-6)


@pytest.mark.parametrize('gripping', [False, True])
def test_only_gripping_pays_for_friction_without_slip(gripping):
    model = build_scene([random_shape(np.random.default_rng(0))], gripping=gripping)
    assert (model.opt.noslip_iterations > 0) == gripping
    assert model.geom('left_finger').condim[0] == (4 if gripping else 3)


def test_same_seed_same_scene_and_other_seed_another():
    task = get_task('push2')
    a, b, c = (sample_scene(task, seed) for seed in (5, 5, 6))
    assert a.shapes == b.shapes
    np.testing.assert_array_equal(a.start_poses, b.start_poses)
    assert not np.allclose(a.start_poses, c.start_poses)


@pytest.mark.parametrize('seed', [-1, 1.5, 'a', None])
def test_a_bad_seed_is_refused_by_name(seed):
    with pytest.raises(SceneError, match='seed'):
        sample_scene(get_task('push2'), seed)


def test_an_unknown_task_names_the_valid_ones():
    with pytest.raises(SceneError, match='push2, push3'):
        Simulator('juggle')


def test_the_origin_of_a_shape_is_its_centre_of_mass():
    rng = np.random.default_rng(0)
    model = build_scene([random_shape(rng) for _ in range(20)])
    np.testing.assert_allclose(model.body_ipos[-20:, :2], 0, atol=1e-9)


def test_the_camera_projects_onto_the_rendered_objects():
    simulator = Simulator('push2', image_size=128)
    for seed in range(5):
        simulator.reset(seed)
        # The picture without arm differs from the empty table where the objects are.
        seen = simulator.observe(hide_arm=True)
        empty = simulator.photograph(seen.object_poses + [9, 9, 0, 0, 0, 0, 0], hide_arm=True)
        objects = np.abs(seen.image.astype(int) - empty.image).max(-1) > 8
        for k, (u, v) in enumerate(seen.object_pixels):
            others = np.delete(seen.object_pixels, k, axis=0)
            rows, columns = np.nonzero(objects)
            pixels = np.column_stack([columns, rows])
            to_k = np.linalg.norm(pixels - [u, v], axis=1)
            nearest = to_k[:, None] < np.linalg.norm(pixels[:, None] - others, axis=-1)
            centre = pixels[nearest.all(1)].mean(0)
            assert np.linalg.norm(centre - [u, v]) < 5, 'of 128 pixels'
    simulator.close()


@pytest.mark.parametrize('look', LOOKS)
def test_the_workspace_is_in_the_picture(look):
    camera = LOOKS[look].camera(False, 64, 64)
    corners = np.array([[x, y, 0.03] for x in (-0.35, 0.35) for y in (-0.35, 0.35)])
    pixels = camera.project(corners)
    assert (pixels > 1).all() and (pixels < 62).all()
