# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The forward model's training loss: pictures reconstructed along whole rollouts.

First the windows of recordings that it is taken over, and their augmentation.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self, TYPE_CHECKING

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS
from tap_ros.base.errors import RecordingError
from tap_ros.images.pixels import to_float
from tap_ros.images.robot_mask import hidden_pixels, RobotMask
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.table import mirror_table
from tap_ros.training.augmentation import mirror, recolour
import torch
from torch.nn import functional as F

if TYPE_CHECKING:
    from tap_ros.training.frames import Episodes

COLOUR_ORDERS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
MOTION_FACTOR = 8.0  # extra weight of pixels that changed since the window's first picture
STILL_WEIGHT = 2e-4  # of the mean share of the crop that is said to move
# Of the mean share of the picture that is said to be objects: with none, a table with grain counts
# as one, too.
OBJECT_WEIGHT = 5e-3
MOTION_THRESHOLD = 0.08  # of the range 2: mean channel difference that counts as change


@dataclass
class Windows:
    """A batch of B windows of T steps, that is T + 1 pictures."""

    images: torch.Tensor  # (B, T + 1, 3, H, W) in [-1, 1]
    hidden: torch.Tensor  # (B, T + 1, 1, H, W) bool, where the robot hides what is compared
    grippers: torch.Tensor  # (B, T + 1, 4) metres and opening
    actions: torch.Tensor  # (B, T, 4)
    homography: torch.Tensor  # (B, 3, 3) table metres to pixels; differs where mirrored
    mirrored: torch.Tensor  # (B,) bool
    colours: torch.Tensor  # (B, 3) int64: channel i shows what was channel colours[i]

    def to(self, device: torch.device | str) -> 'Windows':
        """Copy everything to a device."""
        return Windows(**{name: tensor.to(device) for name, tensor in vars(self).items()})


@dataclass(frozen=True)
class Cuts:
    """
    Which windows are read, of B, and how they are changed; by default not at all.

    :param episodes: (B,) episode indices; starts: (B,) first frames; steps: T.
    :param mirrored: bool (B,), left to right; orders: (B,), index to COLOUR_ORDERS.
    """

    episodes: np.ndarray | Sequence[int]
    starts: np.ndarray | Sequence[int]
    steps: int
    mirrored: np.ndarray | bool = False
    orders: np.ndarray | int = 0

    @classmethod
    def draw(cls, store: 'Episodes', episodes: np.ndarray, batch_size: int, steps: int,
             rng: np.random.Generator) -> Self:
        """Draw from episodes, each with more than `steps` frames; half of them are mirrored."""
        chosen = rng.choice(episodes, batch_size)
        lengths = np.asarray(store.lengths)[chosen]
        starts = (rng.random(batch_size) * (lengths - steps)).astype(int)
        return cls(chosen, starts, steps, rng.random(batch_size) < 0.5,
                   rng.integers(len(COLOUR_ORDERS), size=batch_size))


def make_windows(store: 'Episodes', cuts: Cuts, homography: torch.Tensor,
                 robot_mask: RobotMask = 'none') -> Windows:
    """
    Read windows and change how they look: mirrored left to right, in other colours.

    :param homography: (3, 3) of the table.
    :param robot_mask: see robot_mask.hidden_pixels; the episodes have masks unless it is 'none'.
    :return: Windows; the grippers and actions of mirrored ones have x negated.
    :raises RecordingError: where gripper positions are missing.
    """
    rows = []
    for i, start in zip(cuts.episodes, cuts.starts):
        episode, part = store[int(i)], slice(start, start + cuts.steps + 1)
        frames, masks = episode.frames[part], episode.robot_masks
        rows.append((frames, episode.grippers[part], episode.actions[start:start + cuts.steps],
                     np.zeros(frames.shape[:-1], bool) if masks is None
                     else hidden_pixels(masks[part], robot_mask)))
    images, hands, actions, hidden = map(np.stack, zip(*rows))
    if not np.isfinite(hands).all():
        bad = int(np.asarray(cuts.episodes)[~np.isfinite(hands).all((1, 2))][0])
        raise RecordingError(
            f'/joint_states: episode {bad} lacks gripper positions; the forward model needs '
            f'{", ".join(GRIPPER_JOINTS)} at every picture')
    B = len(images)
    batch = Windows(
        to_float(images), torch.from_numpy(hidden[:, :, None]),
        torch.from_numpy(hands.astype(np.float32)), torch.from_numpy(actions.astype(np.float32)),
        homography.expand(B, 3, 3).clone(), torch.from_numpy(np.full(B, cuts.mirrored)),
        torch.tensor(COLOUR_ORDERS)[np.full(B, cuts.orders)])
    batch.images = mirror(recolour(batch.images, batch.colours[:, None]), batch.mirrored)
    batch.hidden = mirror(batch.hidden, batch.mirrored)
    batch.grippers[batch.mirrored, :, 0] *= -1
    batch.actions[batch.mirrored, :, 0] *= -1
    batch.homography[batch.mirrored] = mirror_table(
        batch.homography, batch.images.shape[-1])[batch.mirrored]
    return batch


