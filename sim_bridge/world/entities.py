# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects as other programs find and move them: by names and room, and where they may be put."""

from collections.abc import Sequence
import math
import subprocess

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.scene import ObjectShape
from tap_ros.contract import WORKSPACE_HIGH
from tap_ros.errors import SceneError
from tap_ros.text import escaped

# Where objects may be put, x, y, z in m: as far as the arm could have pushed or lifted them.
ROOM_HIGH = np.add(WORKSPACE_HIGH, 0.15)
ROOM_LOW = ROOM_HIGH * (-1, -1, 0)
MAX_SPEED = (2.0, 20.0)  # m/s, rad/s
TOUCH = 0.002  # m that bodies at rest reach into each other
MAX_PATTERN = 100  # characters
MATCH_S = 1.0


class PoseError(SceneError):
    """An object cannot be put there."""


def check_pose(pose: ArrayLike) -> np.ndarray:
    """
    Return a pose (7,) x, y, z in m, quaternion x, y, z, w, the latter of length 1.

    :raises PoseError: for another shape, numbers that are not finite, quaternions whose length is
        not about 1, and places that are too far out.
    """
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


def check_velocity(velocity: ArrayLike) -> np.ndarray:
    """
    Return a velocity (6,) in m/s and rad/s.

    :raises SceneError: for another shape, numbers that are not finite, and one that is too fast.
    """
    velocity = np.asarray(velocity, np.float64)
    if velocity.shape != (6,) or not np.less_equal(
            (math.hypot(*velocity[:3]), math.hypot(*velocity[3:])), MAX_SPEED).all():
        raise SceneError(
            f'velocity ({_shown(velocity)}): expected 6 finite numbers, at most '
            f'{MAX_SPEED[0]:g} m/s and {MAX_SPEED[1]:g} rad/s')
    return velocity


def check_free(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> None:
    """
    Accept an object that does not reach into anything.

    :param model: see scene.build_scene; data: where all is, after mj_forward.
    :param name: of the object.
    :raises PoseError: naming what it reaches into.
    """
    body = model.body(name).id
    for geoms, distance in zip(data.contact.geom, data.contact.dist):
        pair = model.geom_bodyid[geoms].tolist()
        if body in pair and distance < -TOUCH:
            other = model.body(pair[pair[0] == body]).name.replace('world', 'the table')
            raise PoseError(f'{name} would reach into {other}')


def box_of(shape: ObjectShape) -> np.ndarray:
    """Return the corners (2, 3) in m of the box around an object, highest first, in its frame."""
    sizes = np.array([(half[0], *half) if shape.kind == 'disc' else half
                      for half in shape.half_sizes])
    centres = np.array([(*centre, 0.0) for centre in shape.centres])
    return np.array([(centres + sizes).max(axis=0), (centres - sizes).min(axis=0)])


def box_around(box: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """
    Return the box along the axes of the world around a box at a pose.

    :param box: (2, 3) see box_of.
    :param pose: (7,) x, y, z in m, quaternion x, y, z, w.
    :return: (2, 3) in m, the highest corner first.
    """
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.roll(pose[3:], 1))
    centre, half = box.mean(axis=0), (box[0] - box[1]) / 2
    middle = pose[:3] + turn.reshape(3, 3) @ centre
    reach = np.abs(turn.reshape(3, 3)) @ half
    return np.array([middle + reach, middle - reach])


def overlaps_box(box: np.ndarray, other: ArrayLike) -> bool:
    """Return whether two boxes (2, 3) along the same axes, highest corner first, overlap."""
    other = np.asarray(other)
    return bool((box[1] <= other[0]).all() and (other[1] <= box[0]).all())


def overlaps_sphere(box: np.ndarray, centre: np.ndarray, radius: float) -> bool:
    """Return whether a box (2, 3), highest corner first, and a sphere overlap."""
    return math.dist(np.clip(centre, box[1], box[0]), centre) <= radius


def matching(pattern: str, names: Sequence[str]) -> list[str]:
    """
    Return the names in which a POSIX extended regular expression is found.

    By grep, since Python's expressions are others and may take for ever.

    :raises SceneError: for an expression that is malformed, too long, takes too long, or counts
        repetitions, for which grep takes gigabytes.
    """
    shown = f"expression '{escaped(pattern, MAX_PATTERN)}'"
    if len(pattern) > MAX_PATTERN or '{' in pattern or not pattern.isprintable():
        raise SceneError(f'{shown}: expected at most {MAX_PATTERN} characters that print, no {{')
    try:
        done = subprocess.run(
            ['grep', '-E', '-e', pattern], input='\n'.join(names), capture_output=True, text=True,
            timeout=MATCH_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SceneError(f'{shown} could not be matched: {escaped(error)}') from error
    if done.returncode > 1:
        raise SceneError(f'{shown}: {escaped(done.stderr.strip())}')
    return done.stdout.split()


def _shown(numbers: np.ndarray) -> str:
    return ', '.join(f'{number:.4g}' for number in numbers.ravel()[:7])
