# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The looks of the world: what is drawn around the physics, and the cameras."""

from dataclasses import dataclass

from sim_bridge.world.camera import Camera
from sim_bridge.world.scene import CAMERA_FOVY, CAMERA_POSITION, CAMERA_TILT
from tap_ros.errors import SceneError
from tap_ros.plugins import names


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
LOOKS = {
    'hand': Look(False, _TABLE),
    'arm': Look(True, _TABLE_AND_ARM),
}
DEFAULT_LOOK = 'hand'
# From the side, at a person's height: for films.
OBSERVER = Camera(480, 360, tilt=1.05, fovy=38.0, position=(1.15, -1.35, 1.15), turn=0.7)


def get_look(name: str) -> Look:
    """
    Look up a look; the name of an arm stands for 'arm', as it did in earlier recordings.

    :raises SceneError: for an unknown name.
    """
    if name in names('tap_ros.arms'):
        name = 'arm'
    if name not in LOOKS:
        raise SceneError(f'look {name!r} is unknown; valid looks: {", ".join(LOOKS)}')
    return LOOKS[name]
