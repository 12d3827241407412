# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of goals and objects that are put elsewhere: what follows, what stays, what is refused."""

import mujoco
import numpy as np
import pytest
from sim_bridge.simulator import PoseError, Simulator
from sim_bridge.tasks.tasks import get_task, sample_scene
from sim_bridge.world.scene import HALF_HEIGHT
from sim_bridge.world.table import GRIPPER_MARGIN
from tap_ros.contract import ROBOT_MASK_FREE
from tap_ros.errors import SceneError

PLACES = np.array([[0.2, 0.1], [-0.15, -0.2]])
FREE = (-0.3, 0.3, HALF_HEIGHT, 0, 0, 0, 1)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


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


def test_objects_that_are_not_named_stay_and_pixels_are_those_of_the_goal_picture(simulator):
    simulator.reset(3)
    goal = simulator.goal()
    poses, names = goal.object_poses, goal.object_names
    simulator.move_goal(names[::-1], goal.object_pixels[::-1])
    np.testing.assert_allclose(simulator.goal_poses[:, :2], poses[:, :2], atol=1e-6)
    simulator.move_goal(names[1:], np.array([[15.25, 30.5]]))
    np.testing.assert_allclose(simulator.goal_poses[0, :2], poses[0, :2], atol=1e-6)
    np.testing.assert_allclose(simulator.goal().object_pixels[1], [15.25, 30.5], atol=1e-5)


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
                simulator.set_goal(PLACES)
                simulator.photograph(simulator.goal_poses)
                for unfit in (lambda: simulator.set_goal(np.zeros((2, 2))),
                              lambda: simulator.put_object('object_0', np.zeros(7))):
                    with pytest.raises(SceneError):
                        unfit()
                np.testing.assert_array_equal(simulator.observe().image, run[-1].image)
        runs.append(run)
    assert np.linalg.norm(runs[0][-1].object_poses[0] - runs[0][0].object_poses[0]) > 0.03
    for a, b in zip(*runs):
        for field in ('image', 'object_poses', 'gripper'):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
        assert a.stamp_ns == b.stamp_ns


def test_a_goal_that_cannot_be_is_refused_and_the_old_one_stays(simulator):
    simulator.reset(3)
    simulator.set_goal(PLACES)
    before, state = simulator.goal(), simulator.state()
    for places, words in (
            (PLACES[:1], r'shape \(2, 2\), got \(1, 2\)'), (np.zeros((2, 3)), r'\(2, 3\)'),
            ([[0.2, 0.1], [0.1, -0.351]], 'object_1.*-0.351.*0.35 m'),
            ([[np.nan, 0.1], [0.1, 0.1]], 'object_0.*nan.*0.35 m'),
            ([[0.1, np.inf], [0.1, 0.1]], 'object_0.*inf.*0.35 m'),
            ([[0.1, 0.1], [0.1, 0.1]], 'object_0 and object_1 would overlap')):
        with pytest.raises(SceneError, match=words):
            simulator.set_goal(places)
    for unfit, words in (((), 'empty.*object_0'), (('cup',), 'cup.*object_0, object_1')):
        with pytest.raises(SceneError, match=words):
            simulator.move_goal(unfit, np.zeros((len(unfit), 2)))
    assert simulator.goal() is before
    np.testing.assert_array_equal(simulator.state(), state)
    for task, words in (('grasp', 'grasp.*push2, push3'), ('order2', '0.38 m')):
        other = Simulator(task)
        other.reset(0)
        if task == 'order2':  # objects may be as far out as they are there
            other.set_goal([[0.38, 0.0], [0.0, -0.38]])
        with pytest.raises(SceneError, match=words):
            other.set_goal([[0.381, 0.0], [0.0, -0.38]])
        other.close()


@pytest.mark.parametrize('kinds', [('disc', 'disc'), ('L', 'T'), ('bar', 'disc')])
def test_objects_overlap_wherever_one_reaches_into_the_other(simulator, kinds):
    seed = next(seed for seed in range(2000) if tuple(
        shape.kind for shape in sample_scene(get_task('push2'), seed).shapes) == kinds)
    simulator.reset(seed)
    refused = []
    for gap in np.arange(0, 0.35, 0.01):
        try:
            simulator.set_goal([[-gap / 2, 0.01], [gap / 2, 0.01]])
            refused.append(False)
        except SceneError:
            refused.append(True)
    # One in the other is the worst; from some distance on they are apart.
    nearest = refused.index(False)
    assert all(refused[:nearest]) and not any(refused[nearest:])
    assert 0.04 < 0.01 * nearest < 0.3
    if kinds == ('disc', 'disc'):
        reach = sum(shape.half_sizes[0][0] for shape in simulator.scene.shapes)
        simulator.set_goal([[0, 0], [reach + 1e-3, 0]])
        with pytest.raises(SceneError, match='object_0 and object_1 would overlap'):
            simulator.set_goal([[0, 0], [reach - 1e-3, 0]])


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
    np.testing.assert_allclose(simulator.object_motions()[0], velocity, atol=1e-12)
    for _ in range(2):  # of physics
        mujoco.mj_step(simulator.model, simulator.data)
    moved, seconds = simulator.object_poses()[0], simulator.data.time
    np.testing.assert_allclose((moved - pose)[:2] / seconds, velocity[:2], atol=1e-6)
    turn, rate = np.empty(4), np.empty(3)
    mujoco.mju_mulQuat(turn, moved[[6, 3, 4, 5]], pose[[6, 3, 4, 5]] * (1, -1, -1, -1))
    mujoco.mju_quat2Vel(rate, turn, seconds)
    np.testing.assert_allclose(rate, velocity[3:], atol=0.1)


def test_an_object_is_not_put_where_it_cannot_be(simulator):
    simulator.reset(3)
    other = simulator.object_poses()[1]
    simulator.data.qpos[2] = 0.01  # the gripper comes down
    mujoco.mj_forward(simulator.model, simulator.data)
    hand = np.array([*simulator.data.qpos[:2], HALF_HEIGHT, *FREE[3:]])
    before = simulator.state()
    for pose, words in (
            *((np.where(np.arange(7) == i, number, FREE), words) for i, number, words in (
                (0, np.nan, 'finite'), (5, np.inf, 'finite'), (6, 0.0, 'quaternion'),
                (6, 2.0, 'quaternion'), (0, 0.61, 'out of reach'), (1, -1e308, 'out of reach'),
                (2, 0.31, 'out of reach'), (2, -0.01, 'out of reach'), (2, 0.01, 'the table'))),
            (other, 'object_1'), (hand, 'finger'), (FREE[:6], '7'), ([FREE], '7'), ((), '7')):
        with pytest.raises(PoseError, match=words) as caught:
            simulator.put_object('object_0', pose)
        assert '\n' not in str(caught.value)
    for velocity in ((0, 0, 0), (np.nan, 0, 0, 0, 0, 0), (0, 0, 0, 0, np.inf, 0),
                     (2.1, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, -21)):
        with pytest.raises(SceneError, match='velocity') as caught:
            simulator.put_object('object_0', FREE, velocity)
        assert not isinstance(caught.value, PoseError)
    for name in ('object_2', 'gripper_x', '', '\x1b'):
        with pytest.raises(SceneError, match='not in the scene'):
            simulator.put_object(name, FREE)
    np.testing.assert_array_equal(simulator.state(), before)
