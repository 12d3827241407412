# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tasks: how many objects, how many frames, and where starts and goals may lie.

The rules are those of the paper's authors (their cartgripper environment): object origins within
0.35 m of the middle, starts at least 0.35 m apart (0.3 m with three objects), every goal exactly
0.2 m from its start and at least 0.2 m from the other goals, yaw changed by at most 0.2 rad.
Doing nothing therefore ends 20 cm from the goals. Where the order matters, objects stand on the
goals of others, see order_tasks.py.

The tasks with a grasp have one object of a shape that the gripper can hold. To grasp is to lift it
from where it stands; to pick and place is to carry it to a place within 0.2 m of the middle, with
the arm starting about 0.3 m from the object. To stack is to build a tower of blocks on the first
one, see stack_tasks.py.
"""

from dataclasses import dataclass

import numpy as np
from sim_bridge.tasks.order_tasks import draw_chain, draw_shapes, EDGE_RANGE, ORDER_SEPARATION
from sim_bridge.tasks.stack_tasks import BLOCK_SEPARATION, draw_block, draw_blocks
from sim_bridge.world.grasping import grasp_place, graspable_shape, graspable_yaw
from sim_bridge.world.places import (
    apart,
    GOAL_DISTANCE,
    GOAL_YAW_RANGE,
    gripper_beside_one,
    GRIPPER_HEIGHT,
    nearest_first,
    OBJECT_RANGE,
)
from sim_bridge.world.scene import ObjectShape, random_shape
from tap_ros.contract import EPISODE_FRAMES, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.errors import SceneError

GOAL_SEPARATION = 0.2  # m between goals
GRASP_RANGE = 0.2  # m, |x| and |y| of the start of an object to be grasped
GRASP_REACH_RANGE = 0.3  # m, |x| and |y| of the gripper's start before a grasp, all in view
PLACE_RANGE = 0.2  # m, |x| and |y| of the place where a picked object goes
PLACE_DISTANCE = (0.12, 0.36)  # m, from the start of an object to its place
LIFT_HEIGHT = 0.11  # m, of the goal of a grasp
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Task:
    """A kind of episode."""

    name: str
    num_objects: int
    start_separation: float  # m between object origins at the start
    kind: str = 'push'  # or 'grasp', 'pick_place', 'stack'
    reach: tuple[float, float] = (0.0, 0.0)  # m, nearest and farthest start, for grasps
    lift: float = 0.0  # m, height of the goal above the table
    ordered: bool = False  # the wrong order of pushes makes it hard
    stream: int = 0  # of random numbers, besides the seed; no two tasks have the same

    @property
    def num_frames(self) -> int:
        """Number of frames of the longest episode."""
        return EPISODE_FRAMES[self.name]

    @property
    def gripping(self) -> bool:
        """Whether the gripper has to hold the object."""
        return self.kind != 'push'

    @property
    def object_range(self) -> float:
        """Return the largest |x| and |y| in m of objects that are pushed, at start and goal."""
        return EDGE_RANGE[1] if self.ordered else OBJECT_RANGE


TASKS = {
    'push2': Task('push2', num_objects=2, start_separation=0.35, stream=2),
    'push3': Task('push3', num_objects=3, start_separation=0.3, stream=3),
    'order2': Task(
        'order2', num_objects=2, start_separation=ORDER_SEPARATION, ordered=True, stream=6),
    'order3': Task(
        'order3', num_objects=3, start_separation=ORDER_SEPARATION, ordered=True, stream=7),
    'grasp': Task(
        'grasp', num_objects=1, start_separation=0.0, kind='grasp',
        reach=(0.13, 0.32), lift=LIFT_HEIGHT, stream=4),
    'pick_place': Task(
        'pick_place', num_objects=1, start_separation=0.0, kind='pick_place',
        reach=(0.27, 0.33), stream=5),
    'stack2': Task(
        'stack2', num_objects=2, start_separation=BLOCK_SEPARATION, kind='stack', stream=8),
    'stack3': Task(
        'stack3', num_objects=3, start_separation=BLOCK_SEPARATION, kind='stack', stream=9),
}


@dataclass(frozen=True)
class Scene:
    """One draw of a task: planar poses are (x, y, yaw) in metres and radians."""

    task: Task
    seed: int
    shapes: tuple[ObjectShape, ...]
    start_poses: np.ndarray  # (K, 3)
    goal_poses: np.ndarray  # (K, 3)
    gripper_start: np.ndarray  # (3,) m
    order: tuple[int, ...]  # objects, as they should be moved; the last one is moved last


def get_task(name: str) -> Task:
    """
    Look up a task.

    :raises SceneError: for an unknown name.
    """
    if name not in TASKS:
        raise SceneError(f'task {name!r} is unknown; valid tasks: {", ".join(TASKS)}')
    return TASKS[name]


def sample_scene(task: Task, seed: int, spread: float = 1.0, low: Place = WORKSPACE_LOW,
                 high: Place = WORKSPACE_HIGH) -> Scene:
    """
    Draw shapes, starts, goals and the gripper's start.

    :param task: Task.
    :param seed: non-negative integer; the same seed gives the same scene.
    :param spread: factor of the ranges in which an object to be gripped, its goal and the gripper
        lie.
    :param low: x, y, z in m of what the arm reaches, least; high: greatest. Scenes are drawn until
        starts, places to push from, goals and the gripper are within.
    :return: Scene.
    :raises SceneError: for a seed that is negative or not an integer.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SceneError(f'seed {seed!r}: expected a non-negative integer')
    rng = np.random.default_rng([int(seed), task.stream])
    while True:
        scene = _draw(task, seed, rng, spread)
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        needed = np.concatenate(
            [starts, starts - (goals - starts) / 2, goals, scene.gripper_start[None, :2]])
        if (needed >= low[:2]).all() and (needed <= high[:2]).all():
            return scene


