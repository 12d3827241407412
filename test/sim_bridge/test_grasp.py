# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of grasping, picking and placing: friction holds, episodes are equally long, they vary."""

from dataclasses import replace

import numpy as np
import pytest
from sim_bridge.collect import make_episode
from sim_bridge.simulator import Simulator
from sim_bridge.tasks import grasp
from sim_bridge.tasks.grasp import GraspConfig, LIFT_HEIGHT
from sim_bridge.tasks.tasks import run_episode

NUM_FRAMES = {'grasp': 15, 'pick_place': 20}
SEEDS = range(12)


@pytest.fixture(scope='module', params=NUM_FRAMES)
def simulator(request):
    simulator = Simulator(request.param)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    return [run_episode(simulator, seed) for seed in SEEDS]


def tracks(observations):
    """Return positions of the object and of the gripper, (T, 3) each, and openings (T,)."""
    grippers = np.array([o.gripper for o in observations], float)
    return np.array([o.object_poses[0, :3] for o in observations]), grippers[:, :3], grippers[:, 3]


def closing(actions):
    """Return the frame at which the fingers have just closed on the object."""
    opening = actions[:-1, 3]
    return int(np.flatnonzero((opening[:-1] == 1) & (opening[1:] == 0))[0]) + 2


def test_what_is_grasped_is_held_as_long_as_the_fingers_are_closed(simulator, episodes):
    frames, places, rests = set(), [], []
    for observations, actions, outcome in episodes:
        assert len(observations) == len(actions) == NUM_FRAMES[simulator.task.name]
        assert not actions[-1].any(), 'nothing is done after the last frame'
        objects, grippers, opening = tracks(observations)
        near = (np.linalg.norm(grippers[:, :2] - objects[:, :2], axis=1) < 0.12) & (
            grippers[:, 2] < 0.075) & (opening > 0.5)
        before = int(near.argmax())  # the first touch happens on the way to this frame at most
        assert before > 1
        assert np.linalg.norm(objects[:before] - objects[0], axis=1).max() < 0.001
        first = closing(actions)
        assert opening[0] < 0.05 and opening[first - 1] > 0.9, 'open when it comes down'
        if outcome != 'success':
            continue
        assert 0.15 < opening[first + 1] < 0.8, 'as far as the object is thick'
        closed = int((np.append(actions[first:-1, 3], 1) == 1).argmax())  # frames till it lets go
        top = first + int(grippers[first:first + closed + 1, 2].argmax())
        below = grippers[first:top + 1, 2] - objects[first:top + 1, 2]
        assert objects[top, 2] - objects[0, 2] > 0.05 and np.ptp(below) < 0.012, 'it slips'
        frames.add(first)
        places.append((grippers - objects)[first, :2])
        if simulator.task.kind == 'pick_place':
            assert opening[-1] > 0.9, 'let go'
            opens = first + int(np.argmax(actions[first:, 3] == 1))
            still = np.linalg.norm(grippers[:opens + 1] - grippers[opens], axis=1) < 0.01
            rests.append(int(still[opens - 2:opens].sum()) == 2)
    assert len(frames) >= 3 and np.std(places, axis=0).max() > 0.015, 'it varies'
    assert not rests or np.mean(rests) >= 0.7, 'before it lets go the hand rests at the place'


def test_most_episodes_succeed_and_a_careless_expert_often_fails(
        simulator, episodes, monkeypatch):
    good = np.mean([outcome == 'success' for *_, outcome in episodes])
    careless = replace(GraspConfig(), explore=1.0)
    monkeypatch.setattr(grasp, 'GraspConfig', lambda: careless)
    bad = np.mean([run_episode(simulator, seed)[2] == 'success' for seed in SEEDS[:8]])
    assert good >= 0.75 and bad < good - 0.2


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


def test_the_goal_is_what_the_task_says(simulator, episodes):
    simulator.reset(3)
    goal = simulator.goal().object_poses[0]
    start = simulator.object_poses()[0]
    assert simulator.outcome() == 'failure', 'nothing is done yet'
    if simulator.task.kind == 'grasp':
        np.testing.assert_allclose(goal[:3] - start[:3], [0, 0, LIFT_HEIGHT], atol=1e-6)
        assert simulator.distances()[0] == pytest.approx(LIFT_HEIGHT, abs=1e-3)
        simulator.data.joint('object_0').qpos[2] += 0.3
        simulator.observe()
        assert simulator.outcome() == 'failure', 'what is thrown is not grasped'
    else:
        np.testing.assert_allclose(goal[:2], simulator.scene.goal_poses[0, :2])
        assert goal[2] == pytest.approx(start[2], abs=1e-3)
    seen, alone = simulator.goal(), simulator.goal(hide_arm=True)
    assert (seen.image != alone.image).any(), 'the arm is in the goal picture'
    episode = make_episode(simulator, *episodes[1])
    np.testing.assert_array_equal(episode.goal_frame, episode.frames[-1])
    np.testing.assert_array_equal(episode.goal_poses, episode.object_poses[-1])
