# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Training the predictor on recordings (section 3, appendix C)."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
import math
import os
from pathlib import Path
import time
from typing import Any

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.images.crop import check_trainable
from tap_ros.prediction.augmentation import Augmentation
from tap_ros.prediction.batches import Batch, episode_order, make_batch, Sampling
from tap_ros.prediction.discriminator import Discriminator
from tap_ros.prediction.held_out import held_out_scores, matched, sample_grid
from tap_ros.prediction.methods import todays_settings
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.prediction.objective import (
    discriminators_loss,
    Draws,
    Networks,
    Outcome,
    predictor_loss,
)
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.recognition import Recognition
from tap_ros.prediction.training_config import DEFAULTS, TrainingConfig
from tap_ros.recording.bags import check_first_picture
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.reading import reading_of
from tap_ros.training.checkpoints import (
    describe_run,
    load_checkpoint,
    run_facts,
    run_folder,
    save_checkpoint,
    start,
    TrainingState,
)
from tap_ros.training.devices import Autocast, make_autocast, pick_device, pick_precision
from tap_ros.training.frames import Frames, MappedFrames, ResidentFrames
from tap_ros.training.inpainted import fill, Filled, with_masks
from tap_ros.training.parallel import joined, Processes, share_batch_norm
from tap_ros.training.split import split_episodes, warn_if_none
from tap_ros.training.weights import save_weights
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

_SHOWN = 8  # episodes in a sample picture


def train(config: TrainingConfig, stop_at: int | None = None, minutes: float | None = None,
          progress: bool = True, after_step: Callable[[int], object] | None = None) -> str:
    """
    Train a predictor, or go on with a run that was interrupted.

    Interrupted and resumed runs end with the same weights, bit for bit, on the same machine.
    Leaves in the run's folder: config.json, run.json, scores.json, checkpoint.safetensors,
    predictor.safetensors and TensorBoard curves with sample pictures.

    :param config: TrainingConfig.
    :param stop_at: stop (and save) at this step instead of the last.
    :param minutes: stop (and save) after so many minutes; None: never.
    :param progress: whether to show a progress bar.
    :param after_step: called with the number of steps done, after each of them.
    :return: path of the weights file.
    :raises ConfigError: if the folder holds a run with other settings or recordings.
    :raises RecordingError: if the recordings cannot be trained on.
    :raises WeightsError: if the initial weights cannot be used, or the checkpoint is damaged.
    :raises StorageError: if the disk is full, or another process trains there. What was saved
        stays; the run goes on from there.
    """
    device = pick_device(config.device)
    torch.set_num_threads(config.threads or len(os.sched_getaffinity(0)))
    deadline = time.monotonic() + 60 * (minutes or math.inf)
    with joined(device) as processes:
        progress = progress and processes.first
        reading = reading_of(config)
        check_first_picture(config.recordings, reading, 'the predictor')
        store = open_recordings(list(config.recordings), progress=progress, reading=reading)
        with run_folder(config.out) if processes.first else nullcontext():
            _train(config, device, processes, store, stop_at, deadline, progress, after_step)
    return str(Path(config.out) / 'predictor.safetensors')


