# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment is a World: a dummy of a few lines, and Meta-World."""

from dataclasses import replace
import json

from examples.my_package.world import Dot
import numpy as np
import pytest
from sim_bridge.collect import BOTTLENECKS_FILE, collect, CollectConfig
from sim_bridge.demonstrations import demonstrate, find_bottleneck
from sim_bridge.pushes import push_to_goal
from sim_bridge.world.protocol import make_world
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError, SceneError, TapError
from tap_ros.recording.cache import open_recordings


def test_an_environment_becomes_a_world_in_a_few_lines():
    world = Dot()
    with pytest.raises(SceneError, match='reset it first'):
        world.observe()
    start, goal = world.reset(3), world.goal()
    np.testing.assert_allclose(goal.object_poses - start.object_poses, [[.1, 0, 0, 0, 0, 0, 0]])
    assert world.outcome() == 'failure'
    seen = world.step([0.05, 0, 0, 0])
    assert world.distances() == pytest.approx([0.05]) and seen.stamp_ns == 250_000_000
    world.step([0.05, 0, 0, 0])
    assert world.outcome() == 'success'
    for bad in ([0, 0, 0], [np.nan, 0, 0, 0]):
        with pytest.raises(SceneError, match='4 finite numbers'):
            world.step(bad)


class Sagging(Dot):
    """Ends 4 mm lower than it shall, and never beyond y = 0.1 m."""

    def move(self, target, opening):
        self.place = np.minimum(target - (0, 0, 0.004), (1, 0.1, 1))


def test_what_sags_is_held_and_what_was_blocked_comes_back_at_once():
    world = Sagging()
    world.reset(3)
    heights = [world.step([0, 0.08, 0.02 * (t == 0), 0]).gripper[2] for t in range(20)]
    np.testing.assert_allclose(heights, 0.016, atol=1e-6)
    assert world.step([0, -0.08, 0, 0]).gripper[1] < 0.1 - 0.05


@pytest.fixture(scope='module')
def metaworld():
    pytest.importorskip('metaworld')
    world = make_world('metaworld', 'push-v3', 64)
    yield world
    world.close()


def test_meta_world_moves_as_it_is_told_and_repeats_from_its_seed(metaworld):
    first = metaworld.reset(5)
    assert (first.robot_mask > 0).any()
    seen = [metaworld.step([0.05, -0.02, 0, 1]) for _ in range(3)][-1]
    np.testing.assert_allclose(
        seen.gripper[:3] - first.gripper[:3], [0.15, -0.06, 0], atol=0.01)
    again, goal = metaworld.reset(5), metaworld.goal()
    np.testing.assert_array_equal(again.image, first.image)
    assert np.linalg.norm(goal.object_poses[0, :3] - again.object_poses[0, :3]) > 0.1
    assert metaworld.distances() > 0.1 and metaworld.outcome() == 'failure'
    gap = np.linalg.norm(goal.object_poses[0, :3] - metaworld.goal_places()[0])
    assert gap < 0.05  # its own tolerance
    changed = np.abs(goal.image.astype(int) - again.image).max(-1) > 30
    u, v = np.rint(goal.object_pixels[0]).astype(int)
    assert changed[v - 2:v + 3, u - 2:u + 3].any()


