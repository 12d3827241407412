# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the objective: from a batch to its loss."""

from dataclasses import replace

from experiments.paper.methods import method_fields
import numpy as np
import pytest
from tap_ros.images.pixels import to_float
from tap_ros.prediction.losses import bell_preference, l1_error
from tap_ros.prediction.networks import Prediction
from tap_ros.training.augmentation import Augmentation
from tap_ros.training.batches import Batch
from tap_ros.training.objective import (
    discriminators_loss,
    Draws,
    GAN_WEIGHT,
    Networks,
    predictor_loss,
)
from tap_ros.training.predictor_config import TrainingConfig
import torch

CONFIG = TrainingConfig(recordings=(), selection='relative', progress_margin=0.0)


class Showing(torch.nn.Module):
    """Predicts a picture it was given, changed like its context."""

    def __init__(self, image, augmentation=None):
        super().__init__()
        self.image = image[:, None]
        if augmentation:
            self.image = augmentation.apply(self.image)

    def forward(self, context, z=None):
        return Prediction(self.image[:, 0], None, None, None)


def showing(image, augmentation=None):
    return Networks(Showing(image, augmentation))


def make_batch(B=4, T=6, padded=0, seed=0):
    frames = np.random.default_rng(seed).integers(0, 256, (B, T + 2, 8, 8, 3), np.uint8)
    frames = torch.from_numpy(frames)
    times = torch.arange(1, T + 1).expand(B, T)
    column = torch.ones(B, 1, dtype=torch.int64)
    return Batch(frames[:, [0, -1]], frames[:, 1:-1], times, column, column * T,
                 column * (T + 1), times <= T - padded)


def test_each_loss_is_the_error_at_the_frame_that_it_chooses():
    w = torch.rand(8, 1, 6, generator=torch.Generator().manual_seed(0))
    batch = replace(make_batch(B=8, padded=2), preference=w)
    image = to_float(batch.context).mean(1)
    errors = l1_error(image[:, None], to_float(batch.targets))[:, :4]  # the rest is padding
    copied = l1_error(to_float(batch.context)[:, :, None], to_float(batch.targets)[:, None])
    still = (errors / (copied.amin(1) * w[:, 0])[:, :4]).argmin(1)
    preferred = (errors / bell_preference(batch.times, batch.first, batch.last)[:, :4]).argmin(1)
    for settings, match in (({'loss': 'min'}, errors.argmin(1)),  # Eq. 2
                            ({'loss': 'fix'}, torch.zeros(8, dtype=torch.int64)),  # Eq. 1
                            ({'loss': 'fix', 'selection': 'marks', 'marks': 'x'},
                             w[:, 0, :4].argmax(1)),
                            ({'selection': 'marks', 'marks': 'x', 'label_weight': 0.1},
                             (errors - 0.1 * w[:, 0, :4].log()).argmin(1)),
                            ({'selection': 'still'}, still),
                            ({'selection': 'absolute'}, preferred)):  # Eq. 5
        outcome = predictor_loss(showing(image), batch, replace(CONFIG, **settings))
        assert outcome.match.equal(match), settings
        expected = errors.gather(1, match[:, None]).mean()  # not weighted by the preference
        assert outcome.loss.item() == pytest.approx(expected.item(), abs=1e-6)


def test_augmentation_does_not_change_the_choice():
    batch = make_batch(B=16)
    image = to_float(batch.targets).mean(1)
    augmentation = Augmentation.draw(16, True, 0.2, np.random.default_rng(0))
    plain = predictor_loss(showing(image), batch, CONFIG)
    batch = replace(batch, augmentation=augmentation)
    changed = predictor_loss(showing(image, augmentation), batch, CONFIG)
    assert changed.match.equal(plain.match)
    perfect = showing(to_float(batch.targets[:, 3]), augmentation)
    assert predictor_loss(perfect, batch, CONFIG).loss < 1e-6


def test_forward_genmin_prefers_later_frames_the_more_the_smaller_beta():
    batch = make_batch(B=32)
    frames = to_float(batch.targets)
    image = 0.6 * frames[:, 0] + 0.4 * frames[:, 5]
    steps = []
    for method in ('genmin0.5-wo-gan', 'genmin30-wo-gan', 'min-wo-gan'):
        config = replace(CONFIG, **method_fields(method), mode='forward')
        steps.append(predictor_loss(showing(image), batch, config).match.unique().tolist())
    assert steps == [[5], [0], [0]]


