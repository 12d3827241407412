# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the parts of section 3's losses."""

import math

import pytest
from tap_ros.prediction.losses import (
    bell,
    bell_preference,
    l1_error,
    l1_errors,
    linear_preference,
    match_step,
    picture_progress,
    recursive_loss,
    relative_to_copying,
    remaining_targets,
)
import torch


def test_error_of_black_against_white_is_1_and_frames_may_be_bytes():
    black, white = -torch.ones(2, 3, 8, 8), torch.ones(2, 3, 8, 8)
    assert l1_error(black, white).equal(torch.ones(2))
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (3, 5, 3, 8, 8), generator=generator, dtype=torch.uint8)
    images = torch.rand(3, 2, 3, 8, 8, generator=generator) * 2 - 1
    expected = l1_error(images[:, :, None], (frames.float() / 127.5 - 1)[:, None])
    everything = l1_errors(images, frames)
    assert everything.allclose(expected, atol=1e-6)
    wanted = torch.tensor([[0, 1, 0, 1, 0], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], dtype=torch.bool)
    some = l1_errors(images, frames, wanted)  # bit for bit; the others cannot be the least
    assert some.equal(everything.masked_fill(~wanted[:, None], math.inf))


def test_bell_and_line_are_the_papers_and_fit_each_episodes_own_length():
    # Section 4: 2/3 at both ends and 1 in the middle of a truncated Gaussian.
    times = torch.arange(1, 14)[None]
    preference = bell_preference(times, 1, 13)
    assert preference[0, 6] == 1 and preference[0, [0, -1]].allclose(torch.tensor(2 / 3))
    gaussian = torch.exp(-((times - 7.0) ** 2) / (2 * (1.110 * 6) ** 2))
    assert preference.allclose(gaussian, atol=1e-3)
    times = torch.tensor([[1, 3, 5], [1, 6, 11]])  # of episodes of other lengths
    preference = bell_preference(times, torch.tensor([[1], [1]]), torch.tensor([[5], [11]]))
    assert preference[0].equal(preference[1])
    assert bell_preference(torch.tensor([[4]]), 4, 4) == 1
    times = torch.arange(1, 16)[None]
    preference = linear_preference(times, 15, 0.5)
    assert preference[0, [0, -1]].allclose(torch.tensor([0.5 + 1 / 15, 1.5]))
    assert linear_preference(times, 15, math.inf).eq(1).all()


def distances(B=5, T=7, seed=0):
    """Return errors (B, 2, T) of start and goal pictures on ways that never turn back."""
    steps = torch.rand(B, T, generator=torch.Generator().manual_seed(seed)) + 0.01
    way = steps.cumsum(1) / steps.sum(1, keepdim=True)
    return torch.stack([0.2 * way + 0.01, 0.2 * (1 - way) + 0.01], 1)


def every(error):
    """Return that no frame is padded, of errors (B, ..., T)."""
    return torch.ones(len(error), error.shape[-1], dtype=torch.bool)


def test_progress_goes_from_minus_1_to_1_whatever_the_pace_and_reversed():
    slow = distances()
    progress = picture_progress(slow, every(slow))
    assert progress[:, [0, -1]].tolist() == [pytest.approx([-1, 1], abs=1e-5)] * 5
    assert (progress.diff() > 0).all()
    reverse = picture_progress(slow.flip(1, 2), every(slow))
    assert torch.allclose(reverse, -progress.flip(1), atol=1e-5)


def test_padding_is_not_on_the_way_and_no_way_at_all_is_finite():
    error, valid = distances(), torch.ones(5, 7, dtype=torch.bool)
    valid[:, 5:] = False
    padded = error.clone()
    padded[:, :, 5:] = torch.tensor([[9.0], [0.0]])
    assert picture_progress(padded, valid)[:, :5].equal(
        picture_progress(error[..., :5], valid[:, :5]))
    for error in (torch.full((2, 2, 1), 0.1), torch.zeros(2, 2, 4)):
        assert bell(picture_progress(error, every(error))).isfinite().all()


def test_copying_is_worth_1_everywhere_also_where_hardly_anything_changed():
    copy_error = torch.tensor([[[0.1, 0.2, 0.3], [0.3, 0.2, 0.1]]])  # start, goal
    ones = torch.ones(1, 3)
    assert relative_to_copying(copy_error.amin(1), copy_error, ones).allclose(ones)
    # A prediction half as wrong as copying in the middle wins over less error beside the start.
    error = torch.tensor([[0.08, 0.1, 0.3]])
    assert match_step(error, every(error)).item() == 0
    assert match_step(
        relative_to_copying(error, copy_error, ones), every(error)).item() == 1
    # A frame equal to the context does not break the choice.
    assert relative_to_copying(error, torch.zeros(1, 2, 3), ones).isfinite().all()


def test_recursion_sums_levels_over_all_episodes_and_goes_on_beyond_the_match():
    # 4 episodes with loss 1, of which 1 has targets left, with loss 2: (4 * 1 + 1 * 2) / 4.
    assert recursive_loss([torch.tensor(1.0), torch.tensor(2.0)], [4, 1]) == 1.5
    times, matched = torch.arange(1, 7).expand(2, 6), torch.tensor([[5], [2]])
    valid = torch.tensor([[True] * 6, [True] * 4 + [False] * 2])
    after, before = (remaining_targets(valid, times, matched, forward)
                     for forward in (True, False))
    assert [row.nonzero().flatten().add(1).tolist() for row in after] == [[6], [3, 4]]
    assert [row.nonzero().flatten().add(1).tolist() for row in before] == [[1, 2, 3, 4], [1]]
