# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Pushing in any order: scenes, goals, and the expert that generates the data (App. D).

The rules of the scenes are those of the paper's authors (their cartgripper environment): object
origins within 0.35 m of the middle, starts at least 0.35 m apart (0.3 m with three objects), every
goal exactly 0.2 m from its start and at least 0.2 m from the other goals, yaw changed by at most
0.2 rad. Doing nothing therefore ends 20 cm from the goals.

The expert is a cross-entropy method with the true simulator. A sample is one push: go behind an
object, come down, push. Samples are rolled out in the true physics, all at once; the best are
refitted; the best push of all is executed and the search begins anew from where things then lie.
The object nearest to the gripper mostly comes first, and is mostly brought home before the next
one is touched. How fast and how far it is pushed, and whether that succeeds, varies from episode
to episode, as the paper's non-deterministic planner gives. Proposing whole pushes rather than
independent displacements is our deviation: a few dozen samples then suffice.

Timing says when the bottleneck comes: the first object is home, the others are untouched. The
expert makes it late by wandering before its first push, and early by interrupting the second one:
it pushes an object a part of the way, wanders, and comes back. Everything it does is done in the
simulator; no picture is moved in time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sim_bridge.tasks.pushes import (
    after_plans,
    draw_share,
    find_order,
    Moment,
    Push,
    push_actions,
    TILT_COST,
    timed_plans,
)
from sim_bridge.tasks.tasks import (
    apart,
    carry_out,
    DemonstrationOptions,
    EpisodeRun,
    moves,
    Task,
    TaskScene,
)
from sim_bridge.world.scene import random_shape
from sim_bridge.world.table import GRIPPER_HEIGHT, GRIPPER_MARGIN, GRIPPER_RANGE, lifted, Table
from sim_bridge.world_protocol import Observation
from tap_ros.base.contract import LIFTED, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.base.search import cross_entropy

OBJECT_RANGE = 0.35  # m, |x| and |y| of object origins at start and goal
GOAL_DISTANCE = 0.2  # m from start to goal of every object that is pushed
GOAL_YAW_RANGE = 0.2  # rad
GOAL_SEPARATION = 0.2  # m between goals
GRIPPER_NEAR = 0.2  # m, at most, to the object that is pushed first
STILL = 0.002  # m, an object within this of its last place has come to rest
MISS = 0.1  # m, at most, from the object's origin to the way of a push at random
MORE_FRAMES = 40  # that an episode may have beyond its task's, so that there is time to wander


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
        hand = gripper_beside_one(rng, starts)
        return TaskScene(shapes, start_poses, goal_poses, hand,
                         tuple(nearest_first(hand[:2], starts, goals)))

    def goal_gripper(self, table: Table, scene: TaskScene) -> np.ndarray:
        """Return where the gripper touches the object that it has pushed to its goal last."""
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        k = scene.order[-1]
        along = (goals[k] - starts[k]) / np.linalg.norm(goals[k] - starts[k])
        with table.unmoved():
            for behind in np.arange(0.04, 0.16, 0.005):
                gripper = np.append(goals[k] - behind * along, 0.01)
                table.place(lifted(scene.goal_poses), gripper)
                if not table.touching():
                    break
        return gripper

    def demonstrate(self, table: Table, scene: TaskScene, first: Observation,
                    rng: np.random.Generator, how: DemonstrationOptions) -> EpisodeRun:
        """Push, from the first motion of the arm to the last of an object."""
        natural = how.timing == 'natural'
        num_frames = how.num_frames or self.num_frames + (0 if natural else MORE_FRAMES)
        expert = Expert(self, table, rng, ExpertConfig() if natural else TIMED_CONFIG, how.misses)
        plans = (_plans(expert, num_frames) if natural else
                 timed_plans(expert, draw_share(how.timing, rng), num_frames, rng))
        observations, actions, outcome = carry_out(
            table, self.succeeds, first, plans, num_frames)
        length = _last_motion(np.array([o.object_poses[:, :3] for o in observations])) + 1
        done = np.concatenate([actions[:length - 1], np.zeros((1, 4), np.float32)])
        return observations[:length], done, outcome


PUSH2 = PushTask('push2', num_objects=2, num_frames=50, stream=2, start_separation=0.35)
PUSH3 = PushTask('push3', num_objects=3, num_frames=85, stream=3, start_separation=0.3)


