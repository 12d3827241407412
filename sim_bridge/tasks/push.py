# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushing in any order: scenes, goals, and the expert that generates the data (App. D).

The rules of the scenes are those of the paper's authors (their cartgripper environment). Every
goal is 0.2 m from its start: doing nothing ends 20 cm from the goals.

The expert is a cross-entropy method with the true simulator. A sample is one push: go behind an
object, come down, push. All are rolled out in the true physics, the best are refitted, the best of
all is executed, and the search begins anew. The object nearest to the gripper mostly comes first,
and is mostly brought home before the next one is touched. How fast and how far it is pushed, and
whether that succeeds, varies from episode to episode, as the paper's non-deterministic planner
gives. Whole pushes rather than independent displacements are our deviation: a few dozen suffice.

Timing says when the bottleneck comes: the first object is home, the others are untouched. The
expert makes it late by wandering before its first push, and early by interrupting the second one:
it pushes an object a part of the way, wanders, and comes back.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sim_bridge.tasks.motions import (
    after_plans,
    carry_out,
    direction,
    EpisodeRun,
    Moment,
    moves,
    Push,
    push_actions,
)
from sim_bridge.tasks.tasks import apart, DemonstrationOptions, Task, TaskScene
from sim_bridge.world.protocol import Observation
from sim_bridge.world.scene import random_shape
from sim_bridge.world.table import GRIPPER_HEIGHT, GRIPPER_MARGIN, GRIPPER_RANGE, lifted, Table
from tap_ros.base.contract import LIFTED, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.base.search import cross_entropy

OBJECT_RANGE = 0.35  # m, |x| and |y| of object origins at start and goal
GOAL_DISTANCE = 0.2  # m from start to goal of every object that is pushed
GOAL_YAW_RANGE = 0.2  # rad
GOAL_SEPARATION = 0.2  # m between goals
GRIPPER_NEAR = 0.2  # m, at most, to the object that is pushed first
STILL = 0.002  # m, an object within this of its last place has come to rest
MISS = 0.1  # m, at most, from the object's origin to the way of a push at random
TILT_COST = 0.2  # m, of an object that topples
SHARES = {'early': (0.2, 0.35), 'middle': (0.4, 0.6), 'late': (0.7, 0.85)}  # of the episode
MORE_FRAMES = 40  # that an episode may have beyond its task's, so that there is time to wander
# Control periods that things take, about:
PUSH = 14  # a push, from wherever the gripper is,
GAP = 9  # of these until the object is touched,
AGAIN = 3  # on average, pushes that have to be repeated
RETURN = 6  # to leave an object and come back to it
DETOUR = 16  # a push is interrupted once for so many


