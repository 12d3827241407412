# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each term of the planner changes its choice where it should, and only there."""

from dataclasses import replace

import numpy as np
from tap_ros.base.contract import LIFTED, LOW
from tap_ros.planning.action_sequences import FULL, HORIZON, Limits
from tap_ros.planning.cost import (
    distances_to_all_pixels,
    distances_to_pixels,
    distances_to_places,
    PlanCost,
)
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC
from tap_ros.prediction.warp import one_hot_maps
import torch
from toy_world import SIZE, to_pixels

# every term left out
PLAIN = VisualMPCConfig(
    search=SearchConfig(40, 1, 5), proposals=0, recheck=0, unfinished=0.0, clearance=0.0,
    warm_start=False, cost_every=1, batch_size=40, threads=1)
CAREFUL = replace(PLAIN, clearance=0.1)
IMAGE = np.zeros((SIZE, SIZE, 3), np.uint8)
NEW = Memory()
GRIPPER = np.array([0.0, 0.0, LOW, 0.0], np.float32)
PICTURE = (24, 32)
PLACES = 1.1 / 43 * np.array([[14, 21], [25, 14]]) - 0.55  # m, of two objects: table cells
GOALS = to_pixels(PLACES)


class Puppets:
    """
    A forward model whose objects go where a test says.

    :param model: ForwardModel; its geometry is used.
    :param outcome: function of actions (N, T, 4) and of grippers (N, 4), where these begin, to
        pixels (N, T, K, 2); NaN: nobody knows where the object is.
    :ivar judged: actions (N, T, 4) of every batch, in turn.
    """

    def __init__(self, model, outcome):
        self.table, self._outcome, self.judged = model.table, outcome, []

    def begin(self, image, gripper, arm_hidden=False):
        self.arm_hidden = arm_hidden

    def carried_maps(self, start, gripper, maps, actions, /, every=1):
        self.judged.append(actions.numpy())
        pixels = np.asarray(self._outcome(actions.numpy(), gripper.numpy()), np.float32)
        for t in range(every - 1, actions.shape[1], every):
            at = pixels[:, t].reshape(-1, 2)
            lost = torch.from_numpy(np.isnan(at).any(1))[:, None, None]
            carried = self.table.seed_maps(torch.from_numpy(np.nan_to_num(at))).where(~lost, 0.0)
            yield carried.view(len(actions), -1, *carried.shape[1:])


def plan(puppets, config=PLAIN, gripper=GRIPPER, pixels=GOALS - 9.0, memory=NEW, goals=GOALS,
         limits=FULL):
    mpc = VisualMPC(puppets, config)
    return mpc.plan(Scene(IMAGE, gripper, pixels), mpc.goal(goals), memory, limits)


def away(*distances):
    """Return pixels (T, K, 2) at distances from the goals, numbers or (T,), of each object."""
    distances = np.stack([np.broadcast_to(d, HORIZON) for d in distances], 1)
    return GOALS + distances[..., None] * [1.0, 0.0]


def steady(model, pixels):
    """Return Puppets that go to pixels (T, K, 2) whatever the gripper does."""
    return Puppets(model, lambda actions, _: np.tile(pixels, (len(actions), 1, 1, 1)))


def goes_right(model, right, left, **changes):
    """
    Tell whether the planner goes right.

    :param right: pixels (T, K, 2) of the objects if it does; left: if it goes left.
    """
    def outcome(actions, _):
        return np.where((actions[..., 0].sum(1) > 0)[:, None, None, None], right, left)

    return plan(Puppets(model, outcome), replace(PLAIN, **changes)).actions[:, 0].sum() > 0


def test_the_planner_goes_where_the_objects_come_nearer_to_their_goals(model):
    assert goes_right(model, away(3, 5), away(4, 5)) and goes_right(model, away(4, 2), away(4, 5))
    home, even = away(0, 10), away(4.5, 4.5)  # one is brought home before both come nearer
    assert goes_right(model, home, even, unfinished=4.0) and goes_right(model, even, home)
    # One that is lost is as far as can be.
    assert not goes_right(model, away(np.nan, 0), away(12, 0))
    assert goes_right(model, away(9, np.nan), away(12, np.nan))


