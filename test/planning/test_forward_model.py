# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the forward model that hold whatever its weights are."""

import pytest
import torch
from toy_world import ARM, TABLE

GRIPPER = torch.tensor([[0.05, -0.1, 0.0, 0.0]])
PIXELS = torch.tensor([[20.0, 17.0], [8.0, 9.0]])


@pytest.fixture
def image():
    return torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1


@torch.inference_mode()
def rollout(model, image, gripper, pixels, actions):
    """Return the expected pixels (N, T, K, 2) of objects at pixels (K, 2)."""
    start, maps = model.begin(image, gripper), model.table.seed_maps(pixels)
    table = model.table.pixels().flatten(0, 1)
    carried = model.carried_maps(start, gripper, maps, actions)
    return torch.stack([m.flatten(2) @ table for m in carried], 1)


def pushing(model):
    """Make a model say that all of its crop moves as the gripper does."""
    with torch.no_grad():
        for layer in (model.push.twists, model.push.masks):
            layer.weight.zero_()
        model.push.twists.bias.copy_(torch.tensor([-1.0, 0, 0, 0, 0, 0]))
        model.push.masks.bias.copy_(torch.tensor([50.0, 0, 0]))
    return model


def test_high_above_the_table_and_without_an_action_nothing_is_pushed(model, image):
    pushing(model)
    actions = torch.zeros(3, 6, 4)
    actions[:2, 1:, 0] = 0.05
    actions[0, 0, 2] = 0.13  # up first
    high, low, still = rollout(model, image, GRIPPER, PIXELS, actions)
    torch.testing.assert_close(high, PIXELS.expand(6, 2, 2), atol=0.01, rtol=0)
    torch.testing.assert_close(still, PIXELS.expand(6, 2, 2), atol=0.01, rtol=0)
    assert (low[-1] - PIXELS).abs().max() > 1


@pytest.mark.parametrize('step', [(0.06, 0.0), (0.0, -0.06), (-0.036, 0.048)])
def test_the_crop_reaches_as_far_as_it_should_and_turns_with_the_motion(model, image, step):
    pushing(model)
    step = torch.tensor(step)
    ahead = step / step.norm()
    beside = torch.stack([-ahead[1], ahead[0]])
    # metres along and across the motion: within the crop and beyond it, but in the window
    within = torch.tensor([[-0.1, 0.0], [0.12, 0.0], [0.0, 0.18], [0.0, -0.18]])
    beyond = torch.tensor([[-0.28, 0.0], [0.3, 0.0], [0.0, 0.31], [0.0, -0.31]])
    table = torch.tensor(TABLE).view(3, 3)
    places = GRIPPER[0, :2] + torch.cat([within, beyond]) @ torch.stack([ahead, beside])
    pixels = places @ table[:2, :2].T + table[:2, 2]
    maps, actions = model.table.seed_maps(pixels), torch.tensor([[[*step, 0.0, 0.0]]])
    carried, = model.carried_maps(model.begin(image, GRIPPER), GRIPPER, maps, actions)
    cells = model.table.pixels().flatten(0, 1)
    moved = (carried[0] - maps).flatten(1) @ cells
    expected = torch.cat([(table[:2, :2] @ step).expand(4, 2), torch.zeros(4, 2)])
    torch.testing.assert_close(moved, expected, atol=0.25, rtol=0)


def test_gripper_moves_by_the_action_within_limits_and_workspace(model):
    gripper = torch.tensor([[0.42, 0.0, 0.02, 0.0]])
    moved = model.move_gripper(gripper, torch.tensor([[0.06, 0.3, -0.1, 2.0]]))
    torch.testing.assert_close(moved, torch.tensor([[0.45, 0.08, 0.0, 1.0]]))


def test_the_arm_is_drawn_where_its_camera_says_and_nowhere_else(model):
    size = model.config.sprite_size
    grippers = torch.tensor([[0.1, 0.2, 0.0, 0.0], [-0.2, -0.1, 0.1, 1.0]])
    drawn = model.draw_arm(grippers)
    assert drawn.shape == (2, 4, 32, 32)
    v, u = torch.meshgrid(torch.arange(32), torch.arange(32), indexing='ij')
    camera = torch.tensor(ARM).view(3, 4)
    for arm, gripper in zip(drawn, grippers):
        ray = camera @ torch.cat([gripper[:3], torch.ones(1)])
        at = ray[:2] / ray[2]
        mask = arm[3]
        middle = torch.stack([(mask * u).sum(), (mask * v).sum()]) / mask.sum()
        torch.testing.assert_close(middle, at, atol=0.1, rtol=0)
        away = torch.maximum((u - at[0]).abs(), (v - at[1]).abs())
        assert mask.max() > 0.7 and mask[away > 6].max() < 0.05
        assert mask[away > size / 2].max() < 1e-4 and arm[:3].abs().max() < 1e-6
