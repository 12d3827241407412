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
from tap_ros.base.contract import GOAL_TOLERANCE
from tap_ros.base.errors import ConfigError
from tap_ros.planning.action_sequences import gripper_after
from tap_ros.planning.cost import distances_to_all_pixels
from tap_ros.planning.mpc_config import SWITCHES
from tap_ros.planning.visual_mpc import Goal, Plan, Scene, VisualMPC

if TYPE_CHECKING:
    from tap_ros.messages.subgoals import Subgoal

AFTER_PUSH = 1.5  # times as far a subgoal is reached in the step after a push


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
        gaps = self.distances(pixels)
        return float(gaps.mean() if self.free is None else gaps[~self.free].mean())

    def distances(self, pixels: ArrayLike) -> np.ndarray:
        """Return the distance (K,) of each object, in pixels, see distance."""
        pixels = np.asarray(pixels, np.float32)
        if self.maps is None:
            return np.asarray(np.linalg.norm(pixels - self.pixels, axis=1))
        edges = np.clip(pixels, 0, np.array(self.maps.shape[:0:-1], np.float32) - 1)
        outside = np.linalg.norm(pixels - edges, axis=1)
        return outside + [
            cv2.remap(table, edge[:1, None], edge[1:, None], cv2.INTER_LINEAR).item()
            for table, edge in zip(self._excess, edges, strict=True)]

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


@dataclass(frozen=True)
class Itinerary:
    """
    Say at every step what to plan to.

    Target i of n lasts until step (i + 1) B / n at most.

    :param targets: of hierarchy.Target, the last one is the goal.
    :param step_budget: B.
    :param switch: 'half': a target gets its whole share of the budget; 'reached': goes on to the
        next one as soon as it is reached.
    :param reached: px of Target.distance; nearer than this is there. 0: never.
    """

    targets: Sequence[Target]
    step_budget: int
    switch: str = 'reached'
    reached: float = GOAL_TOLERANCE

    def __post_init__(self) -> None:
        if self.switch not in SWITCHES:
            raise ConfigError(f'switch {self.switch!r} is unknown; expected one of {SWITCHES}')

    def stage(self, step: int, pixels: np.ndarray, stage: int = 0, lifted: bool = False) -> int:
        """
        Return the index of the target of this step.

        :param step: control periods that have passed.
        :param pixels: (K, 2), where the objects are.
        :param stage: of the step before.
        :param lifted: the hand has just risen after a push. A subgoal is then reached from
            AFTER_PUSH times as far: coming back for the rest costs more commands than it is worth.
        """
        reached = self.reached * (AFTER_PUSH if lifted else 1)
        while stage < len(self.targets) - 1:
            late = step >= (stage + 1) * self.step_budget // len(self.targets)
            if not late and (self.switch == 'half'
                             or not self.targets[stage].distance(pixels) <= reached):
                break
            stage += 1
        return stage


def targets_by(subgoals: Iterable['Subgoal'], pixels: np.ndarray,
               goal_pixels: np.ndarray) -> list[Target]:
    """
    Return the Targets of a way to the goal.

    :param subgoals: list of prediction.predictor.Subgoal to pass by, earliest first; may be empty.
    :param pixels: (K, 2), where the objects are now.
    :param goal_pixels: (K, 2), the last target.
    """
    passed = [Target(s.expected_pixels, s.object_maps) for s in subgoals]
    return [*(_decided(target, pixels, goal_pixels) for target in passed), Target(goal_pixels)]


def _decided(target: Target, pixels: np.ndarray, goal_pixels: np.ndarray) -> Target:
    """
    Return a subgoal that says which objects go first.

    One whose maps are undecided is reached where the objects are, before anything was pushed.
    Those go first that may as well be at their goals by it; the others stay.
    """
    if target.distance(pixels) > GOAL_TOLERANCE:
        return target
    first = target.distances(goal_pixels) <= GOAL_TOLERANCE
    return Target(np.where(first[:, None], goal_pixels, pixels).astype(np.float32))


def choose_sample(mpc: VisualMPC, scene: Scene, goal_pixels: np.ndarray,
                  subgoals: Iterable['Subgoal'],
                  plan: Callable[[Scene, Goal], Plan]) -> list['Subgoal']:
    """
    Take the predicted subgoals of one sample: those whose legs the planner expects to cost least.

    A leg goes to the first subgoal from what is seen, then from each predicted picture to the next
    target, the arm standing where the plan before left it.

    :param scene: visual_mpc.Scene, what is seen now.
    :param goal_pixels: (K, 2).
    :param subgoals: of any samples, earliest first in each.
    :param plan: makes the plan of a leg, by `mpc`; what it raises ends the choice.
    :return: those of the sample taken, earliest first; the first of equals.
    """
    def cost(chain: list['Subgoal']) -> float:
        total, now = 0.0, scene
        for subgoal in [*chain, None]:
            leg = plan(now, mpc.goal(goal_pixels) if subgoal is None
                       else mpc.goal(maps=subgoal.object_maps))
            total += leg.cost
            if subgoal is not None:
                hand = gripper_after(now.gripper, leg.actions)
                now = Scene(subgoal.image, hand, subgoal.expected_pixels)
        return total

    samples: dict[int, list[Subgoal]] = {}
    for subgoal in subgoals:
        samples.setdefault(subgoal.sample, []).append(subgoal)
    chains = list(samples.values())
    return chains[0] if len(chains) == 1 else min(chains, key=cost)
