# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a task is: how its scenes are drawn, its goal, and its expert.

push.py, order.py, grasp.py and stack.py have a family each. Another package adds a task by the
entry points 'tap_ros.tasks'; their names stand for Task objects.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from sim_bridge.tasks.motions import EpisodeRun
from sim_bridge.world.protocol import Observation
from sim_bridge.world.scene import ObjectShape
from sim_bridge.world.table import Table
from tap_ros.base.contract import SUCCESS_DISTANCE, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.base.errors import ConfigError, SceneError
from tap_ros.base.plugins import load_plugin, names

Place = tuple[float, float, float]
TIMINGS = ('natural', 'early', 'middle', 'late', 'mixed')  # of bottlenecks, see push.py


class TaskScene(NamedTuple):
    """What follows from the seed of a scene of K objects; planar poses are x, y (m), yaw (rad)."""

    shapes: tuple[ObjectShape, ...]
    start_poses: np.ndarray  # (K, 3)
    goal_poses: np.ndarray  # (K, 3)
    gripper_start: np.ndarray  # (3,) m
    order: tuple[int, ...]  # objects, as they should be moved; the last one is moved last


@dataclass(frozen=True)
class DemonstrationOptions:
    """
    How an expert is to act.

    :param num_frames: of the longest episode; 0: the task's.
    :param timing: one of TIMINGS, when the first of several pushed objects is home.
    :param misses: share of the pushes that are at random, so that objects are missed, too.
    """

    num_frames: int = 0
    timing: str = 'natural'
    misses: float = 0.0


@dataclass(frozen=True)
class Task(ABC):
    """
    A kind of episode.

    :param name: by which it is asked for.
    :param num_objects: K.
    :param num_frames: of the longest episode, one a control period.
    :param stream: of random numbers, besides the seed; no two tasks have the same.
    :cvar kind: 'push', 'grasp', 'pick_place', 'stack' or another family.
    :cvar gripping: whether the gripper has to hold the object.
    :cvar ordered: whether the wrong order of pushes makes it hard.
    :cvar photographed: the goal of a recorded episode is a picture of where its objects ended,
        with the arm elsewhere; else its last frame.
    """

    name: str
    num_objects: int
    num_frames: int
    stream: int
    kind: ClassVar[str] = ''
    gripping: ClassVar[bool] = False
    ordered: ClassVar[bool] = False
    photographed: ClassVar[bool] = True

    @abstractmethod
    def draw(self, rng: np.random.Generator, spread: float) -> TaskScene:
        """Draw a scene; spread is a factor of the ranges in which things to be gripped lie."""

    @property
    def goal_heights(self) -> float | np.ndarray:
        """Return how high above the table the goals are, m, or (K,) of each object."""
        return 0.0

    def goal_gripper(self, table: Table, scene: TaskScene) -> np.ndarray | None:
        """
        Return where the arm is seen in the goal picture: (3,) m, or (4,) with its opening.

        :param table: with the objects at their start; it may be moved and is put back.
        :return: None: somewhere beside the objects.
        """
        return None

    def succeeds(self, table: Table) -> bool:
        """Return whether every object is within SUCCESS_DISTANCE of its goal."""
        return bool((table.distances() < SUCCESS_DISTANCE).all())

    @abstractmethod
    def demonstrate(self, table: Table, scene: TaskScene, first: Observation,
                    rng: np.random.Generator, how: DemonstrationOptions) -> EpisodeRun:
        """Let the expert act from the start of a scene, of which `first` is seen."""


def task_names() -> list[str]:
    """Return the names of all tasks."""
    return names('tap_ros.tasks')


def get_task(name: str) -> Task:
    """
    Look up a task.

    :raises SceneError: for an unknown name.
    """
    try:
        return load_plugin('tap_ros.tasks', name)
    except ConfigError as error:
        raise SceneError(str(error)) from error


def sample_scene(task: Task, seed: int, spread: float = 1.0, low: Place = WORKSPACE_LOW,
                 high: Place = WORKSPACE_HIGH) -> TaskScene:
    """
    Draw shapes, starts, goals and the gripper's start.

    :param task: Task.
    :param seed: non-negative integer; the same seed gives the same scene.
    :param spread: factor of the ranges in which an object to be gripped, its goal and the gripper
        lie.
    :param low: x, y, z in m of what the arm reaches, least; high: greatest. Scenes are drawn until
        starts, places to push from, goals and the gripper are within.
    :return: TaskScene.
    :raises SceneError: for a seed that is negative or not an integer.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SceneError(f'seed {seed!r}: expected a non-negative integer')
    rng = np.random.default_rng([int(seed), task.stream])
    while True:
        scene = task.draw(rng, spread)
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        needed = np.concatenate(
            [starts, starts - (goals - starts) / 2, goals, scene.gripper_start[None, :2]])
        if (needed >= low[:2]).all() and (needed <= high[:2]).all():
            return scene


def run_episode(simulator: Any, seed: int, num_frames: int = 0, timing: str = 'natural',
                misses: float = 0.0) -> EpisodeRun:
    """
    Run one episode of a task's expert.

    :param simulator: Simulator; reset here.
    :param seed: of the scene and of the expert.
    :param num_frames: and the others: see DemonstrationOptions.
    """
    task, first = simulator.task, simulator.reset(seed)
    return task.demonstrate(simulator, simulator.scene, first,
                            np.random.default_rng([seed, task.stream, 1]),
                            DemonstrationOptions(num_frames, timing, misses))


def apart(positions: np.ndarray, separation: float) -> bool:
    """Return whether all pairs of positions (K, 2) are at least so far apart."""
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return (gaps[np.triu_indices(len(positions), 1)] >= separation).all()
