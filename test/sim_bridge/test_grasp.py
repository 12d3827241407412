# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of grasping, picking and placing: friction holds, episodes are equally long, they vary."""

import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig, make_episode
from sim_bridge.simulator import Simulator
from sim_bridge.tasks import grasp
from sim_bridge.tasks.grasp import (
    grasp_place,
    graspable_shape,
    graspable_yaw,
    GraspConfig,
    LIFT_HEIGHT,
)
from sim_bridge.tasks.tasks import run_episode
from tap_ros.errors import ConfigError

NUM_FRAMES = {'grasp': 15, 'pick_place': 20}
SEEDS = range(12)


@pytest.fixture(scope='module', params=NUM_FRAMES)
def simulator(request):
    simulator = Simulator(request.param)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    return [run_episode(simulator, seed)[:3] for seed in SEEDS]


def tracks(observations):
    """Return positions of the object and of the gripper, (T, 3) each, and openings (T,)."""
    grippers = np.array([o.gripper for o in observations], float)
    return np.array([o.object_poses[0, :3] for o in observations]), grippers[:, :3], grippers[:, 3]


def closing(actions):
    """Return the frame at which the fingers have just closed on the object."""
    opening = actions[:-1, 3]
    return int(np.flatnonzero((opening[:-1] == 1) & (opening[1:] == 0))[0]) + 2


def test_episodes_are_all_equally_long(simulator, episodes):
    for observations, actions, _ in episodes:
        assert len(observations) == len(actions) == NUM_FRAMES[simulator.task.name]
        assert not actions[-1].any(), 'nothing is done after the last frame'


def test_most_episodes_succeed_and_a_careless_expert_often_fails(simulator, episodes):
    good = np.mean([outcome == 'success' for *_, outcome in episodes])
    careless = GraspConfig(explore=1.0)
    bad = np.mean([run_episode(simulator, s, careless)[2] == 'success' for s in SEEDS])
    assert good >= 0.75
    assert bad < good - 0.2


def test_an_object_is_still_until_the_fingers_come_down_to_it(episodes):
    for observations, _, _ in episodes:
        objects, grippers, opening = tracks(observations)
        near = (np.linalg.norm(grippers[:, :2] - objects[:, :2], axis=1) < 0.12) & (
            grippers[:, 2] < 0.075) & (opening > 0.5)
        before = int(near.argmax())  # the first touch happens on the way to this frame at most
        assert before > 1
        moved = np.linalg.norm(objects[:before] - objects[0], axis=1)
        assert moved.max() < 0.001


def test_a_held_object_rises_with_the_gripper_and_does_not_slip(episodes):
    for observations, actions, outcome in episodes:
        if outcome != 'success':
            continue
        objects, grippers, _ = tracks(observations)
        first = closing(actions)
        closed = int((np.append(actions[first:-1, 3], 1) == 1).argmax())  # frames till it lets go
        top = first + int(grippers[first:first + closed + 1, 2].argmax())
        held = slice(first, top + 1)
        assert objects[top, 2] - objects[0, 2] > 0.05
        below = grippers[held, 2] - objects[held, 2]
        assert np.ptp(below) < 0.012, 'it sinks through the fingers'


def test_without_friction_the_same_motions_lift_nothing(simulator, episodes):
    seed = next(s for s, (*_, outcome) in zip(SEEDS, episodes) if outcome == 'success')
    observations, actions, _ = episodes[seed]
    assert tracks(observations)[0][:, 2].max() > 0.08
    simulator.reset(seed)
    simulator.model.geom_friction[:, 0] = 0.02
    simulator.model.geom('table').friction[0] = 1
    for side in ('left', 'right'):
        # Else the rougher of two surfaces counts.
        simulator.model.geom(f'{side}_finger').priority[:] = 1
    heights = [simulator.step(a).object_poses[0, 2] for a in actions[:-1]]
    assert max(heights) < 0.07


def test_the_fingers_open_before_and_hold_the_object_after(simulator, episodes):
    for observations, actions, outcome in episodes:
        _, _, opening = tracks(observations)
        first = closing(actions)
        assert opening[0] < 0.05
        assert opening[first - 1] > 0.9, 'open when it comes down'
        if outcome == 'success':
            assert 0.15 < opening[first + 1] < 0.8, 'as far as the object is thick'
            if simulator.task.kind == 'pick_place':
                assert opening[-1] > 0.9, 'let go'


