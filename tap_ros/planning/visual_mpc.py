# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Visual MPC: choose the next action by searching through the forward model (App. F of the paper).

At every control period: put each object's map at its pixel, predict where many action sequences
carry the maps, take the one that brings them closest to their goals, execute its first action:

    goal, memory = mpc.goal(pixels=goal_pixels), Memory(seed)
    while not there:
        plan = mpc.plan(Scene(image, gripper, object_pixels), goal, memory)
        carry_out(plan.action)
        memory = plan.memory
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
import time
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.errors import PlanningError
from tap_ros.images.pixels import to_float
from tap_ros.planning.action_sequences import FULL, HORIZON, Limits, SequenceShape
from tap_ros.planning.cem import cem
from tap_ros.planning.forward_model import load_forward_model
from tap_ros.planning.goals import Goal, tabulate
from tap_ros.planning.map_model import MapModel
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.mpc_inputs import check_scene, Scene
from tap_ros.planning.plan_cost import landing_clash, prices
from tap_ros.planning.proposals import push_proposals
from tap_ros.planning.rollouts import Rollouts, to_numpy
import torch

WARM_STD = 0.5  # share of the first deviation that a search around the last plan begins with
RECHECK_STD = 0.01  # m, from the gripper to the places from which elites are judged once more


@dataclass(frozen=True)
class Found:
    """What a search found, or what is left of it some actions later."""

    shape: SequenceShape
    parameters: np.ndarray  # (D,) of the sequence, for shape
    elites: np.ndarray  # (E, D) of the best ones that the search has judged
    expected_distance: float  # px, see Plan
    cost: float  # px, see Plan
    goal: Goal  # that it was searched for
    limits: Limits  # within which it was searched
    age: int = 0  # actions that have passed since the search

    def following(self) -> 'Found':
        """Return what is left one action later."""
        return replace(self, shape=self.shape.following(), age=self.age + 1,
                       parameters=self.shape.shift(self.parameters),
                       elites=np.array([self.shape.shift(one) for one in self.elites]))


@dataclass(frozen=True)
class Memory:
    """What one plan leaves to the next; a planner that has not planned yet has Memory(seed)."""

    seed: int = 0
    count: int = 0  # plans so far
    found: Found | None = None


@dataclass(frozen=True)
class Plan:
    """What the planner decided."""

    action: np.ndarray  # (4,) float32: dx, dy, dz m over one control period, gripper opening
    expected_distance: float  # px, mean over objects, where the plan is predicted to end
    current_distance: float  # px, mean over objects, before it
    planning_ms: float
    actions: np.ndarray  # (HORIZON, 4) the whole sequence
    elites: np.ndarray  # (E, HORIZON, 4) the best ones that were considered
    places: np.ndarray  # (K, 2) m, of the table cells nearest to the goals
    cost: float  # what the search minimised: px, summed over objects and time
    memory: Memory  # for the next plan


