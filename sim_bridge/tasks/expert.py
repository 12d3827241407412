# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The expert that generates the data: a cross-entropy method with the true simulator (App. D).

A sample is one push: go behind an object, come down, push. Samples are rolled out in the true
physics, all at once; the best are refitted; the best push of all is executed and the search begins
anew from where things then lie. The object nearest to the gripper mostly comes first, and is
mostly brought home before the next one is touched. How fast and how far it is pushed, and whether
that succeeds, varies from episode to episode, as the paper's non-deterministic planner gives.
Where the order matters, all orders are tried in the simulator before each push, see push_order.py.
Proposing whole pushes rather than independent displacements is our deviation: a few dozen samples
then suffice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import mujoco
import mujoco.rollout
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.episode_run import carry_out, EpisodeRun
from sim_bridge.tasks.grasp_expert import GraspConfig, run_grasp_episode
from sim_bridge.tasks.pick_and_place import STACK_CONFIG
from sim_bridge.tasks.push_order import find_order
from sim_bridge.tasks.pushes import Moment, Push, push_actions, PushRollouts
from sim_bridge.tasks.stack_expert import run_stack_episode
from sim_bridge.tasks.tasks import Task
from sim_bridge.tasks.timing import draw_share, MORE_FRAMES, timed_plans
from tap_ros.contract import LIFTED, WORKSPACE_HIGH, WORKSPACE_LOW