@dataclass(frozen=True)
class PushTask(Task):
    """
    Push every object to its goal.

    :param start_separation: m between object origins at the start.
    """

    start_separation: float
    kind: ClassVar[str] = 'push'
    object_range: ClassVar[float] = OBJECT_RANGE  # m, largest |x| and |y| at start and goal

    def draw(self, rng: np.random.Generator, spread: float) -> TaskScene:
        """Draw separated starts and goals, and the gripper beside one object."""
        shapes = tuple(random_shape(rng) for _ in range(self.num_objects))
        # Separated starts may leave no room for separated goals: then both are drawn anew.
        goals = None
        while goals is None:
            starts = rng.uniform(-OBJECT_RANGE, OBJECT_RANGE, (self.num_objects, 2))
            if apart(starts, self.start_separation):
                goals = _draw_goals(rng, starts)
        start_poses, goal_poses = with_yaws(rng, starts, goals)
        # The gripper touches no object and is near one, so that the start picture tells which is
        # pushed first, also where a goal picture with the arm elsewhere does not tell the last.
        hand = starts[0]
        while np.linalg.norm(starts - hand, axis=1).min() < GRIPPER_MARGIN or (
                np.abs(hand) > GRIPPER_RANGE).any():
            angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(GRIPPER_MARGIN, GRIPPER_NEAR)
            hand = starts[rng.integers(len(starts))] + distance * direction(angle)
        return TaskScene(shapes, start_poses, goal_poses,
                         np.append(hand, rng.uniform(0, GRIPPER_HEIGHT)),
                         tuple(nearest_first(hand, starts, goals)))

    def goal_gripper(self, table: Table, scene: TaskScene) -> np.ndarray:
        """Return where the gripper touches the object that it has pushed to its goal last."""
        start, goal = (poses[scene.order[-1], :2]
                       for poses in (scene.start_poses, scene.goal_poses))
        along = (goal - start) / np.linalg.norm(goal - start)
        with table.unmoved():
            for behind in np.arange(0.04, 0.16, 0.005):
                gripper = np.append(goal - behind * along, 0.01)
                table.place(lifted(scene.goal_poses), gripper)
                if not table.touching():
                    break
        return gripper

    def next_object(self, expert: 'Expert', todo: Sequence[int]) -> int:
        """Return which of the objects that are not in place yet, two at least, is pushed next."""
        return expert.first if expert.first in todo else expert.nearest(todo)

    def demonstrate(self, table: Table, scene: TaskScene, first: Observation,
                    rng: np.random.Generator, how: DemonstrationOptions) -> EpisodeRun:
        """Push, from the first motion of the arm to the last of an object."""
        natural = how.timing == 'natural'
        num_frames = how.num_frames or self.num_frames + (0 if natural else MORE_FRAMES)
        expert = Expert(self, table, rng, ExpertConfig() if natural else TIMED_CONFIG, how.misses)
        seen, actions, outcome = carry_out(
            table, self.succeeds, first,
            expert.plans(num_frames) if natural else expert.timed_plans(how.timing, num_frames),
            num_frames)
        places = np.array([one.object_poses[:, :3] for one in seen])  # (T, K, 3)
        moving = np.flatnonzero(np.linalg.norm(places - places[-1], axis=-1).max(1) > STILL)
        length = moving[-1] + 2 if len(moving) else len(seen)
        done = np.concatenate([actions[:length - 1], np.zeros((1, 4), np.float32)])
        return seen[:length], done, outcome


PUSH2 = PushTask('push2', num_objects=2, num_frames=50, stream=2, start_separation=0.35)
PUSH3 = PushTask('push3', num_objects=3, num_frames=85, stream=3, start_separation=0.3)


def nearest_first(hand: np.ndarray, starts: np.ndarray, goals: np.ndarray) -> list[int]:
    """Return objects as the expert mostly takes them: always the nearest to the gripper (2,)."""
    order, left = [], list(range(len(starts)))
    while left:
        k = min(left, key=lambda i: np.linalg.norm(starts[i] - hand))
        left.remove(k)
        order.append(k)
        hand = goals[k]
    return order