def _draw(task: Task, seed: int, rng: np.random.Generator, spread: float) -> Scene:
    """Draw a scene wherever its objects are."""
    if task.kind == 'stack':
        return _sample_stack(task, seed, rng, spread)
    if task.gripping:
        return _sample_grasp(task, seed, rng, spread)
    if task.ordered:
        return _sample_ordered(task, seed, rng)
    shapes = tuple(random_shape(rng) for _ in range(task.num_objects))
    # Separated starts may leave no room for separated goals: then both are drawn anew.
    goals = None
    while goals is None:
        starts = _draw_starts(rng, task)
        goals = _draw_goals(rng, starts)
    start_poses, goal_poses = _with_yaws(rng, starts, goals)
    hand = gripper_beside_one(rng, starts)
    return Scene(
        task=task, seed=int(seed), shapes=shapes, start_poses=start_poses, goal_poses=goal_poses,
        gripper_start=hand, order=tuple(nearest_first(hand[:2], starts, goals)))


def _sample_ordered(task: Task, seed: int, rng: np.random.Generator) -> Scene:
    """Draw a scene in which the order of pushes matters."""
    shapes = draw_shapes(rng, task.num_objects)
    starts, goals, hand = draw_chain(rng, task.num_objects)
    # So that a name, or a place in a list, does not tell the order.
    names = rng.permutation(task.num_objects)
    starts[names], goals[names] = starts.copy(), goals.copy()
    start_poses, goal_poses = _with_yaws(rng, starts, goals)
    return Scene(
        task=task, seed=int(seed), shapes=shapes, start_poses=start_poses, goal_poses=goal_poses,
        gripper_start=hand, order=tuple(int(k) for k in names[::-1]))


def _with_yaws(rng: np.random.Generator, starts: np.ndarray,
               goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw any yaw at the start, and one near it at the goal; (K, 3) each."""
    yaws = rng.uniform(0, 2 * np.pi, len(starts))
    goal_yaws = yaws + rng.uniform(-GOAL_YAW_RANGE, GOAL_YAW_RANGE, len(starts))
    return np.column_stack([starts, yaws]), np.column_stack([goals, goal_yaws])


def _sample_stack(task: Task, seed: int, rng: np.random.Generator, spread: float) -> Scene:
    """Draw blocks to be stacked; all but the first one are moved."""
    shapes = tuple(draw_block(rng) for _ in range(task.num_objects))
    start_poses, goal_poses, hand = draw_blocks(rng, task.num_objects, spread)
    return Scene(
        task=task, seed=int(seed), shapes=shapes, start_poses=start_poses, goal_poses=goal_poses,
        gripper_start=hand, order=tuple(range(1, task.num_objects)))


def _sample_grasp(task: Task, seed: int, rng: np.random.Generator, spread: float) -> Scene:
    """Draw a scene with one object that can be held; its goal is lifted, or elsewhere."""
    shape = graspable_shape(rng)
    yaw = graspable_yaw(shape, rng)
    start = spread * rng.uniform(-GRASP_RANGE, GRASP_RANGE, 2)
    goal = start
    if task.kind == 'pick_place':
        nearest, farthest = PLACE_DISTANCE[0] * spread, PLACE_DISTANCE[1] * spread
        while not nearest <= np.linalg.norm(goal - start) <= farthest:
            goal = spread * rng.uniform(-PLACE_RANGE, PLACE_RANGE, 2)
    gripper = np.full(2, np.inf)
    while (np.abs(gripper) > spread * GRASP_REACH_RANGE).any():
        angle = rng.uniform(0, 2 * np.pi)
        reach = spread * rng.uniform(*task.reach)
        gripper = start + reach * np.array([np.cos(angle), np.sin(angle)])
    return Scene(
        task=task, seed=int(seed), shapes=(shape,), start_poses=np.array([[*start, yaw]]),
        goal_poses=np.array([[*goal, grasp_place(shape, yaw)[1]]]),
        gripper_start=np.append(gripper, rng.uniform(0, GRIPPER_HEIGHT)), order=(0,))


def _draw_starts(rng: np.random.Generator, task: Task) -> np.ndarray:
    """Draw object origins (K, 2) that are far enough apart."""
    while True:
        starts = rng.uniform(-OBJECT_RANGE, OBJECT_RANGE, (task.num_objects, 2))
        if apart(starts, task.start_separation):
            return starts


def _draw_goals(rng: np.random.Generator, starts: np.ndarray,
                attempts: int = 1000) -> np.ndarray | None:
    """Draw a goal at the fixed distance from each start; None when there seems to be no room."""
    for _ in range(attempts):
        angles = rng.uniform(0, 2 * np.pi, len(starts))
        goals = starts + GOAL_DISTANCE * np.column_stack([np.cos(angles), np.sin(angles)])
        if (np.abs(goals) <= OBJECT_RANGE).all() and apart(goals, GOAL_SEPARATION):
            return goals
    return None
