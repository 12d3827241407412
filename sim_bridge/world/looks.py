# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What pictures show of a scene besides its objects: the arm, table and light, and from where."""

from dataclasses import dataclass

import numpy as np
from sim_bridge.world.camera import Camera
from sim_bridge.world.scene import CAMERA_FOVY, CAMERA_POSITION, CAMERA_TILT
from tap_ros.base import contract
from tap_ros.base.errors import SceneError


@dataclass(frozen=True)
class Look:
    """
    One look.

    Hands and objects are the same in all of them, and so is the camera of tasks with a grasp.

    :param arm: the camera's pictures show the whole arm; else the hand alone.
    :param push_camera: what Camera is given for tasks that push.
    """

    arm: bool
    push_camera: tuple[float, float, tuple[float, float, float]]  # tilt, fovy, position

    def camera(self, gripping: bool, width: int, height: int) -> Camera:
        """Return the camera of a kind of task."""
        tilt, fovy, position = _NEAR if gripping else self.push_camera
        return Camera(width, height, tilt, fovy, position)


_TABLE = (CAMERA_TILT, CAMERA_FOVY, CAMERA_POSITION)  # all of the table
_TABLE_AND_ARM = (0.84, 33.5, (0.0, -1.36, 1.33))
_NEAR = (0.73, 18.5, CAMERA_POSITION)
GRIP_SPREAD = 0.65  # of the ranges in which objects to be gripped lie: that camera sees less
LOOKS = dict(zip(contract.LOOKS, (Look(False, _TABLE), Look(True, _TABLE_AND_ARM)), strict=True))
DEFAULT_LOOK = contract.DEFAULT_LOOK


def get_look(name: str) -> Look:
    """Look up a look; SceneError for an unknown name."""
    if name not in LOOKS:
        raise SceneError(f'look {name!r} is unknown; valid looks: {", ".join(LOOKS)}')
    return LOOKS[name]


@dataclass(frozen=True)
class Appearance:
    """
    Differences from the usual picture of a scene.

    :param table: (r, g, b) factors of the table's colour.
    :param light: direction in which the light shines; its third component is -1.
    :param brightness: factor of all light.
    :param camera_offset: m that the camera is moved along x, y, z.
    :param camera_tilt: rad that it is turned upwards.
    """

    table: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light: tuple[float, float, float] = (0.45, 0.28, -1.0)
    brightness: float = 1.0
    camera_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_tilt: float = 0.0


USUAL = Appearance()
NAMED = {
    'usual': USUAL,
    'lighter_table': Appearance(table=(1.35, 1.45, 1.6)),
    'other_light': Appearance(light=(-0.5, 0.1, -1.0), brightness=0.85),
    'other_camera': Appearance(camera_offset=(0.04, 0.03, 0.02), camera_tilt=-0.01),
}
RANDOM = 'random'  # drawn from the scene's seed
CHOICES = (*NAMED, RANDOM)

TABLE_RANGE = (0.7, 1.4)  # of all three factors together; each differs by up to TABLE_TINT
TABLE_TINT = 0.12
LIGHT_RANGE = 0.6  # |x| and |y| of the light's direction
BRIGHTNESS_RANGE = (0.8, 1.15)
CAMERA_RANGE = 0.03  # m along each axis
TILT_RANGE = 0.015  # rad


def choose_appearance(name: str, seed: int) -> Appearance:
    """
    Return the appearance of a scene.

    :param name: one of CHOICES.
    :param seed: of the scene.
    :raises SceneError: for another name.
    """
    if name in NAMED:
        return NAMED[name]
    if name != RANDOM:
        raise SceneError(f'appearance {name!r} is unknown; valid ones: {", ".join(CHOICES)}')
    rng = np.random.default_rng([seed, 8])
    table = rng.uniform(*TABLE_RANGE) * rng.uniform(1 - TABLE_TINT, 1 + TABLE_TINT, 3)
    x, y = rng.uniform(-LIGHT_RANGE, LIGHT_RANGE, 2)
    return Appearance(
        tuple(table.tolist()), (float(x), float(y), -1.0), float(rng.uniform(*BRIGHTNESS_RANGE)),
        tuple(rng.uniform(-CAMERA_RANGE, CAMERA_RANGE, 3).tolist()),
        float(rng.uniform(-TILT_RANGE, TILT_RANGE)))
