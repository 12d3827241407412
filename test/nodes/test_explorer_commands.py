# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what browsers may ask for."""

import json

from hypothesis import given
from hypothesis import strategies as st
import pytest
from tap_ros.nodes.explorer.calls import CommandError, parse_command

NUMBERS = {'samples': 3, 'levels': 2, 'seed': 1}


def test_a_command_reads_as_it_is_meant():
    for do, fields in (
            ('reset', {'task': 'push2', 'seed': 7}), ('predict', NUMBERS),
            ('reach', {'mode': 'direct', **NUMBERS}), ('cancel', {}), ('photograph', {}),
            ('move', {'name': 'object_0', 'u': 3, 'v': 4.5})):
        text = json.dumps({'do': do, **fields, 'other': 1})
        assert parse_command(text) == parse_command(text.encode()) == (do, fields)


@pytest.mark.parametrize('text, named', [
    ('', 'JSON'), ('[]', 'JSON'), (b'\xff\xfe', 'JSON'), ('[' * 5000, 'JSON'),
    ('{"do": "shutdown"}', 'do: expected one of reset'), ('{"do": ["reach"]}', 'do: '),
    ('{"do": "reset", "task": 3, "seed": 1}', 'task'),
    (json.dumps({'do': 'reset', 'task': 'x' * 101, 'seed': 1}), 'task'),
    ('{"do": "reset", "task": "push2", "seed": -1}', 'seed'),
    ('{"do": "reset", "task": "push2", "seed": true}', 'seed'),
    ('{"do": "reset", "task": "push2", "seed": 1e300}', 'seed'),
    ('{"do": "predict", "samples": 17, "levels": 1, "seed": 0}', 'samples: .* 1 to 16'),
    ('{"do": "predict", "samples": 1, "levels": 0, "seed": 0}', 'levels'),
    ('{"do": "reach", "mode": "fast", "samples": 1, "levels": 1, "seed": 0}', 'mode'),
    ('{"do": "move", "name": "a", "u": NaN, "v": 1}', 'u: '),
    ('{"do": "move", "name": "a", "u": 1, "v": "1"}', 'v: '),
    (f'{{"do": "move", "name": "a", "u": {"9" * 400}, "v": 1}}', 'u: '),
    (f'{{"do": "reset", "task": "a", "seed": {"9" * 400}}}', 'seed')])
def test_what_makes_no_sense_is_refused_by_the_fields_name(text, named):
    with pytest.raises(CommandError, match=named):
        parse_command(text)


@given(st.sampled_from(['reset', 'predict', 'reach', 'cancel', 'move', 'photograph', '']),
       st.dictionaries(
           st.sampled_from(['mode', 'task', 'seed', 'samples', 'levels', 'u', 'v', 'name']),
           st.none() | st.booleans() | st.floats() | st.integers(-10**400, 10**400) | st.text()
           | st.sampled_from([0, 1, 'direct']) | st.lists(st.none())))
def test_anything_else_is_a_command_error_too(do, fields):
    try:
        parse_command(json.dumps({**fields, 'do': do}))
    except CommandError:
        pass
