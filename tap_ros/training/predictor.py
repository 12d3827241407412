# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Training the predictor on recordings (section 3, appendix C)."""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
import sys
from typing import Any

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
from tap_ros.images.crop import check_trainable
from tap_ros.images.drawing import grey_panels, grid
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.losses import l1_error
from tap_ros.prediction.networks import Prediction, PredictorConfig, PredictorNetwork
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import EpisodeStore
from tap_ros.training.augmentation import Augmentation
from tap_ros.training.batches import Batch, episode_order, make_batch, Pictures, Sampling
from tap_ros.training.frames import FilledStore, has_room, ResidentFrames
from tap_ros.training.keyframes import Keyframes, NUM_KEYFRAMES
from tap_ros.training.marks import episode_preferences
from tap_ros.training.objective import (
    discriminators_loss,
    Draws,
    LATENT_SIZE,
    Networks,
    Outcome,
    predictor_loss,
)
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.training.run import Run
from tap_ros.training.selection import Targets
from tap_ros.training.training_networks import Discriminator, Recognition
from tap_ros.weights.devices import make_autocast, pick_precision
import torch

AVERAGE_DECAY = 0.999  # of the moving average that is shipped
VIDEO_FRAMES = 16  # moments at which the recognition network sees the video; the paper: all
AROUND = 2  # frames from a label that no start or goal is drawn from, beside the margin
_SHOWN = 8  # episodes in a sample picture


def train(config: TrainingConfig, stop_at: int | None = None, progress: bool = True,
          after_step: Callable[[int], object] | None = None) -> str:
    """
    Train a predictor, or go on with a run that was interrupted, see run.Run.

    Interrupted and resumed runs end with the same weights, bit for bit, on the same machine.

    :return: path of the weights file.
    :raises WeightsError: if the initial weights cannot be used, or the checkpoint is damaged.
    """
    with Run(config, 'predictor', stop_at=stop_at, progress=progress,
             after_step=after_step) as run:
        if config.patience and not len(run.held_out):
            raise ConfigError('patience: nothing is held out to see improvement by; give '
                              '--held-out, a --test-fraction above 0, or leave --patience out')
        preference, run.about = episode_preferences(
            run.store, config, run.training, progress)
        network, helpers = make_networks(run)
        filled = None if config.robot_mask == 'none' else FilledStore(
            run.store, config.robot_mask, progress)
        keyframes = None
        if config.keyframes:
            assert preference is not None, 'marks label the frames'
            keyframes = Keyframes(run.store, run.training, preference, config, filled)
            network.bank = keyframes.bank()
            _print_left_out(keyframes)
        state = run.begin(network, AVERAGE_DECAY, helpers)
        state.precision = state.precision or pick_precision(config.precision, run.device)
        networks = Networks(state.network, **dict[str, Any](state.helpers.items()),
                            autocast=make_autocast(state.precision, run.device))
        frames = None
        # Copying would be most of the time of a step on a GPU; what does not fit stays in files.
        if run.device.type == 'cuda' and has_room(
                run.device, *[run.store] * (1 if filled is None else 2)):
            frames = ResidentFrames(run.store, run.device, progress)
            if filled is not None:
                filled.gather = ResidentFrames(filled, run.device, progress)
        pictures = Pictures(frames, filled, preference, keyframes)
        draw = partial(draw_batch, run.store, run.training, config, pictures)
        state.network.train()
        state.helpers.train()
        score, show = partial(_score, run, pictures), partial(_show, run, pictures)
        for step, batch in run.steps(draw, score, show, config.patience):
            batch = batch.to(run.device)

            # Eqs. 1 to 10: the predictor, and the recognition network.
            outcome = predictor_loss(networks, batch, config, Draws.make(batch, config.seed, step),
                                     kl_share(step, config.steps, config.kl_warmup))
            state.optimizers[0].zero_grad()
            outcome.loss.backward()
            shown = {**_values(outcome, batch), 'gradient_norm': state.clip_gradients()}
            state.optimizers[0].step()

            # Eq. 11: the discriminators.
            if outcome.judged is not None:
                loss = discriminators_loss(outcome.judged, networks.autocast)
                state.optimizers[1].zero_grad()  # of what the predictor's loss left there, too
                loss.backward()
                state.optimizers[1].step()
                shown['loss_discriminators'] = loss.detach()
            run.show(shown)
    return run.weights


def make_networks(run: Run[TrainingConfig],
                  ) -> tuple[PredictorNetwork, dict[str, torch.nn.Module]]:
    """Make the network, and those that the method needs for its training alone."""
    config = run.config
    check_trainable(run.store.image_size, 'the predictor')
    vae, longest = config.latent == 'vae', int(run.store.lengths.max())
    shape = PredictorConfig(
        image_size=run.store.image_size[0], base_width=config.base_width,
        num_context=1 if config.forward else 2 + NUM_KEYFRAMES * config.keyframes,
        latent_size=LATENT_SIZE if vae else 0, new_pixels=config.new_pixels,
        decoder=config.decoder, skips=config.skips)
    network, helpers = PredictorNetwork(shape), dict[str, torch.nn.Module]()
    if config.initial_weights and not run.checkpoint.exists():
        other, _ = load_network(config.initial_weights)
        mine, others = asdict(network.config), asdict(other.config)
        if differing := [f'{name} {others[name]!r} instead of {mine[name]!r}'
                         for name in mine if mine[name] != others[name]]:
            raise ConfigError(
                f'initial_weights: {config.initial_weights} are for another network: '
                f'{", ".join(differing)}; leave these options out, or begin with other weights')
        network.load_state_dict(other.state_dict())
    if vae:
        images = VIDEO_FRAMES if config.posterior == 'video' else shape.num_context + 1
        helpers['recognition'] = Recognition(shape, images, config.posterior_std)
    if config.gan:
        helpers['discriminator'] = Discriminator(shape, longest - 1)
    if config.gan and vae:
        helpers['posterior_discriminator'] = Discriminator(shape, longest - 1)
    return network, helpers


