# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the losses of section 3."""

import math

import pytest
from tap_ros.prediction.losses import (
    bell,
    bell_preference,
    beside_context,
    changed_pixels,
    fixed_time_loss,
    generalized_minimum_loss,
    l1_error,
    l1_errors,
    linear_preference,
    match_step,
    minimum_loss,
    picture_progress,
    preferred_error,
    recursive_loss,
    relative_to_copying,
    remaining_targets,
)
import torch


@pytest.fixture
def error():
    return torch.rand(6, 9, generator=torch.Generator().manual_seed(0))


def test_genmin_with_w_1_equals_min(error):
    loss = generalized_minimum_loss(error, preferred_error(error, torch.ones_like(error)))
    assert loss == minimum_loss(error)


def test_min_is_the_smallest_fixed_error_and_never_above_genmin(error):
    row = error[:1]
    fixed = [fixed_time_loss(row, torch.tensor([t])) for t in range(row.shape[1])]
    assert minimum_loss(row) == min(fixed)
    preference = bell_preference(torch.arange(9)[None], 0, 8)
    assert minimum_loss(error) <= generalized_minimum_loss(
        error, preferred_error(error, preference))


def test_outer_error_is_not_weighted_by_the_preference():
    error, preference = torch.tensor([[0.3, 0.4]]), torch.tensor([[0.5, 1.0]])
    # 0.3 / 0.5 > 0.4 / 1, so that the second frame is chosen and 0.4 is the loss.
    loss = generalized_minimum_loss(error, preferred_error(error, preference))
    assert loss == torch.tensor(0.4)


def test_padding_is_never_chosen(error):
    valid = torch.ones_like(error, dtype=torch.bool)
    valid[:, 3:] = False
    error[:, 3:] = -1
    assert match_step(error, valid).max() < 3
    assert minimum_loss(error, valid) == error[:, :3].min(1).values.mean()


def test_only_the_chosen_frame_has_a_gradient_and_the_choice_has_none(error):
    selection = (error * 2).requires_grad_()
    outer = error.clone().requires_grad_()
    generalized_minimum_loss(outer, selection).backward()
    assert selection.grad is None
    assert ((outer.grad != 0).sum(1) == 1).all()
    assert (outer.grad.argmax(1) == selection.argmin(1)).all()


def test_errors_may_be_computed_for_the_chosen_frames_only(error):
    def lazily(step):
        return error[torch.arange(len(error)), step]

    selection = error.flip(1)
    assert (generalized_minimum_loss(lazily, selection)
            == generalized_minimum_loss(error, selection))


def test_error_of_black_against_white_is_1_and_frames_may_be_bytes():
    black, white = -torch.ones(2, 3, 8, 8), torch.ones(2, 3, 8, 8)
    assert l1_error(black, white).equal(torch.ones(2))
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (3, 5, 3, 8, 8), generator=generator, dtype=torch.uint8)
    images = torch.rand(3, 2, 3, 8, 8, generator=generator) * 2 - 1
    expected = l1_error(images[:, :, None], (frames.float() / 127.5 - 1)[:, None])
    assert l1_errors(images, frames).allclose(expected, atol=1e-6)


def test_bell_is_the_papers():
    # Section 4: 2/3 at both ends and 1 in the middle of a truncated Gaussian.
    times = torch.arange(1, 14)[None]
    preference = bell_preference(times, 1, 13)
    assert preference[0, 6] == 1
    assert preference[0, [0, -1]].allclose(torch.tensor(2 / 3))
    assert preference.flip(1).allclose(preference)
    sigma = 1.110 * 6
    gaussian = torch.exp(-((times - 7.0) ** 2) / (2 * sigma ** 2))
    assert preference.allclose(gaussian, atol=1e-3)


def test_bell_fits_each_episodes_own_length():
    times = torch.tensor([[1, 3, 5], [1, 6, 11]])
    preference = bell_preference(times, torch.tensor([[1], [1]]), torch.tensor([[5], [11]]))
    assert preference[0].equal(preference[1])
    assert bell_preference(torch.tensor([[4]]), 4, 4) == 1


def test_linear_is_the_papers():
    times = torch.arange(1, 16)[None]
    preference = linear_preference(times, 15, 0.5)
    assert preference[0, 0].allclose(torch.tensor(0.5 + 1 / 15))
    assert preference[0, -1].allclose(torch.tensor(1.5))
    assert linear_preference(times, 15, math.inf).eq(1).all()


def distances(B=5, T=7, seed=0):
    """Return errors (B, 2, T) of start and goal pictures on ways that never turn back."""
    steps = torch.rand(B, T, generator=torch.Generator().manual_seed(seed)) + 0.01
    way = steps.cumsum(1) / steps.sum(1, keepdim=True)
    return torch.stack([0.2 * way + 0.01, 0.2 * (1 - way) + 0.01], 1)


