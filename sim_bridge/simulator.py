# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo table with its tasks, a World: reset, step, observe. Knows nothing of ROS."""

from collections.abc import Iterator, Sequence
import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.tasks.tasks import get_task, sample_scene, task_names
from sim_bridge.world.looks import DEFAULT_LOOK, GRIP_SPREAD
from sim_bridge.world.table import lifted, OBJECT_QPOS_START, Table
from sim_bridge.world_protocol import Observation
from tap_ros.contract import WORKSPACE_HIGH
from tap_ros.errors import SceneError
from tap_ros.robots.arm import DEFAULT_ARM
from tap_ros.text import escaped, listing

# Where objects may be put, x, y, z in m: as far as the arm could have pushed or lifted them.
ROOM_HIGH = np.add(WORKSPACE_HIGH, 0.15)
ROOM_LOW = ROOM_HIGH * (-1, -1, 0)
MAX_SPEED = (2.0, 20.0)  # m/s, rad/s
TOUCH = 0.002  # m that bodies at rest reach into each other


class PoseError(SceneError):
    """An object cannot be put there."""


class Simulator(Table):
    """
    The World 'mujoco_table'.

    :param task: name of a task, see tasks.task_names.
    :param image_size: pixels of the square picture.
    :param look: name of a look, see looks.LOOKS.
    :param appearance: name of an appearance, see looks.CHOICES.
    :param arm: name of an arm, see robots.arm.get_arm.
    :raises ConfigError: for an unknown arm.
    :raises SceneError: for an unknown task, look or appearance, a bad size, or when nothing can be
        rendered.
    """

    def __init__(self, task: str = 'push2', image_size: int = 64, look: str = DEFAULT_LOOK,
                 appearance: str = 'usual', arm: str = DEFAULT_ARM) -> None:
        self.task = get_task(task)
        super().__init__(image_size, self.task.gripping, look, appearance, arm)

    @property
    def task_name(self) -> str:
        """Return the name of the task."""
        return self.task.name

    def reset(self, seed: int) -> Observation:
        """
        Draw the scene of this seed and put everything at its start.

        :param seed: non-negative integer.
        :return: Observation.
        :raises SceneError: for a bad seed.
        """
        task = self.task
        self.scene = sample_scene(
            task, seed, GRIP_SPREAD if task.gripping else 1.0, self.arm.low, self.arm.high)
        self.load(self.scene.shapes, lifted(self.scene.start_poses), self.scene.gripper_start,
                  int(seed))
        self._show_goal(lifted(self.scene.goal_poses, task.goal_heights),
                        task.goal_gripper(self, self.scene))
        return self.observe()

    def goal(self, hide_arm: bool = False) -> Observation:
        """
        Return the Observation of the goal.

        The arm stands as after pushing one object there, holds the object that is to be grasped,
        is above the one that it has put down, or lets go of the top of a tower. After set_goal it
        is somewhere beside the objects.

        :param hide_arm: leave the arm out of the picture.
        """
        return self._goal[1 if hide_arm else 0]

    def set_goal(self, places: ArrayLike) -> None:
        """
        Put the goal elsewhere, until the next reset; nothing moves, and `scene` stays as drawn.

        goal, distances and outcome follow. The objects keep the heights and yaws of the goal
        before, the arm is somewhere beside them.

        :param places: (K, 2) x, y in m of the object origins.
        :raises SceneError: for a task without pushing, another shape, places beyond
            Task.object_range, and objects that would overlap; then the goal stays as it was.
        """
        places = np.asarray(places, np.float64)
        self._check_places(places)
        poses = self.goal_poses.copy()
        poses[:, :2] = places
        with self.unmoved():
            self.place(poses, self.target)
            for first, second in self._overlaps(0.0):
                if {first, second} <= set(self.object_names):
                    raise SceneError(f'{first} and {second} would overlap; put them farther apart')
        self._show_goal(poses, None)

    def move_goal(self, names: Sequence[str], pixels: np.ndarray) -> None:
        """
        Put the goals of some objects where pixels of its picture show the table, see set_goal.

        :param names: of the objects that move; the others' goals stay.
        :param pixels: (len(names), 2) (u, v), where their origins shall be seen.
        :raises SceneError: as set_goal does, without names, and for one that no object has.
        """
        known = self.object_names
        if not names:
            raise SceneError(f'objects: is empty; name those that move, of {listing(known)}')
        unknown = [name for name in names if name not in known]
        if unknown:
            raise SceneError(
                f'objects: {listing(unknown)} not in the scene; it has {listing(known)}')
        places = self.goal_poses[:, :2].copy()
        moved = [known.index(name) for name in names]
        places[moved] = self.camera.on_table(pixels, self.goal_poses[moved, 2])
        self.set_goal(places)

    def outcome(self) -> str:
        """Return 'success' or 'failure', see Task.succeeds."""
        return 'success' if self.task.succeeds(self) else 'failure'

    def put_object(self, name: str, pose: ArrayLike, velocity: ArrayLike = (0,) * 6) -> None:
        """
        Put an object elsewhere, as a hand would; no time passes, `scene` and goal stay.

        :param name: one of object_names.
        :param pose: (7,) x, y, z in m, quaternion x, y, z, w.
        :param velocity: (6,) m/s and rad/s along the axes of the world.
        :raises PoseError: for a pose that is none or out of reach, and where the object would
            reach into something; then it stays where it was.
        :raises SceneError: for a velocity that is not finite or too fast; likewise.
        """
        if name not in self.object_names:
            raise SceneError(f'{escaped(name)} is not in the scene')
        pose, velocity = _check_pose(pose), _check_velocity(velocity)
        # Of a free joint MuJoCo turns the angular velocity with the body.
        turning = np.empty(3)
        mujoco.mju_rotVecQuat(turning, velocity[3:], pose[[6, 3, 4, 5]] * (1, -1, -1, -1))
        where, rates = pose[[0, 1, 2, 6, 3, 4, 5]], [*velocity[:3], *turning]
        with self.unmoved():
            self._put(name, where, rates)
            for pair in self._overlaps(TOUCH):
                if name in pair:
                    other = pair[pair[0] == name].replace('world', 'the table')
                    raise PoseError(f'{name} would reach into {other}')
        self._put(name, where, rates)

    def object_motions(self) -> np.ndarray:
        """Return (K, 6): velocities along the axes of the world, m/s and rad/s."""
        motions = self.data.qvel[OBJECT_QPOS_START:].reshape(-1, 2, 3).copy()
        for name, motion in zip(self.object_names, motions):
            motion[1] = self.data.body(name).xmat.reshape(3, 3) @ motion[1]
        return motions.reshape(-1, 6)

    def _show_goal(self, poses: np.ndarray, gripper: np.ndarray | None) -> None:
        """Take the pictures of a goal, (K, 7) and as Task.goal_gripper."""
        self._goal = [self.photograph(poses, gripper, hide_arm) for hide_arm in (False, True)]
        self.goal_poses = self.goal().object_poses

    def _put(self, name: str, where: np.ndarray, rates: ArrayLike) -> None:
        """Set the free joint of an object."""
        joint = self.data.joint(name)
        joint.qpos, joint.qvel = where, rates
        mujoco.mj_forward(self.model, self.data)

    def _overlaps(self, depth: float) -> Iterator[tuple[str, str]]:
        """Yield the names of bodies that reach into each other by more than so many m."""
        for geoms, distance in zip(self.data.contact.geom, self.data.contact.dist):
            if distance < -depth:
                first, second = self.model.geom_bodyid[geoms].tolist()
                yield self.model.body(first).name, self.model.body(second).name

    def _check_places(self, places: np.ndarray) -> None:
        """Raise SceneError for a task without pushing, another shape, and places out of reach."""
        task = self.task
        if task.kind != 'push':
            push = [name for name in task_names() if get_task(name).kind == 'push']
            raise SceneError(f'the goal of task {task.name} cannot be moved; only those of tasks '
                             f'that push: {listing(push)}')
        if places.shape != (task.num_objects, 2):
            raise SceneError(
                f'places: expected shape ({task.num_objects}, 2), got {places.shape}')
        limit = getattr(task, 'object_range')  # noqa: B009  # of those that push
        for name, place in zip(self.object_names, places):
            if not (np.abs(place) <= limit).all():  # not a number is no place either
                raise SceneError(
                    f'{name}: its goal would be at x {place[0]:.3f} m, y {place[1]:.3f} m, out '
                    f'of reach; in {task.name} objects are pushed to |x| and |y| of at most '
                    f'{limit:g} m')