def sampling_of(config: TrainingConfig) -> Sampling:
    """Say what is taken from episodes to train on."""
    whole = config.latent == 'vae' and config.posterior == 'video'
    return Sampling(
        config.margin, config.num_targets, config.min_crop, config.start_crop,
        config.goal_picture, config.forward, AROUND + config.margin if config.marks else 0,
        config.only_fraction, int(config.gan), VIDEO_FRAMES if whole else 0, config.fill_context)


def draw_batch(store: EpisodeStore, episodes: np.ndarray, config: TrainingConfig,
               pictures: Pictures, step: int) -> Batch:
    """Make the batch of a step, the same one whenever asked."""
    rng = np.random.default_rng([config.seed, 2, step])
    chosen = episodes[episode_order(len(episodes), config.batch_size, config.seed, step)]
    batch = make_batch(store, chosen, sampling_of(config), rng, pictures)
    if pictures.keyframes is not None:
        batch = replace(batch, keyframes=pictures.keyframes.draw(chosen, rng))
    return replace(batch, augmentation=Augmentation.draw(
        len(chosen), config.colour, config.brightness, rng))


def _print_left_out(keyframes: Keyframes) -> None:
    """Print before a training whose labelled frames are not shown as keyframes; on stderr."""
    if left_out := [str(i) for i in keyframes.left_out]:
        print(f'keyframes: the labelled frames of {listing(left_out, 10)} differ from those of '
              'similar demonstrations and are not shown to the network. Check these labels; mark '
              'those that are wrong', file=sys.stderr)


def _values(outcome: Outcome, batch: Batch) -> dict[str, torch.Tensor]:
    """Return what the curves show of a step, by name."""
    fraction = batch.times.gather(1, outcome.match[:, None]) / batch.end
    values = {'loss': outcome.loss, 'match_fraction': fraction.mean(),
              'match_fraction_std': fraction.std(correction=0),
              **{f'loss_{name}': value for name, value in outcome.parts.items()},
              **({} if outcome.nats is None else {'nats': outcome.nats})}
    return {name: value.detach() for name, value in values.items()}


def _score(run: Run[TrainingConfig], pictures: Pictures) -> dict[str, float]:
    """Score the averaged network on the held-out episodes, where its method matches."""
    rows = []
    for i in range(0, len(run.held_out), 64):
        batch, prediction, match = _matched(run, pictures, run.held_out[i:i + 64])
        frame = to_float(batch.targets[torch.arange(len(match), device=match.device), match])
        image = batch.visible(prediction.image[:, None])[:, 0]
        rows.append(torch.stack([
            l1_error(image, frame), l1_error(to_float(batch.measured), frame[:, None]).amin(1),
            (batch.times.gather(1, match[:, None]) / batch.end)[:, 0]]).cpu())
    if not rows:
        return {}
    error, copying, share = torch.cat(rows, 1)
    return {name: score.item() for name, score in {
        'loss': error.mean(), 'relative': error.mean() / copying.mean(),
        'match_fraction': share.mean(), 'match_fraction_std': share.std(correction=0)}.items()}


@torch.no_grad()
def _matched(run: Run[TrainingConfig], pictures: Pictures,
             episodes: np.ndarray) -> tuple[Batch, Prediction, torch.Tensor]:
    """Predict with the averaged network, z at 0; find the frames (B,) that its method chooses."""
    config = run.config
    batch = make_batch(run.store, episodes, Sampling(
        config.margin, goal_picture='recorded' if config.goal_picture == 'recorded' else 'last',
        forward=config.forward, fraction=config.only_fraction,
        fill_context=config.fill_context), pictures=pictures).to(run.device)
    targets = Targets(batch, config)
    with make_autocast(run.state.precision, run.device)():
        prediction = run.state.average(targets.context)
    return batch, prediction, targets.match(prediction.image, targets.measured)


def _show(run: Run[TrainingConfig], pictures: Pictures, episodes: np.ndarray) -> np.ndarray:
    return sample_grid(*_matched(run, pictures, episodes[:_SHOWN]))


def sample_grid(batch: Batch, prediction: Prediction, match: torch.Tensor) -> np.ndarray:
    """
    Show a batch: context, prediction, matched frame, one mask for each source, new pixels.

    :param prediction: networks.Prediction of it.
    :param match: int64 (B,), the matched targets as indices into T.
    :return: uint8 (height, width, 3).
    """
    context, images = batch.context.cpu().numpy(), to_uint8(prediction.image)
    new = prediction.new_pixels
    return grid([[*context[b], images[b], batch.targets[b, step].cpu().numpy(),
                  *grey_panels(prediction.masks[b, :, 0].float()),
                  *([] if new is None else [to_uint8(new[b])])] for b, step in enumerate(match)])


def kl_share(step: int, steps: int, warmup: float) -> float:
    """
    Compute which share of its weight the KL divergence has at a step: 0, a linear rise, then 1.

    Adam scales gradients, so that even a small price can shut z off before it is of use.

    :param step: from 0 on.
    :param steps: length of the training.
    :param warmup: share of the training in which it is 0, and over which it then rises; 0: the
        share is 1 from the start.
    :return: the share, 0 to 1.
    """
    return min(1.0, max(0.0, step / (warmup * steps) - 1)) if warmup else 1.0
