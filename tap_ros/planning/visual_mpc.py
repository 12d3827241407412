# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Visual MPC: choose the next action by searching through the forward model (App. F of the paper).

At every control period: put each object's map at its pixel, predict where many action sequences
carry the maps, take the one that brings them closest to their goals, execute its first action.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
import os
import time

import numpy as np
from tap_ros.contract import CLIMB_LIMIT, LOW, MOVE_LIMIT
from tap_ros.errors import PlanningError
from tap_ros.images import to_float
from tap_ros.planning.action_sequences import HORIZON, SequenceShape
from tap_ros.planning.cem import cem
from tap_ros.planning.expected_distance import distances_to_places
from tap_ros.planning.forward_model import load_forward_model
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.mpc_inputs import check_goal_pixels, check_maps, check_scene
from tap_ros.planning.proposals import push_proposals
import torch

NEAR = 3.0  # px
LAST_WEIGHT = 10.0  # of the horizon's last step in the cost, as in the paper; the others have 1
WARM_STD = 0.5  # share of the first deviation that a warm-started search begins with
RECHECK_STD = 0.01  # m, from the gripper to where the elites are judged once more


@dataclass(frozen=True)
class Plan:
    """What the planner decided."""

    action: np.ndarray  # (4,) float32: dx, dy, dz m over one control period, gripper opening
    expected_distance: float  # px, mean over objects, where the plan is predicted to end
    current_distance: float  # px, mean over objects, before it
    planning_ms: float
    actions: np.ndarray  # (horizon, 4) the whole sequence
    cost: float  # what the search minimised: px, summed over objects and time


