# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of methods and what they stand for."""

import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.methods import parse_method


@pytest.mark.parametrize('name, expected', [
    ('fix', ('fix', 0.5, None, True, False, 'time_preference')),
    ('fix0.25', ('fix', 0.25, None, True, False, 'time_preference')),
    ('fix1.00', ('fix', 1.0, None, True, False, 'time_preference')),
    ('min', ('min', None, None, True, False, 'time_preference')),
    ('genmin', ('genmin', None, None, True, False, 'time_preference')),
    ('genmin0.5', ('genmin', None, 0.5, True, False, 'time_preference')),
    ('genmininf', ('genmin', None, float('inf'), True, False, 'time_preference')),
    ('genmin-wo-gan', ('genmin', None, None, False, False, 'time_preference')),
    ('genmin-vae', ('genmin', None, None, False, True, 'time_preference')),
    ('genmin-vae-gan', ('genmin', None, None, True, True, 'time_preference')),
    ('genmin+relative', ('genmin', None, None, True, False, 'relative_to_copying')),
    ('genmin-wo-gan+reach', ('genmin', None, None, False, False, 'cost_of_reaching')),
    ('genmin2-vae-gan+relative', ('genmin', None, 2.0, True, True, 'relative_to_copying'))])
def test_names_of_the_paper(name, expected):
    method = parse_method(name)
    assert method.name == name
    assert (method.loss, method.fraction, method.beta, method.gan, method.vae,
            method.selection) == expected


@pytest.mark.parametrize('name', [
    '', 'Fix', 'fix1.01', 'fix0', 'min2', 'genmin-gan', 'genmin0', 'fix+relative', 'genmin+',
    'genmin-vae+copying', 'min+reach', 'genmin-2'])
def test_other_names_are_refused_with_what_would_be_right(name):
    with pytest.raises(ConfigError, match='method'):
        parse_method(name)
