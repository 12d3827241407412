# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far the forward model's object maps are from where the objects went."""

import numpy as np
from tap_ros.images import to_float
import torch

SCORED_STEPS = (1, 5, 10, 15)
MOVED_PIXELS = 2.0  # an object counts at a step when it has moved further than this by then


@torch.no_grad()
def map_errors(model, store, episodes, stride=8, max_windows=400):
    """
    Score the maps' expected pixels on recorded episodes.

    Maps start at the recorded object pixels; these ground truths are used here only, never in
    training. Every value is a mean over objects that moved.

    :param model: ForwardModel.
    :param store: EpisodeStore; episodes: indices to score.
    :param stride: frames from one window's start to the next.
    :return: dict of `map_error_px_{t}` (expected pixel against true pixel, per step t),
        `nothing_moves_px_{t}`, `true_simulator_px_{t}` (maps put where the objects truly are by
        then: what projection and the table's cells alone cost) and `moved_{t}` (how many
        objects); empty without object pixels.
    """
    horizon = SCORED_STEPS[-1]
    errors, moves, exact, table = [], [], [], model.pixel_table().flatten(0, 1)
    device = table.device
    for i in episodes:
        episode = store[int(i)]
        pixels = np.asarray(episode.object_pixels)
        for start in range(0, len(episode.frames) - horizon, stride):
            true = pixels[start:start + horizon + 1]
            if not true.shape[1] or not np.isfinite(true).all() or len(errors) >= max_windows:
                continue
            gripper = torch.from_numpy(np.array(episode.grippers[start:start + 1])).to(device)
            actions = torch.from_numpy(np.array(episode.actions[None, start:start + horizon]))
            image = to_float(np.array(episode.frames[start]))[None].to(device)
            maps = model.seed_maps(torch.from_numpy(true[0].copy()).to(device))
            carried = model.carried_maps(
                model.begin(image, gripper), gripper, maps, actions.to(device))
            expected = torch.stack([m[0].flatten(1) @ table for m in carried]).cpu().numpy()
            errors.append(np.linalg.norm(expected - true[1:], axis=-1))  # (T, K)
            ideal = model.seed_maps(torch.from_numpy(true[1:].reshape(-1, 2).copy()).to(device))
            ideal = (ideal.flatten(1) @ table).cpu().numpy().reshape(true[1:].shape)
            exact.append(np.linalg.norm(ideal - true[1:], axis=-1))
            moves.append(np.linalg.norm(true[1:] - true[:1], axis=-1))
    scores = {}
    for t in SCORED_STEPS:
        moved = np.concatenate([m[t - 1] for m in moves]) if moves else np.zeros(0)
        chosen = moved > MOVED_PIXELS
        if chosen.any():
            error = np.concatenate([e[t - 1] for e in errors])
            scores[f'map_error_px_{t}'] = float(error[chosen].mean())
            floor = np.concatenate([e[t - 1] for e in exact])
            scores[f'true_simulator_px_{t}'] = float(floor[chosen].mean())
            scores[f'nothing_moves_px_{t}'] = float(moved[chosen].mean())
            scores[f'moved_{t}'] = int(chosen.sum())
    return scores