def test_scripts_of_meta_world_demonstrate_as_unsteadily_as_people_do(tmp_path):
    pytest.importorskip('metaworld')
    folder = tmp_path / 'bag'
    config = CollectConfig(
        world='metaworld', task='plate-slide-v3', episodes=2, episodes_per_file=1, seed=3)
    told = collect(folder, config, Engine(workers=1), progress=False)
    assert told['success_rate'] == 1 and told['bottlenecks'] == {'': 2}
    first, second = open_recordings(folder)
    assert (first.task, first.seed, first.outcome) == ('plate-slide-v3', 3, 'success')
    assert len({12, len(first), len(second)}) == 3, 'each goes its own way at its own speed'
    assert (first.frames[0] != second.frames[0]).any(), 'each has a scene of its own'
    marks = json.loads((folder / BOTTLENECKS_FILE).read_text())['marks']
    assert [mark['episode'] for mark in marks] == [0, 1]
    for mark, episode in zip(marks, (first, second)):
        (begin, end), = mark['stamps']
        assert episode.stamps[0] < 1e9 * begin <= 1e9 * end < episode.stamps[-1]
    # An interrupted collection goes on to the same files.
    whole = (folder / 'bag_1.mcap').read_bytes()
    (folder / BOTTLENECKS_FILE).write_text(json.dumps({'marks': marks[:1]}))
    assert collect(folder, config, Engine(workers=1), progress=False)['episodes'] == 1
    assert (folder / 'bag_1.mcap').read_bytes() == whole
    assert json.loads((folder / BOTTLENECKS_FILE).read_text())['marks'] == marks
    for bad, words in (({'look': 'arm', 'misses': 0.5}, 'misses, look: of world mujoco_table'),
                       ({'task': 'door-opn-v3'}, "'door-opn-v3' is unknown")):
        with pytest.raises(TapError, match=words):
            collect(tmp_path / 'bad', replace(config, **bad), progress=False)
    assert not (tmp_path / 'bad').exists()


class Slider:
    """A hand that goes to a thing at 1 m and pushes it by 0.5 m."""

    task_name, steps, step_ns, scale = 'slide', 2, 10 ** 7, np.full(3, 0.02)
    reach = np.array([[-0.1, -0.1, 0], [0.1, 0.1, 0]])

    def begin(self, seed):
        self.at, self.thing = np.zeros(3), 1.0

    def act(self, command):
        self.at = self.at + 0.02 * command[:3]
        self.thing = max(self.thing, self.at[0])

    def command(self):
        return np.array([np.clip(10 * (1.5 - self.at[0]), -1, 1), *(-10 * self.at[1:]), 1.0])

    def hand(self):
        return self.at

    def movable(self):
        return np.array([self.thing])

    def gap(self):
        return min(self.thing - self.at[0], 0.03)

    def picture(self):
        return np.full((4, 4, 3), 100 * self.thing, np.uint8)

    def succeeds(self):
        return self.thing > 1.45


def test_the_bottleneck_is_where_the_hand_is_at_what_it_is_about_to_move():
    stage = Slider()
    lengths = set()
    for seed in range(5):
        found = demonstrate(stage, seed, 300)
        things = found.episode.frames[:, 0, 0, 0]
        first, last = found.bottleneck
        assert found.episode.outcome == 'success' and 0 < first <= last
        way = found.episode.actions[:, 0].sum()
        assert abs(way - stage.at[0]) < 0.05 and found.episode.actions[-2, 3] == 0, 'its commands'
        assert (things[:first] == 100).all() and 100 < things[last] < 112
        lengths.add(len(things))
    assert len(lengths) > 2, 'each goes at its own speed'


def test_what_settles_or_is_struck_in_passing_is_not_the_bottleneck_and_why_none_is_known():
    hand = np.zeros((20, 3))
    hand[:, 0] = [0, 0, .1, .2, .2, .1, .0, -.1, .2, .4, .6, .8, .98, .98, 1, 1, 1, 1.02, 1.1, 1.5]
    thing = np.where(np.arange(20) < 3, 0.85, 0.9) + np.maximum(0, hand[:, 0] - 1)  # it settles
    gap = np.clip(1 - hand[:, 0], 0, 0.03)

    def found(gap=gap, thing=thing):
        return find_bottleneck(hand, thing[:, None], gap)
    assert found() == ((14, 18), '')
    gap[3:5], thing[4:] = 0.001, thing[4:] + 0.1  # on a detour
    assert found() == ((14, 18), '')
    assert found(thing=np.ones(20)) == (None, 'nothing moves')
    assert found(np.full(20, 0.03)) == (None, 'the robot touches nothing that moves')
    assert found(np.zeros(20)) == (None, 'the hand is there from the start')
    late = np.arange(20) == 19
    assert found(np.where(late, 0, 0.03), 1.0 * late) == (
        None, 'the hand comes with the last frame')


