# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the explorer without sockets: the distances, the commands of browsers."""

import json
import math

from hypothesis import given
from hypothesis import strategies as st
import pytest
from tap_ros.nodes.explorer.calls import CommandError, parse_command
from tap_ros.nodes.explorer.node import Distances, HISTORY_S, POINTS

GOALS = {'a': (0.0, 0.0, 0.0, 10.0, 10.0), 'b': (1.0, 0.0, 0.0, 20.0, 10.0)}
NUMBERS = {'samples': 3, 'levels': 2, 'seed': 1}
PREDICT, REACH = {'do': 'predict', **NUMBERS}, {'do': 'reach', 'mode': 'direct', **NUMBERS}
RESET = {'do': 'reset', 'task': 'push2', 'seed': 7}
MOVE = {'do': 'move', 'name': 'object_0', 'u': 3, 'v': 4.5}


def at(x, **places):
    """Return two objects, the first at x metres and x pixels from its goal."""
    return {'a': (x, 0.0, 0.0, 10.0 + x, 10.0), 'b': GOALS['b'], **places}


def test_distances_are_centimetres_or_pixels_where_a_pose_is_unknown():
    distances = Distances()
    for time, x in ((1.0, 0.2), (1.5, 0.3), (1.5, 0.1)):  # equal time replaces
        distances.add(time, at(x), GOALS)
    assert distances.shown() == {'unit': 'cm', 'names': ['a', 'b'], 'times': [1.0, 1.5],
                                 'values': [[20.0, 10.0], [0.0, 0.0]]}
    distances.add(0.5, at(0.4), GOALS)
    assert distances.shown()['times'] == [0.5], 'time that goes back begins anew'
    distances.add(2.0, at(4.0, b=(*(math.nan,) * 3, 20.0, 13.0)), GOALS)
    shown = distances.shown()
    assert shown['unit'] == 'px' and shown['values'] == [[4.0], [3.0]], 'units are not mixed'
    distances.add(3.0, at(0.2), {'a': GOALS['a']})
    assert distances.shown()['names'] == ['a'], 'without a goal there is no distance'
    distances.add(4.0, at(0.2), {})
    assert distances.shown()['times'] == []


def test_what_is_kept_and_shown_is_bounded():
    distances = Distances()
    count = int(HISTORY_S * 4) + 500
    for i in range(count):
        distances.add(i * 0.25, at(0.2), GOALS)
    times = distances.shown()['times']
    assert len(times) <= POINTS
    assert times[-1] == pytest.approx((count - 1) * 0.25), 'the newest is there'
    assert times[0] >= times[-1] - HISTORY_S


def test_a_command_reads_as_it_is_meant_and_what_makes_no_sense_is_refused_by_the_fields_name():
    for command in (PREDICT, REACH, RESET, MOVE, {'do': 'cancel'}, {'do': 'photograph'}):
        do, fields = parse_command(json.dumps({**command, 'other': 1}).encode())
        assert {'do': do, **fields} == command
    for text in ('', '[]', b'\xff\xfe', '[' * 5000):
        with pytest.raises(CommandError, match='JSON'):
            parse_command(text)
    large = int('9' * 400)
    for command, name, values in (
            (RESET, 'do', ('shutdown', ['reach'], '\ud800')),
            (RESET, 'task', (3, 'x' * 101, 'a\nb')),
            (RESET, 'seed', (-1, True, 1e300, large)), (PREDICT, 'samples', (17,)),
            (PREDICT, 'levels', (0,)), (REACH, 'mode', ('fast', '\udfff')),
            (MOVE, 'u', (math.nan, large)), (MOVE, 'v', ('1',)),
            (MOVE, 'name', ('a\udc80', '\ud83d'))):
        for value in values:
            with pytest.raises(CommandError, match=name) as refused:
                parse_command(json.dumps({**command, name: value}))
            assert str(refused.value).isprintable()


@given(st.sampled_from(['reset', 'predict', 'reach', 'cancel', 'move', 'photograph', '']),
       st.dictionaries(
           st.sampled_from(['mode', 'task', 'seed', 'samples', 'levels', 'u', 'v', 'name']),
           st.none() | st.booleans() | st.floats() | st.integers(-10**400, 10**400)
           | st.text(st.characters(codec=None)) | st.sampled_from([0, 1, 'direct'])))
def test_anything_else_is_a_command_error_too(do, fields):
    try:
        _, fields = parse_command(json.dumps({**fields, 'do': do}))
        json.dumps(fields, ensure_ascii=False).encode()  # it can be sent on
    except CommandError:
        pass
