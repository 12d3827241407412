# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The parts of section 3's losses: errors, which of them is matched, preferences, recursion.

What is trained with a match is in selection.py. Errors are per-pixel means of the absolute
difference on [0, 1], half of that on [-1, 1], so that losses and reported numbers have the same
unit.
"""

from collections.abc import Iterable, Sequence
import math
from typing import cast

import torch

# A frame that equals a context picture has no distance to it; keep the ratio finite.
_MIN_COPY_DISTANCE = 1e-4
CHANGED = 0.075  # on [0, 1]; a pixel that differs by more has changed


def l1_error(images: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Return the l1 errors (...) on [0, 1] of pictures (..., 3, H, W) in [-1, 1]."""
    return (images - targets).abs().mean((-3, -2, -1)) / 2


def changed_pixels(targets: torch.Tensor, context: torch.Tensor) -> torch.Tensor:
    """
    Find the pixels of a frame that differ from every input: what copying in place cannot give.

    :param targets: (B, 3, H, W) in [-1, 1]; context: (B, C, 3, H, W) in [-1, 1].
    :return: bool (B, 1, H, W).
    """
    difference = (targets[:, None] - context).abs().amax(2, keepdim=True)  # B, C, 1, H, W
    return difference.amin(1) > 2 * CHANGED


@torch.no_grad()
def l1_errors(images: torch.Tensor, targets: torch.Tensor,
              wanted: torch.Tensor | None = None) -> torch.Tensor:
    """
    Measure the l1 error of each picture against each target frame, on [0, 1], without gradient.

    :param images: (B, Q, 3, H, W) in [-1, 1], for example the prediction and the context.
    :param targets: uint8 (B, T, 3, H, W).
    :param wanted: bool (B, T); the errors against other frames are infinite. None: all are wanted.
    :return: (B, Q, T).
    """
    # Fastest on a CPU as frames stay in uint8 until they fit the cache, one episode at a time.
    frames = targets.movedim(2, -1).flatten(2)                             # B, T, D
    images = images.float().movedim(2, -1).flatten(2).add(1).mul(127.5)    # B, Q, D
    if frames.is_cuda:
        distances = torch.stack(
            [(frames - images[:, q, None]).abs().mean(-1) for q in range(images.shape[1])], 1)
    else:
        B, T = frames.shape[:2]
        ends = [(0, T)] * B if wanted is None else map(_ends, wanted)
        distances = images.new_full((B, images.shape[1], T), math.inf)
        episodes, differences = images.new_empty(2, T, frames.shape[2])  # memory that is warm
        for b, (first, last) in enumerate(ends):
            episode = episodes[:last - first].copy_(frames[b, first:last])
            for q, query in enumerate(images[b]):
                out = differences[:last - first] if q + 1 < len(images[b]) else episode
                distances[b, q, first:last] = torch.sub(episode, query, out=out).abs_().mean(1)
    if wanted is not None:
        distances.masked_fill_(~wanted[:, None], math.inf)
    return distances / 255


def _ends(wanted: torch.Tensor) -> tuple[int, int]:
    """Return the first one that is wanted, (T,), and the one behind the last."""
    at = wanted.nonzero()
    return (int(at[0]), int(at[-1]) + 1) if len(at) else (0, 0)


