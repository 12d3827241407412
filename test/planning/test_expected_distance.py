# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the expected distance between a map and places."""

from tap_ros.planning.cost import (
    distances_to_all_pixels,
    distances_to_pixels,
    distances_to_places,
)
from tap_ros.prediction.warp import one_hot_maps
import torch

SIZE = (24, 32)


def test_distances_to_a_sure_position_are_plain_distances():
    maps = one_hot_maps(torch.tensor([[3.0, 4.0]]), SIZE)
    assert distances_to_pixels(maps, torch.tensor([[0.0, 0.0]])) == 5
    assert distances_to_pixels(maps, torch.tensor([[3.0, 4.0]])) == 0


def test_distance_is_expected_over_the_map_not_from_its_mean():
    maps = one_hot_maps(torch.tensor([[0.0, 5.0], [10.0, 5.0]]), SIZE).mean(0)
    assert distances_to_pixels(maps, torch.tensor([5.0, 5.0])) == 5


def test_all_three_ways_give_the_same():
    maps = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(0))
    maps[0] = one_hot_maps(torch.tensor([20.3, 7.8]), SIZE)
    v, u = torch.meshgrid(*map(torch.arange, SIZE), indexing='ij')
    places = torch.stack([u, v], -1).flatten(0, 1).float()
    sure = maps / maps.sum((1, 2), keepdim=True)
    exact = torch.stack([distances_to_pixels(m.expand(len(places), *SIZE), places) for m in sure])
    close = {'atol': 0.05, 'rtol': 0}
    torch.testing.assert_close(distances_to_places(maps, places), exact, **close)
    everywhere = torch.from_numpy(distances_to_all_pixels(maps.numpy()))
    torch.testing.assert_close(everywhere.flatten(1), exact, **close)
    between = places[:50] + 0.4
    exact = torch.stack([distances_to_pixels(m.expand(50, *SIZE), between) for m in sure])
    torch.testing.assert_close(distances_to_places(maps, between), exact, **close)
