# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Training the predictor on recordings (section 3, appendix C)."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
import contextlib
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.images.crop import check_trainable
from tap_ros.images.drawing import grey_panels, grid
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.batches import Augmentation, Batch, episode_order, make_batch, Sampling
from tap_ros.prediction.losses import l1_error
from tap_ros.prediction.marks import weigh
from tap_ros.prediction.methods import todays_settings
from tap_ros.prediction.networks import Prediction, PredictorConfig, PredictorNetwork
from tap_ros.prediction.objective import (
    discriminators_loss,
    Draws,
    Networks,
    Outcome,
    predictor_loss,
)
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.selection import Targets
from tap_ros.prediction.training_config import DEFAULTS, TrainingConfig
from tap_ros.prediction.training_networks import Discriminator, Recognition
from tap_ros.training import run
from tap_ros.training.checkpoints import TrainingState
from tap_ros.training.devices import Autocast, make_autocast, pick_precision
from tap_ros.training.frames import MappedFrames, ResidentFrames
from tap_ros.training.inpainted import fill
import torch

_SHOWN = 8  # episodes in a sample picture
Item = tuple[int, Batch, Augmentation]  # of a step
Gather = Callable[..., Batch]  # make_batch, of episodes, a Sampling and a numpy Generator


def train(config: TrainingConfig, stop_at: int | None = None, progress: bool = True,
          after_step: Callable[[int], object] | None = None) -> str:
    """
    Train a predictor, or go on with a run that was interrupted, see run.run.

    Interrupted and resumed runs end with the same weights, bit for bit, on the same machine.

    :raises WeightsError: if the initial weights cannot be used, or the checkpoint is damaged.
    """
    return run.run(config, 'predictor', _prepare, stop_at=stop_at, progress=progress,
                   after_step=after_step)


def _prepare(this: run.Run) -> run.Course[PredictorNetwork, Item]:
    """Make the networks of a run, what they are trained on and how."""
    config, store, device = this.config, this.store, this.device
    if config.patience and not len(this.held_out):
        raise ConfigError('patience: nothing is held out to see improvement by; give --held-out, '
                          'a --test-fraction above 0, or leave --patience out')
    network, helpers = _make_networks(this)
    state = this.begin(network, helpers, lambda old: {**DEFAULTS, **todays_settings(old)})
    state.precision = state.precision or pick_precision(config.precision, device)
    autocast = make_autocast(state.precision, device)
    # Decoding and copying would be most of the time of a step on a GPU.
    make_frames = (partial(ResidentFrames, device=device, progress=this.progress)
                   if device.type == 'cuda' else MappedFrames)
    frames = make_frames(store)
    filled = fill(store, config.robot_mask, make_frames, this.progress)
    preference, about = weigh(store, config, this.training)

    def gather(episodes: np.ndarray, sampling: Sampling,
               rng: np.random.Generator | None = None) -> Batch:
        return make_batch(store, episodes, sampling, frames, rng, filled, preference)

    networks = Networks(state.network, **dict[str, Any](state.helpers.items()))

    def step(item: Item) -> Callable[[], run.Numbers]:
        number, batch, augmentation = item
        batch, augmentation = batch.to(device), augmentation.to(device)
        draws = Draws.make(batch, config.latent_size, config.seed, number)
        outcome, norm = _step(state, networks, batch, augmentation, draws, config, autocast)
        return lambda: _values(outcome, batch) | {'gradient_norm': norm.item()}

    return run.Course(
        state, partial(_batches, gather, this.training, config), step,
        partial(_score, gather, this, state, autocast),
        about, config.patience)


def _make_networks(this: run.Run) -> tuple[PredictorNetwork, dict[str, torch.nn.Module]]:
    """Make the network, and those that the method needs for its training alone."""
    config, store = this.config, this.store
    check_trainable(store.image_size, 'the predictor')
    vae, longest = config.latent == 'vae', int(store.lengths.max())
    shape = PredictorConfig(
        image_size=store.image_size[0], base_width=config.base_width,
        num_context=1 if config.forward else 2, latent_size=config.latent_size if vae else 0,
        new_pixels=config.new_pixels, decoder=config.decoder, skips=config.skips)
    network, helpers = PredictorNetwork(shape), dict[str, torch.nn.Module]()
    if config.initial_weights and not this.checkpoint.exists():
        other, _ = load_network(config.initial_weights)
        mine, others = asdict(network.config), asdict(other.config)
        if differing := [f'{name} {others[name]!r} instead of {mine[name]!r}'
                         for name in mine if mine[name] != others[name]]:
            raise ConfigError(
                f'initial_weights: {config.initial_weights} are for another network: '
                f'{", ".join(differing)}; leave these options out, or begin with other weights')
        network.load_state_dict(other.state_dict())
    if vae:
        images = (config.video_frames if config.posterior == 'video'
                  else shape.num_context + 1)
        helpers['recognition'] = Recognition(shape, images, config.posterior_std)
    if config.gan:
        helpers['discriminator'] = Discriminator(shape, longest - 1)
    if config.gan and vae:
        helpers['posterior_discriminator'] = Discriminator(shape, longest - 1)
    return network, helpers


