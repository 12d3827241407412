# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far the forward model's object maps, or its pictures, are from what happened."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.images.pixels import to_float
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.training.forward_loss import Cuts, make_windows, MOTION_THRESHOLD
import torch

if TYPE_CHECKING:
    from tap_ros.training.frames import Episodes

SCORED_STEPS = (1, 5, 10, 15)
STRIDE = 8  # frames from one window's start to the next
MOST_WINDOWS = 400
MOVED_PIXELS = 2.0  # an object counts at a step when it has moved further than this by then


def held_out_scores(model: LearnedForwardModel, store: 'Episodes',
                    episodes: np.ndarray) -> dict[str, float]:
    """
    Return what a training tells.

    :return: means of measure_maps over the objects that moved by step t, `map_error_px_{t}` and
        so on, and `moved_{t}`, how many those are; without object pixels those of
        measure_pictures, `picture_l1_{t}` and so on.
    """
    maps = measure_maps(model, store, episodes)
    return {f'{name}_px_{t}': float(values.mean()) for t, measured in maps.items()
            for name, values in measured.items()} | {
        f'moved_{t}': len(measured['map_error']) for t, measured in maps.items()} or {
        f'{name}_l1_{t}': float(np.nanmean(values))
        for t, measured in measure_pictures(model, store, episodes).items()
        for name, values in measured.items() if np.isfinite(values).any()}


@torch.no_grad()
def measure_maps(model: LearnedForwardModel, store: 'Episodes',
                 episodes: Iterable[int]) -> dict[int, dict[str, np.ndarray]]:
    """
    Measure how far the maps' expected pixels end from where recorded objects went.

    Maps start at the recorded object pixels; these ground truths are used here only, never in
    training.

    :param store: EpisodeStore; episodes: indices to score.
    :return: dict from steps t to dicts of arrays (N,) in pixels, for the N objects that moved by
        then: `map_error`, expected pixel against true pixel; `true_simulator`, maps put where the
        objects truly are by then (what projection and the table's cells alone cost); and
        `nothing_moves`, how far they moved. Steps at which none moved are left out.
    """
    horizon = SCORED_STEPS[-1]
    windows: list[np.ndarray] = []  # (T, K, 3) px: error, of true places, way
    table = model.table.pixels().flatten(0, 1)
    device = table.device
    for i in episodes:
        episode = store[int(i)]
        for start in range(0, len(episode.frames) - horizon, STRIDE):
            true = torch.tensor(episode.object_pixels[start:start + horizon + 1], device=device)
            if not true.shape[1] or not true.isfinite().all() or len(windows) >= MOST_WINDOWS:
                continue
            gripper, actions = (torch.tensor(values, device=device) for values in (
                episode.grippers[start:start + 1], episode.actions[None, start:start + horizon]))
            image = to_float(np.array(episode.frames[start]))[None].to(device)
            carried = model.carried_maps(model.begin(image, gripper), gripper,
                                         model.table.seed_maps(true[0]), actions)
            expected = torch.stack([  # a lost map is scored as one that did not move
                m[0].flatten(1) @ table + (1 - m[0].sum((-1, -2)))[:, None] * true[0]
                for m in carried])
            ideal = model.table.seed_maps(true[1:].flatten(0, 1)).flatten(1) @ table
            windows.append(torch.stack([expected, ideal.view_as(expected), true[:1].expand_as(
                expected)]).sub(true[1:]).norm(dim=-1).movedim(0, -1).cpu().numpy())
    measured = {}
    for t in SCORED_STEPS if windows else ():
        found = np.concatenate([window[t - 1] for window in windows])
        found = found[found[:, 2] > MOVED_PIXELS].T
        if found.size:
            measured[t] = dict(zip(('map_error', 'true_simulator', 'nothing_moves'), found))
    return measured


@torch.no_grad()
def measure_pictures(model: LearnedForwardModel, store: 'Episodes',
                     episodes: np.ndarray) -> dict[int, dict[str, np.ndarray]]:
    """
    Measure predicted pictures against what was seen, beside copying the picture begun with.

    The arm is drawn where the commands lead it. What the model's robot mask hides does not count.

    :param episodes: int64, indices to score; those shorter than the longest window are left out.
    :return: dict from steps t to dicts of arrays (N,), l1 errors on [0, 1], means over the
        windows of each episode: `picture` and `copying` over all pixels; `changed_picture` and
        `changed_copying` over those that changed since the window began, NaN where none did.
    """
    lengths = np.asarray(store.lengths)[episodes]
    steps = [t for t in SCORED_STEPS if t < lengths.max(initial=0)]
    found: list[np.ndarray] = []  # (steps, 4) of an episode
    for i, length in zip(episodes.tolist(), lengths.tolist()):
        starts = range(0, length - steps[-1], STRIDE)
        count = len(starts)
        if not count:
            continue
        windows = make_windows(
            store, Cuts([i] * count, starts, steps[-1]), model.homography.cpu(),
            model.config.robot_mask).to(model.homography.device)
        first, gripper = windows.images[:, 0], windows.grippers[:, 0]
        scene, rows = model.look(first, model.draw_arm(gripper)[:, 3:]), []
        ahead = model.rollout(scene.features, gripper, windows.actions)
        for t, (flow, gripper, _) in enumerate(ahead, start=1):
            if t in steps:
                seen = windows.images[:, t]
                counts = ~windows.hidden[:, t, 0]
                changed = counts & ((seen - first).abs().mean(1) > MOTION_THRESHOLD)
                predicted, _ = model.picture(scene, flow, model.draw_arm(gripper))
                errors = [(picture - seen).abs().mean(1) / 2 for picture in (predicted, first)]
                rows.append([float(error[where].mean()) for where in (counts, changed)
                             for error in errors])
        found.append(np.array(rows))
    names = ('picture', 'copying', 'changed_picture', 'changed_copying')
    return {t: dict(zip(names, np.stack(found)[:, n].T)) for n, t in enumerate(steps) if found}
