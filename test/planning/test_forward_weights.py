# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the shipped forward model is good for, on the sample recordings."""

from pathlib import Path

import numpy as np
import pytest
from tap_ros.images.pixels import to_float
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.forward_scores import map_errors
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.recording.reader import iter_episodes
from tap_ros.weights import FORWARD_MODEL
import torch

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'
STEPS = 8


@pytest.fixture(scope='module')
def model():
    return LearnedForwardModel.load(FORWARD_MODEL, precision='float32')


@pytest.fixture(scope='module')
def episodes():
    return list(iter_episodes(SAMPLE))


def test_object_maps_are_carried_to_where_recorded_pushes_led(model, episodes):
    scores = map_errors(model, episodes, range(len(episodes)))
    for t, counted in ((5, 35), (10, 54), (15, 81)):
        assert scores[f'map_error_px_{t}'] < 0.27 * scores[f'nothing_moves_px_{t}']
        assert scores[f'true_simulator_px_{t}'] < 0.02
        moves = [np.linalg.norm(e.object_pixels[start + t] - e.object_pixels[start], axis=1)
                 for e in episodes for start in range(0, len(e.frames) - 15, 8)]
        moved = [move for move in np.concatenate(moves) if move > 2]
        assert scores[f'moved_{t}'] == len(moved) == counted
        assert scores[f'nothing_moves_px_{t}'] == pytest.approx(np.mean(moved), rel=1e-5)


def test_windows_without_known_objects_are_not_scored_and_their_number_is_bounded(
        model, episodes):
    blind = [type(e)(**{**vars(e), 'object_pixels': np.full_like(e.object_pixels, np.nan)})
             for e in episodes[:2]]
    assert map_errors(model, blind, [0, 1]) == {}
    few = map_errors(model, episodes, range(len(episodes)), max_windows=4)
    assert 0 < few['moved_15'] <= 8


def test_pictures_are_composed_as_they_were_recorded(model, episodes):
    chosen = episodes[:6]
    frames = torch.stack([to_float(e.frames[4:5 + STEPS]) for e in chosen])  # (B, T, 3, H, W)
    grippers = torch.from_numpy(np.stack([e.grippers[4:5 + STEPS] for e in chosen]))
    actions = torch.from_numpy(np.stack([e.actions[4:4 + STEPS] for e in chosen]))
    arm = model.draw_arm(grippers[:, 0])
    scene = model.look(frames[:, 0], arm[:, 3:])
    flow, hand = model.still(len(chosen)), grippers[:, 0]
    first, masks = model.picture(scene, flow, arm)
    assert (first - frames[:, 0]).abs().mean() < 0.02
    torch.testing.assert_close(masks.sum(1), torch.ones_like(masks[:, 0]))
    for action in actions.unbind(1):
        flow, hand, _ = model.advance(scene.features, flow, hand, action)
    assert (hand - grippers[:, STEPS])[:, :3].abs().max() < 0.01  # where the recorded arm came
    last, _ = model.picture(scene, flow, model.draw_arm(hand))
    error, still = ((shown - frames[:, STEPS]).abs().mean() for shown in (last, frames[:, 0]))
    assert error < 0.45 * still, (error, still)


def test_pictures_and_positions_may_be_views(episodes):
    mpc = VisualMPC.load(FORWARD_MODEL, VisualMPCConfig(search=SearchConfig(4, 1, 2), proposals=2))
    seen = episodes[0]
    views = (seen.frames[0][:, ::-1], seen.grippers[0][::-1][::-1], seen.object_pixels[0][::-1],
             seen.goal_pixels[::-1])
    plans = []
    for image, gripper, pixels, goals in (views, [view.copy() for view in views]):
        plans.append(mpc.plan(Scene(image, gripper, pixels), mpc.goal(goals)))
    assert np.array_equal(plans[0].actions, plans[1].actions)
    maps = np.random.default_rng(0).random((2, 64, 64))
    views = mpc.goal(maps=maps[::-1]), mpc.goal(maps=maps[::-1].copy())
    assert torch.equal(views[0].distances, views[1].distances)
