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
import math
from pathlib import Path
import time
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.errors import PlanningError
from tap_ros.base.plugins import load_plugin, names
from tap_ros.base.search import finite
from tap_ros.images.pixels import check_image, check_pixels, in_picture, to_float
from tap_ros.planning.action_sequences import (
    DOWN,
    FULL,
    HORIZON,
    landings,
    Limits,
    MOVES,
    push_proposals,
    SequenceShape,
    shift,
)
from tap_ros.planning.cost import distances_to_places, PlanCost
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import ForwardModel, Problem, Solution, Solver
from tap_ros.planning.rollouts import Rollouts, Start, TimeLimit, to_numpy
import torch

MODELS = 'tap_ros.forward_models'
WARM_STD = 0.5  # share of the first deviation that a search around the last plan begins with
SHORT = 0.02  # m; a descent of which more is missing has met something,
STILL = 0.9  # or of which this share is, where the arm comes down in small steps
MOVED = 1.0  # px, from where an object was
RECHECK_STD = 0.01  # m, from the gripper to the places from which elites are judged once more
# What a gripper over the table can be: x, y, z in metres, opening. Anything else is another unit,
# another frame or nonsense; learned models would answer it with a move all the same.
GRIPPER_LOW = np.array([-1.0, -1.0, -0.1, -0.1], np.float32)
GRIPPER_HIGH = np.array([1.0, 1.0, 1.0, 1.1], np.float32)


class TimeIsOver(Exception):
    """Ends the search of a solver."""


@dataclass(frozen=True)
class Scene:
    """
    What the robot sees.

    :param image: (H, W, 3) uint8 rgb, of the size that the planner takes.
    :param gripper: (4,), x, y, z in metres from the middle of the table, and opening, 0 to 1.
    :param object_pixels: (K, 2), (u, v) of each object.
    """

    image: np.ndarray
    gripper: np.ndarray
    object_pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class Goal:
    """Where K objects should be."""

    distances: torch.Tensor  # (K, n n) px, of every table cell from each object's goal
    places: np.ndarray  # (K, 2) m, the table cells nearest to the goals

    def __len__(self) -> int:
        return len(self.distances)


@dataclass(frozen=True)
class Blocked:
    """A place at which the gripper was sent down and did not get there."""

    place: np.ndarray  # (2,) m
    nearest: int  # object
    pixel: np.ndarray  # (2,), where that object was


@dataclass(frozen=True)
class Memory:
    """
    What one plan leaves to the next; a planner that has not planned yet has Memory(seed).

    :param count: plans so far.
    :param parameters: (D,) of the last plan, carried on by one control period; elites: (E, D).
    :param heights: m, of the gripper before the last action, and where that was to bring it.
    :param blocked: places to keep away from until the object nearest to them has moved.
    """

    seed: int = 0
    count: int = 0
    parameters: np.ndarray | None = None
    elites: np.ndarray | None = None
    heights: tuple[float, float] = (0.0, 0.0)
    blocked: tuple[Blocked, ...] = ()

    def blocked_now(self, scene: Scene, objects: np.ndarray) -> tuple[Blocked, ...]:
        """
        Return the places that are blocked in a scene: those known, and where a descent has ended.

        :param scene: after the last action; objects: (K, 2) m, where the objects are.
        """
        pixels, place, height = scene.object_pixels, scene.gripper[:2], scene.gripper[2]
        known = [one for one in self.blocked if np.linalg.norm(
            pixels[one.nearest] - one.pixel) <= MOVED]
        above, below = self.heights
        descent, missing = above - below, height - below
        if descent > 0 and height > DOWN and missing > min(SHORT, STILL * descent):
            nearest = int(np.linalg.norm(objects - place, axis=1).argmin())
            known.append(Blocked(place, nearest, pixels[nearest]))
        return tuple(known)


@dataclass(frozen=True)
class Plan:
    """What the planner decided."""

    action: np.ndarray  # (4,) float32: dx, dy, dz m over one control period, gripper opening
    expected_distance: float  # px, mean over objects, where the plan is predicted to end
    planning_ms: float
    actions: np.ndarray  # (HORIZON, 4) the whole sequence
    elites: np.ndarray  # (E, HORIZON, 4) the best ones that were considered
    cost: float  # what the search minimised: px, summed over objects and time
    num_samples: int  # that the search judged
    memory: Memory  # for the next plan


