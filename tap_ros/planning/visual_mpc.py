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
from tap_ros.errors import ConfigError, ImageError, PlanningError
from tap_ros.images import check_image, to_float
from tap_ros.planning.action_sequences import SequenceShape
from tap_ros.planning.cem import cem, CEMConfig
from tap_ros.planning.forward_model import load_forward_model
from tap_ros.planning.proposals import push_proposals
import torch


@dataclass(frozen=True)
class VisualMPCConfig:
    """
    Settings of the planner. The default is what does best; PAPER is the paper's.

    :param search: settings of the search; 200 samples, 3 iterations, 10 elites.
    :param segments: displacements of a sequence; repeat: control periods of each.
    :param std_move: m per control period, of x and y in the first Gaussian; move_limit their clip.
    :param push_limit: m per control period while the gripper is low, so that pushes are like the
        recorded ones; upright: go up and down without moving sideways, like them.
    :param clearance: m from any object's pixel to where the gripper may come down.
    :param max_lift: segments, at most, that the gripper travels lifted before it goes down.
    :param last_weight: weight of the horizon's last step in the cost; the others have 1.
    :param unfinished: px, extra cost of an object that is not yet within 3 px of its goal, so
        that one is brought home before the next is begun: each change costs a long way.
    :param warm_start: begin with the last plan, carried on by one control period.
    :param warm_std: share of std_move that the warm-started search begins with.
    :param proposals: how many first samples are pushes aimed at the objects, see proposals.py.
    :param arm_hidden: the arm is not in the pictures.
    :param cost_every: the cost looks at every so many steps; 1: at all of them.
    :param batch_size: samples predicted at once; threads: on the CPU. Both change the speed only.
    """

    search: CEMConfig = CEMConfig()
    segments: int = 5
    repeat: int = 3
    std_move: float = 0.04
    move_limit: float = 0.08
    push_limit: float = 0.05
    upright: bool = True
    clearance: float = 0.1
    max_lift: int = 4
    last_weight: float = 10.0
    unfinished: float = 4.0
    warm_start: bool = True
    warm_std: float = 0.5
    proposals: int = 80
    arm_hidden: bool = False
    cost_every: int = 3
    batch_size: int = 50
    threads: int = 0  # 0: as many as there are cores

    def __post_init__(self):
        for name in ('segments', 'repeat', 'batch_size'):
            if getattr(self, name) < 1:
                raise ConfigError(f'{name}: expected at least 1, got {getattr(self, name)}')
        if self.cost_every < 1 or self.segments * self.repeat % self.cost_every:
            raise ConfigError(f'cost_every: expected a divisor of the horizon '
                              f'{self.segments * self.repeat}, got {self.cost_every}')
        if not 0 <= self.max_lift < self.segments:
            raise ConfigError(
                f'max_lift: expected 0..{self.segments - 1} (segments - 1), got {self.max_lift}')
        if not 0 <= self.proposals <= self.search.num_samples:
            raise ConfigError(f'proposals: expected 0..{self.search.num_samples} '
                              f'(num_samples), got {self.proposals}')


NEAR = 3.0  # px

# 0.08 m std and 0.16 m clip in the paper are for actions of 1 s; ours last 0.25 s.
PAPER = VisualMPCConfig(
    warm_start=False, proposals=0, cost_every=1, push_limit=0.08, upright=False,
    clearance=0.0, unfinished=0.0)
PRESETS = {'default': VisualMPCConfig(), 'paper': PAPER}


@dataclass(frozen=True)
class Plan:
    """What the planner decided."""

    action: np.ndarray  # (4,) float32: dx, dy, dz m over one control period, gripper opening
    expected_distance: float  # px, mean over objects, where the plan is predicted to end
    current_distance: float  # px, mean over objects, before it
    planning_ms: float
    actions: np.ndarray  # (horizon, 4) the whole sequence