def test_when_and_where_the_object_is_grasped_varies(episodes):
    frames, places = set(), []
    for observations, actions, outcome in episodes:
        if outcome == 'success':
            objects, grippers, _ = tracks(observations)
            frames.add(closing(actions))
            places.append((grippers - objects)[closing(actions), :2])
    assert len(frames) >= 3
    assert np.std(places, axis=0).max() > 0.015


def test_other_whims_grasp_the_same_object_elsewhere():
    shape = graspable_shape(np.random.default_rng(2))
    yaws = [graspable_yaw(shape, np.random.default_rng(seed)) for seed in range(20)]
    assert np.std(yaws) > 0.1
    for yaw in yaws:
        place, held_yaw, half_gap = grasp_place(shape, yaw)
        assert np.linalg.norm(place) < 0.1 and half_gap < 0.03
        assert abs(held_yaw / (np.pi / 2) - round(held_yaw / (np.pi / 2))) < 1e-9, 'along x and y'


def test_the_goal_is_what_the_task_says(simulator):
    simulator.reset(3)
    goal = simulator.goal().object_poses[0]
    start = simulator.object_poses()[0]
    assert simulator.outcome() == 'failure', 'nothing is done yet'
    if simulator.task.kind == 'grasp':
        np.testing.assert_allclose(goal[:3] - start[:3], [0, 0, LIFT_HEIGHT], atol=1e-6)
        assert simulator.distances()[0] == pytest.approx(LIFT_HEIGHT, abs=1e-3)
    else:
        np.testing.assert_allclose(goal[:2], simulator.scene.goal_poses[0, :2])
        assert goal[2] == pytest.approx(start[2], abs=1e-3)
    seen, alone = simulator.goal(), simulator.goal(hide_arm=True)
    assert (seen.image != alone.image).any(), 'the arm is in the goal picture'


def test_a_thrown_object_is_not_a_grasped_one():
    simulator = Simulator('grasp')
    simulator.reset(0)
    simulator.data.joint('object_0').qpos[2] += 0.3
    simulator.observe()
    assert simulator.outcome() == 'failure'
    simulator.close()


def test_the_goal_of_a_recorded_episode_is_its_last_frame(simulator):
    observations, actions, outcome, _ = run_episode(simulator, 1)
    episode = make_episode(simulator, observations, actions, outcome)
    np.testing.assert_array_equal(episode.goal_frame, episode.frames[-1])
    np.testing.assert_array_equal(episode.goal_poses, episode.object_poses[-1])


def test_the_same_seed_gives_the_same_bytes_and_another_expert_is_refused(simulator, tmp_path):
    config = CollectConfig(simulator.task.name, episodes=2, episodes_per_file=2, seed=7)
    for name in 'ab':
        collect(tmp_path / name / 'bag', config, progress=False)
    a, b = ((tmp_path / name / 'bag' / 'bag_0.mcap').read_bytes() for name in 'ab')
    assert a == b
    other = CollectConfig(simulator.task.name, episodes=2, episodes_per_file=2, seed=7,
                          expert=GraspConfig(explore=0.5))
    with pytest.raises(ConfigError, match='expert'):
        collect(tmp_path / 'a' / 'bag', other, progress=False)


def test_the_object_is_held_near_its_centre_where_that_is_possible(monkeypatch):
    simulator = Simulator('grasp')

    def mean_distance():
        distances = []
        for seed in SEEDS:
            observations, actions, outcome = run_episode(simulator, seed)[:3]
            objects, grippers, _ = tracks(observations)
            if outcome == 'success':
                distances.append(np.linalg.norm((grippers - objects)[closing(actions), :2]))
        return np.mean(distances)

    near = mean_distance()
    monkeypatch.setattr(grasp, 'OFF_CENTRE', 0.0)
    assert near < 0.75 * mean_distance()
    simulator.close()


def test_before_it_lets_go_the_hand_rests_at_the_place():
    simulator, rests = Simulator('pick_place'), []
    for seed in SEEDS:
        observations, actions, outcome = run_episode(simulator, seed)[:3]
        _, grippers, _ = tracks(observations)
        if outcome == 'success':
            opens = closing(actions) + int(np.argmax(actions[closing(actions):, 3] == 1))
            still = np.linalg.norm(grippers[:opens + 1] - grippers[opens], axis=1) < 0.01
            rests.append(int(still[opens - 2:opens].sum()))
    simulator.close()
    assert len(rests) >= 8 and np.mean(np.array(rests) == 2) >= 0.7, rests
