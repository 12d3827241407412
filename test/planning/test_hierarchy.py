# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of hierarchical planning: which target comes when, and how subgoals are chosen."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.messages.subgoals import Subgoal
from tap_ros.planning.action_sequences import gripper_after, Limits
from tap_ros.planning.hierarchy import (
    AFTER_PUSH,
    choose_sample,
    Itinerary,
    Target,
    targets_by,
)
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC
from tap_ros.prediction.warp import one_hot_maps
import torch
from toy_world import Telekinesis

PLACES = np.array([[8.0, 8.0], [20.0, 20.0]])


def targets(count):
    return [Target(PLACES + 4 * i) for i in range(count)]


def stages(itinerary, path):
    """Return the number of the target at each step, the objects being at path (T, K, 2)."""
    found, stage = [], 0
    for step, pixels in enumerate(path):
        stage = itinerary.stage(step, pixels, stage)
        found.append(stage)
    return found


def test_half_gives_every_target_its_share_and_reached_goes_on_at_once_but_no_later():
    far, on_the_spot = np.full((12, 2, 2), 60.0), np.repeat(PLACES[None], 12, 0)
    assert stages(Itinerary(targets(3), 12, 'half'), far) == [0] * 4 + [1] * 4 + [2] * 4
    assert stages(Itinerary(targets(2), 12, 'half'), on_the_spot) == [0] * 6 + [1] * 6
    assert stages(Itinerary(targets(3), 12), on_the_spot) == [1] * 8 + [2] * 4
    assert stages(Itinerary(targets(2), 12), far) == [0] * 6 + [1] * 6
    assert stages(Itinerary(targets(2), 12, reached=0.0), on_the_spot + 1e-3)[5] == 0


def test_a_subgoal_is_reached_from_farther_off_when_the_hand_has_just_risen():
    itinerary, near = Itinerary(targets(2), 12, reached=2.0), PLACES + [2.5, 0.0]
    assert itinerary.stage(3, near) == 0 and itinerary.stage(3, near, lifted=True) == 1
    assert itinerary.stage(3, PLACES + [2.0 * AFTER_PUSH + 0.1, 0.0], lifted=True) == 0


def test_free_objects_count_for_nothing_and_shall_stay_where_they_are():
    target = Target(PLACES, free=np.array([False, True]))
    now = np.array([[8.0, 11.0], [50.0, 50.0]])
    assert target.distance(now) == 3
    np.testing.assert_array_equal(target.goal(now)['pixels'], [PLACES[0], now[1]])


def test_a_map_is_reached_where_its_expected_distance_is_least():
    places, size = np.array([[8.0, 14.0], [20.0, 5.0]]), (24, 32)
    maps = one_hot_maps(torch.tensor(places), size).numpy()
    target = Target(places, maps)
    assert target.distance(places) == pytest.approx(0, abs=0.05)
    assert target.distance(places + [[3.0, 4.0], [0.0, 1.0]]) == pytest.approx(3, abs=0.05)
    beyond = places + [[30.0, 0.0], [0.0, 25.0]]  # the right and the lower end of the picture
    assert target.distance(beyond) == pytest.approx(27.5, abs=0.05)
    # An undecided map is reached in either place, an uneven one in the likelier.
    evenly = Target(places[:1], (maps[:1] + maps[1:]) / 2)  # one object
    for place in (places[:1], places[1:], places.mean(0, keepdims=True)):
        assert evenly.distance(place) == pytest.approx(0, abs=0.05)
    uneven = Target(places[:1], 0.6 * maps[:1] + 0.4 * maps[1:])
    assert uneven.distance(places[:1]) == pytest.approx(0, abs=0.05)
    assert uneven.distance(places[1:]) == pytest.approx(0.2 * 15, abs=0.05)


def subgoal(pixels, sample=0, level=1):
    maps = one_hot_maps(torch.tensor(pixels), (32, 32)).numpy()
    picture = np.full((32, 32, 3), 90, np.uint8)
    return Subgoal(picture, maps, np.asarray(pixels, np.float32), np.ones(2, np.float32),
                   sample, level)


def test_an_undecided_subgoal_moves_first_what_may_be_at_its_goal():
    start, goal = PLACES, PLACES + [[8.0, 0.0], [0.0, 8.0]]
    at_start, at_goal = (one_hot_maps(torch.tensor(p), (32, 32)).numpy() for p in (start, goal))
    decided = subgoal(np.array([goal[0], start[1]]))
    undecided, unmoved = (replace(decided, object_maps=np.stack([share * at_goal[0]
                                  + (1 - share) * at_start[0], at_start[1]]))
                          for share in (0.5, 0.0))
    for one, pixels in ((decided, decided.expected_pixels), (undecided, [goal[0], start[1]]),
                        (unmoved, start)):
        first, last = targets_by([one], start, goal)
        assert (first.maps is None) == (one is not decided)
        np.testing.assert_allclose(first.pixels, pixels, atol=0.01)
        np.testing.assert_array_equal(last.pixels, goal)


def scene(pixels):
    return Scene(np.full((32, 32, 3), 90, np.uint8), np.zeros(4, np.float32), pixels)


def small_planner():
    return VisualMPC(Telekinesis(), VisualMPCConfig(
        search=SearchConfig(16, 1, 4), proposals=4, batch_size=16, threads=1))


def test_samples_are_judged_leg_by_leg():
    mpc, plans = small_planner(), []

    def plan(seen, goal):
        plans.append((seen, goal, mpc.plan(seen, goal, Memory(7), Limits(0.01, 0.02))))
        return plans[-1][-1]

    samples = [subgoal(PLACES + 2.0 * i, i) for i in range(2)]
    chosen = choose_sample(mpc, scene(PLACES), PLACES + 4.0, samples, plan)
    costs = [sum(found.cost for *_, found in plans[i:i + 2]) for i in (0, 2)]
    assert chosen == [samples[np.argmin(costs)]]
    for sample, (_, to, first), (then, _, _) in zip(samples, plans[::2], plans[1::2]):
        assert torch.equal(to.distances, mpc.goal(maps=sample.object_maps).distances)
        assert then.image is sample.image and then.object_pixels is sample.expected_pixels
        hand = gripper_after(np.zeros(4, np.float32), first.actions)
        np.testing.assert_array_equal(then.gripper, hand)


def test_subgoals_are_divided_by_their_sample_and_one_sample_needs_no_plan():
    start, goal = PLACES, PLACES + [6.0, 0.0]
    astray = np.array([[28.0, 28.0], [3.0, 3.0]])
    between = [start + [2.0, 0.0], start + [4.0, 0.0]]
    found = [subgoal(astray, 0, 2), subgoal(astray, 0, 1),
             subgoal(between[0], 1, 2), subgoal(between[1], 1, 1)]
    mpc, plans = small_planner(), []

    def plan(*leg):
        plans.append(leg)
        return mpc.plan(*leg)

    taken = choose_sample(mpc, scene(start), goal, found, plan)
    assert taken == found[2:] and len(plans) == 6  # two legs and the last, for two samples
    assert choose_sample(None, scene(start), goal, found[:2], None) == found[:2]