def match_step(selection_error: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """
    Pick the target with the least selection error, the argmin of Eq. 5.

    :param selection_error: (B, T), E'_t.
    :param valid: bool (B, T), False where an episode is padded.
    :return: int64 (B,), indices into T; never a padded one.
    """
    return selection_error.masked_fill(~valid, math.inf).argmin(1)


def recursive_loss(losses: Sequence[torch.Tensor], counts: Sequence[int]) -> torch.Tensor:
    """
    Recursive loss: the sum over levels r of the loss of the prediction from c(r).

    L = sum_r min_{t in T(r)} E(x_t, G(c(r))), where c(r) holds the prediction of level r - 1, and
    T(r) the targets that its match leaves (Eq. 3).

    :param losses: for each level, the mean loss over the episodes that still have targets.
    :param counts: for each level, how many those are; level 0 has all of them.
    :return: the sum over levels, as a mean over all episodes.
    """
    return total(loss * (count / counts[0]) for loss, count in zip(losses, counts))


def total(terms: Iterable[torch.Tensor]) -> torch.Tensor:
    """Add up terms, of which there is one at least."""
    return cast(torch.Tensor, sum(terms))


def remaining_targets(valid: torch.Tensor, times: torch.Tensor, matched: torch.Tensor,
                      forward: bool) -> torch.Tensor:
    """
    Say which targets the next level of recursion has, T(r) of Eq. 3.

    :param valid: bool (B, T), the targets of this level.
    :param times: int64 (B, T).
    :param matched: int64 (B, 1), the time that this level's prediction was matched to.
    :param forward: whether predictions go on after it, as Eq. 3 says; else they go back towards
        the start, as the paper's recursive bidirectional figure has it.
    :return: bool (B, T).
    """
    return valid & (times > matched if forward else times < matched)


def bell_preference(times: torch.Tensor, first: torch.Tensor | float,
                    last: torch.Tensor | float) -> torch.Tensor:
    """
    Prefer the middle: a Gaussian over the target times, 1 in the middle and 2/3 at both ends.

    w(t) = exp(-(t - m)^2 / (2 sigma^2)), m the middle, sigma 1.110 of half the range (section 4).

    :param times: (B, T) times of the targets.
    :param first: (B, 1) or number, the earliest target time; last: the latest one.
    :return: w(t), (B, T).
    """
    half_range = torch.as_tensor((last - first) / 2, dtype=torch.float32).clamp(min=0.5)
    return bell((times - (last + first) / 2) / half_range)


def bell(position: torch.Tensor) -> torch.Tensor:
    """Return the Gaussian that is 1 at 0 and 2/3 at -1 and 1, of positions of any shape."""
    return torch.exp(math.log(2 / 3) * position ** 2)


def picture_progress(copy_error: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """
    Say how far a frame is on the way from start to goal, by what the pictures show.

    q_t = (d_0 - d_T) / (d_0 + d_T), with d_0 and d_T the l1 distances of frame t to the start and
    the goal picture, rescaled so that the targets of each episode range from -1 to 1. Not in the
    paper, whose preference is over time: the bottleneck of an episode need not be at its middle.

    :param copy_error: (B, 2, T), errors of start and goal picture against the targets.
    :param valid: bool (B, T), False where an episode is padded.
    :return: (B, T), -1 to 1 for valid targets.
    """
    to_start, to_goal = copy_error.unbind(1)
    progress = (to_start - to_goal) / (to_start + to_goal).clamp(min=_MIN_COPY_DISTANCE)
    low = progress.masked_fill(~valid, math.inf).amin(1, keepdim=True)
    high = progress.masked_fill(~valid, -math.inf).amax(1, keepdim=True)
    return 2 * (progress - low) / (high - low).clamp(min=_MIN_COPY_DISTANCE) - 1


def beside_context(progress: torch.Tensor, margin: float,
                   valid: torch.Tensor) -> torch.Tensor:
    """
    Say which targets show too little of the way from start to goal, or too much, to be matched.

    A preference divides errors, so it cannot keep a prediction from copying the start picture
    where a target equals that: 0 over w is 0. The paper leaves frames out by time, next to each
    context picture; this leaves them out by picture_progress.

    :param progress: (B, T), -1 to 1, see picture_progress.
    :param margin: what is left out at both ends of the range, 0 to 1; 0: nothing.
    :param valid: bool (B, T), False where an episode is padded.
    :return: bool (B, T); never the valid target whose progress is nearest to 0.
    """
    outside = progress.abs() > 1 - margin
    from_middle = progress.abs().masked_fill(~valid, math.inf)
    return outside.scatter(1, from_middle.argmin(1, keepdim=True), False)


def linear_preference(times: torch.Tensor, last: torch.Tensor | float,
                      beta: float) -> torch.Tensor:
    """
    Prefer later frames, for forward prediction: w(t) = beta + t / last (section 4).

    :param times: (B, T) times of the targets; last: (B, 1) or number, the last time.
    :param beta: the smaller, the later; infinity prefers none.
    :return: w(t), (B, T).
    """
    if math.isinf(beta):
        return torch.ones_like(times, dtype=torch.float32)
    return beta + times / last


def relative_to_copying(error: torch.Tensor, copy_error: torch.Tensor,
                        preference: torch.Tensor) -> torch.Tensor:
    """
    Measure errors by what copying a context picture would have scored.

    E'_t = E_t / (d_t w(t)), with d_t the l1 distance of frame t to the nearest context picture.
    Not in the paper, though Eq. 5 allows it: with E_t / w(t) alone, the frames beside the context
    win, because predicting them is copying. Here copying is worth 1 everywhere.

    :param error: (B, T); preference: (B, T), w(t).
    :param copy_error: (B, C, T), errors of the context pictures against the targets.
    :return: (B, T).
    """
    return error / (copy_error.amin(1).clamp(min=_MIN_COPY_DISTANCE) * preference)
