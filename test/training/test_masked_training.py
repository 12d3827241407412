# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A masked robot leaves no trace in losses, gradients and choices."""

from dataclasses import replace

from experiments.paper.methods import method_fields
from made_episodes import cover, write_bag
import numpy as np
import pytest
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.recording.cache import open_recordings
from tap_ros.training.augmentation import Augmentation
from tap_ros.training.batches import make_batch, Pictures, Sampling
from tap_ros.training.frames import FilledStore
from tap_ros.training.objective import (
    discriminators_loss,
    Draws,
    LATENT_SIZE,
    Networks,
    predictor_loss,
)
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.training.training_networks import Discriminator, Recognition
import torch

CHOSEN = [0, 1, 2, 3]


@pytest.fixture(scope='module')
def bags(bag, tmp_path_factory):
    """Write the same episodes twice, with robots that look different."""
    folder, store = tmp_path_factory.mktemp('covered'), open_recordings([bag], progress=False)
    return [write_bag(folder / f'robot{seed}', [
        cover(store[i], side=6, seed=seed) for i in range(8)]) for seed in range(2)]


def batches(bags, robot_mask, **sampling):
    """Return the batches of two recordings, with the context pictures of the first."""
    found = []
    for bag in bags:
        store = open_recordings([bag], progress=False)
        found.append(make_batch(store, CHOSEN, Sampling(margin=1, video_frames=4, **sampling),
                                pictures=Pictures(filled=FilledStore(store, robot_mask))))
    return found[0], replace(found[1], context=found[0].context)


def networks(settings, images=4):
    """Make the networks of a method; the recognition network sees so many pictures."""
    torch.manual_seed(0)
    vae = settings.latent == 'vae'
    config = PredictorConfig(image_size=32, base_width=4, num_context=2,
                             latent_size=LATENT_SIZE if vae else 0, new_pixels=True)
    return Networks(
        PredictorNetwork(config), Recognition(config, images) if vae else None,
        Discriminator(config, 12) if settings.gan else None,
        Discriminator(config, 12) if settings.gan and vae else None)


def learn(batch, config):
    """Return loss, match and the gradients of all networks."""
    nets = networks(config, 4 if config.posterior == 'video' else 3)
    augmentation = Augmentation.draw(len(CHOSEN), True, 0.2, np.random.default_rng(1))
    assert augmentation.flip.any() and not augmentation.flip.all()
    batch = replace(batch, augmentation=augmentation)
    outcome = predictor_loss(nets, batch, config, Draws.make(batch, 0, 0))
    loss = outcome.loss
    if outcome.judged is not None:
        loss = loss + discriminators_loss(outcome.judged)
    loss.backward()
    return [outcome.loss.detach(), outcome.match, *(
        parameter.grad for net in vars(nets).values() if isinstance(net, torch.nn.Module)
        for parameter in net.parameters() if parameter.grad is not None)]


@pytest.mark.parametrize('values', [
    {'selection': 'progress'}, {'selection': 'relative', 'recursion': 2},
    method_fields('genmin-vae-gan'), {**method_fields('genmin-vae'), 'posterior': 'frame'}])
def test_what_the_robot_looks_like_changes_nothing(bags, values):
    config = TrainingConfig(recordings=(), **values)
    one, other = (learn(batch, config) for batch in batches(bags, 'all'))
    assert len(one) == len(other) > 10
    assert all(a.equal(b) for a, b in zip(one, other))
    if config.method == 'genmin-wo-gan+progress':  # with no or half a mask it does
        for robot_mask in ('none', 'arm'):
            one, other = (learn(batch, config) for batch in batches(bags, robot_mask))
            assert not one[0].equal(other[0])


def test_a_share_of_the_context_pictures_is_filled(bags):
    share, store = 0.5, open_recordings([bags[0]], progress=False)
    filled = FilledStore(store, 'all')
    chosen = np.arange(8).repeat(8)
    batch = make_batch(store, chosen, Sampling(fill_context=share), np.random.default_rng(0),
                       Pictures(filled=filled))
    shown = np.array([(context.numpy() == filled.gather([i], np.array([[0]]))[0, 0].numpy()).all()
                      for i, context in zip(chosen, batch.context[:, 0])])
    assert abs(shown.mean() - share) < 0.2
    assert (batch.bare[:, :, -2:, -2:] == 0).all() and (batch.targets[:, :, -2:, -2:] == 0).all()