STILL = 0.002  # m, an object within this of its last place has come to rest
TILT_COST = 0.2  # m, added to a sample that topples an object
MISS = 0.1  # m, at most, from the object's origin to the way of a push at random


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

    :param simulator: Simulator, already reset.
    :param rng: numpy Generator; every whim of this expert comes from it.
    :param config: ExpertConfig.
    :param rollout: mujoco.rollout.Rollout to share between episodes.
    :param misses: share of the pushes that are at random instead of searched.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator, config: ExpertConfig,
                 rollout: mujoco.rollout.Rollout, misses: float = 0.0) -> None:
        self._simulator, self._rng, self._config = simulator, rng, config
        self._misses = misses
        self._rollouts = PushRollouts(simulator, rollout)
        self._goals = simulator.goal().object_poses[:, :3]
        self._num_samples = rng.integers(*config.num_samples, endpoint=True)
        self._preference = rng.uniform(0, config.preference, simulator.task.num_objects)
        self._first = self._nearest(range(simulator.task.num_objects), Moment.of(simulator))

    @property
    def num_objects(self) -> int:
        """Return K."""
        return len(self._goals)

    def undone(self) -> list[int]:
        """Return which objects are not at their goals yet."""
        places = self._simulator.object_poses()[:, :3]
        distances = np.linalg.norm(places - self._goals, axis=1)
        return np.flatnonzero(distances > self._config.done_distance).tolist()

    def next_object(self) -> int | None:
        """
        Choose an object to push: the first in the best order if that matters, else the nearest.

        That is at first the one nearest to where the gripper started, wherever it walked since.

        :return: its number, or None when all are in place.
        """
        todo, now = self.undone(), Moment.of(self._simulator)
        if len(todo) < 2:
            return todo[0] if todo else None
        if self._simulator.task.ordered:
            return find_order(self._rollouts, now, self._goals, todo, self._rng)[0]
        return self._first if self._first in todo else self._nearest(todo, now)

    def _nearest(self, objects: Sequence[int], now: Moment) -> int:
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
            steps = int(self._rng.integers(*self._config.wander, endpoint=True))
        # As fast as it travels: pictures of a slow walk would be easy to predict from the start.
        angles = self._rng.uniform(0, 2 * np.pi, steps)
        lengths = self._rng.uniform(*self._config.travel_speed, steps)
        here = self._simulator.target[:3]
        path = here[:2] + np.cumsum(
            lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 0)
        path = np.clip(path, WORKSPACE_LOW[:2], WORKSPACE_HIGH[:2])
        path = np.concatenate([here[None], np.column_stack([path, np.full(steps, LIFTED)])])
        return np.column_stack([np.diff(path, axis=0), np.zeros(steps)])

    def plan(self, steps_left: int, only: int | None = None,
             part: float = 1.0) -> np.ndarray | None:
        """
        Search for the next push.

        :param steps_left: control periods until the episode ends.
        :param only: the object to be pushed; None: any, mostly next_object.
        :param part: of the way that object is pushed.
        :return: (n, 4) actions, or None when every object is in place.
        """
        now, todo = Moment.of(self._simulator), self.undone()
        first = self.next_object() if only is None else only
        if not todo or first is None:
            return None
        if self._misses and self._rng.random() < self._misses:
            return self._random_push(now, steps_left)
        goals = self._goals
        if only is not None or self._simulator.task.ordered:
            todo = [first]
            goals = goals.copy()
            goals[first] = now.places[first] + part * (goals[first] - now.places[first])
        distances = np.linalg.norm(now.places - goals, axis=1)
        best_cost, best = np.inf, None
        mean = spread = None
        for _ in range(self._config.num_iterations):
            pushes = self._sample(todo, now.places, goals, mean, spread)
            plans = [push_actions(push, now.target, now.places[k, :2], goals[k, :2])[:steps_left]
                     for k, push in pushes]
            costs = self._costs(now, plans, goals, distances, first)
            if self._rng.random() < self._config.explore:
                return plans[0]
            order = np.argsort(costs, kind='stable')[:self._config.num_elites]
            if costs[order[0]] < best_cost:
                best_cost, best = costs[order[0]], plans[order[0]]
            # Refit to the elites that push the same object as the best one does.
            same = [i for i in order if pushes[i][0] == pushes[order[0]][0]]
            parameters = np.array([astuple(pushes[i][1])[:4] for i in same])
            todo = [pushes[order[0]][0]]
            mean, spread = parameters.mean(0), parameters.std(0) + [0.08, 0.006, 0.01, 0.005]
        return best

    def _random_push(self, now: Moment, steps_left: int) -> np.ndarray:
        """
        Aim at any object from anywhere, then go on low, in other directions or back.

        So that objects are hit, grazed and missed, and the gripper leaves them without lifting.
        """
        rng, config = self._rng, self._config
        k = rng.integers(self.num_objects)
        push = Push(
            rng.uniform(0, 2 * np.pi), rng.uniform(-MISS, MISS), rng.uniform(-0.1, 0.05),
            rng.uniform(*config.push_speed), rng.uniform(*config.travel_speed))
        actions = push_actions(push, now.target, now.places[k, :2], self._goals[k, :2])
        here = now.target[:3] + actions[:, :3].sum(0)
        path = [here]
        for _ in range(rng.integers(1, 4)):
            angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*config.push_speed)
            step = speed * np.array([np.cos(angle), np.sin(angle), 0])
            path += [path[-1] + i * step for i in range(1, rng.integers(2, 6))]
        path = np.clip(path, WORKSPACE_LOW, WORKSPACE_HIGH)
        further = np.column_stack([np.diff(path, axis=0), np.zeros(len(path) - 1)])
        return np.concatenate([actions, further])[:steps_left]

    def _sample(self, todo: Sequence[int], places: np.ndarray, goals: np.ndarray,
                mean: np.ndarray | None, spread: np.ndarray | None) -> list[tuple[int, Push]]:
        """Draw objects and pushes of them."""
        rng, config = self._rng, self._config
        pushes = []
        for _ in range(self._num_samples):
            k = int(rng.choice(todo))
            if mean is None or spread is None:
                gap = goals[k, :2] - places[k, :2]
                parameters = np.array([
                    np.arctan2(gap[1], gap[0]) + rng.normal(0, 0.35), rng.normal(0, 0.025),
                    rng.normal(0, 0.03), rng.uniform(*config.push_speed)])
            else:
                parameters = rng.normal(mean, spread)
                parameters[3] = np.clip(parameters[3], *config.push_speed)
            angle, offset, overshoot, speed = parameters
            travel_speed = rng.uniform(*config.travel_speed)
            pushes.append((k, Push(angle, offset, overshoot, speed, travel_speed)))
        return pushes

    def _costs(self, now: Moment, plans: Sequence[np.ndarray], goals: np.ndarray,
               distances: np.ndarray, first: int) -> np.ndarray:
        """Roll all plans out in the true simulator; return (N,) metres."""
        moments, upright = self._rollouts(now, plans)
        ends = np.linalg.norm(np.array([m.places for m in moments]) - goals, axis=-1)  # (N, K)
        costs = ends.sum(1) + TILT_COST * (~upright).sum(1)
        costs += self._config.step_cost * np.array([len(plan) for plan in plans])
        untouched = np.abs(ends - distances) < 0.005
        return costs + (untouched * self._preference).sum(1) + self._config.nearest * untouched[
            :, first]