def _train(config: TrainingConfig, device: torch.device, processes: Processes, store: EpisodeStore,
           stop_at: int | None, deadline: float, progress: bool,
           after_step: Callable[[int], object] | None) -> None:
    """Train as the only run in the folder; see train."""
    training, held_out = with_masks(
        store, split_episodes(store, config.test_fraction), config.robot_mask)
    warn_if_none(held_out)
    torch.manual_seed(config.seed)
    network = PredictorNetwork(network_config(config, store.image_size))
    checkpoint = Path(config.out) / 'checkpoint.safetensors'
    if config.initial_weights and not checkpoint.exists():
        _begin_with(network, config.initial_weights)
    helpers = _helpers(config, network.config, store)
    for module in (network, *helpers.values()):
        share_batch_norm(module, processes)
    state = start(network, config.learning_rate, device, helpers)
    load_checkpoint(checkpoint, state, asdict(config), store.data_hash,
                    lambda settings: {**DEFAULTS, **todays_settings(settings)})
    # A run keeps what it began with. Processes of other machines may find otherwise: one decides.
    state.precision = state.precision or ('bfloat16' if processes.agree(
        pick_precision(config.precision, device) == 'bfloat16', device) else 'float32')
    autocast = make_autocast(state.precision, device)
    # Decoding and copying would be most of the time of a step on a GPU.
    make_frames = (partial(ResidentFrames, device=device, progress=progress)
                   if device.type == 'cuda' else MappedFrames)
    frames = make_frames(store)
    filled = fill(store, config.robot_mask, make_frames, progress)
    processes.wait()  # before the first one writes a checkpoint
    compiled: Callable[[Any], Any] = (
        torch.compile if config.compile else lambda module: module)
    networks = Networks(compiled(state.network), **{
        name: compiled(helper) for name, helper in state.helpers.items()})
    last = min(config.steps, stop_at or config.steps)
    report = partial(_report, config=config, store=store, frames=frames, filled=filled,
                     training=training, held_out=held_out, autocast=autocast)
    bar = tqdm(total=config.steps, initial=state.step, unit='step', disable=not progress,
               desc=f'{config.method}, {state.precision}')
    curves = SummaryWriter(config.out, purge_step=state.step) if processes.first else None
    with curves or nullcontext(), bar:
        began = time.monotonic() - state.seconds
        for step, batch, augmentation in _batches(
                store, frames, filled, training, config, processes, state.step, last):
            state.set_rates(config.steps, config.warmup, config.learning_rate,
                            config.discriminator_rate)
            batch, augmentation = batch.to(device), augmentation.to(device)
            draws = Draws.make(batch, config.latent_size, config.seed, step, processes)
            outcome, norm = _step(state, networks, batch, augmentation, draws, config, processes,
                                  autocast)
            state.update_average(config.average_decay)
            state.step = step + 1
            # Tell and save.
            bar.update()
            if state.step % config.log_every == 0:
                values = _values(outcome, batch, processes)
                if curves is not None:
                    _log(curves, bar, state.step, values, norm,
                         state.optimizers[0].param_groups[0]['lr'])
            if after_step is not None:
                after_step(state.step)
            late = math.isfinite(deadline) and processes.agree(
                time.monotonic() > deadline, device)
            if curves is not None and (
                    state.step % config.save_every == 0 or state.step == last or late):
                state.seconds = time.monotonic() - began
                report(state, curves)  # first: a run that is stopped in between reports again
                save_checkpoint(checkpoint, state, asdict(config), store.data_hash)
            if late:
                break


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


def network_config(config: TrainingConfig, image_size: tuple[int, int]) -> PredictorConfig:
    """
    Say which network a training run needs.

    :param config: TrainingConfig.
    :param image_size: (height, width) of the recordings.
    :return: PredictorConfig.
    :raises ConfigError: if the pictures are not square, or of a size that it cannot have.
    """
    check_trainable(image_size, 'the predictor')
    return PredictorConfig(image_size=image_size[0], base_width=config.base_width,
                           num_context=1 if config.forward else 2,
                           latent_size=config.latent_size if config.latent == 'vae' else 0,
                           new_pixels=config.new_pixels, decoder=config.decoder,
                           skips=config.skips)


def _begin_with(network: PredictorNetwork, weights: str) -> None:
    """Copy the weights of another training into a fresh network."""
    other, _ = load_network(weights)
    if other.config != network.config:
        mine, others = asdict(network.config), asdict(other.config)
        raise ConfigError(f'initial_weights: {weights} are for another network: ' + ', '.join(
            f'{name} {others[name]!r} instead of {mine[name]!r}'
            for name in mine if mine[name] != others[name]))
    network.load_state_dict(other.state_dict())


def _step(state: TrainingState[PredictorNetwork], networks: Networks, batch: Batch,
          augmentation: Augmentation, draws: Draws, config: TrainingConfig, processes: Processes,
          autocast: Autocast) -> tuple[Outcome, torch.Tensor]:
    """Do one step of the predictor, then one of the discriminators; return (Outcome, norm)."""
    state.network.train()
    state.helpers.train()
    judges = [judge for judge in (networks.discriminator, networks.posterior_discriminator)
              if judge is not None]  # a compiled network has no truth value
    for judge in judges:
        judge.requires_grad_(False)
    outcome = predictor_loss(networks, batch, augmentation, config, draws, autocast,
                             kl_share(state.step, config.steps, config.kl_warmup))
    state.optimizers[0].zero_grad()
    outcome.loss.backward()
    processes.average_gradients(state.optimizers[0].param_groups[0]['params'])
    norm = torch.nn.utils.clip_grad_norm_(
        state.optimizers[0].param_groups[0]['params'], config.gradient_clip or math.inf)
    state.optimizers[0].step()
    if outcome.judged is not None:
        for judge in judges:
            judge.requires_grad_(True)
        loss = discriminators_loss(outcome.judged, autocast)
        state.optimizers[1].zero_grad()
        loss.backward()
        processes.average_gradients(state.optimizers[1].param_groups[0]['params'])
        state.optimizers[1].step()
        outcome.parts['discriminators'] = loss.detach()
    return outcome, norm


def _helpers(config: TrainingConfig, shape: PredictorConfig,
             store: EpisodeStore) -> dict[str, torch.nn.Module]:
    """Make the networks that the method needs for its training alone."""
    helpers: dict[str, torch.nn.Module] = {}
    longest = int(store.lengths.max())
    if config.latent == 'vae':
        images = (config.video_frames if config.posterior == 'video'
                  else shape.num_context + 1)
        helpers['recognition'] = Recognition(shape, images, config.posterior_std)
    if config.gan:
        helpers['discriminator'] = Discriminator(shape, longest - 1)
        if config.latent == 'vae':
            helpers['posterior_discriminator'] = Discriminator(shape, longest - 1)
    return helpers


