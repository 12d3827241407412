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
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.training.robot_mask import FreeView

FIRST_SCENE = FIRST_SCENES['stack3']
SEEDS = range(FIRST_SCENE, FIRST_SCENE + 6)
CLEAR_SCENE = FIRST_SCENE + 7  # SPOT and what is above block 0 are in front of no other block
SPOT = (0.1, -0.1)  # m, on the table


@pytest.fixture(scope='module', params=STACKING_TASKS)
def simulator(request):
    simulator = Simulator(request.param)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def tower():
    simulator = Simulator('stack3')
    yield simulator
    simulator.close()


def episodes(simulator, name, seeds=SEEDS):
    return [stack(simulator, parse_method(name), seed) for seed in seeds]


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


def test_what_is_lowest_in_a_picture_comes_first(tower):
    orders = []
    for seed in SEEDS:
        _, reader = reset(tower, seed)
        moves = moves_to(tower, reader, tower.goal().image)
        orders.append([move.object for move in moves])
    assert orders.count([1, 2]) >= len(SEEDS) - 1


def test_a_true_subgoal_says_that_one_block_goes_on_the_first_and_the_others_stay(tower):
    for moved in (1, 2):
        right = 0
        for seed in SEEDS:
            start, reader = reset(tower, seed)
            poses = start.object_poses.copy()
            poses[moved] = tower.goal().object_poses[1]
            moves = moves_to(tower, reader, tower.photograph(poses, hide_arm=True).image)
            right += len(moves) == 1 and moves[0].object == moved and np.allclose(
                moves[0].place, start.object_poses[0, :2])
        assert right >= len(SEEDS) - 1


def test_what_is_shown_twice_is_elsewhere_and_what_is_not_shown_stays(tower):
    start, reader = reset(tower, CLEAR_SCENE)
    poses = start.object_poses.copy()
    poses[1, :2] = SPOT
    there = tower.photograph(poses, hide_arm=True).image
    here = tower.observe(hide_arm=True).image
    u, v = start.object_pixels[1].round().astype(int)
    twice = there.copy()
    twice[v - 6:v + 7, u - 6:u + 7] = here[v - 6:v + 7, u - 6:u + 7]
    right, low = tower.camera.project([*SPOT, HALF_HEIGHT]).round().astype(int) + [2, 0]
    empty = here[low - 6:low + 7, right:right + 4]
    twice[low - 6:low + 7, right:right + 4] = empty  # so that the copy is the smaller one
    for picture in (there, twice):
        move, = moves_to(tower, reader, picture)
        assert move.object == 1
        np.testing.assert_allclose(move.place, SPOT, atol=0.02)
    poses[1, 0] = 20  # out of sight
    gone = tower.photograph(poses, hide_arm=True).image.copy()
    assert not moves_to(tower, reader, gone)
    gone[40:42, 30:33] = here[v - 1, u]  # six pixels of its colour are no block
    assert not moves_to(tower, reader, gone)


def test_the_oracle_succeeds_in_most_scenes_and_doing_nothing_in_none(simulator):
    for name in ('oracle_order', 'true_places'):
        runs = episodes(simulator, name)
        assert np.mean([run.success for run in runs]) >= 0.8
        assert all(run.first_right for run in runs if run.success)
        for run in runs:
            if run.success:
                assert (run.distances < SUCCESS_DISTANCE).all()
    for run in episodes(simulator, 'nothing'):
        assert not run.success and not run.moves and len(run.frames) == 1


def test_direct_fails_where_it_begins_with_the_upper_block(tower):
    runs = episodes(tower, 'direct', range(FIRST_SCENE, FIRST_SCENE + 10))
    assert {run.first_right for run in runs} == {True, False}
    assert not any(run.success for run in runs if not run.first_right)
    assert all(run.success for run in runs if run.first_right)


def test_an_object_comes_to_stand_on_the_highest_one_at_its_place():
    poses = np.array([[0, 0, 0.03], [0, 0.01, 0.09], [0.2, 0, 0.03]])
    np.testing.assert_array_equal(what_is_below(poses, Move(2, (0.01, 0))), poses[1])
    np.testing.assert_array_equal(what_is_below(poses, Move(1, (0.01, 0))), poses[0])
    assert what_is_below(poses, Move(2, (0.1, 0))).tolist() == [0.1, 0, -HALF_HEIGHT]
    assert what_is_below(poses, Move(2, (0.2, 0))).tolist() == [0.2, 0, -HALF_HEIGHT]


def test_the_chain_of_predicted_subgoals_ends_with_the_goal_and_repeats(tower):
    predictor = SubgoalPredictor.load('stack3')
    method = parse_method('shipped:recursion2')
    first, second = (stack(tower, method, SEEDS[0], predictor) for _ in range(2))
    assert len(first.stages) == 3
    np.testing.assert_array_equal(first.stages[-1].picture, first.goal.image)
    subgoal, = predictor.predict(first.start.image, first.goal.image)
    np.testing.assert_array_equal(first.stages[1].picture, subgoal.image)
    assert first.moves == second.moves
    np.testing.assert_array_equal(first.distances, second.distances)


class Witness:
    """A predictor trained on pictures without the robot, that keeps the pictures it is shown."""

    training = {'settings': {'robot_mask': 'all', 'fill_context': 1}}

    def __init__(self):
        self._predictor, self.shown = SubgoalPredictor.load('stack3'), []

    def predict(self, *pictures, **how):
        self.shown += pictures
        return self._predictor.predict(*pictures, **how)


def test_a_predictor_is_shown_pictures_as_it_was_trained_on(tower):
    witness, view = Witness(), FreeView('all')
    run = stack(tower, parse_method('shipped'), SEEDS[0], witness)
    expected = [view.update(run.start.image, run.start.robot_mask),
                view.fill(run.goal.image, run.goal.robot_mask)]
    np.testing.assert_array_equal(witness.shown, expected)
    assert (witness.shown[1] != run.goal.image).any()
