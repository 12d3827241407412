# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictors of real demonstrations: which are held out and marked in each draw."""

from experiments.real import Options, order_of
import pytest
from tap_ros.base.errors import ConfigError


def test_each_demonstration_is_held_out_once_and_none_of_these_is_marked():
    options = Options(recordings='bags/g1', truth='truth.json')
    orders = [order_of(40, options, draw) for draw in range(options.draws)]
    held_out = [set(order[:options.held_out]) for order in orders]
    assert set.union(*held_out) == set(range(40)) and sum(map(len, held_out)) == 40
    for order, held in zip(orders, held_out):
        assert sorted(order) == list(range(40))
        assert not held & set(order[-options.marks:])


def test_draws_that_hold_out_more_than_there_are_is_an_error():
    with pytest.raises(ConfigError, match='need 40 demonstrations; there are 39'):
        order_of(39, Options(recordings='bags/g1', truth='truth.json'), 0)
