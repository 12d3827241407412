# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the objective: from a batch to its loss."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.images import to_float
from tap_ros.prediction.augmentation import Augmentation
from tap_ros.prediction.batches import Batch
from tap_ros.prediction.losses import l1_error, minimum_loss
from tap_ros.prediction.networks import Prediction
from tap_ros.prediction.objective import held_out_scores, predictor_loss
from tap_ros.prediction.training_config import TrainingConfig
import torch

CONFIG = TrainingConfig(recordings=('bag',), out='out', outer_power=1.0)


class Showing(torch.nn.Module):
    """Predicts a picture it was given, changed like its context."""

    def __init__(self, image, augmentation=None):
        super().__init__()
        self.image = image[:, None]
        if augmentation:
            self.image = augmentation.apply(self.image)

    def forward(self, context):
        return Prediction(self.image[:, 0], None, None, None)


def make_batch(B=4, T=6, padded=0, seed=0):
    frames = np.random.default_rng(seed).integers(0, 256, (B, T + 2, 8, 8, 3), np.uint8)
    frames = torch.from_numpy(frames)
    times = torch.arange(1, T + 1).expand(B, T)
    column = torch.ones(B, 1, dtype=torch.int64)
    return Batch(frames[:, [0, -1]], frames[:, 1:-1], times, column, column * T,
                 column * (T + 1), times <= T - padded)


@pytest.mark.parametrize('method, selection', [
    ('min', 'time_preference'), ('genmin', 'time_preference'),
    ('genmin', 'relative_to_copying')])
def test_a_perfect_prediction_is_matched_at_no_loss(method, selection):
    batch = make_batch()
    config = replace(CONFIG, method=method, selection=selection)
    outcome = predictor_loss(Showing(to_float(batch.targets[:, 2])), batch, None, config)
    assert outcome.match.tolist() == [2] * 4
    assert outcome.loss.item() == pytest.approx(0, abs=1e-6)


def test_min_is_eq_2():
    batch = make_batch()
    image = to_float(batch.context).mean(1)
    outcome = predictor_loss(Showing(image), batch, None, replace(CONFIG, method='min'))
    errors = l1_error(image[:, None], to_float(batch.targets))
    assert outcome.loss.item() == pytest.approx(minimum_loss(errors).item(), abs=1e-6)


def test_padding_is_never_matched():
    batch = make_batch(padded=3)
    outcome = predictor_loss(Showing(to_float(batch.targets[:, 4])), batch, None, CONFIG)
    assert outcome.match.max() <= 2 and outcome.loss > 0.1


def test_augmentation_does_not_change_the_choice():
    batch = make_batch(B=16)
    image = to_float(batch.targets).mean(1)
    augmentation = Augmentation.draw(16, True, True, 0.2, np.random.default_rng(0))
    plain = predictor_loss(Showing(image), batch, None, CONFIG)
    changed = predictor_loss(Showing(image, augmentation), batch, augmentation, CONFIG)
    assert changed.match.equal(plain.match)
    perfect = Showing(to_float(batch.targets[:, 3]), augmentation)
    assert predictor_loss(perfect, batch, augmentation, CONFIG).loss < 1e-6


def test_a_concave_outer_error_prefers_either_bottleneck_to_their_blend():
    batch = make_batch(B=2, T=1)
    targets = to_float(batch.targets[:, 0])  # two episodes of one scene, two ways to do it
    first, second = targets
    blend = (first + second) / 2

    def loss(image, power):
        config = replace(CONFIG, method='fix', outer_power=power)
        return predictor_loss(
            Showing(image.expand(2, -1, -1, -1)), batch, None, config).loss.item()

    assert loss(first, 1.0) == pytest.approx(loss(blend, 1.0), rel=1e-5)
    assert loss(first, 0.5) == pytest.approx(loss(second, 0.5), rel=1e-5)
    assert loss(first, 0.5) < 0.9 * loss(blend, 0.5)


def test_held_out_scores_are_means_over_episodes():
    batches = [make_batch(B=3, seed=1), make_batch(B=1, seed=2)]
    shown = torch.cat([to_float(batch.targets[:, 2]) for batch in batches])

    class Next(torch.nn.Module):
        def forward(self, context):
            nonlocal shown
            image, shown = shown[:len(context)], shown[len(context):]
            return Prediction(image, None, None, None)

    scores = held_out_scores(Next(), batches, CONFIG)
    assert scores['loss'] == pytest.approx(0, abs=1e-6)
    assert scores['match_fraction'] == pytest.approx(3 / 7)
    assert scores['match_fraction_std'] == pytest.approx(0, abs=1e-6)
