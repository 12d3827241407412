# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A masked robot leaves no trace in losses, gradients and choices."""

from dataclasses import replace

from made_episodes import cover, move_squares, write_bag
import numpy as np
import pytest
from tap_ros.errors import RecordingError
from tap_ros.prediction.batches import Augmentation, make_batch, Sampling
from tap_ros.prediction.methods import method_fields
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.prediction.objective import discriminators_loss, Draws, Networks, predictor_loss
from tap_ros.prediction.selection import Targets
from tap_ros.prediction.training import train
from tap_ros.prediction.training_config import ObjectiveSettings, TrainingConfig
from tap_ros.prediction.training_networks import Discriminator, Recognition
from tap_ros.recording.cache import open_recordings
from tap_ros.training.inpainted import fill
from tap_ros.training.weights import load_weights
import torch

CHOSEN = [0, 1, 2, 3]


def make_episode(seed):
    """Draw two squares that move, in 7 to 11 frames; the goal picture is none of them."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(6, 22, (2, 2))
    goal = start + rng.uniform(4, 6, (2, 2)) * rng.choice([-1, 1], (2, 2))
    episode = move_squares(start, goal, length=7 + seed % 5, seed=seed)
    return replace(episode, goal_frame=255 - episode.frames[-1])


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Write the same episodes twice, with robots that look different."""
    folder = tmp_path_factory.mktemp('covered')
    return [write_bag(folder / f'robot{seed}', [
        cover(make_episode(i), side=6, seed=seed) for i in range(8)]) for seed in range(2)]


def batches(bags, robot_mask, **sampling):
    """Return the batches of two recordings, with the context pictures of the first."""
    found = []
    for bag in bags:
        store = open_recordings([bag], progress=False)
        found.append(make_batch(store, CHOSEN, Sampling(margin=1, video_frames=4, **sampling),
                                filled=fill(store, robot_mask)))
    return found[0], replace(found[1], context=found[0].context)


def networks(settings, images=4):
    """Make the networks of a method; the recognition network sees so many pictures."""
    torch.manual_seed(0)
    vae = settings.latent == 'vae'
    config = PredictorConfig(image_size=32, base_width=4, num_context=2,
                             latent_size=3 if vae else 0, new_pixels=True)
    return Networks(
        PredictorNetwork(config), Recognition(config, images) if vae else None,
        Discriminator(config, 12) if settings.gan else None,
        Discriminator(config, 12) if settings.gan and vae else None)


def learn(batch, config):
    """Return loss, match and the gradients of all networks."""
    nets = networks(config, 4 if config.posterior == 'video' else 3)
    augmentation = Augmentation.draw(len(CHOSEN), True, True, 0.2, np.random.default_rng(1))
    assert augmentation.flip.any() and not augmentation.flip.all()
    outcome = predictor_loss(nets, batch, augmentation, config, Draws.make(
        batch, 3, 0, 0))
    loss = outcome.loss
    if outcome.judged is not None:
        loss = loss + discriminators_loss(outcome.judged)
    loss.backward()
    return [outcome.loss.detach(), outcome.match, *(
        parameter.grad for net in vars(nets).values() if net is not None
        for parameter in net.parameters() if parameter.grad is not None)]


@pytest.mark.parametrize('values', [
    {'selection': 'progress'}, {'selection': 'relative', 'recursion': 2},
    method_fields('genmin-vae-gan'), {**method_fields('genmin-vae'), 'posterior': 'frame'}])
def test_what_the_robot_looks_like_changes_nothing(bags, values):
    config = ObjectiveSettings(**values)
    one, other = (learn(batch, config) for batch in batches(bags, 'all'))
    assert len(one) == len(other) > 10
    assert all(a.equal(b) for a, b in zip(one, other))
    if config.method == 'genmin-wo-gan+progress':  # with no or half a mask it does
        for robot_mask in ('none', 'arm'):
            one, other = (learn(batch, config) for batch in batches(bags, robot_mask))
            assert not one[0].equal(other[0])


def test_pixels_that_are_never_free_have_no_gradient(bags):
    batch, _ = batches(bags, 'all')
    assert (~batch.seen).sum() == 4 * len(CHOSEN)  # the base
    augmentation = Augmentation.draw(len(CHOSEN), True, True, 0.2, np.random.default_rng(1))
    targets = Targets(batch, augmentation, ObjectiveSettings())
    image = torch.rand(len(CHOSEN), 3, 32, 32, requires_grad=True)
    targets.outer_l1(image, torch.zeros(len(CHOSEN), dtype=torch.int64)).sum().backward()
    touched = (augmentation.undo(image.grad[:, None] - 1)[:, 0] + 1).abs().sum(1) > 1e-9
    assert not touched[~batch.seen].any()
    assert touched[batch.seen].float().mean() > 0.99


@pytest.mark.parametrize('share', [0.0, 0.5, 1.0])
def test_context_pictures_are_filled_when_asked_to(bags, share):
    store = open_recordings([bags[0]], progress=False)
    filled = fill(store, 'all')
    chosen = np.arange(8).repeat(8)
    batch = make_batch(store, chosen, Sampling(fill_context=share), filled=filled,
                       rng=np.random.default_rng(0))
    shown = np.array([(context.numpy() == filled.frames([i], np.array([[0]]))[0, 0].numpy()).all()
                      for i, context in zip(chosen, batch.context[:, 0])])
    assert abs(shown.mean() - share) < 0.2
    for row in np.flatnonzero(~shown):
        assert (batch.context[row, 0].numpy() == store.frames(chosen[row])[0]).all()
    assert (batch.bare[:, :, -2:, -2:] == 0).all() and (batch.targets[:, :, -2:, -2:] == 0).all()


def test_weights_say_their_mask_and_recordings_without_masks_are_refused(bags, bag, tmp_path):
    config = TrainingConfig(
        recordings=(str(bags[0]),), out=str(tmp_path), base_width=4, batch_size=2, steps=1,
        margin=1, test_fraction=0.3, threads=1, precision='float32', robot_mask='all',
        fill_context=0.5)
    about = load_weights(train(config, progress=False), 'predictor')[2]
    assert about['settings']['robot_mask'] == 'all' and about['settings']['fill_context'] == 0.5
    with pytest.raises(RecordingError, match='robot_mask all .* /camera/robot_mask'):
        train(replace(config, recordings=(str(bag),)), progress=False)
