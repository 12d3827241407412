# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A goal that is put elsewhere: from pixels of its picture to places, and which places will do."""

from collections.abc import Sequence

import mujoco
import numpy as np
from sim_bridge.tasks.tasks import Task, TASKS
from sim_bridge.world.camera import Camera
from sim_bridge.world.scene import object_names
from tap_ros.errors import SceneError
from tap_ros.text import listing


def places_from(camera: Camera, poses: np.ndarray, names: Sequence[str],
                pixels: np.ndarray) -> np.ndarray:
    """
    Turn pixels of a goal picture into places of the goal.

    :param camera: of the picture.
    :param poses: (K, 7) of the goal before: x, y, z in m, quaternion x, y, z, w.
    :param names: of the objects that move; the others stay.
    :param pixels: (len(names), 2) (u, v), where their origins shall be seen.
    :return: (K, 2) x, y in m; infinite where a pixel shows no table.
    :raises SceneError: without names, and for one that no object has.
    """
    known = object_names(len(poses))
    if not names:
        raise SceneError(f'objects: is empty; name those that move, of {listing(known)}')
    unknown = [name for name in names if name not in known]
    if unknown:
        raise SceneError(f'objects: {listing(unknown)} not in the scene; it has {listing(known)}')
    places = poses[:, :2].copy()
    moved = [known.index(name) for name in names]
    places[moved] = camera.on_table(pixels, poses[moved, 2])
    return places


def check_places(task: Task, places: np.ndarray) -> None:
    """
    Accept places where objects can be pushed to.

    :param task: Task.
    :param places: (K, 2) x, y in m.
    :raises SceneError: for a task without pushing, another shape, and places out of reach.
    """
    if task.kind != 'push':
        push = [name for name, other in TASKS.items() if other.kind == 'push']
        raise SceneError(f'the goal of task {task.name} cannot be moved; only those of tasks that '
                         f'push: {listing(push)}')
    if places.shape != (task.num_objects, 2):
        raise SceneError(f'places: expected shape ({task.num_objects}, 2), got {places.shape}')
    limit = task.object_range
    for name, place in zip(object_names(task.num_objects), places):
        if not (np.abs(place) <= limit).all():  # not a number is no place either
            raise SceneError(
                f'{name}: its goal would be at x {place[0]:.3f} m, y {place[1]:.3f} m, out of '
                f'reach; in {task.name} objects are pushed to |x| and |y| of at most {limit:g} m')


def check_apart(model: mujoco.MjModel, data: mujoco.MjData, names: Sequence[str]) -> None:
    """
    Accept objects that do not reach into each other.

    :param model: see scene.build_scene; data: where they are, after mj_forward.
    :param names: of the objects.
    :raises SceneError: naming two that do.
    """
    bodies = {model.body(name).id: name for name in names}
    for geoms, distance in zip(data.contact.geom, data.contact.dist):
        pair = [bodies[body] for body in model.geom_bodyid[geoms].tolist() if body in bodies]
        if distance < 0 and len(pair) == 2:
            raise SceneError(f'{pair[0]} and {pair[1]} would overlap; put them farther apart')
