# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of tasks and their experts: grasping, stacking, pushing in order; and one that is added."""

from examples.my_package.task import VISIT
import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.motions import Moment
from sim_bridge.tasks.order import best_push, find_order
from sim_bridge.tasks.stack import is_tower
from sim_bridge.tasks.tasks import run_episode, sample_scene, task_names
from tap_ros.base import plugins
from tap_ros.base.contract import SUCCESS_DISTANCE
from tap_ros.recording.cache import open_recordings

NUM_FRAMES = {'grasp': 15, 'pick_place': 20}
SEEDS = range(6)
gripping = pytest.mark.parametrize('simulator', NUM_FRAMES, indirect=True)


@pytest.fixture(scope='module')
def simulator(request):
    simulator = Simulator(request.param, 64)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    seeds = SEEDS[:3] if simulator.task.kind == 'stack' else SEEDS
    return [run_episode(simulator, seed) for seed in seeds]


def tracks(observations):
    """Return positions of the object and of the gripper, (T, 3) each, and openings (T,)."""
    grippers = np.array([o.gripper for o in observations], float)
    return np.array([o.object_poses[0, :3] for o in observations]), grippers[:, :3], grippers[:, 3]


@gripping
def test_what_is_grasped_is_held_as_long_as_the_fingers_are_closed(simulator, episodes):
    frames, places = set(), []
    for observations, actions, outcome in episodes:
        assert len(observations) == len(actions) == NUM_FRAMES[simulator.task.name]
        assert not actions[-1].any(), 'nothing is done after the last frame'
        objects, grippers, opening = tracks(observations)
        opened = actions[:-1, 3] == 1  # then the fingers have just closed on the object:
        first = int(np.flatnonzero(opened[:-1] & (actions[1:-1, 3] == 0))[0]) + 2
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
    assert len(places) >= 0.6 * len(episodes), 'most succeed'
    assert len(frames) >= 2 and np.std(places, axis=0).max() > 0.015, 'it varies'


@pytest.mark.parametrize('simulator', ['stack2'], indirect=True)
def test_most_towers_stand_and_episodes_end_with_the_release(simulator, episodes):
    assert np.mean([outcome == 'success' for *_, outcome in episodes]) >= 0.6
    for observations, actions, outcome in episodes:
        assert len(observations) == len(actions) <= simulator.task.num_frames
        if outcome == 'success':
            assert is_tower(observations[-1].object_poses)
            assert not is_tower(observations[-10].object_poses), 'the tower is not shown for long'
            opening = np.array([o.gripper[3] for o in observations])
            assert opening[-1] > 0.9 and opening[-4] < 0.9


def ends_of_pushes(simulator, seed, order):
    """Return in m how far objects end from their goals, pushed in that order, the worst again."""
    simulator.reset(seed)
    moment, goals = Moment.of(simulator), simulator.goal_poses[:, :3]
    rng = np.random.default_rng(seed)
    for k in order:
        moment, _ = best_push(simulator, moment, goals, k, rng)
    worst = int(np.linalg.norm(moment.places - goals, axis=1).argmax())
    moment, _ = best_push(simulator, moment, goals, worst, rng)
    return np.linalg.norm(moment.places - goals, axis=1)


@pytest.mark.parametrize('simulator', ['order2'], indirect=True)
def test_the_wrong_order_fails_and_the_right_one_is_found_and_succeeds(simulator):
    right, wrong, found = [], [], []
    for seed in SEEDS[:3]:
        order = sample_scene(simulator.task, seed).order
        right.append(ends_of_pushes(simulator, seed, order))
        wrong.append(ends_of_pushes(simulator, seed, order[::-1]))
        simulator.reset(seed)
        goals = simulator.goal_poses[:, :3]
        best = find_order(simulator, Moment.of(simulator), goals, range(len(goals)),
                          np.random.default_rng(seed))
        found.append(best[0] == order[0])
    good, bad = (np.max(ends, axis=1) < SUCCESS_DISTANCE for ends in (right, wrong))
    assert good.mean() > 0.6 and not bad.any() and np.mean(found) > 0.6


def test_another_package_adds_a_task_in_a_few_lines(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, 'visit', VISIT, raising=False)
    monkeypatch.setitem(plugins.BUILT_IN['tap_ros.tasks'], 'visit', 'tap_ros.base.plugins:visit')
    assert 'visit' in task_names()
    simulator = Simulator('visit')
    simulator.reset(0)
    assert simulator.outcome() == 'failure' and simulator.distances() < 1e-3
    simulator.close()
    # In this process: another one does not know what a test adds.
    monkeypatch.setattr('sim_bridge.collect.run_tasks', lambda tasks, *_: (
        (task, lambda task=task: task.function(*task.args)) for task in tasks))
    collect(tmp_path / 'bag', CollectConfig(task='visit', episodes=1), progress=False)
    episode, = open_recordings(tmp_path / 'bag')
    assert (episode.task, episode.outcome, len(episode.frames)) == ('visit', 'success', 10)
