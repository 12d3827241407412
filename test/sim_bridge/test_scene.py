# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the scenes: start and goal rules, camera, determinism."""

import numpy as np
import pytest
from sim_bridge.camera import Camera
from sim_bridge.scene import build_scene, random_shape
from sim_bridge.simulator import Simulator
from sim_bridge.tasks import (
    GOAL_DISTANCE,
    GOAL_SEPARATION,
    GOAL_YAW_RANGE,
    OBJECT_RANGE,
    sample_scene,
    TASKS,
)
from tap_ros.errors import SceneError


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
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


def test_same_seed_same_scene_and_other_seed_another():
    task = TASKS['push2']
    a, b, c = (sample_scene(task, seed) for seed in (5, 5, 6))
    assert a.shapes == b.shapes
    np.testing.assert_array_equal(a.start_poses, b.start_poses)
    assert not np.allclose(a.start_poses, c.start_poses)


@pytest.mark.parametrize('seed', [-1, 1.5, 'a', None])
def test_a_bad_seed_is_refused_by_name(seed):
    with pytest.raises(SceneError, match='seed'):
        sample_scene(TASKS['push2'], seed)


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
        table = np.median(seen.image.reshape(-1, 3), axis=0)
        objects = np.abs(seen.image - table).max(-1) > 8
        for k, (u, v) in enumerate(seen.object_pixels):
            others = np.delete(seen.object_pixels, k, axis=0)
            rows, columns = np.nonzero(objects)
            pixels = np.column_stack([columns, rows])
            to_k = np.linalg.norm(pixels - [u, v], axis=1)
            nearest = to_k[:, None] < np.linalg.norm(pixels[:, None] - others, axis=-1)
            centre = pixels[nearest.all(1)].mean(0)
            assert np.linalg.norm(centre - [u, v]) < 5, 'of 128 pixels'
    simulator.close()


def test_the_workspace_is_in_the_picture():
    camera = Camera(64, 64)
    corners = np.array([[x, y, 0.03] for x in (-0.35, 0.35) for y in (-0.35, 0.35)])
    pixels = camera.project(corners)
    assert (pixels > 1).all() and (pixels < 62).all()