class VisualMPC:
    """
    The planner. Deterministic: the same seed and inputs give the same actions.

    :param model: ForwardModel, or what carries object maps as it does.
    :param config: VisualMPCConfig.
    """

    def __init__(self, model, config=None):
        self.model, config = model, config or VisualMPCConfig()
        if model.grid.device.type != 'cpu':  # a GPU predicts all samples at once
            config = replace(config, batch_size=config.search.num_samples)
        self.config, self._limits = config, (MOVE_LIMIT, CLIMB_LIMIT)
        # Each thread predicts whole batches: operators split among threads would wait for each
        # other at every one of some thousand small steps, and for anything else that runs.
        threads = self.config.threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(
            threads if model.grid.device.type == 'cpu' else 1,
            initializer=torch.set_num_threads, initargs=(1,))
        self.reset(0)

    @classmethod
    def load(cls, path, config=None, device='cpu'):
        """
        Load the forward model's weights.

        :param path: safetensors file of kind 'forward_model'.
        :raises WeightsError: for a file that is missing, damaged or of another kind.
        """
        return cls(load_forward_model(path, device), config)

    @property
    def image_size(self):
        """Return (height, width) of the pictures it takes."""
        return self.model.config.image_size, self.model.config.image_size

    def reset(self, seed=0):
        """Forget the last plan and start the random numbers anew."""
        config = self.config
        self._seed, self._count, self._age = seed, 0, 0
        move, climb = self._limits
        self._first_shape = self._shape = SequenceShape(
            None if config.free_phase else 0, move, min(move, config.push_limit), config.upright,
            climb)
        self._last = self._plan = self._goal = None  # _last: parameters of what is left of _plan

    @property
    def memory(self):
        """Return what one plan leaves to the next; it may be set back, and then gives the same."""
        return self._count, self._age, self._shape, self._last, self._plan, self._goal

    @memory.setter
    def memory(self, memory):
        self._count, self._age, self._shape, self._last, self._plan, self._goal = memory

    def limit(self, move, climb):
        """
        Plan within limits, from the next reset on.

        :param move: m per control period, |x| and |y|; climb: m, |z|; above the contract's
            limits they change nothing.
        """
        self._limits = min(move, MOVE_LIMIT), min(climb, CLIMB_LIMIT)

    @torch.inference_mode()
    def act(self, image, gripper, object_pixels, goal_maps=None, goal_pixels=None):
        """
        Choose the next action.

        :param image: (H, W, 3) uint8.
        :param gripper: (4,) metres and opening.
        :param object_pixels: (K, 2) as (u, v), where the objects are now.
        :param goal_maps: (K, H, W), where they should be, each of positive mass; or
        :param goal_pixels: (K, 2). Exactly one of the two.
        :return: Plan.
        :raises PlanningError: for inputs that cannot be planned with.
        """
        begin = time.perf_counter()
        gripper, objects = check_scene(image, gripper, object_pixels, self.image_size)
        distance = self._goal_distance(goal_maps, goal_pixels, len(objects))  # (K, n n)
        maps = self.model.seed_maps(torch.from_numpy(objects).to(distance.device))
        current = float((maps.flatten(1) * distance).sum(1).mean())
        unchanged = self._goal is not None and torch.equal(self._goal, distance)
        if unchanged and self._age < self.config.replan_every:
            shape, best = self._shape, self._last
            actions = shape.actions(best[None], gripper[2])[0]
            expected, cost = self._plan.expected_distance, self._plan.cost
        else:
            shape = self._shape if self.config.warm_start else self._first_shape
            best, actions, expected, cost = self._search(shape, image, gripper, maps, distance)
            self._age = 0
        self._count, self._age = self._count + 1, self._age + 1
        self._last, self._shape, self._goal = shape.shift(best), shape.following(), distance
        self._plan = Plan(
            actions[0], expected, current, 1000 * (time.perf_counter() - begin), actions, cost)
        return self._plan

    def _search(self, shape, image, gripper, maps, distance):
        """
        Search the best sequence of actions.

        :param shape: SequenceShape; maps (K, n, n) of the objects on the table grid.
        :param distance: (K, n n) px from each table cell to the goals.
        :return: its parameters (D,), actions (horizon, 4), expected distance at its end, cost.
        """
        device, config = distance.device, self.config
        rng = np.random.default_rng([self._seed, self._count])
        price = distance + config.unfinished * (distance / NEAR).clamp(max=1)
        state = torch.from_numpy(gripper)[None].to(device)
        features = self.model.begin(to_float(image)[None].to(device), state, config.arm_hidden)
        here = maps.flatten(1).cpu().numpy() @ self._table_points()  # (K, 2) metres

        def cost(samples, starts=state):
            actions = shape.actions(samples, gripper[2])
            clash = landing_clash(shape.landings(actions, gripper), here, config.clearance)
            costs, _ = self._cost(features, starts.repeat(len(samples), 1), maps, price,
                                  actions.repeat(len(starts), 0))
            return costs.reshape(len(samples), len(starts)).mean(1) + clash

        aside = np.random.default_rng([self._seed, self._count, 1])  # rng draws the same without
        starts = np.tile(gripper, (max(1, config.recheck), 1))
        starts[1:, :2] += aside.normal(0, RECHECK_STD, starts[1:, :2].shape)
        recheck = partial(cost, starts=torch.from_numpy(starts).to(device))
        mean, std = self._first_gaussian(shape)
        proposals = self._propose(shape, gripper, here, distance, rng)
        if config.warm_start and self._last is not None:
            proposals = np.concatenate([proposals, self._last[None]])
        clip = partial(shape.clip, least_lift=shape.least_lift(gripper[2]))
        best, best_cost = cem(cost, mean, std, config.search, rng, clip, proposals,
                                 recheck if config.recheck else None)
        actions = shape.actions(best[None], gripper[2])
        _, ends = self._cost(features, state, maps, distance, actions)
        return best, actions[0], float(ends[0]), best_cost

    def _first_gaussian(self, shape):
        """Return mean and deviation (D,): fresh, or around the last plan."""
        config = self.config
        mean, std = shape.first_gaussian()
        if config.warm_start and self._last is not None:
            mean, std = self._last, std * WARM_STD
        return mean, std

    def _propose(self, shape, gripper, here, distance, rng):
        """Return proposals (P, D) from where objects are (K, 2) to their goals' nearest cells."""
        if not self.config.proposals:
            return np.zeros((0, shape.size))
        goals = self._table_points()[distance.argmin(1).cpu().numpy()]
        return push_proposals(shape, gripper, here, goals, self.config.proposals, rng)

    def _table_points(self):
        """Return the table's cells (n n, 2) in metres."""
        model = self.model
        return (model.grid.flatten(0, 1) * model.config.table_half).cpu().numpy()

    def _cost(self, features, gripper, maps, distance, actions):
        """
        Judge action sequences.

        Cost: each object's expected distance to its goal, summed over objects and over the
        horizon, the last step with its own weight (10, as the authors' planner has).

        :param gripper: (N, 4), where each sequence begins, or (1, 4).
        :param distance: (K, n n) pixels, what each object costs in every table cell.
        :param actions: (N, horizon, 4).
        :return: costs (N,) numpy; expected distance at the horizon's end, px, mean over objects.
        """
        config, worst = self.config, distance.amax(1)
        size = -(-len(actions) // -(-len(actions) // config.batch_size))  # as even as can be

        @torch.inference_mode()
        def judge(part, begin):
            count, total, seen = len(part), 0, 0
            missing = size - count  # the last part is filled up: all go the same way
            part, begin = (torch.cat([t, t[-1:].expand(missing, *t.shape[1:])])
                           for t in (part, begin))
            for carried in self.model.carried_maps(
                    features, begin, maps, part, config.cost_every):
                carried = carried.flatten(2)
                last = torch.einsum('nkc,kc->nk', carried, distance)
                last = last + (1 - carried.sum(2)) * worst  # a lost object is as far as can be
                total, seen = total + last.sum(1), seen + 1
            total = (total - last.sum(1)) * (HORIZON - 1) / max(1, seen - 1)
            return (total + LAST_WEIGHT * last.sum(1))[:count], last.mean(1)[:count]

        # together with others that come down as late: up there, nothing needs to be predicted
        order = np.argsort((actions[..., 2].cumsum(1) + gripper[0, 2].item() > LOW + 0.01).sum(1),
                           kind='stable')
        begins = gripper.expand(len(actions), -1)[torch.from_numpy(order).to(gripper.device)]
        parts = [t.split(size) for t in (
            torch.from_numpy(actions[order]).to(distance.device), begins)]
        costs, ends = map(torch.cat, zip(*self._pool.map(judge, *parts)))
        back = np.argsort(order)
        costs, ends = costs.cpu().double().numpy()[back], ends.cpu().numpy()[back]
        # rounded so that the batch size, which moves the last bits, cannot change the ranking
        return costs.round(2), ends

    def _goal_distance(self, goal_maps, goal_pixels, count):
        """
        Tabulate the distance of every table cell to each goal.

        For a goal map q it is the expected distance, so that an object map p costs that between
        the two, E_{p,q}|x - y|.

        :return: (K, n n) pixels.
        """
        if (goal_maps is None) == (goal_pixels is None):
            raise PlanningError('goal: give exactly one of goal_maps and goal_pixels')
        cells = self.model.pixel_table().flatten(0, 1)  # (n n, 2)
        if goal_pixels is not None:
            goals = check_goal_pixels(goal_pixels, count, self.image_size)
            return torch.cdist(torch.from_numpy(goals).to(cells.device), cells)
        maps = check_maps(goal_maps, count, self.image_size)
        return distances_to_places(torch.from_numpy(maps).to(cells.device), cells)


def landing_clash(landings, objects, clearance):
    """
    Cost of coming down upon an object, which recordings of good pushes do not show.

    :param landings: (N, 2) metres, NaN for none; objects: (K, 2); clearance: m.
    :return: (N,) pixels: 0, or more than any push can gain.
    """
    if not clearance:
        return np.zeros(len(landings))
    gap = np.linalg.norm(landings[:, None] - objects, axis=-1).min(1)  # (N,)
    return np.where(gap < clearance, 100 + 1000 * (clearance - gap), 0)
