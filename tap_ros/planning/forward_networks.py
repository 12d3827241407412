# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The two networks of the forward model: one looks at the picture, one foresees a push."""

import torch
from torch import nn
from torch.nn import functional as F

NUM_ACTION_TERMS = 10


def convolution(channels_in: int, channels_out: int, stride: int = 1) -> nn.Sequential:
    """Return conv 3x3, group norm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride, 1),
        nn.GroupNorm(max(1, channels_out // 8), channels_out), nn.ReLU(inplace=True))


class SceneEncoder(nn.Module):
    """A small U-Net: picture and arm mask in; features, object layer and background out."""

    def __init__(self, width: int, features: int) -> None:
        super().__init__()
        self.fine = nn.Sequential(convolution(4, width), convolution(width, width))
        self.middle = nn.Sequential(
            convolution(width, 2 * width, 2), convolution(2 * width, 2 * width))
        self.coarse = nn.Sequential(
            convolution(2 * width, 3 * width, 2), convolution(3 * width, 3 * width))
        self.lift_coarse = nn.Conv2d(3 * width, 2 * width, 1)
        self.up_middle = convolution(2 * width, 2 * width)
        self.lift_middle = nn.Conv2d(2 * width, width, 1)
        self.up_fine = convolution(width, width)
        self.head = nn.Conv2d(width, features + 9, 1)

    def forward(self, image: torch.Tensor,
                arm_mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """
        Look at a picture.

        :param image: (B, 3, H, W) in [-1, 1].
        :param arm_mask: (B, 1, H, W) in [0, 1], where the arm is.
        :return: features (B, C, H, W), objects (B, 4, H, W), background (B, 3, H, W).
        """
        fine = self.fine(torch.cat([image, arm_mask], 1))
        middle = self.middle(fine)
        coarse = self.lift_coarse(self.coarse(middle))
        middle = self.lift_middle(self.up_middle(F.interpolate(coarse, scale_factor=2) + middle))
        fine = self.up_fine(F.interpolate(middle, scale_factor=2) + fine)
        out = self.head(fine).float()
        new_objects, new_background = out[:, 0:3].tanh(), out[:, 3:6].tanh()
        fill_objects, fill_background, mask = out[:, 6:9].sigmoid().split(1, 1)
        objects = torch.lerp(image, new_objects, fill_objects)
        background = torch.lerp(image, new_background, fill_background)
        features = torch.cat([out[:, 9:], mask], 1)
        return features, torch.cat([objects, mask], 1), background


def crop_points(cells: tuple[int, int], cell: float, back: float) -> torch.Tensor:
    """Return (h, w, 2): along and across the motion, metres from the gripper."""
    along = torch.arange(cells[0]) * cell - back
    across = torch.arange(cells[1]) * cell
    return torch.stack(torch.meshgrid(along, across - across.mean(), indexing='ij'), dim=-1)


class PushNet(nn.Module):
    """
    Backward flow around the gripper from the crop of features and the action.

    Objects are rigid: the flow is that of two planar rigid motions (what is pushed, and what that
    pushes in turn), each where its mask says; the third mask is for what stays.

    :param points: (2h, 2w, 2) places of the crop's cells, metres along and across the motion.
    """

    fields: torch.Tensor

    def __init__(self, features: int, width: int, blocks: int, points: torch.Tensor) -> None:
        super().__init__()
        cells = points.shape[0] // 2, points.shape[1] // 2
        self.look = nn.Conv2d(features, width, 3, 2, 1)
        self.action = nn.Linear(NUM_ACTION_TERMS, width)
        self.place = nn.Parameter(torch.zeros(1, width, *cells))
        self.squeeze = nn.Conv2d(width, 12, 1)
        self.gather = nn.Linear(12 * cells[0] * cells[1], 2 * width)
        self.spread = nn.Linear(2 * width, width)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(blocks))
        self.masks = nn.Conv2d(width, 3, 1)
        self.twists = nn.Linear(2 * width, 2 * 3)
        nn.init.normal_(self.place, std=0.1)
        # at first everything ahead moves a little, with the gripper: masks need motion to learn
        nn.init.normal_(self.twists.weight, std=0.01)
        with torch.no_grad():
            self.twists.bias.copy_(torch.tensor([-0.8, 0, 0, -0.8, 0, 0]))
            self.masks.get_parameter('bias').copy_(torch.tensor([0, 0, 1.0]))
        # each twist's field per unit: along, across, turning (one unit is 10 cm from the gripper)
        at = points[::2, ::2].permute(2, 0, 1) / 0.1
        fields = torch.zeros(3, 2, *cells)
        fields[0, 0], fields[1, 1] = 1, 1
        fields[2, 0], fields[2, 1] = -at[1], at[0]
        self.register_buffer('fields', fields, persistent=False)

    def forward(self, crop: torch.Tensor,
                action_terms: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Predict the flow in units of the gripper's displacement.

        :param crop: (N, C, 2h, 2w).
        :param action_terms: (N, NUM_ACTION_TERMS).
        :return: flow (N, 2, h, w) along and across the motion, and masks (N, 3, h, w) of what is
            pushed, what is pushed in turn, and what stays.
        """
        dtype = self.look.weight.dtype
        # in two steps: both at once takes three times as long
        x = self.look(crop.to(dtype).contiguous(memory_format=torch.channels_last))
        place = self.place.contiguous(memory_format=torch.channels_last)  # mixed layouts are slow
        x = F.relu_(x.add_(place).add_(self.action(action_terms.to(dtype))[..., None, None]))
        x = F.relu_(self.blocks[0](x))
        whole = F.relu_(self.gather(F.relu_(self.squeeze(x)).flatten(1)))
        x = x + self.spread(whole)[..., None, None]
        for block in self.blocks[1:]:
            x = x + F.relu_(block(x))
        masks = self.masks(x).float().softmax(1)
        N, _, h, w = masks.shape
        rigid = self.twists(whole).float().view(2 * N, 3) @ self.fields.flatten(1)
        return (masks[:, :2, None] * rigid.view(N, 2, 2, h, w)).sum(1), masks


def action_terms(gripper: torch.Tensor, following: torch.Tensor, direction: torch.Tensor,
                 length: torch.Tensor) -> torch.Tensor:
    """
    Describe an action and where it happens, in numbers of order 1.

    :param gripper: (N, 4) before and following (N, 4) after the step, metres.
    :param direction: (N, 2) unit vector of the motion; length (N, 1) metres.
    :return: (N, NUM_ACTION_TERMS).
    """
    cos, sin = direction[:, :1], direction[:, 1:]
    heights = torch.cat([gripper[:, 2:3], following[:, 2:3]], 1)
    return torch.cat([
        length / 0.05, heights / 0.05, (heights < 0.06).to(heights), cos, sin,
        (cos * sin).abs() * 2, gripper[:, :2] / 0.3], 1)
