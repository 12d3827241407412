# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forward models and solvers of the planner; tap_ros.base.plugins gives them names."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from typing import Any, Protocol, runtime_checkable, TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import check_fields

if TYPE_CHECKING:
    from tap_ros.planning.table import Table
    import torch

Judge = Callable[[np.ndarray], np.ndarray]  # samples (N, D) to costs (N,); NaN counts as worst


@runtime_checkable
class ForwardModel(Protocol):
    """
    Says where objects go when the gripper moves, as maps on a square grid of the table.

    forward_model.LearnedForwardModel and sim_bridge.true_model.TrueModel are two.
    """

    @property
    def table(self) -> 'Table':
        """Where the grid is in the pictures that the model takes."""

    def begin(self, image: 'torch.Tensor', gripper: 'torch.Tensor',
              arm_hidden: bool = False) -> Any:
        """
        Look once at what all sequences of a plan begin with.

        :param image: float32 (1, 3, H, W) in [-1, 1], of table.image_size.
        :param gripper: float32 (1, 4): x, y, z in metres, and opening, 0 to 1.
        :param arm_hidden: the arm is not in the picture.
        :return: what carried_maps takes first; the planner does not look into it.
        """

    def carried_maps(self, start: Any, gripper: 'torch.Tensor', maps: 'torch.Tensor',
                     actions: 'torch.Tensor', /, every: int = 1) -> 'Iterator[torch.Tensor]':
        """
        Yield the maps (N, K, n, n) after every so many steps of N action sequences.

        :param start: from begin.
        :param gripper: float32 (N, 4), where each sequence begins.
        :param maps: float32 (K, n, n) now, on the n x n cells of the table; each sums to 1.
        :param actions: float32 (N, T, 4): dx, dy, dz in metres in a control period, and opening;
            T a multiple of `every`.
        :return: T / every tensors float32; each map sums to 1, or to 0 where nobody knows where
            the object is. Called from several threads at once.
        """


@dataclass(frozen=True)
class SearchConfig:
    """
    How much a solver searches.

    :param num_samples: per iteration; num_iterations; num_elites: that the next one begins from.
    """

    num_samples: int = 200
    num_iterations: int = 3
    num_elites: int = 10

    def __post_init__(self) -> None:
        check_fields(self, {'num_elites': (1, self.num_samples), 'num_iterations': (1, inf)})


@dataclass(frozen=True)
class Problem:
    """
    What a solver minimises.

    :param cost: Judge; it raises where time is over, and the planner takes the best so far.
    :param mean: (D,) of the first Gaussian; std: (D,).
    :param clip: limits samples (N, D), not a single one (D,), to what is allowed.
    :param proposals: (P, D), samples that are worth a look, or None.
    :param kept: (E, D), elites of the plan before, one step later, or None.
    :param moves: T; the first 2 T parameters are x, y of T displacements, one after the other.
    :param recheck: a dearer Judge, for the last elites alone.
    """

    cost: Judge
    mean: np.ndarray
    std: np.ndarray
    clip: Judge = np.asarray
    proposals: np.ndarray | None = None
    kept: np.ndarray | None = None
    moves: int = 0
    recheck: Judge | None = None


@dataclass(frozen=True)
class Solution:
    """What a solver found."""

    best: np.ndarray  # (D,)
    cost: float  # of the best, by Problem.cost
    elites: np.ndarray  # (E, D), the cheapest first


class Solver(Protocol):
    """Searches the minimum of a Problem: a function; solvers.cem and solvers.icem are two."""

    def __call__(self, problem: Problem, config: SearchConfig,
                 rng: np.random.Generator) -> Solution:
        """
        Search.

        :param problem: its cost takes samples, float64 (N, D), and returns (N,) costs in pixels.
            What it raises goes on to the planner: time is over.
        :param config: how many samples, iterations and elites.
        :param rng: all randomness comes from it, in an order that depends on the shapes only.
        :return: Solution: the best sample (D,), its cost, and the elites (E, D), cheapest first.
        """
