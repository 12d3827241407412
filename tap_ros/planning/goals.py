# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals as the planner takes them: distances from every place on the table, tabulated once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.errors import PlanningError
from tap_ros.planning.expected_distance import distances_to_places
from tap_ros.planning.map_model import MapModel
from tap_ros.planning.mpc_inputs import check_goal_maps, check_goal_pixels
import torch


@dataclass(frozen=True, eq=False)
class Goal:
    """Where K objects should be."""

    distances: torch.Tensor  # (K, n n) px, of every table cell from each object's goal
    places: np.ndarray  # (K, 2) m, the table cells nearest to the goals

    def __len__(self) -> int:
        return len(self.distances)

    def equals(self, other: 'Goal') -> bool:
        """Tell whether the objects should be in the same places."""
        return self is other or torch.equal(self.distances, other.distances)


def tabulate(model: MapModel, pixels: ArrayLike | None = None,
             maps: ArrayLike | None = None) -> Goal:
    """
    Tabulate a goal: where each object should be, as pixels or as maps.

    For a goal map q the distance is the expected one, so that an object map p costs that between
    the two, E_{p,q}|x - y|.

    :param model: whose table it is.
    :param pixels: (K, 2) as (u, v), in the picture; or
    :param maps: (K, H, W), each of positive mass. Exactly one of the two.
    :raises PlanningError: for goals that cannot be planned to.
    """
    if (maps is None) == (pixels is None):
        raise PlanningError('goal: give exactly one of pixels and maps')
    cells = model.pixel_table().flatten(0, 1)  # (n n, 2)
    if pixels is not None:
        goals = check_goal_pixels(pixels, model.image_size)
        distances = torch.cdist(torch.from_numpy(goals).to(cells.device), cells)
    if maps is not None:
        goals = check_goal_maps(maps, model.image_size)
        distances = distances_to_places(torch.from_numpy(goals).to(cells.device), cells)
    return Goal(distances, model.table_points()[distances.argmin(1)].cpu().numpy())