def gripper_beside_one(rng: np.random.Generator, positions: np.ndarray) -> np.ndarray:
    """
    Draw a place of the gripper that touches no object and is near one of them.

    So the start picture tells which object is pushed first, also where a goal picture with the
    arm elsewhere does not tell which was last.

    :param rng: numpy Generator.
    :param positions: (K, 2) object origins in metres, at least GRIPPER_MARGIN apart.
    :return: (3,) metres.
    """
    while True:
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(GRIPPER_MARGIN, GRIPPER_NEAR)
        xy = positions[rng.integers(len(positions))] + distance * np.array(
            [np.cos(angle), np.sin(angle)])
        away = np.linalg.norm(positions - xy, axis=1)
        if (away >= GRIPPER_MARGIN).all() and (np.abs(xy) <= GRIPPER_RANGE).all():
            return np.append(xy, rng.uniform(0, GRIPPER_HEIGHT))


def nearest_first(hand: np.ndarray, starts: np.ndarray, goals: np.ndarray) -> list[int]:
    """
    Order objects as the expert mostly takes them: always the one nearest to the gripper.

    :param hand: (2,) metres, where the gripper is; starts (K, 2), goals (K, 2) of the objects.
    :return: list of K object indices.
    """
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
        angles = rng.uniform(0, 2 * np.pi, len(starts))
        goals = starts + GOAL_DISTANCE * np.column_stack([np.cos(angles), np.sin(angles)])
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


