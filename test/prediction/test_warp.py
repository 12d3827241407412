# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of warping pictures and object maps."""

from tap_ros.prediction.warp import (
    expected_pixels,
    one_hot_maps,
    warp,
    warp_object_maps,
)
import torch

SIZE = (20, 30)


def constant_flow(du, dv, batch=1, contexts=2, size=SIZE):
    flow = torch.zeros(batch, contexts, 2, *size)
    flow[:, :, 0], flow[:, :, 1] = du, dv
    return flow


def masks_for(weights, batch=1, size=SIZE):
    return torch.tensor(weights)[None, :, None, None, None].expand(batch, -1, 1, *size)


def test_output_is_read_from_where_the_flow_points_to():
    images = torch.rand(2, 2, 3, *SIZE)
    assert warp(images, constant_flow(0, 0, 2)).allclose(images, atol=1e-5)
    images = images[:1]
    warped = warp(images, constant_flow(3, -2))
    assert warped[..., 2:, :-3].allclose(images[..., :-2, 3:], atol=1e-4)
    far = warp(images, constant_flow(1000, 0))  # outside is the border
    assert far.allclose(images[..., -1:].expand_as(images), atol=1e-5)
    # Each context has its own flow.
    flow = constant_flow(0, 0)
    flow[:, 1, 0] = 4
    warped = warp(images, flow)
    assert warped[:, 0].allclose(images[:, 0], atol=1e-5)
    assert warped[:, 1, ..., :-4].allclose(images[:, 1, ..., 4:], atol=1e-4)


def test_one_hot_maps_sum_to_1_with_their_mean_at_the_pixel():
    pixels = torch.tensor([[[0.0, 0.0], [29.0, 19.0], [7.25, 11.6]]])
    maps = one_hot_maps(pixels, SIZE)
    assert maps.sum((-2, -1)).allclose(torch.ones(1, 3))
    assert expected_pixels(maps).allclose(pixels, atol=1e-5)
    assert maps[0, 0, 0, 0] == 1 and maps[0, 1, 19, 29] == 1
    # Positions outside move to the border.
    maps = one_hot_maps(torch.tensor([[-5.0, 50.0]]), SIZE)
    assert maps[0, 19, 0] == 1 and maps.sum() == 1


def test_a_translation_moves_the_expected_pixel_by_exactly_that():
    pixels = torch.tensor([[10.3, 8.0], [15.0, 9.6]])
    maps = one_hot_maps(pixels, SIZE).expand(1, 2, 2, *SIZE)
    for du, dv in ((3.0, -2.0), (-4.5, 1.25)):
        warped = warp_object_maps(maps, constant_flow(-du, -dv), masks_for([0.4, 0.6]))
        assert warped.maps.sum((-2, -1)).allclose(torch.ones(1, 2))
        assert warped.mass.allclose(torch.ones(1, 2), atol=1e-4)
        moved = expected_pixels(warped.maps)[0] - pixels
        assert moved.allclose(torch.tensor([du, dv]).expand(2, 2), atol=1e-3)


def start_and_goal():
    """Return positions (1, 2) of an object in two context pictures, and its maps."""
    start, goal = torch.tensor([[5.0, 5.0]]), torch.tensor([[25.0, 15.0]])
    return start, goal, torch.stack([one_hot_maps(start, SIZE), one_hot_maps(goal, SIZE)])[None]


def test_an_object_that_the_flow_jumps_over_arrives_with_what_is_around_it():
    columns = torch.arange(30.0)
    maps = one_hot_maps(torch.tensor([[10.0, 8.0]]), SIZE).expand(1, 2, 1, *SIZE)
    for jump, expected in (
            (torch.where(columns >= 10, 1.0, -1.0), 10.0),   # nothing reads columns 9.01..10.99
            (torch.where(columns >= 15, -4.0, -6.0), 15.0)):  # nor 8.01..10.99
        flow = constant_flow(0, 0)
        flow[:, :, 0] = jump
        warped = warp_object_maps(maps, flow, masks_for([0.5, 0.5]))
        assert warped.mass < 0.05
        assert warped.maps.sum().allclose(torch.tensor(1.0))
        assert (expected_pixels(warped.maps)[0] - torch.tensor([expected, 8.0])).norm() < 1


def test_masks_choose_the_context_of_an_object_that_stays_where_it_was_if_all_avoid_it():
    start, goal, maps = start_and_goal()
    for weights, expected in (([1.0, 0.0], start), ([0.0, 1.0], goal),
                              ([0.5, 0.5], (start + goal) / 2)):
        warped = warp_object_maps(maps, constant_flow(0, 0), masks_for(weights))
        assert expected_pixels(warped.maps)[0].allclose(expected, atol=1e-4)
    away = constant_flow(1000, 1000)
    warped = warp_object_maps(maps, away, masks_for([0.75, 0.25]))
    assert warped.mass == 0
    assert expected_pixels(warped.maps)[0].allclose(0.75 * start + 0.25 * goal, atol=1e-4)
    hidden = warp_object_maps(maps, away, masks_for([0.0, 0.0, 1.0]))
    assert expected_pixels(hidden.maps)[0].allclose((start + goal) / 2, atol=1e-4)


def test_an_object_that_is_lost_is_where_a_keyframe_has_it_if_that_is_known():
    start, goal, maps = start_and_goal()
    there = torch.tensor([[12.0, 18.0]])
    third = one_hot_maps(there, SIZE)[None, None]
    away, masks = constant_flow(1000, 1000, contexts=3), masks_for([0.5, 0.25, 0.25])
    known, unknown = (warp_object_maps(torch.cat([maps, one], 1), away, masks)
                      for one in (third, 0 * third))
    assert known.mass == unknown.mass == 0
    assert expected_pixels(known.maps)[0].allclose(there, atol=1e-4)
    assert expected_pixels(unknown.maps)[0].allclose((2 * start + goal) / 3, atol=1e-4)
    copied = warp_object_maps(torch.cat([maps, third], 1), constant_flow(0, 0, contexts=3),
                              masks_for([0.0, 0.9, 0.1]))
    assert expected_pixels(copied.maps)[0].allclose(0.9 * goal + 0.1 * there, atol=1e-4)