def _fraction(config: TrainingConfig) -> float | None:
    """Return the share of an episode at which the only target is, None for all targets."""
    return config.fraction if config.loss == 'fix' else None


def _batches(store: EpisodeStore, frames: Frames, filled: Filled | None, episodes: np.ndarray,
             config: TrainingConfig, processes: Processes, first: int,
             last: int) -> Iterator[tuple[int, Batch, Augmentation]]:
    """Yield (step, Batch, Augmentation), made two steps ahead in another thread."""
    whole = config.latent == 'vae' and config.posterior == 'video'
    sampling = Sampling(
        config.margin, config.num_targets, config.min_crop, config.start_crop,
        config.goal_picture, config.forward, _fraction(config), int(config.gan),
        config.video_frames if whole else 0, config.fill_context)
    part = processes.part(config.batch_size)

    def make(step: int) -> tuple[int, Batch, Augmentation]:
        rng = np.random.default_rng([config.seed, 2, step])
        chosen = episodes[episode_order(len(episodes), config.batch_size, config.seed, step)]
        batch = make_batch(store, chosen, sampling, frames, rng, part, filled)
        augmentation = Augmentation.draw(
            len(chosen), config.flip, config.colour, config.brightness, rng)
        return step, batch, augmentation.part(part)

    with ThreadPoolExecutor(1) as pool:
        ahead = [pool.submit(make, step) for step in range(first, min(first + 2, last))]
        for step in range(first, last):
            if step + 2 < last:
                ahead.append(pool.submit(make, step + 2))
            yield ahead.pop(0).result()


def _values(outcome: Outcome, batch: Batch, processes: Processes) -> dict[str, float]:
    """Return what the curves show of a step, by name: means over the whole batch."""
    fraction = batch.times.gather(1, outcome.match[:, None]) / batch.end
    values = {'loss': outcome.loss, 'match_fraction': fraction.mean(),
              'match_fraction_square': fraction.square().mean(),
              **{f'loss_{name}': value for name, value in outcome.parts.items()},
              **({} if outcome.nats is None else {'nats': outcome.nats})}
    means = processes.mean(torch.stack([value.detach().float() for value in values.values()]))
    shown: dict[str, float] = dict(zip(values, means.tolist()))
    variance = shown.pop('match_fraction_square') - shown['match_fraction'] ** 2
    return shown | {'match_fraction_std': math.sqrt(max(variance, 0))}


def _log(curves: SummaryWriter, bar: tqdm, step: int, values: dict[str, float], norm: torch.Tensor,
         rate: float) -> None:
    """Add a point to the curves and to the progress bar."""
    for name, value in {**values, 'gradient_norm': norm.item(), 'learning_rate': rate}.items():
        curves.add_scalar(f'train/{name}', value, step)
    bar.set_postfix(loss=f'{values["loss"]:.4f}', match=f'{values["match_fraction"]:.2f}')


def _report(state: TrainingState[PredictorNetwork], curves: SummaryWriter, config: TrainingConfig,
            store: EpisodeStore, frames: Frames, filled: Filled | None, training: np.ndarray,
            held_out: np.ndarray, autocast: Autocast) -> None:
    """Score the averaged network on held-out episodes; write weights, scores and pictures."""
    device = next(state.average.parameters()).device

    sampling = Sampling(
        config.margin, goal_picture='recorded' if config.goal_picture == 'recorded' else 'last',
        forward=config.forward, fraction=_fraction(config),
        fill_context=config.fill_context)

    def batch(episodes: np.ndarray) -> Batch:
        return make_batch(store, episodes, sampling, frames, filled=filled).to(device)

    scores = {}
    if len(held_out):
        parts = (batch(held_out[i:i + 64]) for i in range(0, len(held_out), 64))
        scores = held_out_scores(state.average, parts, config, autocast)
    for name, value in scores.items():
        curves.add_scalar(f'held_out/{name}', value, state.step)
    for name, episodes in (('training', training[:_SHOWN]), ('held_out', held_out[:_SHOWN])):
        if len(episodes):
            shown = batch(episodes)
            picture = sample_grid(shown, *matched(state.average, shown, config, autocast))
            curves.add_image(name, picture, state.step, dataformats='HWC')
    about = run_facts(state, config.seed, store, training, held_out)
    describe_run(config.out, config=asdict(config), run=about, scores=scores)
    save_weights(Path(config.out) / 'predictor.safetensors', state.average, 'predictor',
                 state.network.config, about | {'settings': asdict(config), 'scores': scores})