class VisualMPC:
    """
    The planner. Deterministic: the same seed and inputs give the same actions.

    :param model: ForwardModel.
    :param config: VisualMPCConfig.
    """

    def __init__(self, model, config=None):
        self.model = model
        self.config = config or VisualMPCConfig()
        # Each thread predicts whole batches: operators split among threads would wait for each
        # other at every one of some thousand small steps, and for anything else that runs.
        threads = self.config.threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(
            threads if next(model.parameters()).device.type == 'cpu' else 1,
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
        self._seed, self._count, self._last = seed, 0, None
        self._shape = SequenceShape(
            config.segments, config.repeat, 0, config.move_limit, config.max_lift,
            config.push_limit, config.upright)

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
        gripper, objects = self._check(image, gripper, object_pixels)
        distance = self._goal_distance(goal_maps, goal_pixels, len(objects))  # (K, n n)
        shape = self._shape
        rng = np.random.default_rng([self._seed, self._count])
        device, config = distance.device, self.config
        price = distance + config.unfinished * (distance / NEAR).clamp(max=1)
        state = torch.from_numpy(gripper)[None].to(device)
        features = self.model.begin(to_float(image)[None].to(device), state, config.arm_hidden)
        maps = self.model.seed_maps(torch.from_numpy(objects).to(device))
        current = (maps.flatten(1) * distance).sum(1).mean()

        here = maps.flatten(1).cpu().numpy() @ self._table_points()  # (K, 2) metres

        def cost(samples):
            actions = shape.actions(samples, gripper[2])
            clash = landing_clash(shape.landings(actions, gripper), here, config.clearance)
            return self._cost(features, state, maps, price, actions)[0] + clash

        mean, std = self._first_gaussian(shape)
        proposals = self._propose(shape, gripper, here, distance, rng)
        if self._last is not None:
            proposals = np.concatenate([proposals, self._last[None]])
        clip = partial(shape.clip, least_lift=shape.least_lift(gripper[2]))
        best, _, _ = cem(cost, mean, std, config.search, rng, clip, proposals)
        actions = shape.actions(best[None], gripper[2])
        _, last = self._cost(features, state, maps, distance, actions)
        self._count += 1
        if config.warm_start:
            self._last, self._shape = shape.shift(best), shape.following()
        return Plan(actions[0, 0], float(last[0]), float(current),
                    1000 * (time.perf_counter() - begin), actions[0])

    def _first_gaussian(self, shape):
        """Return mean and deviation (D,): fresh, or around the last plan."""
        config = self.config
        mean, std = np.zeros(shape.size), np.full(shape.size, config.std_move)
        mean[-1], std[-1] = config.max_lift / 2, config.max_lift / 2
        if self._last is not None:
            mean, std = self._last, std * config.warm_std
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

        :param distance: (K, n n) pixels, what each object costs in every table cell.
        :param actions: (N, horizon, 4).
        :return: costs (N,) numpy; expected distance at the horizon's end, px, mean over objects.
        """
        config = self.config

        @torch.inference_mode()
        def judge(part):
            count, total, seen = len(part), 0, 0
            # a fixed batch keeps results the same whatever the number of samples
            part = torch.cat([part, part[-1:].expand(config.batch_size - count, -1, -1)])
            for carried in self.model.carried_maps(
                    features, gripper, maps, part, config.cost_every):
                last = torch.einsum('nkc,kc->nk', carried.flatten(2), distance)
                total, seen = total + last.sum(1), seen + 1
            steps = config.segments * config.repeat
            total = (total - last.sum(1)) * (steps - 1) / max(1, seen - 1)
            return (total + config.last_weight * last.sum(1))[:count], last.mean(1)[:count]

        parts = torch.from_numpy(actions).to(distance.device).split(config.batch_size)
        costs, ends = zip(*self._pool.map(judge, parts))
        # rounded so that the batch size, which moves the last bits, cannot change the ranking
        return torch.cat(costs).cpu().double().numpy().round(3), torch.cat(ends).cpu().numpy()

    def _goal_distance(self, goal_maps, goal_pixels, count):
        """
        Tabulate the distance of every table cell to each goal.

        For a goal map q the distance of a cell x is E_q|x - y|, so that an object map p costs the
        expected distance between the two, E_{p,q}|x - y|.

        :return: (K, n n) pixels.
        """
        if (goal_maps is None) == (goal_pixels is None):
            raise PlanningError('goal: give exactly one of goal_maps and goal_pixels')
        cells = self.model.pixel_table().flatten(0, 1)  # (n n, 2)
        if goal_pixels is not None:
            goals = self._check_pixels(goal_pixels, 'goal_pixels', count)
            return torch.cdist(torch.from_numpy(goals).to(cells.device), cells)
        maps = check_maps(goal_maps, count, self.image_size)
        grid = self.model.pixels.flatten(0, 1)
        weights = torch.from_numpy(maps).flatten(1).to(cells.device)
        weights = weights / weights.sum(1, keepdim=True)
        return weights @ torch.cdist(grid, cells)

    def _check(self, image, gripper, object_pixels):
        """Check what the robot sees; return gripper (4,) and object pixels (K, 2) as float32."""
        try:
            check_image(image, 'image', self.image_size)
        except ImageError as error:
            raise PlanningError(str(error)) from error
        gripper = np.asarray(gripper, np.float32)
        if gripper.shape != (4,) or not np.isfinite(gripper).all():
            raise PlanningError(
                f'gripper: expected 4 finite numbers (x, y, z in m, opening), got {gripper}')
        return gripper, self._check_pixels(object_pixels, 'object_pixels', None)

    def _check_pixels(self, pixels, name, count):
        """Check pixels (K, 2); return them as float32."""
        pixels = np.asarray(pixels, np.float32)
        if pixels.ndim != 2 or pixels.shape[1] != 2 or not len(pixels):
            raise PlanningError(f'{name}: expected shape (K, 2) with K at least 1, '
                                f'got {pixels.shape}')
        if count is not None and len(pixels) != count:
            raise PlanningError(f'{name}: {len(pixels)} goals for {count} objects; '
                                'give one for each object, in the same order')
        if not np.isfinite(pixels).all():
            bad = np.flatnonzero(~np.isfinite(pixels).all(1)).tolist()
            raise PlanningError(f'{name}: unknown (not finite) for objects {bad}; '
                                'plan for known objects only')
        size = np.array(self.image_size[::-1])
        if name == 'goal_pixels' and ((pixels < -0.5) | (pixels > size - 0.5)).any():
            bad = pixels[((pixels < -0.5) | (pixels > size - 0.5)).any(1)].tolist()
            raise PlanningError(f'{name}: {bad} outside the {size[0]}x{size[1]} picture')
        return pixels


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


def check_maps(maps, count, size):
    """
    Check goal maps (K, H, W); return them as float32.

    :raises PlanningError: for a wrong shape, negative or not finite values, or an empty map.
    """
    maps = np.asarray(maps, np.float32)
    if maps.shape != (count, *size):
        raise PlanningError(f'goal_maps: expected shape {(count, *size)} (one map for each '
                            f'object), got {maps.shape}')
    mass = maps.sum((1, 2))
    if not np.isfinite(maps).all() or (maps < 0).any() or (mass <= 0).any():
        raise PlanningError('goal_maps: expected finite values of at least 0 and a positive sum '
                            f'for each object, got sums {mass.tolist()}')
    return maps


def with_preset(name, **changes):
    """
    Return a preset with changes.

    :raises ConfigError: for an unknown preset.
    """
    if name not in PRESETS:
        raise ConfigError(f'preset {name!r} is unknown; valid presets: {", ".join(PRESETS)}')
    return replace(PRESETS[name], **changes)