class VisualMPC:
    """
    The planner. It keeps nothing: the same scene, goal and memory give the same plan.

    :param model: MapModel.
    :param config: VisualMPCConfig.
    """

    def __init__(self, model: MapModel, config: VisualMPCConfig | None = None) -> None:
        self.model, self.config = model, config or VisualMPCConfig()
        on_cpu = model.device.type == 'cpu'  # a GPU predicts all samples at once
        self.rollouts = Rollouts(
            model, self.config.batch_size if on_cpu else self.config.search.num_samples,
            self.config.threads)
        self._points = model.table_points().cpu().numpy()

    @classmethod
    def load(cls, path: str | Path, config: VisualMPCConfig | None = None,
             device: torch.device | str = 'cpu') -> Self:
        """
        Load the forward model's weights.

        :param path: safetensors file of kind 'forward_model'.
        :raises WeightsError: for a file that is missing, damaged or of another kind.
        """
        return cls(load_forward_model(path, device), config)

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (height, width) of the pictures it takes."""
        return self.model.image_size

    @torch.inference_mode()
    def goal(self, pixels: ArrayLike | None = None, maps: ArrayLike | None = None) -> Goal:
        """Tabulate a goal, given as pixels (K, 2) or as maps (K, H, W), see goals.tabulate."""
        return tabulate(self.model, pixels, maps)

    @torch.inference_mode()
    def plan(self, scene: Scene, goal: Goal, memory: Memory = Memory(),
             limits: Limits = FULL) -> Plan:
        """
        Choose the next action.

        :param memory: of the plan before.
        :param limits: of the actions.
        :raises PlanningError: for a scene that cannot be planned in.
        """
        begin, scene = time.perf_counter(), check_scene(scene, self.image_size)
        if len(goal) != len(scene.object_pixels):
            raise PlanningError(f'goal: {len(goal)} goals for {len(scene.object_pixels)} objects; '
                                'give one for each object, in the same order')
        maps = self.model.seed_maps(torch.from_numpy(scene.object_pixels).to(self.model.device))
        current = (maps.flatten(1) * goal.distances).sum(1).mean()
        current, weights = to_numpy(current, maps.flatten(1))
        found = memory.found
        if (found is None or found.age >= self.config.replan_every or found.limits != limits
                or not found.goal.equals(goal)):
            found = self._search(scene, maps, weights @ self._points, goal, memory, limits)
        actions, = found.shape.actions(found.parameters[None], scene.gripper[2])
        milliseconds = 1000 * (time.perf_counter() - begin)
        elites = found.shape.actions(found.elites, scene.gripper[2])
        return Plan(actions[0], found.expected_distance, float(current), milliseconds, actions,
                    elites, goal.places, found.cost,
                    Memory(memory.seed, memory.count + 1, found.following()))

    def _search(self, scene: Scene, maps: torch.Tensor, here: np.ndarray, goal: Goal,
                memory: Memory, limits: Limits) -> Found:
        """
        Search the best sequence of actions.

        :param maps: (K, n, n), of the objects on the table; here: (K, 2) m, where they are.
        :return: Found.
        """
        config, gripper, device = self.config, scene.gripper, maps.device
        last = memory.found if config.warm_start else None
        # look once, from where all sequences begin
        shape = config.shape(limits, last.shape.phase if last else 0)
        start = self.model.begin(to_float(scene.image)[None].to(device),
                                 torch.from_numpy(gripper)[None].to(device), config.arm_hidden)
        judge = partial(self.rollouts.judge, start, maps)
        price = prices(goal.distances, config.unfinished)

        # mean over where the gripper begins
        def cost(samples: np.ndarray, grippers: np.ndarray = gripper[None]) -> np.ndarray:
            actions = shape.actions(samples, gripper[2])
            clash = landing_clash(shape.landings(actions, gripper), here, config.clearance)
            costs, _ = judge(price, actions.repeat(len(grippers), 0),
                             np.tile(grippers, (len(samples), 1)), config.cost_every)
            return costs.reshape(len(samples), -1).mean(1) + clash

        # from here and from a little beside
        def recheck(samples: np.ndarray) -> np.ndarray:
            aside = np.random.default_rng([memory.seed, memory.count, 1])
            grippers = np.tile(gripper, (config.recheck, 1))
            grippers[1:, :2] += aside.normal(0, RECHECK_STD, (config.recheck - 1, 2))
            return cost(samples, grippers)

        # search, first of all where pushes are likely and where the last plan led
        rng = np.random.default_rng([memory.seed, memory.count])
        mean, std = shape.first_gaussian()
        proposals = push_proposals(shape, gripper, here, goal.places, config.proposals, rng)
        if last:
            mean, std = last.parameters, WARM_STD * std
            proposals = np.concatenate([proposals, mean[None]])
        clip = partial(shape.clip, least_lift=shape.least_lift(gripper[2]))
        best, best_cost, elites = cem(cost, mean, std, config.search, rng, clip, proposals,
                                      recheck if config.recheck else None)
        actions = shape.actions(best[None], gripper[2])
        _, ends = judge(goal.distances, actions, gripper[None], HORIZON)
        return Found(shape, best, elites, float(ends[0]), best_cost, goal, limits)