def with_yaws(rng: np.random.Generator, starts: np.ndarray,
              goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw any yaw at the start, and one near it at the goal; (K, 3) each."""
    yaws = rng.uniform(0, 2 * np.pi, len(starts))
    goal_yaws = yaws + rng.uniform(-GOAL_YAW_RANGE, GOAL_YAW_RANGE, len(starts))
    return np.column_stack([starts, yaws]), np.column_stack([goals, goal_yaws])


def _draw_goals(rng: np.random.Generator, starts: np.ndarray) -> np.ndarray | None:
    """Draw a goal at the fixed distance from each start; None when there seems to be no room."""
    for _ in range(1000):
        goals = starts + GOAL_DISTANCE * direction(rng.uniform(0, 2 * np.pi, len(starts)))
        if (np.abs(goals) <= OBJECT_RANGE).all() and apart(goals, GOAL_SEPARATION):
            return goals
    return None


@dataclass(frozen=True)
class ExpertConfig:
    """How hard the expert searches, and how it varies."""

    num_samples: tuple[int, int] = (8, 24)  # fewest and most, drawn anew for each episode
    num_iterations: int = 2
    num_elites: int = 5
    explore: float = 0.1  # probability that a random sample is executed instead of the best
    preference: float = 0.04  # m, spread of the whim for pushing one object before another
    nearest: float = 0.3  # m, worth of pushing the first object home before the next one
    step_cost: float = 0.001  # m per control period
    done_distance: float = 0.025  # m, an object this near its goal is left alone
    wander: tuple[int, int] = (5, 10)  # control periods of a random walk before the first push
    travel_speed: tuple[float, float] = (0.06, 0.08)  # m per control period
    push_speed: tuple[float, float] = (0.03, 0.055)


# Corrections would move the bottleneck; an object that has arrived is left alone.
TIMED_CONFIG = ExpertConfig(
    num_samples=(16, 24), explore=0.03, done_distance=0.035, travel_speed=(0.07, 0.08))


class Expert:
    """
    Plans one episode of pushes.

    :param table: Table with a scene of the task.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param misses: share of the pushes that are at random instead of searched.
    :ivar first: the object nearest to where the gripper started, wherever it walked since.
    """

    def __init__(self, task: PushTask, table: Table, rng: np.random.Generator,
                 config: ExpertConfig, misses: float = 0.0) -> None:
        self._task, self.table, self.rng, self._config = task, table, rng, config
        self._misses = misses
        self.goals = table.goal_poses[:, :3]
        self._num_samples = rng.integers(*config.num_samples, endpoint=True)
        self._preference = rng.uniform(0, config.preference, task.num_objects)
        self.first = self.nearest(range(task.num_objects))

    def nearest(self, objects: Sequence[int]) -> int:
        """Return the object nearest to the gripper."""
        places = self.table.object_poses()[list(objects), :2]
        return objects[int(np.linalg.norm(places - self.table.target[:2], axis=1).argmin())]

    def plans(self, num_frames: int) -> Iterator[np.ndarray]:
        """
        Yield a walk, then pushes until all objects are in place.

        Without the walk, the middle of most episodes is where one object is in place and the other
        untouched, and a prediction for a fixed time finds that bottleneck nearly always.

        :param num_frames: at most.
        :return: iterator of (n, 4) actions, each to be carried out before the next is asked for.
        """
        plan: np.ndarray | None = self._wander(
            int(self.rng.integers(*self._config.wander, endpoint=True)))
        steps_left = num_frames - 1
        while plan is not None:
            yield plan
            steps_left -= len(plan)
            plan = self._push(self._next_object(self._undone()), steps_left)

    def timed_plans(self, timing: str, num_frames: int) -> Iterator[np.ndarray]:
        """
        Yield plans after which the bottleneck has come when it shall; see plans.

        :param timing: one of TIMINGS but 'natural'; 'mixed': any of the others.
        """
        rng, count = self.rng, len(self.goals)
        if timing == 'mixed':
            timing = str(rng.choice(list(SHARES)))
        share = rng.uniform(*SHARES[timing])  # of the episode
        before = (count * PUSH + AGAIN) * share - (PUSH + GAP / 2)
        waiting = min(before / (1 - share), num_frames - count * PUSH)
        plan = self._wander(max(round(waiting), int(rng.integers(1, 3))))
        done, detours = 0, list[int]()  # control periods so far, and of the interruptions to come
        current: int | None = None  # the object that is pushed now
        while plan is not None:
            yield plan
            done += len(plan)
            if detours:
                yield (plan := self._wander(detours.pop()))
                done += len(plan)
            todo = self._undone()
            if current not in todo:
                current = self._next_object(todo)
                if count - len(todo) == 1:  # the second push is interrupted, once or several times
                    spare = min((done + GAP / 2) / share, num_frames) - done - (count - 1) * PUSH
                    times = max(round(spare / DETOUR), 1) if spare >= RETURN else 0
                    detours = [max(int(spare / times) - RETURN, 1)] * times if times else []
            plan = self._push(current, num_frames - 1 - done, 1 / (1 + len(detours)))

    def _undone(self) -> list[int]:
        """Return which objects are not at their goals yet."""
        gaps = np.linalg.norm(self.table.object_poses()[:, :3] - self.goals, axis=1)
        return np.flatnonzero(gaps > self._config.done_distance).tolist()

    def _next_object(self, todo: list[int]) -> int | None:
        """Choose an object to push of those that are not in place; None when all are."""
        return self._task.next_object(self, todo) if len(todo) > 1 else todo[0] if todo else None

    def _wander(self, steps: int) -> np.ndarray:
        """Plan to rise and walk about at random for so many control periods."""
        # As fast as it travels: pictures of a slow walk would be easy to predict from the start.
        angles = self.rng.uniform(0, 2 * np.pi, steps)
        lengths = self.rng.uniform(*self._config.travel_speed, steps)
        here = self.table.target[:3]
        path = here[:2] + np.cumsum(lengths[:, None] * direction(angles), 0)
        path = np.clip(path, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
        return moves([here, *np.column_stack([path, np.full(steps, LIFTED)])])

    def _push(self, first: int | None, steps_left: int, part: float = 0) -> np.ndarray | None:
        """
        Search for the next push.

        :param first: the object to be pushed; None: all are in place.
        :param steps_left: control periods until the episode ends.
        :param part: of the way that this object is pushed; 0: all of it, and sometimes another.
        :return: (n, 4) actions, or None when every object is in place.
        """
        if first is None:
            return None
        config, rng, now = self._config, self.rng, Moment.of(self.table)
        if self._misses and rng.random() < self._misses:
            return self._random_push(now, steps_left)
        todo, goals = self._undone(), self.goals
        if part or self._task.ordered:
            todo, goals = [first], goals.copy()
            goals[first] = now.places[first] + (part or 1) * (goals[first] - now.places[first])

        def actions_of(sample: np.ndarray) -> np.ndarray:
            k, push = int(sample[0]), Push(*sample[1:])
            return push_actions(push, now.target, now.places[k, :2], goals[k, :2])[:steps_left]

        def cost(samples: np.ndarray) -> np.ndarray:
            plans = [actions_of(sample) for sample in samples]
            after, topples = after_plans(self.table, now, plans)
            ends = np.linalg.norm(after.places - goals, axis=-1)  # (N, K)
            untouched = np.abs(ends - np.linalg.norm(now.places - goals, axis=1)) < 0.005
            costs = ends.sum(1) + TILT_COST * topples.sum(1)
            costs += config.step_cost * np.array(list(map(len, plans)))
            costs += (untouched * self._preference).sum(1)
            costs += config.nearest * untouched[:, first]
            if rng.random() < config.explore:
                costs[0] = -np.inf  # whatever comes of it
            return costs

        best, _ = cross_entropy(
            lambda elites: self._sample(todo, goals - now.places, elites), cost,
            config.num_iterations, config.num_elites)
        return actions_of(best[0])

    def _random_push(self, now: Moment, steps_left: int) -> np.ndarray:
        """Aim at any object from anywhere, hit, graze or miss it, and go on low, also back."""
        rng, config = self.rng, self._config
        k = rng.integers(len(self.goals))
        push = Push(
            rng.uniform(0, 2 * np.pi), rng.uniform(-MISS, MISS), rng.uniform(-0.1, 0.05),
            rng.uniform(*config.push_speed), rng.uniform(*config.travel_speed))
        actions = push_actions(push, now.target, now.places[k, :2], self.goals[k, :2])
        path = [now.target[:3] + actions[:, :3].sum(0)]
        for _ in range(rng.integers(1, 4)):
            angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*config.push_speed)
            step = speed * np.append(direction(angle), 0)
            path += [path[-1] + i * step for i in range(1, rng.integers(2, 6))]
        further = moves(np.clip(path, WORKSPACE_LOW, WORKSPACE_HIGH))
        return np.concatenate([actions, further])[:steps_left]

    def _sample(self, todo: Sequence[int], gaps: np.ndarray,
                elites: np.ndarray | None) -> np.ndarray:
        """Draw (N, 6): objects and pushes of them; or like elites', of that of the best one."""
        rng, config = self.rng, self._config
        if elites is not None:
            todo = [int(elites[0, 0])]
            near = elites[elites[:, 0] == todo[0], 1:5]
            mean, spread = near.mean(0), near.std(0) + [0.08, 0.006, 0.01, 0.005]
        samples = []
        for _ in range(self._num_samples):
            k = int(rng.choice(todo))
            if elites is None:
                turn, offset, overshoot = rng.normal(0, (0.35, 0.025, 0.03))
                angle = np.arctan2(gaps[k, 1], gaps[k, 0]) + turn
                speed = rng.uniform(*config.push_speed)
            else:
                angle, offset, overshoot, speed = rng.normal(mean, spread)
                speed = np.clip(speed, *config.push_speed)
            samples.append([
                k, angle, offset, overshoot, speed, rng.uniform(*config.travel_speed)])
        return np.array(samples)