# Corrections would move the bottleneck; an object that has arrived is left alone.
TIMED_CONFIG = ExpertConfig(
    num_samples=(16, 24), explore=0.03, done_distance=0.035, travel_speed=(0.07, 0.08))


def default_config(task: Task, timing: str = 'natural') -> ExpertConfig | GraspConfig:
    """Return what the expert of a task does unless it is told otherwise."""
    if timing != 'natural':
        return TIMED_CONFIG
    if task.kind == 'stack':
        return STACK_CONFIG
    return GraspConfig() if task.gripping else ExpertConfig()


def run_episode(
        simulator: Simulator, seed: int, config: ExpertConfig | GraspConfig | None = None,
        rollout: mujoco.rollout.Rollout | None = None, num_frames: int = 0,
        timing: str = 'natural', misses: float = 0.0) -> EpisodeRun:
    """
    Run one episode of the expert, from the first motion of the arm to the last of an object.

    Tasks with a grasp go to grasp_expert.py, where episodes are all equally long, and to
    stack_expert.py, where they end with the release of the last block.

    :param simulator: Simulator.
    :param seed: of the scene and of the expert.
    :param config: ExpertConfig, or GraspConfig for a task with a grasp; None: default_config.
    :param rollout: mujoco.rollout.Rollout to share between episodes, or None.
    :param num_frames: of the longest episode; 0: the task's, with a timing MORE_FRAMES more.
    :param timing: one of timing.TIMINGS, when the first of several pushed objects is home.
    :param misses: share of the pushes that are at random, so that objects are missed, too.
    :return: EpisodeRun.
    """
    task = simulator.task
    if task.gripping:
        assert config is None or isinstance(config, GraspConfig)
        run = run_stack_episode if task.kind == 'stack' else run_grasp_episode
        return run(simulator, seed, config, rollout, num_frames)
    assert config is None or isinstance(config, ExpertConfig)
    natural = timing == 'natural'
    num_frames = num_frames or task.num_frames + (0 if natural else MORE_FRAMES)
    first = simulator.reset(seed)
    rng = np.random.default_rng([seed, task.stream, 1])
    expert = Expert(simulator, rng, config or (ExpertConfig() if natural else TIMED_CONFIG),
                    rollout or mujoco.rollout.Rollout(nthread=0), misses)
    plans = (_plans(expert, num_frames) if natural else
             timed_plans(expert, draw_share(timing, rng), num_frames, rng))
    observations, actions, outcome, seconds = carry_out(simulator, first, plans, num_frames)
    length = _last_motion(np.array([o.object_poses[:, :3] for o in observations])) + 1
    done = np.concatenate([actions[:length - 1], np.zeros((1, 4), np.float32)])
    return observations[:length], done, outcome, seconds


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