class Expert:
    """
    Plans pushes for one episode.

    :param task: PushTask.
    :param table: Table with its scene.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param config: ExpertConfig.
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
        self.first = self.nearest(range(task.num_objects), Moment.of(table))

    @property
    def num_objects(self) -> int:
        """Return K."""
        return len(self.goals)

    def undone(self) -> list[int]:
        """Return which objects are not at their goals yet."""
        places = self.table.object_poses()[:, :3]
        distances = np.linalg.norm(places - self.goals, axis=1)
        return np.flatnonzero(distances > self._config.done_distance).tolist()

    def next_object(self) -> int | None:
        """
        Choose an object to push: the first in the best order, or `first`, then the nearest.

        :return: its number, or None when all are in place.
        """
        todo, now = self.undone(), Moment.of(self.table)
        if len(todo) < 2:
            return todo[0] if todo else None
        if self._task.ordered:
            return find_order(self.table, now, self.goals, todo, self.rng)[0]
        return self.first if self.first in todo else self.nearest(todo, now)

    def nearest(self, objects: Sequence[int], now: Moment) -> int:
        """Return the object nearest to the gripper."""
        here = np.linalg.norm(now.places[list(objects), :2] - now.target[:2], axis=1)
        return objects[int(here.argmin())]

    def wander(self, steps: int | None = None) -> np.ndarray:
        """
        Plan to rise and walk about at random, for example before the first push.

        Without it, the middle of most episodes is where one object is in place and the other
        untouched, and a prediction for a fixed time finds that bottleneck nearly always.

        :param steps: control periods; None: drawn.
        :return: (steps, 4) actions.
        """
        if steps is None:
            steps = int(self.rng.integers(*self._config.wander, endpoint=True))
        # As fast as it travels: pictures of a slow walk would be easy to predict from the start.
        angles = self.rng.uniform(0, 2 * np.pi, steps)
        lengths = self.rng.uniform(*self._config.travel_speed, steps)
        here = self.table.target[:3]
        path = here[:2] + np.cumsum(
            lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 0)
        path = np.clip(path, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
        return moves([here, *np.column_stack([path, np.full(steps, LIFTED)])])

    def plan(self, steps_left: int, only: int | None = None,
             part: float = 1.0) -> np.ndarray | None:
        """
        Search for the next push.

        :param steps_left: control periods until the episode ends.
        :param only: the object to be pushed; None: any, mostly next_object.
        :param part: of the way that object is pushed.
        :return: (n, 4) actions, or None when every object is in place.
        """
        now, todo = Moment.of(self.table), self.undone()
        first = self.next_object() if only is None else only
        if not todo or first is None:
            return None
        if self._misses and self.rng.random() < self._misses:
            return self._random_push(now, steps_left)
        goals = self.goals
        if only is not None or self._task.ordered:
            todo = [first]
            goals = goals.copy()
            goals[first] = now.places[first] + part * (goals[first] - now.places[first])
        config, rng = self._config, self.rng

        def actions_of(sample: np.ndarray) -> np.ndarray:
            k = int(sample[0])
            return push_actions(Push(*sample[1:]), now.target, now.places[k, :2],
                                goals[k, :2])[:steps_left]

        def cost(samples: np.ndarray) -> np.ndarray:
            costs = self._costs(now, [actions_of(sample) for sample in samples], goals, first)
            if rng.random() < config.explore:
                costs[0] = -np.inf  # whatever comes of it
            return costs

        best, _ = cross_entropy(
            lambda elites: self._sample(todo, now.places, goals, elites), cost,
            config.num_iterations, config.num_elites)
        return actions_of(best[0])

    def _random_push(self, now: Moment, steps_left: int) -> np.ndarray:
        """
        Aim at any object from anywhere, then go on low, in other directions or back.

        So that objects are hit, grazed and missed, and the gripper leaves them without lifting.
        """
        rng, config = self.rng, self._config
        k = rng.integers(self.num_objects)
        push = Push(
            rng.uniform(0, 2 * np.pi), rng.uniform(-MISS, MISS), rng.uniform(-0.1, 0.05),
            rng.uniform(*config.push_speed), rng.uniform(*config.travel_speed))
        actions = push_actions(push, now.target, now.places[k, :2], self.goals[k, :2])
        here = now.target[:3] + actions[:, :3].sum(0)
        path = [here]
        for _ in range(rng.integers(1, 4)):
            angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*config.push_speed)
            step = speed * np.array([np.cos(angle), np.sin(angle), 0])
            path += [path[-1] + i * step for i in range(1, rng.integers(2, 6))]
        further = moves(np.clip(path, WORKSPACE_LOW, WORKSPACE_HIGH))
        return np.concatenate([actions, further])[:steps_left]

    def _sample(self, todo: Sequence[int], places: np.ndarray, goals: np.ndarray,
                elites: np.ndarray | None) -> np.ndarray:
        """
        Draw (N, 6): objects, and pushes of them.

        :param elites: pushes like those of the object that the best one pushes; None: others.
        """
        rng, config = self.rng, self._config
        if elites is not None:
            todo = [int(elites[0, 0])]
            near = elites[elites[:, 0] == todo[0], 1:5]
            mean, spread = near.mean(0), near.std(0) + [0.08, 0.006, 0.01, 0.005]
        samples = []
        for _ in range(self._num_samples):
            k = int(rng.choice(todo))
            if elites is None:
                gap = goals[k, :2] - places[k, :2]
                push = np.array([
                    np.arctan2(gap[1], gap[0]) + rng.normal(0, 0.35), rng.normal(0, 0.025),
                    rng.normal(0, 0.03), rng.uniform(*config.push_speed)])
            else:
                push = rng.normal(mean, spread)
                push[3] = np.clip(push[3], *config.push_speed)
            samples.append([k, *push, rng.uniform(*config.travel_speed)])
        return np.array(samples)

    def _costs(self, now: Moment, plans: Sequence[np.ndarray], goals: np.ndarray,
               first: int) -> np.ndarray:
        """Roll all plans out in the true simulator; return (N,) metres."""
        moments, upright = after_plans(self.table, now, plans)
        ends = np.linalg.norm(np.array([m.places for m in moments]) - goals, axis=-1)  # (N, K)
        costs = ends.sum(1) + TILT_COST * (~upright).sum(1)
        costs += self._config.step_cost * np.array([len(plan) for plan in plans])
        untouched = np.abs(ends - np.linalg.norm(now.places - goals, axis=1)) < 0.005
        return costs + (untouched * self._preference).sum(1) + self._config.nearest * untouched[
            :, first]


# Corrections would move the bottleneck; an object that has arrived is left alone.
TIMED_CONFIG = ExpertConfig(
    num_samples=(16, 24), explore=0.03, done_distance=0.035, travel_speed=(0.07, 0.08))


def _plans(expert: Expert, num_frames: int) -> Iterator[np.ndarray]:
    """Yield a walk, then pushes until all objects are in place."""
    plan: np.ndarray | None = expert.wander()
    steps_left = num_frames - 1
    while plan is not None:
        yield plan
        steps_left -= len(plan)
        plan = expert.plan(steps_left)


def _last_motion(positions: np.ndarray) -> int:
    """Return the first frame from which on no object moves; positions (T, K, 3) metres."""
    away = np.linalg.norm(positions - positions[-1], axis=-1).max(1) > STILL
    moving = np.flatnonzero(away)
    return min(moving[-1] + 1, len(positions) - 1) if len(moving) else len(positions) - 1