def test_the_end_counts_ten_times_as_much_as_a_step_on_the_way(model):
    def mid_end(mid, end):
        return away(np.where(np.arange(HORIZON) < HORIZON - 1, mid, end), 0)

    assert goes_right(model, mid_end(7, 4), mid_end(5, 8))
    assert goes_right(model, mid_end(4, 8), mid_end(8, 5))  # 14 times 4 px against 10 times 3


def dives(actions, _):
    """Bring the objects nearer only by coming down at once."""
    down = (actions[:, 0, 2] < 0)[:, None, None, None]
    return np.where(down, away(6, 6), away(7, 7))


def test_the_gripper_does_not_come_down_upon_an_object(model):
    above = np.append(PLACES[1] + [0.03, 0.0], [LIFTED, 0]).astype(np.float32)
    beside = above + np.float32([0.12, 0, 0, 0])
    found = [plan(Puppets(model, dives), config, gripper, GOALS)
             for gripper in (above, beside) for config in (PLAIN, CAREFUL)]
    assert [one.action[2] < 0 for one in found] == [True, False, True, True]
    # where there is room it changes nothing
    assert np.array_equal(found[2].actions, found[3].actions) and found[2].cost == found[3].cost


def test_where_the_gripper_met_something_it_comes_down_again_once_the_object_has_moved(model):
    def next_plan(x, z, pixels, memory):
        gripper = np.array([x, -0.45, z, 0], np.float32)
        return plan(Puppets(model, dives), CAREFUL, gripper, pixels, memory)

    first = next_plan(0.2, LIFTED, GOALS, NEW)
    assert first.action[2] < 0 and not first.memory.blocked
    for resting, met in ((LOW, 0), (0.05, 1)):  # at what height the descent ended
        rising = next_plan(0.2, resting, GOALS, first.memory)
        assert len(rising.memory.blocked) == met
        # back over the place; aside; the nearest object has moved; the other one has
        nearest = np.linalg.norm(PLACES - [0.2, -0.45], axis=1).argmin()
        moved = 2.0 * np.eye(2)[:, :, None].repeat(2, 2)
        for x, pixels, avoided, kept in (
                (0.2, GOALS, met, met), (0.27, GOALS, 0, met),
                (0.2, GOALS + moved[nearest], 0, 0), (0.2, GOALS + moved[1 - nearest], met, met)):
            again = next_plan(x, LIFTED, pixels, rising.memory)
            assert (again.action[2] >= 0, len(again.memory.blocked)) == (avoided, kept)
    assert next_plan(0.2, LIFTED, GOALS, NEW).action[2] < 0  # another goal begins anew


def test_narrow_places_are_tried_only_where_the_workspace_ends():
    ends = np.array([[0.2, -0.45], [0.3, -0.45], [0.0, 0.115], [0.0, 0.09], [np.nan, np.nan],
                     [0.0, 0.45], [0.0, 0.41]])
    costs = PlanCost(clearance=0.1).of_landings(
        ends, np.array([[0.0, 0.0], [0.0, 0.36]]), np.array([[0.2, -0.45]]))
    assert costs[0] > 1000 and costs[3] > 100 and costs[6] > 100
    assert 0 < costs[2] < 100 and 0 < costs[5] < 100 and not costs[[1, 4]].any()
    # In a smaller workspace other places are at its end, and those beyond it are none.
    costs = PlanCost(clearance=0.1).of_landings(
        ends, np.array([[0.0, 0.0], [0.0, 0.36]]), np.zeros((0, 2)), Limits(high=(0.25, 0.09)))
    assert 0 < costs[3] < 100 and costs[[1, 2, 5, 6]].min() >= 1000 and not costs[[0, 4]].any()