class Judge(torch.nn.Module):
    """A discriminator that sees how bright a picture is, and remembers it."""

    def __init__(self, num_times):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(num_times))

    def forward(self, context, image):
        self.shown = image
        return image.mean((1, 2, 3))[:, None] * self.weight


def test_gan_terms_stand_at_the_matched_time():
    batch = make_batch(padded=2)
    config = replace(CONFIG, **method_fields('genmin'))
    image = to_float(batch.targets[:, 2]).requires_grad_()
    networks = Networks(Showing(image), discriminator=Judge(7))
    outcome = predictor_loss(networks, batch, config, Draws.make(batch, 0, 0))
    logits = image.mean((1, 2, 3))
    expected = GAN_WEIGHT * torch.nn.functional.softplus(-logits).mean()
    assert outcome.parts['gan'].item() == pytest.approx(expected.item(), rel=1e-5)
    assert outcome.judged.step.tolist() == [2] * 4  # index of time 3
    assert (outcome.judged.other_step != outcome.judged.step).all()
    assert (outcome.judged.other_step < 4).all()  # the rest is padding
    outcome.loss.backward()
    assert image.grad.abs().sum() > 0
    before = image.grad.clone()
    discriminators_loss(outcome.judged).backward()
    assert image.grad.equal(before)  # the discriminators' loss does not reach the predictor
    assert networks.discriminator.weight.grad.nonzero().flatten().tolist() == [2]


class Shade(torch.nn.Module):
    """Predicts a picture of one brightness, the first number of z."""

    def forward(self, context, z=None):
        size = context.shape[-1]
        return Prediction(z[:, :1, None, None].expand(-1, 3, size, size), None, None, None)


class Brightness(torch.nn.Module):
    """Takes the mean of some pictures for the mean of z, whose variance is that of the prior."""

    def __init__(self, last):
        super().__init__()
        self.scale, self.last, self.seen = torch.nn.Parameter(torch.ones(())), last, []

    def forward(self, images):
        self.seen.append(images)
        mean = self.scale * images[:, -self.last:].mean((1, 2, 3, 4))[:, None]
        return mean, torch.zeros_like(mean)


def still_draws(batch, prior=0.0):
    """Make draws with the posterior's own mean and a fixed sample of the prior."""
    B, T = batch.times.shape
    return Draws(torch.zeros(B, T, 1), torch.full((B, 1), prior), torch.rand(B, T))


def test_eq_10_l1_and_one_judge_see_the_posterior_the_other_judge_the_prior():
    batch = replace(make_batch(B=4), video=make_batch(B=4, seed=7).targets)
    config = replace(CONFIG, **method_fields('min-vae-gan'), kl_weight=0.01)
    networks = Networks(Shade(), Brightness(6), Judge(7), Judge(7))
    augmentation = Augmentation.draw(4, True, 0.2, np.random.default_rng(0))
    batch = replace(batch, augmentation=augmentation)
    outcome = predictor_loss(networks, batch, config, still_draws(batch, 0.5))
    video = augmentation.apply(to_float(batch.video))
    assert networks.recognition.seen[0].equal(video)  # changed as the context is
    mean = video.mean((1, 2, 3, 4))
    assert networks.discriminator.shown.eq(0.5).all()
    posterior = networks.posterior_discriminator.shown
    assert posterior.mean((1, 2, 3)).allclose(mean, atol=1e-6)
    target = augmentation.apply(to_float(
        batch.targets[torch.arange(4), outcome.match])[:, None])[:, 0]
    softplus = torch.nn.functional.softplus
    expected = {
        'kl': 0.01 * (mean ** 2 / 2).mean(), 'error': l1_error(posterior, target).mean(),
        'gan': GAN_WEIGHT * (softplus(torch.tensor(-0.5)) + softplus(-mean).mean())}
    assert set(outcome.parts) == set(expected)
    for name, value in expected.items():
        assert outcome.parts[name].item() == pytest.approx(value.item(), rel=1e-4), name
    outcome.loss.backward()
    assert networks.recognition.scale.grad.abs() > 0


