# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the distances that the page shows."""

import math

import pytest
from tap_ros.nodes.explorer.distances import Distances, LONGEST, POINTS

GOALS = {'a': ((0.0, 0.0, 0.0), (10.0, 10.0)), 'b': ((1.0, 0.0, 0.0), (20.0, 10.0))}


def at(x, **places):
    """Return two objects, the first at x metres and x pixels from its goal."""
    return {'a': ((x, 0.0, 0.0), (10.0 + x, 10.0)), 'b': GOALS['b'], **places}


def test_distances_are_centimetres_where_poses_are_known():
    distances = Distances()
    distances.add(1.0, at(0.2), GOALS)
    distances.add(1.5, at(0.1), GOALS)
    assert distances.shown() == {'unit': 'cm', 'names': ['a', 'b'], 'times': [1.0, 1.5],
                                 'values': [[20.0, 10.0], [0.0, 0.0]]}


def test_distances_are_pixels_where_a_pose_is_unknown():
    distances = Distances()
    nowhere = {'b': ((math.nan,) * 3, (20.0, 13.0))}
    distances.add(1.0, at(0.2), GOALS)
    distances.add(2.0, at(4.0, **nowhere), GOALS)
    shown = distances.shown()
    assert shown['unit'] == 'px' and shown['values'] == [[4.0], [3.0]], 'units are not mixed'


def test_an_object_without_a_goal_is_left_out():
    distances = Distances()
    distances.add(1.0, at(0.2), {'a': GOALS['a']})
    assert distances.shown()['names'] == ['a']
    distances.add(2.0, at(0.2), {})
    assert distances.shown()['times'] == []


def test_time_that_goes_back_begins_anew_and_equal_time_replaces():
    distances = Distances()
    for time, x in ((1.0, 0.3), (2.0, 0.2), (2.0, 0.1)):
        distances.add(time, at(x), GOALS)
    assert distances.shown()['values'][0] == [30.0, 10.0]
    distances.add(0.5, at(0.4), GOALS)
    assert distances.shown()['times'] == [0.5]


def test_what_is_kept_and_shown_is_bounded():
    distances = Distances()
    count = int(LONGEST * 4) + 500
    for i in range(count):
        distances.add(i * 0.25, at(0.2), GOALS)
    shown = distances.shown()
    assert len(shown['times']) <= POINTS
    assert shown['times'][-1] == pytest.approx((count - 1) * 0.25), 'the newest is there'
    assert shown['times'][0] >= shown['times'][-1] - LONGEST
