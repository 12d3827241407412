# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of objects as other programs see them: their room, their names, and where they are put."""

from itertools import product

import mujoco
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.world.entities import (
    box_around,
    box_of,
    matching,
    overlaps_box,
    overlaps_sphere,
    PoseError,
)
from sim_bridge.world.scene import box_shape, HALF_HEIGHT, ObjectShape, random_shape
from tap_ros.errors import SceneError

FREE = (-0.3, 0.3, HALF_HEIGHT, 0, 0, 0, 1)
NAMES = ('object_0', 'object_1', 'object_2')


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


def turned(rng):
    """Return a pose with any orientation."""
    quaternion = rng.normal(size=4)
    return np.append(rng.uniform(-1, 1, 3), quaternion / np.linalg.norm(quaternion))


def corners(shape):
    """Return the corners of what an object is made of, (N, 3), in its frame."""
    found = []
    for half, centre in zip(shape.half_sizes, shape.centres):
        sides = (half[0], half[0], half[1]) if shape.kind == 'disc' else half
        found += [np.multiply(signs, sides) + (*centre, 0) for signs in product((-1, 1), repeat=3)]
    return np.array(found)


@pytest.mark.parametrize('shape', [
    box_shape('L', 0.02, 0.08, 0.03, ((0, 0, 0),) * 2),
    ObjectShape('disc', ((0.05, HALF_HEIGHT),), ((0, 0),), ((0, 0, 0),)),
    *(random_shape(np.random.default_rng(seed)) for seed in range(8))])
def test_a_box_is_as_small_as_what_is_in_it_allows(shape):
    parts, rng = corners(shape), np.random.default_rng(0)
    box = box_of(shape)
    np.testing.assert_allclose(box, [parts.max(axis=0), parts.min(axis=0)])
    for pose in (turned(rng) for _ in range(5)):
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, pose[[6, 3, 4, 5]])
        whole = np.array(list(product(*box.T))) @ turn.reshape(3, 3).T + pose[:3]
        np.testing.assert_allclose(
            box_around(box, pose), [whole.max(axis=0), whole.min(axis=0)], atol=1e-12)


def test_boxes_and_spheres_overlap_where_they_have_a_point_in_common():
    box = np.array([[1, 2, 3], [0, 0, 0]], float)
    assert overlaps_box(box, [[1.5, 2.5, 3.5], [0.9, 1.9, 2.9]])
    assert overlaps_box(box, [[0.6, 0.6, 0.6], [0.5, 0.5, 0.5]])
    for axis in range(3):
        for way in (1.01 * (box[0] - box[1]), -1.01 * (box[0] - box[1])):
            assert not overlaps_box(box, box + way * np.eye(3)[axis])
    assert overlaps_sphere(box, np.array([0.5, 0.5, 0.5]), 0)
    beside = np.array([1.3, 2.4, 1])  # 0.5 from an edge
    assert overlaps_sphere(box, beside, 0.501) and not overlaps_sphere(box, beside, 0.499)


@pytest.mark.parametrize('pattern, found', [
    ('object', '012'), ('_1', '1'), ('^object_[02]$', '02'), ('ject_(1|2)$', '12'),
    ('cup', ''), ('^1', ''), (r'[[:digit:]]', '012'), ('-e', ''), ('.*' * 50, '012'),
    ('(' * 20 + '.' + ')*' * 20 + 'x', '')])
def test_names_are_found_by_posix_extended_expressions(pattern, found):
    assert matching(pattern, NAMES) == [f'object_{number}' for number in found]


@pytest.mark.parametrize('pattern', [
    '(', '[', 'a' * 101, '((.{1,255}){1,255}){1,255}', 'a\nb', '\x00', '\ud800'])
def test_an_expression_that_cannot_be_matched_is_named(pattern):
    with pytest.raises(SceneError, match='expression') as caught:
        matching(pattern, NAMES)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


def test_an_object_is_put_and_nothing_else_moves(simulator):
    before, goal = simulator.reset(3), simulator.goal()
    simulator.put_object('object_1', FREE)
    after = simulator.observe()
    np.testing.assert_array_equal(after.object_poses[1], FREE)
    np.testing.assert_array_equal(after.object_poses[0], before.object_poses[0])
    np.testing.assert_array_equal(after.gripper, before.gripper)
    assert after.stamp_ns == before.stamp_ns and (after.image != before.image).any()
    assert simulator.goal() is goal
    later = simulator.step(np.zeros(4))  # it rests there
    np.testing.assert_allclose(later.object_poses[1], FREE, atol=1e-3)


