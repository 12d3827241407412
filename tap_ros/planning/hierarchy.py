# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hierarchical planning: one target after another, the goal last (App. F of the paper).

The paper has one subgoal and switches at half the budget ('half'). Switching as soon as the
subgoal is reached ('reached') wastes no steps. Several subgoals share the budget equally.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike
from tap_ros.contract import GOAL_TOLERANCE
from tap_ros.errors import ConfigError
from tap_ros.planning.action_sequences import FULL, gripper_after, Limits
from tap_ros.planning.cost import distances_to_all_pixels
from tap_ros.planning.mpc_config import SWITCHES
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.visual_mpc import Memory, VisualMPC

if TYPE_CHECKING:
    from tap_ros.messages.subgoals import Subgoal


@dataclass(frozen=True)
class Target:
    """
    Where objects should be.

    :param pixels: (K, 2) (u, v), for a map its mean.
    :param maps: (K, H, W) object maps that the planner takes instead of the pixels, or None.
    :param free: (K,) bool, objects that should stay wherever they are; None: no object.
    """

    pixels: np.ndarray
    maps: np.ndarray | None = None
    free: np.ndarray | None = None

    def distance(self, pixels: ArrayLike) -> float:
        """
        Return how far the objects at pixels (K, 2) are, in pixels, mean over those not free.

        To a map it is what the planner minimises, the expected distance, less the least that it
        can be anywhere in the picture. An object whose map is evenly undecided between two places
        is thus there in either: waiting until it is half way would be waiting for nothing.
        """
        pixels = np.asarray(pixels, np.float32)
        if self.maps is None:
            gaps = np.linalg.norm(pixels - self.pixels, axis=1)
        else:
            edges = np.clip(pixels, 0, np.array(self.maps.shape[:0:-1], np.float32) - 1)
            gaps = np.linalg.norm(pixels - edges, axis=1)  # of those outside
            gaps = [gap + cv2.remap(table, edge[:1, None], edge[1:, None], cv2.INTER_LINEAR).item()
                    for gap, table, edge in zip(gaps, self._excess, edges, strict=True)]
        return float(np.mean(gaps) if self.free is None else np.asarray(gaps)[~self.free].mean())

    @cached_property
    def _excess(self) -> np.ndarray:
        """Return the expected distance (K, H, W) of each pixel to the maps, less the least."""
        tables = distances_to_all_pixels(np.asarray(self.maps, np.float32))
        return tables - tables.min((1, 2), keepdims=True)

    def goal(self, pixels: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arguments of VisualMPC.goal, for objects that are at pixels (K, 2)."""
        if self.maps is not None:
            return {'maps': self.maps}
        if self.free is None:
            return {'pixels': self.pixels}
        return {'pixels': np.where(self.free[:, None], pixels, self.pixels)}


class Itinerary:
    """
    Say at every step what to plan to.

    Target i of n lasts until step (i + 1) B / n at most.

    :param targets: list of Target, the last one is the goal.
    :param step_budget: B.
    :param switch: 'half': a target gets its whole share of the budget; 'reached': goes on to the
        next one as soon as it is reached.
    :param reached: px of Target.distance; nearer than this is there. 0: never.
    :ivar switches: steps at which the second, third ... target began; may be set back.
    """

    def __init__(self, targets: Iterable[Target], step_budget: int, switch: str = 'reached',
                 reached: float = GOAL_TOLERANCE) -> None:
        if switch not in SWITCHES:
            raise ConfigError(f'switch {switch!r} is unknown; expected one of {SWITCHES}')
        self._targets, self._budget = list(targets), step_budget
        self._switch, self._reached = switch, reached
        self.switches: tuple[int, ...] = ()

    def target(self, step: int, pixels: np.ndarray) -> Target:
        """
        Return the Target of this step.

        :param step: control periods that have passed.
        :param pixels: (K, 2), where the objects are.
        """
        while (stage := len(self.switches)) < len(self._targets) - 1:
            late = step >= (stage + 1) * self._budget // len(self._targets)
            there = (self._switch != 'half'
                     and self._targets[stage].distance(pixels) <= self._reached)
            if not late and not there:
                break
            self.switches += step,
        return self._targets[len(self.switches)]


def targets_by(subgoals: Iterable['Subgoal'], goal_pixels: np.ndarray) -> list[Target]:
    """
    Return the Targets of a way to the goal.

    :param subgoals: list of prediction.predictor.Subgoal to pass by, earliest first; may be empty.
    :param goal_pixels: (K, 2), the last target.
    """
    return [*(Target(s.expected_pixels, s.object_maps) for s in subgoals), Target(goal_pixels)]


def choose_sample(mpc: VisualMPC, scene: Scene, goal_pixels: np.ndarray,
                  subgoals: Iterable['Subgoal'], seed: int = 0, limits: Limits = FULL,
                  before_plan: Callable[[], object] | None = None) -> list['Subgoal']:
    """
    Take the predicted subgoals of one sample; of several samples by choose_subgoals.

    :param subgoals: list of prediction.predictor.Subgoal of any samples, earliest first in each.
    :return: those of the sample taken, earliest first. The other parameters are choose_subgoals'.
    """
    samples: dict[int, list[Subgoal]] = {}
    for subgoal in subgoals:
        samples.setdefault(subgoal.sample, []).append(subgoal)
    chains = list(samples.values())
    if len(chains) == 1:
        return chains[0]
    best, _ = choose_subgoals(mpc, scene, goal_pixels, chains, seed, limits, before_plan)
    return chains[best]


def choose_subgoals(mpc: VisualMPC, scene: Scene, goal_pixels: np.ndarray,
                    candidates: Sequence[Sequence['Subgoal']], seed: int = 0,
                    limits: Limits = FULL,
                    before_plan: Callable[[], object] | None = None) -> tuple[int, np.ndarray]:
    """
    Choose among sampled subgoals by what the planner itself expects them to cost.

    The cost of a chain of subgoals is what the planner minimises, summed over its legs: to the
    first subgoal from what is seen, then from each predicted picture to the next target, the arm
    standing where the plan before left it.

    :param mpc: VisualMPC.
    :param scene: mpc_inputs.Scene, what is seen now.
    :param goal_pixels: (K, 2).
    :param candidates: list of lists of prediction.predictor.Subgoal, earliest first.
    :param seed: of the planner; limits: of its actions.
    :param before_plan: called before every plan; what it raises ends the choice.
    :return: index of the candidate of least cost, the first of equals; costs (N,).
    """
    costs, goal = [], mpc.goal(goal_pixels)
    for chain in candidates:
        seen, total = scene, 0.0
        for subgoal in [*chain, None]:
            if before_plan is not None:
                before_plan()
            target = goal if subgoal is None else mpc.goal(maps=subgoal.object_maps)
            plan = mpc.plan(seen, target, Memory(seed), limits)
            total += plan.cost
            if subgoal is not None:
                hand = gripper_after(seen.gripper, plan.actions)
                seen = Scene(subgoal.image, hand, subgoal.expected_pixels)
        costs.append(total)
    return int(np.argmin(costs)), np.array(costs)
