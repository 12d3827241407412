# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Follow objects from picture to picture, without ground truth after the first one.

Each step the forward model carries every object's map by the action that was executed, and the
new picture corrects it: the object as it looked in the first picture, laid flat on the table and
turned, is searched around the expected place. The model's masks say which pixels are the object
and which are hidden by the arm.
"""

import numpy as np
from tap_ros.images.pixels import to_float
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.table import project, sample_picture
import torch

CELLS, CELL = 19, 0.012  # template: cells a side, metres each
REACH = 0.036  # m, search radius around the expected place
TURN = 0.35  # rad, most that an object turns in one control period
Tracked = tuple[np.ndarray, np.ndarray]  # pixels (K, 2) float32, and how objects are turned, rad
LEAST_SEEN = 0.25  # share of an object that has to be visible for a correction
PULL = 0.02  # cost of being REACH away from the expected place, picture range 2


class ObjectTracker:
    """
    Keep track of K objects.

    :param image: (H, W, 3) uint8, the first picture; gripper (4,) in it.
    :param pixels: (K, 2) where the objects are in it.
    :ivar start: Tracked, of the first picture.
    """

    def __init__(self, model: LearnedForwardModel, image: np.ndarray, gripper: np.ndarray,
                 pixels: np.ndarray) -> None:
        self._model = model
        pixels = np.asarray(pixels, np.float32).copy()
        self.start: Tracked = pixels, np.zeros(len(pixels))
        device = model.table.device
        line = (torch.arange(CELLS, device=device) - (CELLS - 1) / 2) * CELL
        self._cells = torch.cartesian_prod(line, line).flip(-1)  # metres around an object
        with torch.inference_mode():
            picture, arm = self._prepare(image, gripper)
            objects = model.look(picture, arm).objects[:, 3:]
            at = self._place(self._table(pixels), torch.zeros(len(pixels)))
            layers = torch.cat([picture, objects * (1 - arm)], 1)
            templates = self._read(layers, at)  # (K, 4, cells)
        inside = (self._cells.norm(dim=1) <= CELL * CELLS / 2).float()
        self._templates, self._weights = templates[:, :3], templates[:, 3] * inside

    @torch.inference_mode()
    def update(self, tracked: Tracked, before: np.ndarray, gripper_before: np.ndarray,
               action: np.ndarray, after: np.ndarray, gripper: np.ndarray) -> Tracked:
        """
        Follow the objects through one action.

        :param tracked: in the picture before.
        :param before: (H, W, 3) uint8, the picture that the action answered; gripper_before (4,).
        :param action: (4,) that was executed.
        :param after: (H, W, 3) uint8, the new picture; gripper (4,) in it.
        :return: Tracked in the new picture.
        """
        model, pixels, angles = self._model, tracked[0], tracked[1].copy()
        device = model.table.device
        # predict: the maps move by the model's own flow
        hand = torch.as_tensor(gripper_before, device=device)[None]
        features = model.begin(to_float(before)[None].to(device), hand)
        maps = model.table.seed_maps(torch.from_numpy(pixels).to(device))
        moves = torch.as_tensor(np.asarray(action, np.float32), device=device)[None, None]
        carried, = model.carried_maps(features, hand, maps, moves)
        # differences only, so that blurring and cells do not add up over the steps
        table = model.table.pixels().flatten(0, 1)
        kept = carried[0].sum((-1, -2)) > 0  # else nobody knows where it went
        shift = (carried[0] - maps).flatten(1) @ table * kept[:, None]
        expected = pixels + shift.cpu().numpy()
        # correct: match what the objects looked like
        picture, arm = self._prepare(after, gripper)
        layers = torch.cat([picture, 1 - arm], 1)
        centres = self._table(expected)
        for k in range(len(expected)):
            moved = bool(np.linalg.norm(shift[k].cpu().numpy()) > 0.05)
            centre, angles[k] = self._match(k, layers, centres[k], float(angles[k]), moved)
            if centre is not None:
                expected[k] = project(model.homography, centre[None]).cpu().numpy()[0]
        return expected.astype(np.float32), angles

    def _match(self, k: int, layers: torch.Tensor, centre: torch.Tensor, before: float,
               moved: bool) -> tuple[torch.Tensor | None, float]:
        """
        Search object k around a place, coarsely and then finely.

        :param centre: (2,) metres, the expected place; before: rad, how it was turned.
        :param moved: the model says that it was pushed.
        :return: (2,) metres, or None when the object is hidden; its angle.
        """
        device = layers.device
        best, angle = centre, before
        # what was not pushed may have been all the same, a little
        radius, turn = (REACH, TURN) if moved else (REACH / 2, TURN / 2)
        for _ in range(3):
            line = torch.linspace(-1, 1, 7, device=device)
            turns, dy, dx = torch.meshgrid(
                torch.linspace(-1, 1, 5, device=device), line, line, indexing='ij')
            places = best + radius * torch.stack([dx, dy], -1).view(-1, 2)  # (S, 2)
            angles = angle + turn * turns.flatten()
            found = self._read(layers, self._place(places, angles))  # (S, 4, cells)
            weights = self._weights[k] * found[:, 3]
            seen = weights.sum(1)
            difference = (found[:, :3] - self._templates[k]).abs().mean(1).clamp(max=0.5)
            costs = (weights * difference).sum(1) / seen.clamp_min(1e-6)
            costs = costs + PULL * ((places - centre).norm(dim=1) / REACH) ** 2
            costs = costs.where(seen > LEAST_SEEN * self._weights[k].sum(), torch.inf)
            i = int(costs.argmin())
            if not torch.isfinite(costs[i]) or self._weights[k].sum() < 1:
                return None, before
            best, angle = places[i], float(angles[i])
            radius, turn = radius / 3, turn / 2
        return best, angle

    def _prepare(self, image: np.ndarray,
                 gripper: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the picture (1, 3, H, W) in [-1, 1] and the mask (1, 1, H, W) of the arm."""
        device = self._model.table.device
        hand = torch.as_tensor(np.asarray(gripper, np.float32), device=device)[None]
        return to_float(image)[None].to(device), self._model.draw_arm(hand)[:, 3:]

    def _table(self, pixels: np.ndarray) -> torch.Tensor:
        """Return table metres (K, 2) of pixels (K, 2)."""
        pixels = torch.as_tensor(np.asarray(pixels, np.float32), device=self._model.table.device)
        return project(torch.linalg.inv(self._model.homography), pixels)

    def _place(self, centres: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
        """Return pixels (S, cells, 2) of the template's cells, turned about centres (S, 2)."""
        angles = angles.to(centres)
        cos, sin = angles.cos()[:, None], angles.sin()[:, None]
        x, y = self._cells.T
        turned = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)  # (S, cells, 2)
        return project(self._model.homography, centres[:, None] + turned)

    def _read(self, layers: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        """Read layers (1, C, H, W) at pixels (S, cells, 2): (S, C, cells)."""
        return sample_picture(layers, pixels[None])[0].transpose(0, 1)