def test_pushes_are_recorded_as_a_planner_and_its_model_need_them(tmp_path):
    pytest.importorskip('metaworld')
    for task, pushes in (('plate-slide-v3', 'goal'), ('push-v3', 'random')):
        folder = tmp_path / task
        config = CollectConfig(world='metaworld', task=task, pushes=pushes, episodes=1,
                               seed=3, image_size=32)
        collect(folder, config, Engine(workers=1), progress=False)
        episode, = open_recordings(folder)
        assert episode.object_source == 'ground_truth' and episode.robot_masks.any()
        moved = episode.grippers[1:, :3] - episode.grippers[:-1, :3]
        assert np.median(np.abs(moved - episode.actions[:-1, :3])) < 0.01, 'as it was told'
        if pushes == 'goal':
            assert (episode.task, episode.outcome) == (task, 'success')
            places = episode.object_poses[:, 0]
            way = np.linalg.norm(places - places[0], axis=1)
            assert way[:4].max() < 0.01 and way[-1] > 0.1
    for bad, words in (({'task': 'door-open-v3'}, 'nothing can be pushed about in door-open-v3'),
                       ({'world': 'mujoco_table', 'task': 'push2'}, 'see misses')):
        with pytest.raises(ConfigError, match=words):
            collect(tmp_path / 'bad', replace(config, **bad), progress=False)
    assert not (tmp_path / 'bad').exists()


def test_what_stands_in_the_way_is_passed_by():
    pytest.importorskip('metaworld')
    world = make_world('metaworld', 'push-wall-v3', 32)
    around = [world.demonstrate(seed, pushes='goal').episode for seed in (500, 501)]
    assert {episode.outcome for episode in around} == {'success'}
    for episode in around:
        for way in world.ways:
            gaps = episode.object_poses[:, 0, :2] - way
            assert np.linalg.norm(gaps, axis=1).min() < 0.06
    world.close()


@pytest.fixture(scope='module')
def ogbench():
    pytest.importorskip('ogbench')
    world = make_world('ogbench', 'cube-double', 64)
    yield world
    world.close()


def test_ogbench_moves_as_it_is_told_and_repeats_from_its_seed(ogbench):
    first = ogbench.reset(5)
    seen = [ogbench.step([0.05, -0.02, -0.01, 0]) for _ in range(3)][-1]
    np.testing.assert_allclose(
        seen.gripper[:3] - first.gripper[:3], [0.15, -0.06, -0.03], atol=0.01)
    again, goal = ogbench.reset(5), ogbench.goal()
    np.testing.assert_array_equal(again.image, first.image)
    np.testing.assert_array_equal(again.object_poses, first.object_poses)
    assert set(np.unique(again.robot_mask)) <= {0, 128, 255} and (again.robot_mask == 128).any()
    np.testing.assert_allclose(goal.object_poses[:, :3], ogbench.goal_places(), atol=1e-6)
    for seen in (again, goal):
        u, v = np.rint(seen.object_pixels).astype(int).T
        assert (seen.image[v, u].max(1) > 150).all(), 'cubes are seen where they are'
    first, last = ogbench.order
    gap = goal.object_poses[last, :2] - again.object_poses[first, :2]
    assert np.linalg.norm(gap) < 0.03, 'one cube stands where the other shall be'
    with pytest.raises(SceneError, match='valid: cube-double'):
        make_world('ogbench', 'cube-triple', 64)


def test_in_ogbench_the_order_decides(ogbench):
    ends = []
    for turn in (1, -1):
        ogbench.reset(0)
        for action in push_to_goal(ogbench, route=ogbench.route()[::turn]):
            ogbench.step(action)
        ends.append(ogbench.outcome())
    assert ends == ['success', 'failure']
