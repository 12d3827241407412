# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The learned forward model: where objects go when the gripper moves (App. F of the paper).

Fixed-time and action-conditioned: one step is one control period. The picture is encoded once,
into table features and layers. Every step then

1. reads the features around the gripper, where the flow so far has carried them, on a small crop
   that turns with the motion (so what is learned for one place and direction holds for all);
2. predicts the backward appearance flow of this step, metres on the table, from crop and action;
3. composes it with the flow so far: phi_{t+1}(x) = f_t(x) + phi_t(x + f_t(x)).

The flow warps the first picture's object layer and its mask, and by the very same rule the object
maps: p_t(x) ~ p_0(x + phi_t(x)). Pictures are only composed in training, as
arm over warped objects over background, three masks that sum to 1.

Unlike the authors' ConvLSTM, it decodes nothing per step, and draws the arm by its kinematics.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from tap_ros.base.contract import ACTION_LIMIT, CLEAR, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.base.errors import check_fields, ConfigError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.images.robot_mask import RobotMask
from tap_ros.planning.forward_networks import action_terms, crop_points, PushNet, SceneEncoder
from tap_ros.planning.table import (
    grid_points,
    pixel_points,
    project,
    sample,
    sample_picture,
    shifted,
    Table,
)
from tap_ros.weights import find_forward_model
from tap_ros.weights.devices import has_bfloat16, placed
from tap_ros.weights.weights import load_weights, make_network
import torch
from torch import nn

LEAST_MASS = 0.05  # of a carried map, beneath which it is lost


@dataclass(frozen=True)
class ForwardModelConfig:
    """What the forward model is; saved in its weights."""

    table: tuple[float, ...]  # 9 numbers, row-major: homography from table metres to pixels
    arm: tuple[float, ...]  # 12 numbers, row-major: camera from gripper metres to the arm's pixels
    image_size: int = 64
    workspace_low: tuple[float, ...] = WORKSPACE_LOW  # m, of the gripper
    workspace_high: tuple[float, ...] = WORKSPACE_HIGH
    table_half: float = 0.55  # m, half the side of the table grid
    table_cells: int = 44
    window_cells: int = 26  # of the table grid around the gripper: the crop in any direction
    crop_cells: tuple[int, int] = (20, 24)  # along the motion, across it
    crop_cell: float = 0.02  # m
    crop_back: float = 0.14  # m that the crop reaches behind the gripper
    features: int = 8
    width: int = 32
    blocks: int = 3
    encoder_width: int = 16
    sprite_size: int = 24  # pixels, side of the picture of the arm
    robot_mask: RobotMask = 'none'  # what the pictures are without
    crop: str = ''  # of the camera's pictures, see crop.Crop
    crop_size: int = 0  # Crop.size
    camera_size: tuple[int, int] = (0, 0)  # (0, 0): unknown

    def __post_init__(self) -> None:
        if len(self.table) != 9 or len(self.arm) != 12 or self.image_size % 4 or any(
                n % 2 for n in self.crop_cells):
            raise ConfigError(
                'forward model: expected 9 numbers for table and 12 for arm, image_size a '
                f'multiple of 4, crop_cells even; got {len(self.table)}, {len(self.arm)}, '
                f'{self.image_size}, {self.crop_cells}')
        sizes = ('image_size', 'table_cells', 'features', 'width', 'blocks', 'encoder_width',
                 'sprite_size')
        check_fields(self, {**dict.fromkeys(sizes, (1, 1024)),
                            'window_cells': (2, self.table_cells)})


@dataclass
class Look:
    """What one look at a picture gives; B pictures."""

    features: torch.Tensor  # (B, C, n, n) on the table grid
    objects: torch.Tensor  # (B, 4, H, W) layer of the objects: rgb in [-1, 1], mask in [0, 1]
    background: torch.Tensor  # (B, 3, H, W) in [-1, 1]