def test_velocities_are_those_along_the_axes_of_the_world(simulator):
    simulator.reset(3)
    pose = np.array([-0.3, 0.3, 0.25, *(np.array([1, 2, 3, 4]) / np.sqrt(30))])
    velocity = [0.4, -0.2, 0.1, 3.0, -2.0, 1.0]
    simulator.put_object('object_0', pose, velocity)
    speed, change = simulator.object_motions()[0]
    np.testing.assert_allclose(speed.ravel(), velocity, atol=1e-12)
    np.testing.assert_allclose(change[0], [0, 0, -9.81], atol=1e-6)  # it falls
    for _ in range(2):  # of physics
        mujoco.mj_step(simulator.model, simulator.data)
    seconds = simulator.data.time
    moved = simulator.object_poses()[0]
    np.testing.assert_allclose((moved - pose)[:2] / seconds, velocity[:2], atol=1e-6)
    turn, back = np.empty(4), pose[[6, 3, 4, 5]] * (1, -1, -1, -1)
    mujoco.mju_mulQuat(turn, moved[[6, 3, 4, 5]], back)
    rate = np.empty(3)
    mujoco.mju_quat2Vel(rate, turn, seconds)
    np.testing.assert_allclose(rate, velocity[3:], atol=0.1)
    # What was read can be put again.
    motion = simulator.object_motions()[0, 0].ravel()
    simulator.put_object('object_0', moved, motion)
    np.testing.assert_allclose(simulator.object_motions()[0, 0].ravel(), motion, atol=1e-12)


@pytest.mark.parametrize('change, words', [
    ({0: np.nan}, 'finite'), ({5: np.inf}, 'finite'), ({6: 0.0}, 'quaternion'),
    ({6: 2.0}, 'quaternion'), ({0: 0.61}, 'out of reach'), ({1: -1e308}, 'out of reach'),
    ({2: 0.31}, 'out of reach'), ({2: -0.01}, 'out of reach'), ({2: 0.01}, 'the table')])
def test_a_pose_that_cannot_be_is_refused_and_all_stays_to_the_bit(simulator, change, words):
    simulator.reset(3)
    pose = np.array(FREE, float)
    for index, number in change.items():
        pose[index] = number
    before = simulator.state()
    with pytest.raises(PoseError, match=words) as caught:
        simulator.put_object('object_0', pose)
    assert '\n' not in str(caught.value)
    np.testing.assert_array_equal(simulator.state(), before)


def test_an_object_is_not_put_into_another_nor_into_the_fingers(simulator):
    simulator.reset(3)
    other = simulator.object_poses()[1]
    simulator.data.qpos[2] = 0.01  # the gripper comes down
    mujoco.mj_forward(simulator.model, simulator.data)
    before = simulator.state()
    with pytest.raises(PoseError, match='object_1'):
        simulator.put_object('object_0', other)
    hand = np.array([*simulator.data.qpos[:2], HALF_HEIGHT, *FREE[3:]])
    with pytest.raises(PoseError, match='finger'):
        simulator.put_object('object_0', hand)
    np.testing.assert_array_equal(simulator.state(), before)


@pytest.mark.parametrize('velocity', [
    (0, 0, 0), (np.nan, 0, 0, 0, 0, 0), (0, 0, 0, 0, np.inf, 0), (2.1, 0, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, -21)])
def test_a_velocity_that_cannot_be_is_refused(simulator, velocity):
    simulator.reset(3)
    before = simulator.state()
    with pytest.raises(SceneError, match='velocity') as caught:
        simulator.put_object('object_0', FREE, velocity)
    assert not isinstance(caught.value, PoseError)
    np.testing.assert_array_equal(simulator.state(), before)


def test_a_pose_has_seven_numbers(simulator):
    simulator.reset(3)
    for pose in (FREE[:6], (*FREE, 0), [FREE], ()):
        with pytest.raises(PoseError, match='7'):
            simulator.put_object('object_0', pose)


@pytest.mark.parametrize('name', ['object_2', 'gripper_x', '', '\x1b'])
def test_only_objects_of_the_scene_are_put(simulator, name):
    simulator.reset(3)
    with pytest.raises(SceneError, match='not in the scene'):
        simulator.put_object(name, FREE)
