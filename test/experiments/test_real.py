# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which real demonstrations are held out, marked and trained on."""

from experiments.real import Options, order_of
import pytest
from tap_ros.base.errors import ConfigError


def test_each_demonstration_is_held_out_once_and_the_marked_are_trained_on():
    options = Options('bag', 'truth.json', trained_on=15)
    orders = [order_of(40, options, draw) for draw in range(4)]
    assert sorted(i for order in orders for i in order[:10]) == list(range(40))
    assert all(sorted(order) == list(range(40)) for order in orders)
    for few in (9, 31):
        with pytest.raises(ConfigError, match=f'trained_on {few}: expected 10, .* to 30, '):
            order_of(40, Options('bag', 'truth.json', trained_on=few), 0)
    with pytest.raises(ConfigError, match='5 draws that hold out 10 need 50'):
        order_of(40, Options('bag', 'truth.json', draws=5), 0)
