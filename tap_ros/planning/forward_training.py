# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training of the forward model from recordings.

Everything random is drawn from (seed, step), so that a run that was interrupted goes on to the
same result.
"""

from dataclasses import asdict
import os
from pathlib import Path
import time

import numpy as np
from tap_ros.images.crop import check_trainable
from tap_ros.images.drawing import grey_panels, grid
from tap_ros.images.pixels import to_uint8
from tap_ros.planning.forward_loss import draw_arm_like, draw_windows, forward_loss, Windows
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from tap_ros.planning.forward_scores import map_errors
from tap_ros.planning.forward_training_config import DEFAULTS, ForwardTrainingConfig
from tap_ros.planning.table import fit_arm, fit_shift, fit_table
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
from tap_ros.training.devices import pick_device
from tap_ros.training.inpainted import Episodes, FilledStore, with_masks
from tap_ros.training.robot_mask import fill_from_past
from tap_ros.training.split import split_episodes, warn_if_none
from tap_ros.training.weights import save_weights
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

FITTED_EPISODES = 100  # enough for the homography and the arm's camera


def train(config: ForwardTrainingConfig, stop_at: int | None = None, progress: bool = True) -> str:
    """
    Train a forward model, or go on with a run that was interrupted.

    Leaves in the run's folder: config.json, run.json, scores.json, checkpoint.safetensors,
    forward_model.safetensors and TensorBoard curves with sample pictures.

    :param config: ForwardTrainingConfig.
    :param stop_at: stop (and save) at this step instead of the last.
    :param progress: whether to show a progress bar.
    :return: path of the weights file.
    :raises ConfigError: if the folder holds a run with other settings or recordings.
    :raises RecordingError: if the recordings cannot be trained on.
    :raises WeightsError: if the checkpoint is damaged.
    :raises StorageError: if the disk is full, or another process trains there. What was saved
        stays; the run goes on from there.
    """
    device = pick_device(config.device)
    torch.set_num_threads(config.threads or len(os.sched_getaffinity(0)))
    reading = reading_of(config)
    check_first_picture(config.recordings, reading, 'the forward model')
    store = open_recordings(list(config.recordings), progress=progress, reading=reading)
    with run_folder(config.out):
        _train(config, device, store, stop_at, progress)
    return str(Path(config.out) / 'forward_model.safetensors')


def _train(config: ForwardTrainingConfig, device: torch.device, store: EpisodeStore,
           stop_at: int | None, progress: bool) -> None:
    """Train as the only process in the folder; see train."""
    training, held_out = with_masks(
        store, split_episodes(store, config.test_fraction, config.horizon + 1), config.robot_mask)
    warn_if_none(held_out)
    torch.manual_seed(config.seed)
    state = start(
        LearnedForwardModel(model_config(config, store, training)), config.learning_rate, device)
    checkpoint = Path(config.out) / 'checkpoint.safetensors'
    load_checkpoint(checkpoint, state, asdict(config), store.data_hash,
                    lambda settings: {**DEFAULTS, **settings})
    # The picture that is looked at shows what a node would show; see FreeView.
    episodes = store if config.robot_mask == 'none' else FilledStore(
        store, config.robot_mask, progress, fill_from_past)
    tables = episode_tables(store, state.network)
    last = min(config.steps, stop_at or config.steps)
    bar = tqdm(total=config.steps, initial=state.step, desc='forward model', unit='step',
               disable=not progress)
    with SummaryWriter(config.out, purge_step=state.step) as curves, bar:
        began = time.monotonic() - state.seconds
        for step in range(state.step, last):
            state.set_rates(config.steps, config.warmup, config.learning_rate)
            # One step of Adam towards the recorded pictures.
            batch, shown = draw_step(config, episodes, training, step, tables)
            loss, parts = forward_loss(state.network, batch.to(device), shown, config)
            state.optimizers[0].zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(state.network.parameters(), config.gradient_clip)
            state.optimizers[0].step()
            state.update_average(config.average_decay)
            state.step = step + 1
            # Tell and save.
            bar.update()
            if state.step % config.log_every == 0:
                for name, value in parts.items():
                    curves.add_scalar(f'train/{name}', value, state.step)
                bar.set_postfix(picture=f'{parts["picture"]:.4f}', horizon=len(batch.actions[0]))
            if state.step % config.save_every == 0 or state.step == last:
                state.seconds = time.monotonic() - began
                # The report first: a run that is stopped in between reports again.
                _report(state, curves, config, store, episodes, training, held_out)
                save_checkpoint(checkpoint, state, asdict(config), store.data_hash)


def model_config(config: ForwardTrainingConfig, store: EpisodeStore,
                 training: np.ndarray) -> ForwardModelConfig:
    """
    Say which network the recordings need, fitting its geometry to them.

    :param config: ForwardTrainingConfig.
    :param store: EpisodeStore; training: indices of its training episodes.
    :return: ForwardModelConfig.
    :raises ConfigError: if the pictures are not square, or of a size that it cannot have.
    :raises RecordingError: if gripper positions are missing.
    """
    check_trainable(store.image_size, 'the forward model')
    chosen = training[np.linspace(0, len(training) - 1, FITTED_EPISODES).astype(int)]
    episodes = [store[int(i)] for i in np.unique(chosen)]
    arm = fit_arm(episodes)
    return ForwardModelConfig(
        table=tuple(fit_table(episodes, arm).ravel().tolist()), arm=tuple(arm.ravel().tolist()),
        image_size=store.image_size[0], width=config.width, features=config.features,
        robot_mask=config.robot_mask, crop=config.crop, crop_size=config.size,
        camera_size=store.camera_size or (0, 0))


def episode_tables(store: EpisodeStore, model: LearnedForwardModel) -> torch.Tensor:
    """
    Return where the table is in the pictures of every episode, on the CPU.

    :return: (E, 3, 3); where the robot is masked, shifted as far as the camera was, see fit_shift.
    """
    table = model.homography.cpu()
    if model.config.robot_mask == 'none':
        return table.expand(len(store), 3, 3)
    return torch.from_numpy(np.stack([
        fit_shift(store[i], table.double().numpy()) for i in range(len(store))])).float()


def draw_step(config: ForwardTrainingConfig, store: Episodes, training: np.ndarray, step: int,
              homography: torch.Tensor) -> tuple[Windows, set[int]]:
    """
    Draw the windows of one step, and which of their pictures are compared.

    :param homography: (3, 3), or (E, 3, 3) of every episode.
    :return: Windows, set of picture indices from 1 to their length.
    """
    rng = np.random.default_rng([config.seed, step])
    growth = min(1.0, (step + 1) / max(1, config.grow * config.steps))
    length = max(1, round(min(2, config.horizon) + growth * (config.horizon - 2)))
    batch = draw_windows(
        store, training, config.batch_size, length, homography.cpu(), rng, config.augment,
        config.robot_mask)
    return batch, set((rng.permutation(length)[:config.pictures] + 1).tolist())


def _report(state: TrainingState[LearnedForwardModel], curves: SummaryWriter,
            config: ForwardTrainingConfig, store: EpisodeStore, filled: Episodes,
            training: np.ndarray, held_out: np.ndarray) -> None:
    """Score the averaged network on held-out episodes; write weights, scores and pictures."""
    scores = map_errors(state.average, filled, held_out)
    for name, value in scores.items():
        curves.add_scalar(f'held_out/{name}', value, state.step)
    for name, episodes in (('training', training), ('held_out', held_out)):
        if len(episodes):
            picture = sample_grid(state.average, filled, episodes, config)
            curves.add_image(name, picture, state.step, dataformats='HWC')
    about = run_facts(state, config.seed, store, training, held_out)
    describe_run(config.out, config=asdict(config), run=about, scores=scores)
    save_weights(
        Path(config.out) / 'forward_model.safetensors', state.average, 'forward_model',
        state.network.config, about | {'settings': asdict(config), 'scores': scores})


@torch.no_grad()
def sample_grid(model: LearnedForwardModel, store: Episodes, episodes: np.ndarray,
                config: ForwardTrainingConfig, rows: int = 6, seed: int = 0) -> np.ndarray:
    """
    Show windows: first picture, its objects' mask and background, then true beside predicted.

    :return: uint8 (height, width, 3).
    """
    batch = draw_windows(
        store, episodes, rows, config.horizon, model.homography.cpu(),
        np.random.default_rng(seed), augment=False).to(model.homography.device)

    def arm(t: int) -> torch.Tensor:
        return draw_arm_like(model, batch.grippers[:, t], batch.mirrored, batch.colours)

    scene = model.look(batch.images[:, 0], arm(0)[:, 3:], batch.homography)
    columns = [list(to_uint8(batch.images[:, 0])), grey_panels(scene.objects[:, 3].cpu()),
               list(to_uint8(scene.background))]
    flow, gripper = model.still(rows), batch.grippers[:, 0]
    for t in range(1, config.horizon + 1):
        flow, gripper, _ = model.advance(scene.features, flow, gripper, batch.actions[:, t - 1])
        if t in (config.horizon // 3, 2 * config.horizon // 3, config.horizon):
            predicted, _ = model.picture(scene, flow, arm(t), batch.homography)
            columns += [list(to_uint8(batch.images[:, t])), list(to_uint8(predicted))]
    return grid([list(row) for row in zip(*columns)])
