# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which frame a prediction is trained towards: the selection error E' and its argmin (Eq. 5)."""

from collections.abc import Callable

from tap_ros.images.pixels import to_float
from tap_ros.prediction import losses
from tap_ros.training.augmentation import mirror
from tap_ros.training.batches import Batch
from tap_ros.training.predictor_config import TrainingConfig
import torch

Errors = Callable[[torch.Tensor], torch.Tensor]  # against the frames that bool (B, T) names


def selection_errors(error: Errors, copy_error: Errors, batch: Batch,
                     config: TrainingConfig) -> torch.Tensor:
    """
    Compute E'_t of Eq. 5 for the configured method: E_t / w(t) in the paper (section 3.2).

    The preference w(t) is linear in forward prediction, else a bell. With w = 1 this is the
    minimum over time (Eq. 2). Where w(t) is the likelihood of a label it is a prior of the
    minimum, E_t - label_weight log w(t): the minimum chooses within what the label leaves open.

    :param error: function of bool (B, T), the frames that can be chosen, to (B, T), the errors of
        the prediction against them.
    :param copy_error: the same for the context pictures, to (B, C, T).
    :return: (B, T); of padded frames anything.
    """
    valid = batch.valid
    if config.loss == 'min':
        return error(valid)
    if config.selection in ('marks', 'still'):
        assert batch.preference is not None, 'made before the training'
        w = batch.preference[:, 0]
        if config.selection == 'marks':
            return error(valid) - config.label_weight * w.log()
        return losses.relative_to_copying(error(valid), copy_error(valid), w)
    preference = (losses.linear_preference(batch.times, batch.end, config.beta) if config.forward
                  else losses.bell_preference(batch.times, batch.first, batch.last))
    if config.selection == 'relative':
        return losses.relative_to_copying(error(valid), copy_error(valid), preference)
    if config.selection == 'progress':
        progress = losses.picture_progress(copy_error(valid), valid)
        if config.progress_margin:
            valid = valid & ~losses.beside_context(progress, config.progress_margin, valid)
        return error(valid) / losses.bell(progress)
    return error(valid) / preference


class Targets:
    """
    The frames of a batch that predictions are compared with, and what predictions come from.

    :ivar context: (B, C, 3, H, W) in [-1, 1], augmented, with the keyframes of the first level.
    :ivar keyframes: (B, levels, n, 3, H, W), augmented; None: there are none.
    :ivar measured: start and goal as errors are measured with them, see Batch.measured.
    """

    def __init__(self, batch: Batch, config: TrainingConfig) -> None:
        self.batch, self.augmentation, self.config = batch, batch.augmentation, config
        self.rows = torch.arange(len(batch.context), device=batch.context.device)
        self.keyframes = None if batch.keyframes is None else self.augmented(
            batch.keyframes.flatten(1, 2)).unflatten(1, batch.keyframes.shape[1:3])
        self.context = self.augmented(batch.context)
        self.measured = self.context if batch.bare is None else self.augmented(batch.bare)
        self.context = self.beside(self.context, 0)

    def beside(self, context: torch.Tensor, level: int) -> torch.Tensor:
        """Return contexts (B, C, 3, H, W) with the keyframes of a level, from 0, if any."""
        return context if self.keyframes is None else torch.cat(
            [context, self.keyframes[:, level]], 1)

    def augmented(self, pictures: torch.Tensor) -> torch.Tensor:
        """Return pictures, uint8 (B, N, H, W, 3), as networks see them, (B, N, 3, H, W)."""
        images = to_float(pictures)
        return self.augmentation.apply(images) if self.augmentation else images

    def frame(self, step: torch.Tensor) -> torch.Tensor:
        """Return the augmented frames (B, 3, H, W) at indices step (B,) into T."""
        return self.augmented(self.batch.targets[self.rows, step][:, None])[:, 0]

    def visible(self, image: torch.Tensor) -> torch.Tensor:
        """Return augmented pictures (B, 3, H, W), black where targets are, see Batch.visible."""
        seen = self.batch.seen
        if seen is None:
            return image
        if self.augmentation:
            seen = mirror(seen, self.augmentation.flip)
        return image.masked_fill(~seen[:, None], -1)

    def match(self, image: torch.Tensor, context: torch.Tensor,
              batch: Batch | None = None) -> torch.Tensor:
        """
        Find the target that each prediction is trained towards, the argmin of Eq. 5.

        Chosen among the frames as recorded: undoing the augmentation of one picture is cheaper
        than applying it to all targets.

        :param image: (B, 3, H, W), predictions, augmented.
        :param context: (B, C, 3, H, W), what they come from, as errors are measured with it.
        :param batch: with the valid targets and the bounds of the preference, where these are not
            the batch's own.
        :return: int64 (B,), indices into T.
        """
        batch = batch or self.batch
        if self.config.only_fraction is not None:
            return torch.zeros_like(self.rows)  # the batch begins with the fixed frame
        if self.config.loss == 'fix':  # at the frame of the largest w
            assert batch.preference is not None, 'made before the training'
            return batch.preference[:, 0].masked_fill(~batch.valid, -1).argmax(1)
        images = image.detach()[:, None]
        return losses.match_step(selection_errors(
            lambda wanted: self.errors(images, wanted)[:, 0],
            lambda wanted: self.errors(context.detach(), wanted), batch, self.config), batch.valid)

    def errors(self, images: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        """
        Return the errors (B, Q, T) of augmented pictures (B, Q, 3, H, W), as recorded.

        :param wanted: bool (B, T), against which frames; the others are infinite.
        """
        if self.augmentation:
            images = self.augmentation.undo(images)
        return losses.l1_errors(
            self.batch.visible(images), self.batch.targets.movedim(-1, 2), wanted)

    def l1(self, image: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Return the l1 errors (B,) of predictions (B, 3, H, W) at targets (B,) of T."""
        return losses.l1_error(self.visible(image), self.frame(step))
