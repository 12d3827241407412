# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of drawing the match at a temperature that falls to 0."""

from dataclasses import replace
import math

import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.batches import Batch
from tap_ros.prediction.losses import match_step
from tap_ros.prediction.objective import Draws
from tap_ros.prediction.training_config import ObjectiveSettings
from tap_ros.training.parallel import Processes
from tap_ros.training.schedule import match_temperature
import torch

N = 20000  # episodes that are alike
ERRORS = torch.tensor([0.2, 0.1, 0.15, 0.05]).expand(N, 4)
VALID = torch.tensor([True, True, True, False]).expand(N, 4)


def chance(seed=0):
    return torch.rand(N, 4, generator=torch.Generator().manual_seed(seed))


def shares(temperature, errors=ERRORS):
    match = match_step(errors, VALID, temperature, chance())
    return torch.bincount(match, minlength=4) / N


@pytest.mark.parametrize('temperature', [0.0, 1e-9])
def test_without_a_temperature_it_is_the_argmin(temperature):
    error = torch.rand(N, 4, generator=torch.Generator().manual_seed(1))
    expected = error.masked_fill(~VALID, math.inf).argmin(1)
    assert match_step(error, VALID, temperature, chance()).equal(expected)
    assert match_step(error, VALID).equal(expected)


@pytest.mark.parametrize('temperature', [1e9, math.inf])
def test_at_any_heat_valid_targets_are_equally_likely_and_others_never(temperature):
    assert shares(temperature).tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0], abs=0.02)
    assert shares(temperature)[3] == 0


@pytest.mark.parametrize('scale', [1.0, 1e-3])
def test_in_between_it_is_the_softmax_of_the_error_relative_to_its_least(scale):
    expected = torch.softmax(-torch.tensor([1.0, 0.0, 0.5]) / 0.7, 0).tolist()
    assert shares(0.7, scale * ERRORS).tolist() == pytest.approx([*expected, 0], abs=0.02)


@pytest.mark.parametrize('value', [0.0, 1.0])
def test_the_ends_of_the_random_numbers_are_no_exception(value):
    match = match_step(ERRORS[:2], VALID[:2], 1.0, torch.full((2, 4), value))
    assert match.tolist() == [1, 1]  # with the same noise everywhere the least error wins
    assert match_step(0 * ERRORS[:2], VALID[:2], 1.0, chance()[:2]).max() <= 2


def test_the_temperature_falls_evenly_and_stays_at_0():
    values = [match_temperature(step, 100, 0.8, 0.5) for step in range(100)]
    assert values[0] == 0.8 and values[25] == pytest.approx(0.4)
    assert all(a > b for a, b in zip(values[:50], values[1:51])) and set(values[50:]) == {0}
    assert {match_temperature(step, 100, 0.0, 0.5) for step in range(100)} == {0}


def batch(B):
    column, times = torch.ones(B, 1, dtype=torch.int64), torch.arange(1, 7).expand(B, 6)
    frames = torch.zeros(B, 6, 8, 8, 3, dtype=torch.uint8)
    return Batch(frames[:, :2], frames, times, column, column * 6, column * 7, times > 0)


def test_draws_are_those_of_the_step_whoever_asks():
    whole = Draws.make(batch(4), 3, 0, 5, levels=2)
    assert whole.match.shape == (4, 2, 6)
    for rank in (0, 1):
        part = Draws.make(batch(2), 3, 0, 5, Processes(rank, 2), levels=2)
        assert all(value.equal(vars(whole)[name][2 * rank:2 * rank + 2])
                   for name, value in vars(part).items())
    for seed, step in ((0, 6), (1, 5)):
        other = Draws.make(batch(4), 3, seed, step, levels=2)
        assert not any(value.equal(vars(whole)[name]) for name, value in vars(other).items())
    # Levels of recursion come last, so that they change no other draw.
    assert Draws.make(batch(4), 3, 0, 5).other.equal(whole.other)


@pytest.mark.parametrize('values', [
    {'match_temperature': -1.0}, {'match_temperature': math.inf}, {'match_share': 0.0},
    {'match_temperature': 1.0, 'method': 'fix'}])
def test_what_cannot_be_annealed_is_refused(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        replace(ObjectiveSettings(), **values)
