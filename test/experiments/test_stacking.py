# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of stacking via pictures, in the real simulator with the shipped weights."""

from experiments.planning.methods import FIRST_SCENES, parse_method, STACKING_TASKS
from experiments.planning.reading import Move, PictureReader, read_moves
from experiments.planning.stacking import stack, what_is_below
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.world.scene import HALF_HEIGHT
from tap_ros.base.contract import SUCCESS_DISTANCE
from tap_ros.prediction.predictor import SubgoalPredictor

FIRST_SCENE = FIRST_SCENES['stack3']
SEEDS = range(FIRST_SCENE, FIRST_SCENE + 4)


@pytest.fixture(scope='module', params=STACKING_TASKS)
def simulator(request):
    simulator = Simulator(request.param, 64)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def tower():
    simulator = Simulator('stack3', 64)
    yield simulator
    simulator.close()


def moves_to(simulator, reader, picture):
    poses = simulator.object_poses()[:, :3]
    pixels = reader.read(picture, simulator.camera.project(poses))
    return read_moves(pixels, poses, simulator.camera)


def by_object(moves):
    return {move.object: move.place for move in moves}


def reset(simulator, seed):
    start = simulator.reset(seed)
    return start, PictureReader(simulator, start)


def test_the_goal_says_which_object_goes_where_and_a_picture_of_now_that_all_stay(simulator):
    right = []
    for seed in SEEDS:
        _, reader = reset(simulator, seed)
        # Without the hand, which may hide half of an object.
        assert not moves_to(simulator, reader, simulator.observe(hide_arm=True).image)
        found = by_object(moves_to(simulator, reader, simulator.goal().image))
        places = {k: simulator.scene.goal_poses[k, :2] for k in simulator.scene.order}
        right.append(found.keys() == places.keys() and all(
            np.linalg.norm(found[k] - places[k]) < 0.6 * SUCCESS_DISTANCE for k in places))
    assert sum(right) >= len(SEEDS) - 1


def test_the_oracle_succeeds_in_most_scenes_and_doing_nothing_in_none(simulator):
    runs = [stack(simulator, parse_method('oracle_order'), seed) for seed in SEEDS[:2]]
    assert any(run.success for run in runs)
    for run in runs:
        assert not run.success or run.first_right and (run.distances < SUCCESS_DISTANCE).all()
    run = stack(simulator, parse_method('nothing'), SEEDS[0])
    assert not run.success and not run.moves and len(run.frames) == 1


def test_an_object_comes_to_stand_on_the_highest_one_at_its_place():
    poses = np.array([[0, 0, 0.03], [0, 0.01, 0.09], [0.2, 0, 0.03]])
    np.testing.assert_array_equal(what_is_below(poses, Move(2, (0.01, 0))), poses[1])
    assert what_is_below(poses, Move(2, (0.2, 0))).tolist() == [0.2, 0, -HALF_HEIGHT]


def test_the_chain_of_predicted_subgoals_ends_with_the_goal_and_repeats(tower):
    predictor, method = SubgoalPredictor.load('stack3'), parse_method('shipped:recursion2')
    first, second = (stack(tower, method, SEEDS[0], predictor) for _ in range(2))
    assert len(first.stages) == 3
    np.testing.assert_array_equal(first.stages[-1].picture, first.goal.image)
    subgoal, = predictor.predict(first.start.image, first.goal.image)
    np.testing.assert_array_equal(first.stages[1].picture, subgoal.image)
    assert first.moves == second.moves
    np.testing.assert_array_equal(first.distances, second.distances)