def _step(state: TrainingState[PredictorNetwork], networks: Networks, batch: Batch,
          augmentation: Augmentation, draws: Draws, config: TrainingConfig,
          autocast: Autocast) -> tuple[Outcome, torch.Tensor]:
    """Do one step of the predictor, then one of the discriminators; return (Outcome, norm)."""
    state.network.train()
    state.helpers.train()
    judges = [judge for judge in (networks.discriminator, networks.posterior_discriminator)
              if judge is not None]
    for judge in judges:
        judge.requires_grad_(False)
    outcome = predictor_loss(networks, batch, augmentation, config, draws, autocast,
                             kl_share(state.step, config.steps, config.kl_warmup))
    state.optimizers[0].zero_grad()
    outcome.loss.backward()
    norm = state.clip_gradients(config.gradient_clip)
    state.optimizers[0].step()
    if outcome.judged is not None:
        for judge in judges:
            judge.requires_grad_(True)
        loss = discriminators_loss(outcome.judged, autocast)
        state.optimizers[1].zero_grad()
        loss.backward()
        state.optimizers[1].step()
        outcome.parts['discriminators'] = loss.detach()
    return outcome, norm


def _batches(gather: Gather, episodes: np.ndarray, config: TrainingConfig, first: int,
             last: int) -> Iterator[Item]:
    """Yield (step, Batch, Augmentation), made two steps ahead in another thread."""
    whole = config.latent == 'vae' and config.posterior == 'video'
    sampling = Sampling(
        config.margin, config.num_targets, config.min_crop, config.start_crop,
        config.goal_picture, config.forward, config.only_fraction, int(config.gan),
        config.video_frames if whole else 0, config.fill_context)

    def make(step: int) -> Item:
        rng = np.random.default_rng([config.seed, 2, step])
        chosen = episodes[episode_order(len(episodes), config.batch_size, config.seed, step)]
        batch = gather(chosen, sampling, rng)
        augmentation = Augmentation.draw(
            len(chosen), config.flip, config.colour, config.brightness, rng)
        return step, batch, augmentation

    with ThreadPoolExecutor(1) as pool:
        ahead = [pool.submit(make, step) for step in range(first, min(first + 2, last))]
        for step in range(first, last):
            if step + 2 < last:
                ahead.append(pool.submit(make, step + 2))
            yield ahead.pop(0).result()


def _values(outcome: Outcome, batch: Batch) -> dict[str, float]:
    """Return what the curves show of a step, by name."""
    fraction = batch.times.gather(1, outcome.match[:, None]) / batch.end
    values = {'loss': outcome.loss, 'match_fraction': fraction.mean(),
              'match_fraction_std': fraction.std(correction=0),
              **{f'loss_{name}': value for name, value in outcome.parts.items()},
              **({} if outcome.nats is None else {'nats': outcome.nats})}
    return {name: value.item() for name, value in values.items()}


def _score(gather: Gather, this: run.Run, state: TrainingState[PredictorNetwork],
           autocast: Autocast) -> tuple[run.Numbers, Mapping[str, np.ndarray]]:
    """Score the averaged network, z at 0, where its method matches; show some of all."""
    config, held_out = this.config, this.held_out
    sampling = Sampling(
        config.margin, goal_picture='recorded' if config.goal_picture == 'recorded' else 'last',
        forward=config.forward, fraction=config.only_fraction, fill_context=config.fill_context)

    scores, pictures, losses, copied, fractions = {}, {}, [], [], []
    for i in range(0, len(held_out), 64):
        part = gather(held_out[i:i + 64], sampling).to(this.device)
        prediction, match = matched(state.average, part, config, autocast)
        frame = to_float(part.targets[torch.arange(len(match), device=match.device), match])
        image = part.visible(prediction.image[:, None])[:, 0]
        losses.append(l1_error(image, frame).cpu())
        copied.append(l1_error(to_float(part.measured), frame[:, None]).amin(1).cpu())
        fractions.append((part.times.gather(1, match[:, None]) / part.end)[:, 0].cpu())
    if losses:
        shares = torch.cat(fractions)
        loss = torch.cat(losses).mean()
        scores = {'loss': loss.item(), 'relative': (loss / torch.cat(copied).mean()).item(),
                  'match_fraction': shares.mean().item(),
                  'match_fraction_std': shares.std(correction=0).item()}
    for name, episodes in (('training', this.training), ('held_out', held_out)):
        if len(episodes):
            shown = gather(episodes[:_SHOWN], sampling).to(this.device)
            pictures[name] = sample_grid(shown, *matched(state.average, shown, config, autocast))
    return scores, pictures


@torch.no_grad()
def matched(network: PredictorNetwork, batch: Batch, config: TrainingConfig,
            autocast: Autocast = contextlib.nullcontext) -> tuple[Prediction, torch.Tensor]:
    """
    Predict, with z at 0, and find the frames that the method chooses.

    :param network: PredictorNetwork in eval mode.
    :param batch: batches.Batch, on the network's device.
    :param autocast: makes the context manager to run the network in.
    :return: (Prediction, int64 (B,) indices into T).
    """
    context = to_float(batch.context)
    with autocast():
        prediction = network(context)
    targets = Targets(batch, None, config)
    return prediction, targets.match(prediction.image, targets.measured(context))


@torch.no_grad()
def sample_grid(batch: Batch, prediction: Prediction, match: torch.Tensor) -> np.ndarray:
    """
    Show a batch: context, prediction, matched frame, one mask for each source, new pixels.

    :param prediction: networks.Prediction of it.
    :param match: int64 (B,), the matched targets as indices into T.
    :return: uint8 (height, width, 3).
    """
    context = batch.context.cpu().numpy()
    images = to_uint8(prediction.image)
    match = match.cpu()
    rows = []
    for b in range(len(context)):
        row = [*context[b], images[b], batch.targets[b, match[b]].cpu().numpy()]
        row += grey_panels(prediction.masks[b, :, 0].float())
        if prediction.new_pixels is not None:
            row.append(to_uint8(prediction.new_pixels[b]))
        rows.append(row)
    return grid(rows)


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
