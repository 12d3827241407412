# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of projections, and their fits from recordings."""

from dataclasses import replace

import numpy as np
from tap_ros.planning.table import fit_arm, fit_projection, fit_table, project, Table
import torch
from toy_world import ARM, make_episode, TABLE

TILTED = np.array([[62.0, 12.0, -15.0, 31.5], [0.1, -37.0, -58.0, 27.0], [0.0, 0.37, -0.48, 1.0]])


def test_fit_recovers_a_camera_despite_outliers():
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.4, -0.4, 0], [0.4, 0.4, 0.15], (400, 3))
    pixels = project(torch.from_numpy(TILTED), torch.from_numpy(points)).numpy()
    pixels[::20] += 30
    fitted = torch.from_numpy(fit_projection(points, pixels))
    error = (project(fitted, torch.from_numpy(points)).numpy() - pixels)[1::20]
    assert np.abs(error).max() < 0.3


def test_arm_camera_and_table_are_found_in_recordings():
    episodes = [make_episode(seed) for seed in range(40)]
    arm, missed = fit_arm(episodes)
    assert missed < 1.5
    points = torch.tensor([[-0.3, -0.2, 0], [0.3, 0.1, 0], [0, 0, 0]], dtype=torch.float64)
    true = project(torch.tensor(ARM, dtype=torch.float64).view(3, 4), points)
    assert (project(torch.from_numpy(arm), points) - true).abs().max() < 1.5
    blind = [replace(episodes[0], object_poses=np.full((18, 2, 7), np.nan))]
    np.testing.assert_array_equal(fit_table(blind, arm), arm[:, [0, 1, 3]])
    table = fit_table(episodes, arm)
    np.testing.assert_allclose(table / table[2, 2], np.reshape(TABLE, (3, 3)), atol=0.01)


def test_maps_sum_to_one_and_have_their_mean_at_the_pixel():
    table = Table(torch.tensor(TABLE).view(3, 3), (32, 32), 40)
    pixels = torch.tensor([[10.3, 12.9], [20.0, 17.5]])
    maps = table.seed_maps(pixels)
    torch.testing.assert_close(maps.sum((1, 2)), torch.ones(2))
    mean = maps.flatten(1) @ table.pixels().flatten(0, 1)
    torch.testing.assert_close(mean, pixels, atol=1e-3, rtol=0)
    torch.testing.assert_close(
        project(table.homography, table.places(pixels)), pixels, atol=1e-3, rtol=0)