def test_eq_9_is_the_divergence_and_the_least_error_at_a_sample_of_the_posterior():
    batch = replace(make_batch(B=4), video=make_batch(B=4, seed=7).targets)
    config = replace(CONFIG, **method_fields('min-vae'), kl_weight=0.01)
    networks = Networks(Shade(), Brightness(6))
    outcome = predictor_loss(networks, batch, config, still_draws(batch))
    mean = to_float(batch.video).mean((1, 2, 3, 4))  # of z, which is the shade of the prediction
    errors = (mean[:, None, None, None, None] - to_float(batch.targets).movedim(-1, 2)).abs()
    least = (errors.mean((2, 3, 4)) / 2).amin(1)
    nats = (mean ** 2 / 2).mean().item()
    assert outcome.loss.item() == pytest.approx(0.01 * nats + least.mean().item(), rel=1e-4)
    assert outcome.nats.item() == pytest.approx(nats, rel=1e-4)
    for free, price in ((nats / 4, 0.75 * nats), (2 * nats, 0.0)):
        outcome = predictor_loss(networks, batch, replace(config, free_nats=free),
                                 still_draws(batch))
        assert outcome.parts['kl'].item() == pytest.approx(0.01 * price, rel=1e-4)


def test_appendix_b_is_the_minimum_over_the_whole_loss():
    batch = make_batch(B=2, T=5)
    shades = torch.tensor([[250, 30, 128, 30, 250], [250, 140, 30, 250, 100]], dtype=torch.uint8)
    batch = replace(batch, targets=shades[..., None, None, None].expand(-1, -1, 8, 8, 3))
    config = replace(CONFIG, **method_fields('min-vae'), posterior='frame', kl_weight=0.01)
    # z says which frame it was: the l1 error is 0 at all times, and the KL divergence decides.
    divergence = 0.01 * to_float(batch.targets).mean((2, 3, 4)) ** 2 / 2
    networks = Networks(Shade(), Brightness(1))
    outcome = predictor_loss(networks, batch, config, still_draws(batch))
    assert outcome.match.tolist() == [2, 1]
    assert outcome.loss.item() == pytest.approx(divergence.amin(1).mean().item(), abs=1e-6)
    assert all(seen.shape[1] == 3 for seen in networks.recognition.seen)  # context and one frame


class Moving(torch.nn.Module):
    """Predicts one target after the other."""

    def __init__(self, *images):
        super().__init__()
        self.images, self.contexts = images, []

    def forward(self, context, z=None):
        self.contexts.append(context)
        return Prediction(self.images[len(self.contexts) - 1], None, None, None)


@pytest.mark.parametrize('mode, second', [('forward', 4), ('bidirectional', 0)])
def test_recursion_goes_on_from_its_own_prediction_and_leaves_that_alone(mode, second):
    batch = make_batch()
    config = replace(CONFIG, **method_fields('min-wo-gan'), mode=mode, recursion=2)
    frames = to_float(batch.targets)
    network = Moving(frames[:, 2].clone().requires_grad_(), frames[:, second])
    assert predictor_loss(Networks(network), batch, config).loss < 1e-6
    assert not network.contexts[1].requires_grad
    assert network.contexts[1][:, -1].equal(frames[:, 2])
    if mode == 'bidirectional':
        assert network.contexts[1][:, 0].equal(to_float(batch.context[:, 0]))
    # A frame on the other side is no target of the second level.
    wrong = Moving(frames[:, 2], frames[:, 4 - second])
    assert predictor_loss(Networks(wrong), batch, config).loss > 0.1


def test_progress_prefers_half_way_in_the_pictures_and_leaves_out_what_shows_an_input():
    def matches(shares, image, **settings):
        start, goal, T = torch.zeros(8, 8, 3), torch.full((8, 8, 3), 200), len(shares)
        targets = start + torch.tensor(shares)[:, None, None, None] * (goal - start)
        column, frames = torch.ones(1, 1, dtype=torch.int64), to_float(targets.byte())
        batch = Batch(torch.stack([start, goal])[None].byte(), targets[None].byte(),
                      torch.arange(1, T + 1)[None], column, column * T, column * (T + 1),
                      torch.ones(1, T, dtype=torch.bool))
        return predictor_loss(showing(image(frames)[None]), batch, replace(
            CONFIG, **settings)).match.item()

    late = (0.02, 0.04, 0.06, 0.08, 0.1, 0.5, 0.9)  # of targets that fit alike the one half way
    assert [matches(late, lambda frames: (frames[3] + frames[5]) / 2, selection=kind)
            for kind in ('absolute', 'progress')] == [4, 5]
    waiting = (0.0, 0.0, 0.4, 0.7, 1.0)
    assert [matches(waiting, lambda frames: frames[0], selection='progress',
                    progress_margin=margin) for margin in (0.0, 0.5)] == [0, 2]