def _check_pose(pose: ArrayLike) -> np.ndarray:
    """Return a pose (7,) with a quaternion of length 1; PoseError for one that cannot be."""
    pose = np.asarray(pose, np.float64)
    if pose.shape != (7,) or not np.isfinite(pose).all():
        raise PoseError(f'pose ({_shown(pose)}): expected 7 finite numbers')
    length = math.hypot(*pose[3:])  # which takes numbers of any size
    if abs(length - 1) > 0.01:
        raise PoseError(f'orientation ({_shown(pose[3:])}): expected a quaternion of length 1')
    if (pose[:3] < ROOM_LOW).any() or (pose[:3] > ROOM_HIGH).any():
        raise PoseError(
            f'position ({_shown(pose[:3])}) m is out of reach; expected |x| and |y| of at most '
            f'{ROOM_HIGH[0]:g} m, z from 0 to {ROOM_HIGH[2]:g} m')
    return np.append(pose[:3], pose[3:] / length)


def _check_velocity(velocity: ArrayLike) -> np.ndarray:
    """Return a velocity (6,) in m/s and rad/s; SceneError for one that cannot be."""
    velocity = np.asarray(velocity, np.float64)
    if velocity.shape != (6,) or not np.less_equal(
            (math.hypot(*velocity[:3]), math.hypot(*velocity[3:])), MAX_SPEED).all():
        raise SceneError(
            f'velocity ({_shown(velocity)}): expected 6 finite numbers, at most '
            f'{MAX_SPEED[0]:g} m/s and {MAX_SPEED[1]:g} rad/s')
    return velocity


def _shown(numbers: np.ndarray) -> str:
    return ', '.join(f'{number:.4g}' for number in numbers.ravel()[:7])