def test_progress_goes_from_minus_1_to_1_and_never_back_also_reversed():
    progress = picture_progress(distances())
    assert progress[:, 0].tolist() == pytest.approx([-1] * 5, abs=1e-5)
    assert progress[:, -1].tolist() == pytest.approx([1] * 5, abs=1e-5)
    assert (progress.diff() > 0).all()
    reverse = picture_progress(distances().flip(1, 2))
    assert torch.allclose(reverse, -progress.flip(1), atol=1e-5)


def test_progress_does_not_depend_on_how_fast_the_pictures_change():
    slow = distances()
    held = slow.repeat_interleave(torch.tensor([4, 1, 1, 1, 1, 1, 6]), 2)  # waits at both ends
    assert torch.allclose(picture_progress(held)[:, [0, 4, 5, 6, 7, 8, 9]],
                          picture_progress(slow), atol=1e-5)


def test_half_way_between_the_pictures_is_preferred_most():
    way = torch.tensor([[0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9, 1]])  # most of it is late
    error = torch.stack([way, 1 - way], 1) + 0.01
    assert bell(picture_progress(error)).argmax().item() == 6


def test_padding_is_not_on_the_way_and_no_way_at_all_is_finite():
    error, valid = distances(), torch.ones(5, 7, dtype=torch.bool)
    valid[:, 5:] = False
    padded = error.clone()
    padded[:, :, 5:] = torch.tensor([[9.0], [0.0]])
    assert picture_progress(padded, valid)[:, :5].equal(picture_progress(error[..., :5]))
    for error in (torch.full((2, 2, 1), 0.1), torch.zeros(2, 2, 4)):
        assert bell(picture_progress(error)).isfinite().all()


def test_what_shows_too_little_or_too_much_of_the_way_is_beside_the_context():
    progress = torch.tensor([[-1, -0.6, -0.4, 0, 0.5, 0.51, 1], [-1, -1, -1, -1, 0.9, 1, 1]])
    valid = torch.ones(2, 7, dtype=torch.bool)
    assert beside_context(progress, 0.5, valid).tolist() == [
        [True, True, False, False, False, True, True],
        [True, True, True, True, False, True, True]]  # one is left, the nearest to the middle
    valid[1, 4] = False
    assert not beside_context(progress, 0.5, valid)[1, :4].all()
    assert not beside_context(progress, 0).any()


def test_copying_is_worth_1_everywhere_also_where_hardly_anything_changed():
    copy_error = torch.tensor([[[0.1, 0.2, 0.3], [0.3, 0.2, 0.1]]])  # start, goal
    ones = torch.ones(1, 3)
    assert relative_to_copying(copy_error.amin(1), copy_error, ones).allclose(ones)
    # A prediction half as wrong as copying in the middle wins over less error beside the start.
    error = torch.tensor([[0.08, 0.1, 0.3]])
    assert match_step(error).item() == 0
    assert match_step(relative_to_copying(error, copy_error, ones)).item() == 1
    little = torch.tensor([[0.001, 0.0005]])
    assert relative_to_copying(little, little[:, None], torch.ones(1, 2)).allclose(torch.ones(2))
    # A frame equal to the context does not break the choice.
    copy_error, error = torch.zeros(1, 2, 3), torch.tensor([[0.0, 0.1, 0.2]])
    assert relative_to_copying(error, copy_error, torch.ones(1, 3)).isfinite().all()


def test_recursion_sums_levels_over_all_episodes():
    # 4 episodes with loss 1, of which 1 has targets left, with loss 2: (4 * 1 + 1 * 2) / 4.
    assert recursive_loss([torch.tensor(1.0), torch.tensor(2.0)], [4, 1]) == 1.5
    assert recursive_loss([torch.tensor(1.0)], [4]) == 1


def test_targets_of_the_next_level_lie_beyond_the_match():
    times = torch.arange(1, 7).expand(2, 6)
    valid = torch.tensor([[True] * 6, [True] * 4 + [False] * 2])
    matched = torch.tensor([[5], [2]])
    after = remaining_targets(valid, times, matched, forward=True)
    before = remaining_targets(valid, times, matched, forward=False)
    assert [row.nonzero().flatten().add(1).tolist() for row in after] == [[6], [3, 4]]
    assert [row.nonzero().flatten().add(1).tolist() for row in before] == [[1, 2, 3, 4], [1]]


def test_changed_pixels_differ_from_every_input():
    start, goal = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    goal[..., 0, 0] = 1
    frame = torch.zeros(1, 3, 2, 2)
    frame[..., 0, 0] = 1  # as in the goal
    frame[:, 2, 0, 1] = 1  # new, in one channel
    frame[..., 1, 0] = 0.1  # nearly as in both
    changed = changed_pixels(frame, torch.stack([start, goal], 1))
    assert changed.tolist() == [[[[False, True], [False, False]]]]
    assert changed_pixels(frame, start[:, None])[0, 0, 0, 0]
    # A pixel has changed from a difference of 0.075 on.
    frame = torch.zeros(1, 3, 1, 2)
    frame[..., 0], frame[..., 1] = 2 * 0.074, 2 * 0.076
    assert changed_pixels(frame, torch.zeros(1, 1, 3, 1, 2)).tolist() == [[[[False, True]]]]
