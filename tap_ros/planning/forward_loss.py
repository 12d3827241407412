# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The forward model's training loss: pictures reconstructed along whole rollouts."""

from collections.abc import Collection

from tap_ros.planning.forward_data import mirror, recolour, Windows
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
import torch
from torch.nn import functional as F

MOTION_THRESHOLD = 0.08  # of the range 2: mean channel difference that counts as change


def draw_arm_like(model: LearnedForwardModel, grippers: torch.Tensor, mirrored: torch.Tensor,
                  colours: torch.Tensor) -> torch.Tensor:
    """
    Draw the arm as it looks in augmented pictures.

    :param grippers: (B, 4) as augmented; mirrored (B,) bool; colours (B, 3) channel orders.
    :return: (B, 4, H, W), see LearnedForwardModel.draw_arm.
    """
    sign = 1 - 2 * mirrored.float()
    plain = torch.cat([grippers[:, :1] * sign[:, None], grippers[:, 1:]], 1)
    return mirror(recolour(model.draw_arm(plain), colours), mirrored)


def motion_weight(target: torch.Tensor, first: torch.Tensor, factor: float) -> torch.Tensor:
    """
    Weight pixels that differ from the first picture, and their neighbours, by 1 + factor.

    Most of a picture never changes; without this weight, predicting no motion is nearly perfect.

    :param target: (B, 3, H, W); first (B, 3, H, W).
    :return: (B, 1, H, W).
    """
    changed = ((target - first).abs().mean(1, keepdim=True) > MOTION_THRESHOLD).float()
    return 1 + factor * F.max_pool2d(changed, 3, 1, 1)


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
                 config: ForwardTrainingConfig) -> tuple[torch.Tensor, dict[str, float]]:
    """
    Roll the model along the windows and compare pictures at some of the steps.

    What the robot hides in a picture is compared with nothing. Where the model moves something
    counts as much as where something moved, else it would rather see pushes where there are none.

    :param model: LearnedForwardModel.
    :param batch: Windows.
    :param picture_steps: indices in 1..T of the pictures compared.
    :param config: ForwardTrainingConfig.
    :return: loss, dict of its parts.
    """
    arms = draw_arm_like(model, batch.grippers[:, 0], batch.mirrored, batch.colours)
    first = batch.images[:, 0]
    scene = model.look(first, arms[:, 3:].detach(), batch.homography)
    flow, gripper = model.still(len(first)), batch.grippers[:, 0]
    pictures = moving = first.new_zeros(())
    count = batch.actions.shape[1]
    for t in range(1, count + 1):
        action = batch.actions[:, t - 1]
        flow, gripper, masks = model.advance(scene.features, flow, gripper, action)
        moving = moving + (1 - masks[:, 2]).mean()
        if t in picture_steps:
            arm = draw_arm_like(model, batch.grippers[:, t], batch.mirrored, batch.colours)
            predicted, _ = model.picture(scene, flow, arm, batch.homography)
            target = batch.images[:, t]
            predicted = torch.where(batch.hidden[:, t], target, predicted)
            weight = torch.maximum(*(motion_weight(picture, first, config.motion_factor)
                                     for picture in (target, predicted.detach())))
            pictures = pictures + picture_loss(predicted, target, weight)
    parts = {'picture': pictures / len(picture_steps), 'moving': moving / count,
             'objects': scene.objects[:, 3].mean()}
    loss = (parts['picture'] + config.still_weight * parts['moving']
            + config.object_weight * parts['objects'])
    return loss, {k: float(v.detach()) for k, v in parts.items()}
