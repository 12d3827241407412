# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo table with its tasks, a World: reset, step, observe. Knows nothing of ROS."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.demonstrations import Demonstration, to_episode
from sim_bridge.tasks.tasks import get_task, run_episode, sample_scene, task_names
from sim_bridge.world.looks import DEFAULT_LOOK, GRIP_SPREAD
from sim_bridge.world.protocol import Observation
from sim_bridge.world.table import lifted, Table
from tap_ros.base.contract import CAMERA_SIZE
from tap_ros.base.errors import SceneError
from tap_ros.base.text import listing
from tap_ros.robots.arm import DEFAULT_ARM


class Simulator(Table):
    """
    The World 'mujoco_table': an arm with a gripper, K objects, a camera, a goal.

    Everything follows from seeds and actions, to the bit. Observations have shapes and units as
    protocol.Observation says; it belongs to the thread of its first reset, which draws.

    :param task: name of a task, such as 'push2'; see tasks.task_names.
    :param image_size: width and height of the pictures, 16 to 1024 pixels.
    :param look: 'hand' or 'arm', what pictures show of the arm.
    :param appearance: of table, light and camera, one of looks.CHOICES; 'random': drawn from the
        seed of each scene.
    :param arm: name of an arm, such as 'ur10e'.
    :ivar scene: the TaskScene of the last reset.
    :raises ConfigError: for an unknown arm.
    :raises SceneError: for an unknown task, look or appearance and a bad size; by reset also when
        nothing can be rendered.
    """

    def __init__(self, task: str = 'push2', image_size: int = CAMERA_SIZE,
                 look: str = DEFAULT_LOOK, appearance: str = 'usual',
                 arm: str = DEFAULT_ARM) -> None:
        self.task = get_task(task)
        self.task_name = self.task.name
        super().__init__(image_size, self.task.gripping, look, appearance, arm)

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
            for geoms, distance in zip(self.data.contact.geom, self.data.contact.dist):
                first, second = (self.model.body(k).name for k in self.model.geom_bodyid[geoms])
                if distance < 0 and {first, second} <= set(self.object_names):
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

    def demonstrate(self, seed: int, num_frames: int = 0, timing: str = 'natural',
                    misses: float = 0.0) -> Demonstration:
        """
        Let the expert of the task act in the scene of a seed.

        The goal of the episode is the one that it reached: a picture of where the objects ended,
        with the arm elsewhere, as a person would photograph a goal; after a grasp, whose object
        the arm may still hold, the last frame itself. The expert's own goal, from which the
        outcome follows, is drawn again from the seed by tasks.sample_scene.

        :param num_frames: and the others: see tasks.DemonstrationOptions.
        """
        seen, actions, outcome = run_episode(self, seed, num_frames, timing, misses)
        goal = seen[-1]
        if self.task.photographed:
            goal = self.photograph(goal.object_poses)
        return Demonstration(to_episode(seen, actions, goal, self.task.name, seed, outcome))

    def _show_goal(self, poses: np.ndarray, gripper: np.ndarray | None) -> None:
        """Take the pictures of a goal, (K, 7) and as Task.goal_gripper."""
        self._goal = [self.photograph(poses, gripper, hide_arm) for hide_arm in (False, True)]
        self.goal_poses = self.goal().object_poses

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
            if not np.isfinite(place).all():
                raise SceneError(f'the goal of {name} is not on the table')
            if far := [f'{max(1, round(100 * (abs(one) - limit)))} cm too '
                       f'{less if one < 0 else more}' for one, less, more in zip(
                           place, ('far left', 'near'), ('far right', 'far away'))
                       if abs(one) > limit]:
                raise SceneError(f'the goal of {name} is out of reach: {", ".join(far)}; expected '
                                 f'at most {100 * limit:g} cm from the middle each way')
