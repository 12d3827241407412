# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training of the forward model from recordings.

Everything random is drawn from (seed, step), so that a run that was interrupted goes on to the
same result.
"""

from collections.abc import Sequence
from functools import partial
import sys

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.images.crop import check_trainable
from tap_ros.images.drawing import grey_panels, grid
from tap_ros.images.pixels import to_uint8
from tap_ros.images.robot_mask import fill_from_past
from tap_ros.messages import topics
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from tap_ros.planning.table import fit_arm, fit_table
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.reading import Reading
from tap_ros.training.forward_config import ForwardTrainingConfig
from tap_ros.training.forward_loss import Cuts, forward_loss, make_windows, Windows
from tap_ros.training.forward_scores import held_out_scores
from tap_ros.training.frames import Episodes, FilledStore
from tap_ros.training.run import Run
import torch

AVERAGE_DECAY = 0.995  # of the moving average that is shipped
HORIZON = 8  # control periods of the longest windows
PICTURES = 4  # compared per window
FITTED_EPISODES = 100  # enough for the homography and the arm's camera
_SHOWN = 6  # windows in a sample picture
MOST_MISSED = 3 / 64  # of the picture's side, by which the arm may be beside its fit


def train(config: ForwardTrainingConfig, stop_at: int | None = None, progress: bool = True) -> str:
    """
    Train a forward model, or go on with a run that was interrupted, see run.Run.

    :return: path of the weights file.
    :raises RecordingError: for recordings without commands; see also run.Run and model_config.
    """
    with Run(config, 'forward_model', HORIZON + 1, stop_at, progress) as run:
        if not run.store.commands:
            raise RecordingError(
                'recordings: they hold no commands to the arm, which the forward model learns '
                f'from; record {topics.TWIST.recorded}, too')
        network = LearnedForwardModel(model_config(config, run.store, run.training))
        if config.initial_weights and not run.checkpoint.exists():
            take_weights(network, config.initial_weights)
        state = run.begin(network, AVERAGE_DECAY)
        # The picture that is looked at shows what a node would show; see FreeView.
        episodes: Episodes = run.store if config.robot_mask == 'none' else FilledStore(
            run.store, config.robot_mask, progress, fill_from_past)
        draw = partial(draw_step, config, episodes, run.training, state.network.homography.cpu())
        score = partial(held_out_scores, state.average, episodes, run.held_out)
        show = partial(sample_grid, state.average, episodes)
        for _, (windows, compared) in run.steps(draw, score, show):
            loss, parts = forward_loss(state.network, windows.to(run.device), compared)
            state.optimizers[0].zero_grad()
            loss.backward()
            norm = state.clip_gradients()
            state.optimizers[0].step()
            run.show({**parts, 'gradient_norm': norm})
    return run.weights


def take_weights(network: LearnedForwardModel, initial_weights: str) -> None:
    """Take over the weights of another forward model, but for its picture of the arm."""
    others = LearnedForwardModel.load(initial_weights, precision='float32').state_dict()
    del others['sprite']
    try:
        network.load_state_dict(others, strict=False)
    except RuntimeError as error:  # names the shapes
        raise ConfigError(
            f'initial_weights: {initial_weights} are for another network: {error}') from error


def model_config(config: ForwardTrainingConfig, store: EpisodeStore,
                 training: np.ndarray) -> ForwardModelConfig:
    """
    Say which network the recordings need, fitting its geometry to them.

    :param store: EpisodeStore; training: indices of its training episodes.
    :return: ForwardModelConfig.
    :raises ConfigError: if the pictures are not square, or of a size that it cannot have.
    :raises RecordingError: if gripper positions are missing, or the arm is not where they say.
    """
    check_trainable(store.image_size, 'the forward model')
    chosen = training[np.linspace(0, len(training) - 1, FITTED_EPISODES).astype(int)]
    episodes = [store[int(i)] for i in np.unique(chosen)]
    arm, missed = fit_arm(episodes)
    print(f'the arm is seen {missed:.1f} px from where its gripper positions put it (median)',
          file=sys.stderr)
    if missed > MOST_MISSED * store.image_size[0]:
        raise RecordingError(
            f'recordings: the arm is seen {missed:.1f} px from where its gripper positions put '
            f'it, more than {MOST_MISSED * store.image_size[0]:.0f}; the camera must not move, '
            'nor anything but the arm and what it pushes; see that /joint_states are of this '
            'robot and stamped by the same clock, or record robot masks (robot_mask_node)')
    table = (cut_projection(config.projection, store, config)[:, [0, 1, 3]] if config.projection
             else fit_table(episodes, arm))
    return ForwardModelConfig(
        table=tuple(table.ravel().tolist()), arm=tuple(arm.ravel().tolist()),
        image_size=store.image_size[0], robot_mask=config.robot_mask, crop=config.crop,
        crop_size=config.size, camera_size=store.camera_size or (0, 0))


def cut_projection(projection: Sequence[float], store: EpisodeStore,
                   reading: Reading) -> np.ndarray:
    """
    Make a camera's projection into that of its pictures after cutting and scaling.

    :param projection: 12 numbers, row-major, K [R | t]: the robot's metres to the camera's pixels.
    :return: (3, 4) float64, its last entry 1.
    """
    size = store.camera_size or store.image_size
    corners = np.array([[0, 0], [size[1] - 1, size[0] - 1]], float)
    low, high = reading.cut.pixels(corners, size)
    scale = (high - low) / (corners[1] - corners[0])
    matrix = np.reshape(projection, (3, 4)).astype(float)
    matrix[:2] = scale[:, None] * matrix[:2] + low[:, None] * matrix[2]
    return matrix / matrix[2, 3]


def draw_step(config: ForwardTrainingConfig, store: Episodes, training: np.ndarray,
              homography: torch.Tensor, step: int) -> tuple[Windows, set[int]]:
    """
    Draw the windows of one step, and which of their pictures are compared.

    :param homography: (3, 3) of the table, on the CPU.
    :return: Windows, set of picture indices from 1 to their length.
    """
    rng = np.random.default_rng([config.seed, step])
    growth = min(1.0, (step + 1) / max(1, config.grow * config.steps))
    length = round(2 + growth * (HORIZON - 2))
    cuts = Cuts.draw(store, training, config.batch_size, length, rng)
    return (make_windows(store, cuts, homography, config.robot_mask),
            set((rng.permutation(length)[:PICTURES] + 1).tolist()))


@torch.no_grad()
def sample_grid(model: LearnedForwardModel, store: Episodes,
                episodes: np.ndarray) -> np.ndarray:
    """
    Show windows: first picture, its objects' mask and background, then true beside predicted.

    :return: uint8 (height, width, 3).
    """
    cuts = Cuts.draw(store, episodes, _SHOWN, HORIZON, np.random.default_rng(0))
    batch = make_windows(store, Cuts(cuts.episodes, cuts.starts, HORIZON),
                         model.homography.cpu()).to(model.homography.device)
    scene = model.look(batch.images[:, 0], model.draw_arm(batch.grippers[:, 0])[:, 3:])
    columns = [list(to_uint8(batch.images[:, 0])), grey_panels(scene.objects[:, 3].cpu()),
               list(to_uint8(scene.background))]
    steps = model.rollout(scene.features, batch.grippers[:, 0], batch.actions)
    for t, (flow, *_) in enumerate(steps, start=1):
        if t in (HORIZON // 3, 2 * HORIZON // 3, HORIZON):
            predicted, _ = model.picture(scene, flow, model.draw_arm(batch.grippers[:, t]))
            columns += [list(to_uint8(batch.images[:, t])), list(to_uint8(predicted))]
    return grid([list(row) for row in zip(*columns)])