def draw_arm_like(model: LearnedForwardModel, batch: Windows, t: int) -> torch.Tensor:
    """Draw the arm as it looks in pictures t: (B, 4, H, W), see LearnedForwardModel.draw_arm."""
    gripper, sign = batch.grippers[:, t], 1 - 2 * batch.mirrored.float()
    arm = model.draw_arm(torch.cat([gripper[:, :1] * sign[:, None], gripper[:, 1:]], 1))
    coloured = torch.cat([recolour(arm[:, :3], batch.colours), arm[:, 3:]], 1)
    return mirror(coloured, batch.mirrored)


def motion_weight(target: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
    """
    Weight pixels that differ from the first picture, and their neighbours, by 1 + MOTION_FACTOR.

    Most of a picture never changes; without this weight, predicting no motion is nearly perfect.

    :param target: (B, 3, H, W); first (B, 3, H, W).
    :return: (B, 1, H, W).
    """
    changed = ((target - first).abs().mean(1, keepdim=True) > MOTION_THRESHOLD).float()
    return 1 + MOTION_FACTOR * F.max_pool2d(changed, 3, 1, 1)


def picture_loss(predicted: torch.Tensor, target: torch.Tensor,
                 weight: torch.Tensor) -> torch.Tensor:
    """
    Weighted l1 at full, half and quarter resolution, so that flow finds objects pixels away.

    :param predicted: (B, 3, H, W); target (B, 3, H, W); weight (B, 1, H, W).
    :return: scalar.
    """
    total = weight.new_zeros(())
    for scale in range(3):
        if scale:
            predicted, target = F.avg_pool2d(predicted, 2), F.avg_pool2d(target, 2)
            weight = F.avg_pool2d(weight, 2)
        total = total + (weight * (predicted - target).abs()).mean()
    return total / 3


def forward_loss(model: LearnedForwardModel, batch: Windows, picture_steps: Collection[int],
                 ) -> tuple[torch.Tensor, dict[str, float]]:
    """
    Roll the model along the windows and compare pictures at some of the steps.

    What the robot hides in a picture is compared with nothing. Where the model moves something
    counts as much as where something moved, else it would rather see pushes where there are none.

    :param picture_steps: indices in 1..T of the pictures compared.
    :return: loss, dict of its parts.
    """
    arms = draw_arm_like(model, batch, 0)
    first = batch.images[:, 0]
    scene = model.look(first, arms[:, 3:].detach(), batch.homography)
    pictures = moving = first.new_zeros(())
    steps = model.rollout(scene.features, batch.grippers[:, 0], batch.actions)
    for t, (flow, _, masks) in enumerate(steps, start=1):
        moving = moving + (1 - masks[:, 2]).mean()
        if t in picture_steps:
            arm = draw_arm_like(model, batch, t)
            predicted, _ = model.picture(scene, flow, arm, batch.homography)
            target = batch.images[:, t]
            predicted = torch.where(batch.hidden[:, t], target, predicted)
            weight = torch.maximum(*(motion_weight(picture, first)
                                     for picture in (target, predicted.detach())))
            pictures = pictures + picture_loss(predicted, target, weight)
    parts = {'picture': pictures / len(picture_steps), 'moving': moving / batch.actions.shape[1],
             'objects': scene.objects[:, 3].mean()}
    loss = (parts['picture'] + STILL_WEIGHT * parts['moving']
            + OBJECT_WEIGHT * parts['objects'])
    return loss, {k: float(v.detach()) for k, v in parts.items()}