class LearnedForwardModel(nn.Module):
    """A protocols.ForwardModel; see the file's head."""

    homography: torch.Tensor
    arm_camera: torch.Tensor
    grid: torch.Tensor
    ahead: torch.Tensor
    pixels: torch.Tensor
    crop: torch.Tensor
    limits: torch.Tensor
    move_limit: torch.Tensor

    def __init__(self, config: ForwardModelConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = SceneEncoder(config.encoder_width, config.features)
        crop = crop_points(config.crop_cells, config.crop_cell, config.crop_back)
        self.push = PushNet(config.features + 1, config.width, config.blocks, crop)
        size = config.sprite_size
        sprite = torch.zeros(4, 4, size, size)  # (basis 1 x y z, rgb and mask logit)
        sprite[0, 3] = 2 - (pixel_points((size, size)) - (size - 1) / 2).norm(dim=-1)
        self.sprite = nn.Parameter(sprite)
        for name, value in {
                'homography': torch.tensor(config.table).view(3, 3).float(),
                'arm_camera': torch.tensor(config.arm).view(3, 4).float(),
                'grid': grid_points(config.table_cells).movedim(-1, 0).contiguous(),
                'ahead': torch.tensor([1.0, 0.0]),
                'pixels': pixel_points((config.image_size, config.image_size)),
                'crop': (crop.flatten(0, 1) / config.table_half).T.contiguous(),
                'limits': torch.tensor([[*config.workspace_low, 0.0],
                                        [*config.workspace_high, 1.0]]),
                'move_limit': torch.tensor(ACTION_LIMIT)}.items():
            self.register_buffer(name, value, persistent=False)

    @classmethod
    def load(cls, path: str | Path, device: torch.device | str = 'cpu',
             simulator: object = None, precision: str = 'auto') -> Self:
        """
        Load a trained forward model, ready to predict.

        :param path: name of the shipped one, 'push', or a safetensors file.
        :param simulator: is not needed; forward models are all loaded alike.
        :param precision: of the push net: 'float32', 'bfloat16', or 'auto': bfloat16 where the
            device has instructions for it.
        :return: the model in evaluation mode.
        :raises WeightsError: for an unknown name, a missing or damaged file, or one of another
            kind.
        :raises ConfigError: for the name of a predictor.
        """
        path = find_forward_model(path)
        values, state, _ = load_weights(path, 'forward_model')
        model = make_network(cls, ForwardModelConfig, values, state, path)
        model = model.to(device).eval().requires_grad_(False)
        if precision == 'bfloat16' or (precision == 'auto' and has_bfloat16(device)):
            fields = model.push.fields  # geometry stays exact
            model.push.bfloat16()
            model.push.fields = fields
        return placed(model, device)

    @property
    def camera_crop(self) -> TrainedCrop:
        """What it makes of a camera's pictures."""
        config = self.config
        return TrainedCrop(Crop(config.crop, config.crop_size),
                           config.camera_size if any(config.camera_size) else None,
                           self.table.image_size)

    @property
    def robot_mask(self) -> RobotMask:
        """Return what the pictures that it takes are without."""
        return self.config.robot_mask

    @property
    def table(self) -> Table:
        """Return the grid that it keeps its flow on, and where it is in the pictures."""
        config = self.config
        return Table(self.homography, (config.image_size,) * 2, config.table_cells,
                     config.table_half)

    def draw_arm(self, gripper: torch.Tensor) -> torch.Tensor:
        """
        Draw the arm where its kinematics put it.

        :param gripper: (B, 4) metres.
        :return: (B, 4, H, W): rgb in [-1, 1] and mask in [0, 1]; zeros for a model that is made
            for pictures without the robot.
        """
        if self.config.robot_mask == 'all':
            return gripper.new_zeros(len(gripper), 4, *self.pixels.shape[:2])
        basis = torch.cat([torch.ones_like(gripper[:, :1]), gripper[:, :3]], 1)  # (B, 4)
        sprites = torch.einsum('bi,icuv->bcuv', basis, self.sprite)
        # a rim of masks near zero, so that nothing is drawn outside the sprite
        rim = torch.full_like(sprites[:, 3:], -12.0)
        rim[..., 1:-1, 1:-1] = sprites[:, 3:, 1:-1, 1:-1]
        sprites = torch.cat([sprites[:, :3].tanh(), rim.sigmoid()], 1)
        centre = project(self.arm_camera, gripper[:, None, :3])[:, :, None]  # (B, 1, 1, 2)
        half = (self.config.sprite_size - 1) / 2
        return sample_picture(sprites, self.pixels - centre + half)

    def look(self, image: torch.Tensor, arm_mask: torch.Tensor,
             homography: torch.Tensor | None = None) -> Look:
        """
        Look at pictures.

        :param image: (B, 3, H, W) in [-1, 1].
        :param arm_mask: (B, 1, H, W) from draw_arm; zeros where the arm is hidden.
        :param homography: (B, 3, 3) where it differs from the model's.
        :return: Look.
        """
        features, objects, background = self.encoder(image, arm_mask)
        at = project(self.homography if homography is None else homography,
                     self.table.points().expand(len(image), -1, -1))
        return Look(sample_picture(features, at.unflatten(1, self.grid.shape[1:])), objects,
                    background)

    def still(self, count: int) -> torch.Tensor:
        """Return the flow (count, 2, n, n) of a scene in which nothing has moved."""
        return torch.zeros_like(self.grid).expand(count, -1, -1, -1)

    def move_gripper(self, gripper: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Return where the gripper is after an action: clipped to limits and workspace."""
        step = action[:, :3].clamp(-self.move_limit, self.move_limit)
        moved = torch.cat([gripper[:, :3] + step, action[:, 3:]], 1)
        return moved.clamp(*self.limits)

    def advance(self, features: torch.Tensor, flow: torch.Tensor, gripper: torch.Tensor,
                action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """
        Predict one control period.

        :param features: (N, C, n, n) of the Look, expanded to the samples.
        :param flow: (N, 2, n, n) backward flow from now to the first picture, table units.
        :param gripper: (N, 4) metres; action: (N, 4) metres and opening.
        :return: flow and gripper after the step, and the step's masks (N, 3, h, w), see PushNet.
        """
        half = self.config.table_half
        following = self.move_gripper(gripper, action)
        move = following[:, :2] - gripper[:, :2]
        length = move.norm(dim=1, keepdim=True)
        direction = torch.where(length > 1e-4, move / length.clamp_min(1e-4), self.ahead)
        cos, sin = direction[:, 0], direction[:, 1]
        turn = torch.stack([cos, sin, -sin, cos], 1).view(-1, 2, 2)  # rows: local axes on table
        # 1. look at what is now around the gripper
        at = (turn.mT.flatten(0, 1) @ self.crop).view(-1, 2, self.crop.shape[1])
        at = (at + gripper[:, :2, None] / half).unflatten(2, self.config.crop_cells)
        crop = sample(features, shifted(at, flow))
        # 2. predict the flow of this step, from new places back to old ones
        local, masks = self.push(crop, action_terms(gripper, following, direction, length))
        step = (turn.mT @ local.flatten(2)) * (length / half)[..., None]  # (N, 2, h w) on table
        # 3. compose, where the crop reaches: phi'(x) = f(x) + phi(x + f(x))
        window, points = self._window(gripper)
        step = sample(step.view_as(local), self._crop_coordinates(points, gripper, turn), 'zeros')
        back = points + step
        moved = back - points + sample(flow, back)
        cells = flow.flatten(2).scatter(2, window.expand(-1, 2, -1), moved.flatten(2))
        return cells.view_as(flow), following, masks

    def rollout(self, features: torch.Tensor, gripper: torch.Tensor,
                actions: torch.Tensor) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield what advance returns after each of actions (N, T, 4) from (N, 4)."""
        flow = self.still(len(actions))
        for action in actions.unbind(1):
            flow, gripper, masks = self.advance(features, flow, gripper, action)
            yield flow, gripper, masks

    def _window(self, gripper: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the cells (N, 1, m m) near the gripper, row-major, and points (N, 2, m, m)."""
        n, m = self.config.table_cells, self.config.window_cells
        corner = (gripper[:, :2] / self.config.table_half + 1) * ((n - 1) / 2) - (m - 1) / 2
        corner = corner.round().long().clamp(0, n - m)  # (N, 2) column, row
        line = torch.arange(m, device=gripper.device)
        columns, rows = corner[:, :1] + line, corner[:, 1:] + line  # (N, m)
        cells = rows[:, :, None] * n + columns[:, None]
        first = corner[..., None, None] * (2 / (n - 1))  # (N, 2, 1, 1)
        return cells.flatten(1)[:, None], self.grid[:, :m, :m] + first

    def _crop_coordinates(self, points: torch.Tensor, gripper: torch.Tensor,
                          turn: torch.Tensor) -> torch.Tensor:
        """Return where points (N, 2, m, m) lie in the crop, in [-1, 1] if inside."""
        config = self.config
        h, w = config.crop_cells[0] // 2, config.crop_cells[1] // 2
        # the push net's cells are two of the crop's wide, the first at the crop's corner
        spans = gripper.new_tensor([h - 1, w - 1]) * config.crop_cell  # half extents, metres
        corner = self.crop[:, 0] * config.table_half
        rows = turn.mT / spans  # (N, 2, 2): table metres to [-1, 1] along, across
        shift = -(gripper[:, None, :2] @ rows) - corner / spans - 1
        # grid_sample wants the last axis of the crop, across, first
        return torch.baddbmm(
            shift.flip(-1).mT, (rows.flip(-1) * config.table_half).mT, points.flatten(2)
        ).view_as(points)

    def carry(self, maps: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
        """
        Carry object maps by the flow.

        :param maps: (N, K, n, n) on the table grid, in the first picture.
        :param flow: (N, 2, n, n), table units.
        :return: (N, K, n, n), each summing to 1, or to 0 where nearly all of it was lost: a flow
            that jumps over an object or off the table does not say where it went.
        """
        carried = sample(maps, self.grid + flow, 'zeros')
        mass = carried.sum((-1, -2), keepdim=True)
        return torch.where(mass < LEAST_MASS, 0, carried / mass.clamp_min(LEAST_MASS))

    def picture(self, scene: Look, flow: torch.Tensor, arm: torch.Tensor,
                homography: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Compose the picture that the flow leads to, for training and for people.

        :param scene: Look of B first pictures; flow (B, 2, n, n); arm (B, 4, H, W) as drawn.
        :return: picture (B, 3, H, W) and masks (B, 3, 1, H, W) of arm, objects and background.
        """
        if homography is None:
            homography = self.homography.expand(len(flow), 3, 3)
        half = self.config.table_half
        table = project(torch.linalg.inv(homography), self.pixels.flatten(0, 1)) / half
        table = table.unflatten(1, self.pixels.shape[:2]).movedim(-1, 1)  # (B, 2, H, W)
        source = shifted(table, flow, 'zeros').movedim(1, -1)
        source = project(homography, source.flatten(1, 2) * half).view_as(source)
        objects = sample_picture(scene.objects, source)
        arm_mask = arm[:, 3:]
        object_mask = (1 - arm_mask) * objects[:, 3:]
        rest = 1 - arm_mask - object_mask
        picture = arm_mask * arm[:, :3] + object_mask * objects[:, :3] + rest * scene.background
        return picture, torch.stack([arm_mask, object_mask, rest], 1)

    def begin(self, image: torch.Tensor, gripper: torch.Tensor,
              arm_hidden: bool = False) -> torch.Tensor:
        """Look once at the picture (1, 3, H, W): features (1, C, n, n) for carried_maps."""
        arm_mask = self.draw_arm(gripper)[:, 3:]
        return self.look(image, torch.zeros_like(arm_mask) if arm_hidden else arm_mask).features

    def carried_maps(self, features: torch.Tensor, gripper: torch.Tensor, maps: torch.Tensor,
                     actions: torch.Tensor, /, every: int = 1) -> Iterator[torch.Tensor]:
        """
        Yield the maps (N, K, n, n) after every so many steps of N action sequences.

        :param features: (1, C, n, n) from begin; maps (K, n, n) on the table grid.
        :param gripper: (1, 4), or (N, 4) where each sequence begins.
        :param actions: (N, horizon, 4).
        """
        count = len(actions)
        features, maps = (x.expand(count, -1, -1, -1) for x in (features, maps))
        gripper, flow = gripper.expand(count, -1), self.still(count)
        for t, action in enumerate(actions.unbind(1), 1):
            # above all objects the gripper moves none, whatever the network says
            following = self.move_gripper(gripper, action)
            low = torch.minimum(gripper[:, 2], following[:, 2]) < CLEAR
            if low.is_cuda or low.any():  # asking makes a GPU wait
                moved = self.advance(features, flow, gripper, action)[0]
                flow = (moved if not low.is_cuda and low.all()
                        else torch.where(low[:, None, None, None], moved, flow))
            gripper = following
            if t % every == 0:
                yield self.carry(maps, flow)
