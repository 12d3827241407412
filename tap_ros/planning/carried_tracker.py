# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The learned follower: the forward model carries the objects, each new picture corrects them.

At each picture the model carries every object's map by what the gripper did, and the picture
corrects it: the object as it looked in the first picture, laid flat on the table and turned, is
searched around the expected place. The model's masks say which pixels are the object and which are
hidden by the arm.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.errors import TrackingError
from tap_ros.images.pixels import to_float
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.table import project, sample_picture
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import HIDDEN, LOST, SEEN, Tracked, View
from tap_ros.weights import FORWARD_MODEL
import torch

CONFIDENCE = 0.8  # it does not know; about the share that is right in the simulator
CELLS, CELL = 19, 0.012  # template: cells a side, metres each
REACH = 0.036  # m, search radius around the expected place
TURN = 0.35  # rad, most that an object turns in one control period
LEAST_SEEN = 0.25  # share of an object that has to be visible for a correction
PULL = 0.02  # cost of being REACH away from the expected place, picture range 2


class CarriedTracker:
    """
    A Tracker whose forward model was trained in the view of the camera; it finds no goals.

    :param camera: not used: the weights hold their own.
    """

    def __init__(self, camera: PinholeCamera | None = None) -> None:
        self._model = LearnedForwardModel.load(FORWARD_MODEL)
        self._scale, self._pixels = np.ones(2), np.zeros((0, 2))
        line = (torch.arange(CELLS) - (CELLS - 1) / 2) * CELL
        self._cells = torch.cartesian_prod(line, line).flip(-1)  # metres around an object

    def select(self, view: View, pixels: Sequence[Sequence[float]] | np.ndarray) -> Tracked:
        """Follow other objects, at the clicks themselves; see Tracker."""
        height, width = view.image.shape[:2]
        clicks = np.asarray(pixels, np.float64).reshape(-1, 2)
        for u, v in clicks:
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                raise TrackingError(f'click ({u:g}, {v:g}) is outside the picture')
            if view.robot_mask is not None and view.robot_mask[round(v), round(u)]:
                raise TrackingError(f'click ({u:g}, {v:g}) is on the robot; move it away first')
        self._scale = self._model.config.image_size / np.array([width, height])
        self._pixels = clicks
        # Where the objects are in the pixels of the model, and how they are turned, rad.
        self._places = ((clicks + 0.5) * self._scale - 0.5).astype(np.float32)
        self._angles = np.zeros(len(clicks))
        self._image, self._gripper = self._small(view), self._hand(view)
        with torch.inference_mode():
            picture, arm = self._prepare()
            objects = self._model.look(picture, arm).objects[:, 3:]
            at = self._place(self._table(self._places), torch.zeros(len(clicks)))
            layers = torch.cat([picture, objects * (1 - arm)], 1)
            templates = self._read(layers, at)  # (K, 4, cells)
        inside = (self._cells.norm(dim=1) <= CELL * CELLS / 2).float()
        self._templates, self._weights = templates[:, :3], templates[:, 3] * inside
        return self._state(view)

    @torch.inference_mode()
    def update(self, view: View) -> Tracked:
        """Carry the objects by what the gripper did since the last picture; see Tracker."""
        model, after = self._model, self._hand(view)
        # predict: the maps move by the model's own flow
        hand = torch.from_numpy(self._gripper)[None]
        action = np.append(after[:3] - self._gripper[:3], after[3])
        features = model.begin(to_float(self._image)[None], hand)
        maps = model.table.seed_maps(torch.from_numpy(self._places))
        carried, = model.carried_maps(features, hand, maps, torch.from_numpy(action)[None, None])
        # differences only, so that blurring and cells do not add up over the steps
        table = model.table.pixels().flatten(0, 1)
        kept = carried[0].sum((-1, -2)) > 0  # else nobody knows where it went
        shift = ((carried[0] - maps).flatten(1) @ table * kept[:, None]).numpy()
        expected = self._places + shift
        # correct: match what the objects looked like
        self._image, self._gripper = self._small(view), after
        picture, arm = self._prepare()
        layers = torch.cat([picture, 1 - arm], 1)
        centres = self._table(expected)
        for k in range(len(expected)):
            moved = bool(np.linalg.norm(shift[k]) > 0.05)
            centre = self._match(k, layers, centres[k], moved)
            if centre is not None:
                expected[k] = project(model.homography, centre[None]).numpy()[0]
        self._places = expected.astype(np.float32)
        self._pixels = (self._places + 0.5) / self._scale - 0.5
        return self._state(view)

    def find(self, view: View) -> Tracked:
        """Find nothing: all are LOST; see Tracker."""
        count = len(self._pixels)
        return Tracked(np.full((count, 2), np.nan), (LOST,) * count, np.zeros(count),
                       (np.zeros((0, 2)),) * count)

    def _match(self, k: int, layers: torch.Tensor, centre: torch.Tensor,
               moved: bool) -> torch.Tensor | None:
        """
        Search object k around a place, coarsely and then finely, and note how it is turned.

        :param centre: (2,) metres, the expected place; moved: the model says that it was pushed.
        :return: (2,) metres, or None when the object is hidden.
        """
        best, angle = centre, float(self._angles[k])
        # what was not pushed may have been all the same, a little
        radius, turn = (REACH, TURN) if moved else (REACH / 2, TURN / 2)
        for _ in range(3):
            line = torch.linspace(-1, 1, 7)
            turns, dy, dx = torch.meshgrid(torch.linspace(-1, 1, 5), line, line, indexing='ij')
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
                return None
            best, angle = places[i], float(angles[i])
            radius, turn = radius / 3, turn / 2
        self._angles[k] = angle
        return best

    def _small(self, view: View) -> np.ndarray:
        """Return the picture at the size of the model."""
        size = self._model.config.image_size
        return np.asarray(cv2.resize(view.image, (size, size), interpolation=cv2.INTER_AREA))

    @staticmethod
    def _hand(view: View) -> np.ndarray:
        """Return the gripper, float32; TrackingError where it is not known."""
        if view.gripper is None:
            raise TrackingError('carried needs the gripper: publish joint states, or follow with '
                                'the tracker rigid')
        return np.asarray(view.gripper, np.float32)

    def _state(self, view: View) -> Tracked:
        """Return where the objects are; hidden where the mask says so."""
        mask, states = view.robot_mask, []
        for u, v in self._pixels:
            inside = mask is not None and 0 <= v < mask.shape[0] - 0.5 and (
                0 <= u < mask.shape[1] - 0.5)
            states.append(HIDDEN if inside and mask is not None and mask[round(v), round(u)]
                          else SEEN)
        count = len(states)
        return Tracked(self._pixels, tuple(states), np.full(count, CONFIDENCE),
                       (np.zeros((0, 2)),) * count)

    def _prepare(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the picture (1, 3, H, W) in [-1, 1] and the mask (1, 1, H, W) of the arm."""
        hand = torch.from_numpy(self._gripper)[None]
        return to_float(self._image)[None], self._model.draw_arm(hand)[:, 3:]

    def _table(self, pixels: np.ndarray) -> torch.Tensor:
        """Return table metres (K, 2) of pixels (K, 2)."""
        places = torch.from_numpy(pixels.astype(np.float32))
        return project(torch.linalg.inv(self._model.homography), places)

    def _place(self, centres: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
        """Return pixels (S, cells, 2) of the template's cells, turned about centres (S, 2)."""
        cos, sin = angles.cos()[:, None], angles.sin()[:, None]
        x, y = self._cells.T
        turned = torch.stack([cos * x - sin * y, sin * x + cos * y], -1)  # (S, cells, 2)
        return project(self._model.homography, centres[:, None] + turned)

    def _read(self, layers: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        """Read layers (1, C, H, W) at pixels (S, cells, 2): (S, C, cells)."""
        return sample_picture(layers, pixels[None])[0].transpose(0, 1)