class VisualMPC:
    """
    The planner. It keeps nothing: the same scene, goal and memory give the same plan.

    :param cost: PlanCost; None: that of the config.
    :raises ConfigError: for an unknown name of a solver.
    """

    def __init__(self, model: ForwardModel, config: VisualMPCConfig | None = None,
                 cost: PlanCost | None = None) -> None:
        self.model, self.config = model, config or VisualMPCConfig()
        self.cost = cost or PlanCost(self.config.unfinished, self.config.clearance)
        solver = self.config.solver
        self.solver: Solver = (load_plugin('tap_ros.solvers', solver) if isinstance(solver, str)
                               else solver)
        on_cpu = model.table.device.type == 'cpu'  # a GPU predicts all samples at once
        self.rollouts = Rollouts(
            model, self.cost,
            self.config.batch_size if on_cpu else self.config.search.num_samples,
            self.config.threads)
        self._points = model.table.points().cpu().numpy()

    @classmethod
    def load(cls, path: str | Path, config: VisualMPCConfig | None = None,
             device: torch.device | str = 'cpu') -> Self:
        """
        Make a planner with a forward model by name or file.

        :param path: 'push', the shipped one, or a task that it is for; a safetensors file; or
            NAME:ARGUMENT of a forward model of another package, which loads ARGUMENT.
        :param config: of the search; None: the default.
        :param device: where to predict, 'cpu' or 'cuda'.
        :raises WeightsError: for an unknown name, or a file that is missing, damaged or of another
            kind.
        :raises ConfigError: for the name of a predictor.
        """
        name, _, argument = str(path).partition(':')
        if argument and name in names(MODELS):
            return cls(load_plugin(MODELS, name).load(argument, device), config)
        return cls(LearnedForwardModel.load(path, device), config)

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (height, width) of the pictures it takes."""
        return self.model.table.image_size

    def goal(self, pixels: ArrayLike | None = None, maps: ArrayLike | None = None) -> Goal:
        """
        Tabulate a goal once: how far each place on the table is from it.

        For a goal map q the distance is the expected one, so that an object map p costs that
        between the two, E_{p,q}|x - y|. Give exactly one of the two:

        :param pixels: (K, 2) numbers, (u, v) of each object in a picture of image_size.
        :param maps: (K, H, W) numbers of at least 0, one map of positive sum for each object.
        :return: Goal, for plan.
        :raises PlanningError: for goals that cannot be planned to; ImageError: for pixels of
            another shape, or not finite.
        """
        if (maps is None) == (pixels is None):
            raise PlanningError('goal: give exactly one of pixels and maps')
        table, (height, width) = self.model.table, self.image_size
        cells = self.rollouts.compute(table.pixels).flatten(0, 1)
        if maps is None:
            goals, distances_of = check_pixels(pixels, 'goal_pixels'), torch.cdist
            if outside := goals[~in_picture(goals, self.image_size)].tolist():
                raise PlanningError(f'goal_pixels: {outside} outside the {width}x{height} picture')
        else:
            goals, distances_of = np.ascontiguousarray(maps, np.float32), distances_to_places
            if goals.ndim != 3 or goals.shape[1:] != (height, width):
                raise PlanningError(f'goal_maps: expected shape (K, {height}, {width}), one map '
                                    f'for each object, got {goals.shape}')
            mass = goals.sum((1, 2))
            if not np.isfinite(goals).all() or (goals < 0).any() or (mass <= 0).any():
                raise PlanningError('goal_maps: expected finite values of at least 0 and a '
                                    f'positive sum for each object, got sums {mass.tolist()}')
        distances = self.rollouts.compute(
            distances_of, torch.from_numpy(goals).to(cells.device), cells)
        return Goal(distances, self._points[distances.argmin(1).cpu().numpy()])

    @torch.inference_mode()
    def plan(self, scene: Scene, goal: Goal, memory: Memory = Memory(),
             limits: Limits = FULL, seconds: float = math.inf) -> Plan:
        """
        Choose the next action.

        :param scene: what is seen now, of K objects.
        :param goal: of the same objects in the same order, see goal.
        :param memory: of the plan before, Plan.memory; Memory(seed) at first.
        :param limits: of the actions, m in a control period.
        :param seconds: that it may take. The search then ends early, with the best so far; at
            least as many samples are judged as are at once.
        :return: Plan; its action is (4,) float32, dx, dy, dz in m and opening, 0 to 1.
        :raises PlanningError: for a scene that cannot be planned in; ImageError: for its picture
            or pixels.
        """
        limit, begin = TimeLimit(seconds), time.perf_counter()
        scene = checked(scene, self.image_size)
        if len(goal) != len(scene.object_pixels):
            raise PlanningError(f'goal: {len(goal)} goals for {len(scene.object_pixels)} objects; '
                                'give one for each object, in the same order')
        # put each object's map at its pixel, look at the picture
        table, gripper = self.model.table, scene.gripper
        maps = table.seed_maps(torch.from_numpy(scene.object_pixels).to(table.device))
        weights, = to_numpy(maps.flatten(1))
        start = Start(maps, self.rollouts.compute(
            self.model.begin, to_float(scene.image)[None].to(table.device),
            torch.from_numpy(gripper)[None].to(table.device), self.config.arm_hidden))
        # search the sequence of least cost
        shape, here = SequenceShape(limits), weights @ self._points
        blocked = memory.blocked_now(scene, here)
        found, num_samples = self._search(
            shape, replace(start, limit=limit), gripper, here, goal,
            replace(memory, blocked=blocked))
        # say where it ends; its first action is the answer
        parameters = np.concatenate([found.best[None], found.elites])
        actions, *elites = shape.actions(parameters, gripper)
        _, (end,) = self.rollouts.judge(
            start, goal.distances, actions[None], gripper[None], HORIZON)
        left, *kept = map(shift, parameters)
        return Plan(actions[0], float(end), 1000 * (time.perf_counter() - begin), actions,
                    np.array(elites), found.cost, num_samples,
                    Memory(memory.seed, memory.count + 1, left, np.array(kept),
                           (float(gripper[2]), float(gripper[2] + actions[0, 2])), blocked))

    @staticmethod
    def aside(gripper: np.ndarray, distance: float, memory: Memory, limits: Limits) -> Plan:
        """Go straight up, by no object's place; distance: px, the Plan's expected_distance."""
        actions = SequenceShape(limits).rise(gripper)
        return Plan(actions[0], distance, 0.0, actions, actions[None], math.nan, 0,
                    Memory(memory.seed, memory.count + 1, blocked=memory.blocked))

    def _search(self, shape: SequenceShape, start: 'Start', gripper: np.ndarray,
                here: np.ndarray, goal: Goal, memory: Memory) -> tuple[Solution, int]:
        """
        Search the parameters of least cost; return how many were judged, too.

        :param here: (K, 2) m, where the objects are.
        """
        config, prices = self.config, self.cost.prices(goal.distances)
        judged: list[tuple[np.ndarray, np.ndarray]] = []  # samples, costs
        blocked = np.array([one.place for one in memory.blocked]).reshape(-1, 2)

        # mean over where the gripper begins
        def cost(samples: np.ndarray, grippers: np.ndarray = gripper[None]) -> np.ndarray:
            actions = shape.actions(samples, gripper)
            clash = self.cost.of_landings(
                landings(actions, gripper), here, blocked, shape.limits)
            costs, _ = self.rollouts.judge(
                start, prices, actions.repeat(len(grippers), 0),
                np.tile(grippers, (len(samples), 1)), config.cost_every)
            return costs.reshape(len(samples), -1).mean(1) + clash

        # a solver need not know of time: its search is left, with what it has tried
        def cost_in_time(samples: np.ndarray) -> np.ndarray:
            judged.append((samples, cost(samples)))
            if start.limit.over:
                raise TimeIsOver
            return judged[-1][1]

        # from here and from a little beside
        def recheck(samples: np.ndarray) -> np.ndarray:
            aside = np.random.default_rng([memory.seed, memory.count, 1])
            grippers = np.tile(gripper, (config.recheck, 1))
            grippers[1:, :2] += aside.normal(0, RECHECK_STD, (config.recheck - 1, 2))
            return cost(samples, grippers)

        # first of all where pushes are likely, and where the last plan led
        rng = np.random.default_rng([memory.seed, memory.count])
        mean, std = shape.first_gaussian()
        proposals = push_proposals(shape, gripper, here, goal.places, config.proposals, rng)
        if config.warm_start and memory.parameters is not None:
            mean, std = memory.parameters, WARM_STD * std
            proposals = np.concatenate([proposals, mean[None]])
        problem = Problem(
            cost_in_time, mean, std,
            partial(shape.clip, least_lift=shape.least_lift(gripper[2])), proposals,
            memory.elites if config.warm_start else None, MOVES,
            recheck if config.recheck else None)
        try:
            solution = self.solver(problem, config.search, rng)
        except TimeIsOver:
            samples, costs = map(np.concatenate, zip(*judged))
            first = np.argsort(finite(costs), kind='stable')[:config.search.num_elites]
            solution = Solution(samples[first[0]], float(costs[first[0]]), samples[first])
        return solution, sum(int((~np.isnan(costs)).sum()) for _, costs in judged)


def checked(scene: Scene, size: tuple[int, int]) -> Scene:
    """Return a Scene with numbers as float32 if it can be planned in; see VisualMPC.plan."""
    check_image(scene.image, 'image', size)
    pixels = check_pixels(scene.object_pixels, 'object_pixels')
    if not len(pixels):
        raise PlanningError('object_pixels: no objects; give the position of one at least')
    gripper = np.ascontiguousarray(scene.gripper, np.float32)  # torch takes no flipped views
    if gripper.shape != (4,) or not np.isfinite(gripper).all():
        raise PlanningError(
            f'gripper: expected 4 finite numbers (x, y, z in m, opening), got {gripper}')
    for name, value, low, high in zip(('x', 'y', 'z', 'opening'), gripper, GRIPPER_LOW,
                                      GRIPPER_HIGH):
        if not low <= value <= high:
            raise PlanningError(
                f'gripper: {name} is {value:g}; expected {low:g} to {high:g} (metres from the '
                'middle of the table, opening 0 to 1)')
    return Scene(scene.image, gripper, pixels)
