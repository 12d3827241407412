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

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
import math
import os
from pathlib import Path
import time
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import LOW
from tap_ros.base.errors import PlanningError
from tap_ros.base.plugins import load_plugin
from tap_ros.base.search import finite
from tap_ros.images.pixels import to_float
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
from tap_ros.planning.cost import PlanCost
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.mpc_inputs import check_scene, Goal, Scene, tabulate
from tap_ros.planning.protocols import ForwardModel, Problem, Solution, Solver
import torch

WARM_STD = 0.5  # share of the first deviation that a search around the last plan begins with
SHORT = 0.02  # m; a descent of which more is missing has met something,
STILL = 0.9  # or of which this share is, where the arm comes down in small steps
MOVED = 1.0  # px, from where an object was
RECHECK_STD = 0.01  # m, from the gripper to the places from which elites are judged once more


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
    places: np.ndarray  # (K, 2) m, of the table cells nearest to the goals
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
        Load a learned forward model's weights.

        :param path: safetensors file of kind 'forward_model'.
        :raises WeightsError: for a file that is missing, damaged or of another kind.
        """
        return cls(LearnedForwardModel.load(path, device), config)

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (height, width) of the pictures it takes."""
        return self.model.table.image_size

    def goal(self, pixels: ArrayLike | None = None, maps: ArrayLike | None = None) -> Goal:
        """Tabulate a goal, given as pixels (K, 2) or as maps (K, H, W), see tabulate."""
        return self.rollouts.compute(tabulate, self.model.table, pixels, maps)

    @torch.inference_mode()
    def plan(self, scene: Scene, goal: Goal, memory: Memory = Memory(),
             limits: Limits = FULL, seconds: float = math.inf) -> Plan:
        """
        Choose the next action.

        :param memory: of the plan before.
        :param limits: of the actions.
        :param seconds: that it may take. The search then ends early, with the best so far; at
            least as many samples are judged as are at once.
        :raises PlanningError: for a scene that cannot be planned in.
        """
        limit, begin = TimeLimit(seconds), time.perf_counter()
        scene = check_scene(scene, self.image_size)
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
        actions, *elites = shape.actions(parameters, gripper[2])
        _, (end,) = self.rollouts.judge(
            start, goal.distances, actions[None], gripper[None], HORIZON)
        milliseconds = 1000 * (time.perf_counter() - begin)
        left, *kept = map(shift, parameters)
        return Plan(actions[0], float(end), milliseconds, actions,
                    np.array(elites), goal.places, found.cost, num_samples,
                    Memory(memory.seed, memory.count + 1, left, np.array(kept),
                           (float(gripper[2]), float(gripper[2] + actions[0, 2])), blocked))

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
            actions = shape.actions(samples, gripper[2])
            clash = self.cost.of_landings(landings(actions, gripper), here, blocked)
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


class TimeIsOver(Exception):
    """Ends the search of a solver."""


class TimeLimit:
    """
    Lets the parts of a search begin that will end in time, judged by the longest so far.

    :param seconds: from now on.
    :ivar over: whether a part was left out.
    """

    def __init__(self, seconds: float = math.inf) -> None:
        self._end, self._longest, self.over = time.perf_counter() + seconds, -math.inf, False

    def run(self, part: Callable[[], Any]) -> Any:
        """Return what a part returns, None if it is left out; those are run that begin at once."""
        begin = time.perf_counter()
        if self.over or begin + self._longest > self._end:
            self.over = True
            return None
        found = part()
        self._longest = max(self._longest, time.perf_counter() - begin)
        return found


@dataclass(frozen=True)
class Start:
    """What all sequences of a plan begin with."""

    maps: torch.Tensor  # (K, n, n) of the objects now
    features: Any  # from ForwardModel.begin
    limit: TimeLimit = field(default_factory=TimeLimit)


class Rollouts:
    """
    Carries object maps along action sequences and says what these cost.

    :param model: ForwardModel; cost: PlanCost.
    :param batch_size: sequences predicted at once, at most.
    :param threads: on the CPU; 0: as many as there are cores. Each computes alone: so the bits
        of a plan do not depend on how many threads torch is given.
    """

    def __init__(self, model: ForwardModel, cost: PlanCost, batch_size: int,
                 threads: int = 0) -> None:
        self.model, self.cost, self.batch_size = model, cost, batch_size
        # Each thread predicts whole batches: operators split among threads would wait for each
        # other at every one of some thousand small steps, and for anything else that runs.
        self._pool = ThreadPoolExecutor(
            (threads or len(os.sched_getaffinity(0))) if model.table.device.type == 'cpu' else 1,
            initializer=torch.set_num_threads, initargs=(1,))

    def compute(self, function: Callable[..., Any], *args: Any) -> Any:
        """Return what a function of tensors returns, computed in one of the threads."""
        return self._pool.submit(torch.inference_mode()(function), *args).result()

    def judge(self, start: Start, prices: torch.Tensor, actions: np.ndarray,
              grippers: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Judge action sequences by PlanCost.of_maps.

        :param start: Start; what its limit leaves out is NaN.
        :param prices: (K, n n) px, of an object in each table cell.
        :param actions: numpy (N, HORIZON, 4); grippers (N, 4), where each sequence begins.
        :param every: look at the maps after every so many steps.
        :return: numpy costs (N,) float64, rounded to 0.01 px; prices at the end (N,).
        """
        size = -(-len(actions) // -(-len(actions) // self.batch_size))  # as even as can be

        @torch.inference_mode()
        def judge(actions: torch.Tensor,
                  grippers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            count = len(actions)  # the last part is filled up: all go the same way
            actions, grippers = (torch.cat([t, t[-1:].expand(size - count, *t.shape[1:])])
                                 for t in (actions, grippers))
            carried = self.model.carried_maps(
                start.features, grippers, start.maps, actions, every)
            costs, ends = self.cost.of_maps(carried, prices)
            return costs[:count], ends[:count]

        # together with others that come down as late: up there, nothing needs to be predicted
        heights = grippers[:, 2:3] + actions[..., 2].cumsum(1)
        order = np.argsort((heights > LOW + 0.01).sum(1), kind='stable')
        back = np.argsort(order)
        parts = list(zip(*(torch.from_numpy(values[order]).to(prices.device).split(size)
                           for values in (actions, grippers))))
        # the part of the last sequence first: solvers put proposals there, such as the last plan
        queue = sorted(range(len(parts)), key=lambda i: i != back[-1] // size)
        running = {i: self._pool.submit(start.limit.run, partial(judge, *parts[i])) for i in queue}
        found = [running[i].result() or prices.new_full((2, len(part[0])), torch.nan).unbind()
                 for i, part in enumerate(parts)]
        costs, ends = to_numpy(*map(torch.cat, zip(*found)))
        # rounded so that the batch size, which moves the last bits, cannot change the ranking
        return costs[back].astype(np.float64).round(2), ends[back]


def to_numpy(*tensors: torch.Tensor) -> list[np.ndarray]:
    """Bring tensors of one type to numpy in one trip, for each of which a GPU would wait."""
    joined = torch.cat([tensor.flatten() for tensor in tensors]).cpu().numpy()
    ends = np.cumsum([tensor.numel() for tensor in tensors])
    return [part.reshape(tensor.shape) for part, tensor in zip(np.split(joined, ends), tensors)]
