# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How a scene looks besides its objects: table, light and the camera's place; named or drawn."""

from dataclasses import dataclass

import numpy as np
from tap_ros.errors import SceneError


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
    :return: Appearance.
    :raises SceneError: for another name.
    """
    if name == RANDOM:
        return random_appearance(np.random.default_rng([seed, 8]))
    if name not in NAMED:
        raise SceneError(f'appearance {name!r} is unknown; valid ones: {", ".join(CHOICES)}')
    return NAMED[name]


def random_appearance(rng: np.random.Generator) -> Appearance:
    """Draw an Appearance within the bounds above."""
    table = rng.uniform(*TABLE_RANGE) * rng.uniform(1 - TABLE_TINT, 1 + TABLE_TINT, 3)
    x, y = rng.uniform(-LIGHT_RANGE, LIGHT_RANGE, 2)
    return Appearance(
        tuple(table.tolist()), (float(x), float(y), -1.0), float(rng.uniform(*BRIGHTNESS_RANGE)),
        tuple(rng.uniform(-CAMERA_RANGE, CAMERA_RANGE, 3).tolist()),
        float(rng.uniform(-TILT_RANGE, TILT_RANGE)))