def sticks(actions, grippers):
    """Carry the second object along wherever the gripper is low and upon it."""
    hand = np.tile(grippers[:, :3], 1).astype(float)
    place, path = np.tile(PLACES[1] - [0.15, 0.1], (len(actions), 1)), []
    for action in actions.transpose(1, 0, 2):
        touched = (hand[:, 2] < 0.05) & (np.linalg.norm(hand[:, :2] - place, axis=1) < 0.13)
        hand = hand + action[:, :3]
        place = place + np.where(touched[:, None], action[:, :2], 0)
        path.append(np.stack([np.tile(PLACES[0], (len(actions), 1)), place], 1))
    return to_pixels(np.stack(path, 1))


def test_proposals_find_an_object_that_chance_does_not(model):
    gripper = np.array([0.3, 0.3, LIFTED, 0], np.float32)
    seen = to_pixels(PLACES - [[0.0, 0.0], [0.15, 0.1]])
    proposing = replace(PLAIN, proposals=20)
    blind, aimed = (plan(Puppets(model, sticks), config, gripper, seen)
                    for config in (PLAIN, proposing))
    now = np.linalg.norm(seen - GOALS, axis=1).mean()
    assert aimed.expected_distance < 0.6 * now < blind.expected_distance


def test_the_last_plan_carried_on_is_among_the_first_candidates(model):
    first = plan(steady(model, away(5, 5)))

    def only_that(actions, _):
        same = np.abs(actions[:, :-1] - first.actions[1:]).max((1, 2)) < 1e-6
        return np.where(same[:, None, None, None], away(0, 0), away(5, 5))

    after = GRIPPER + np.append(first.action[:3], 0)
    warm, cold = (plan(Puppets(model, only_that), replace(PLAIN, warm_start=start), after,
                       memory=first.memory) for start in (True, False))
    assert np.allclose(warm.actions[:-1], first.actions[1:], atol=1e-6)
    assert warm.expected_distance < 1 and cold.expected_distance > 4


def slips(actions, grippers):
    """Push home to the right, from GRIPPER only; nearly home to the left from anywhere."""
    exact = np.linalg.norm(grippers[:, :2] - GRIPPER[:2], axis=1) < 1e-4
    right = actions[..., 0].sum(1) > 0
    return np.where(
        (right & exact)[:, None, None, None], away(0, 0),
        np.where(right[:, None, None, None], away(9, 9), away(2, 2)))


def test_a_push_that_succeeds_from_one_place_only_is_not_taken(model):
    search = SearchConfig(40, 1, 40)  # so that elites go both ways
    plans = {n: plan(Puppets(model, slips), replace(PLAIN, search=search, recheck=n))
             for n in (0, 1, 6)}
    right = {n: found.actions[:, 0].sum() > 0 for n, found in plans.items()}
    assert right == {0: True, 1: True, 6: False}  # judged again from the same place: no change


def test_a_gripper_that_stands_upon_something_goes_up_before_it_pushes(model):
    for height, first in ((0.06, True), (LOW, False), (LIFTED, False)):
        puppets = steady(model, away(5, 5))
        plan(puppets, gripper=np.array([0, 0, height, 0], np.float32))
        assert (height + puppets.judged[0][:, 0, 2] > 0.1).all() == first


def test_all_three_ways_give_the_same():
    maps = torch.rand(3, *PICTURE, generator=torch.Generator().manual_seed(0))
    maps[0] = one_hot_maps(torch.tensor([20.3, 7.8]), PICTURE)
    v, u = torch.meshgrid(*map(torch.arange, PICTURE), indexing='ij')
    places = torch.stack([u, v], -1).flatten(0, 1).float()
    sure = maps / maps.sum((1, 2), keepdim=True)
    exact = torch.stack([
        distances_to_pixels(m.expand(len(places), *PICTURE), places) for m in sure])
    close = {'atol': 0.05, 'rtol': 0}
    torch.testing.assert_close(distances_to_places(maps, places), exact, **close)
    everywhere = torch.from_numpy(distances_to_all_pixels(maps.numpy()))
    torch.testing.assert_close(everywhere.flatten(1), exact, **close)
