# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Objects that the gripper can hold, and where it can hold them.

The fingers close along x and the gripper cannot turn, so an object is held by a part that lies
nearly along y; closing the fingers turns that part quite along y.
"""

import numpy as np
from sim_bridge.world.scene import box_shape, HALF_HEIGHT, ObjectShape, SHAPES

GRASP_YAW = 0.45  # rad, largest angle between y and the part to be held
FINGER_DEPTH = 0.022  # m, thickness of a finger and a little room
FINGER_HALF_WIDTH = 0.02  # m, along y


def graspable_shape(rng: np.random.Generator) -> ObjectShape:
    """
    Draw a thin shape and its colours.

    :param rng: numpy Generator.
    :return: ObjectShape with its centre of area at the origin.
    """
    kind = SHAPES[rng.choice(len(SHAPES), p=(0.35, 0.35, 0.15, 0.15))]
    colours = tuple(tuple(rng.uniform(0.3, 1.0, 3)) for _ in range(2))
    if kind == 'disc':
        size = (rng.uniform(0.02, 0.028), HALF_HEIGHT)
        return ObjectShape(kind, (size,), ((0, 0),), colours[:1])
    thickness, length = rng.uniform(0.014, 0.018), rng.uniform(0.06, 0.09)
    return box_shape(kind, thickness, length, rng.uniform(0.03, 0.05), colours)


def graspable_yaw(shape: ObjectShape, rng: np.random.Generator) -> float:
    """Draw a yaw with which some part of the shape lies nearly along y; radians."""
    if shape.kind == 'disc':
        return rng.uniform(0, 2 * np.pi)
    # The two parts of an L or T are at right angles: one of them fits at any quarter turn.
    quarters = 2 * rng.integers(2) if shape.kind == 'bar' else rng.integers(4)
    return (quarters * np.pi / 2 + rng.uniform(-GRASP_YAW, GRASP_YAW)) % (2 * np.pi)


def grasp_place(shape: ObjectShape, yaw: float) -> tuple[np.ndarray, float, float]:
    """
    Find a place where the fingers can hold an object that stands with this yaw.

    :param shape: ObjectShape.
    :param yaw: radians.
    :return: (2,) gripper x, y relative to the object's origin in metres, the yaw that the object
        has when held, and half the gap between the fingers in metres.
    """
    if shape.kind == 'disc':
        return np.zeros(2), yaw, shape.half_sizes[0][0]
    angles = [(yaw - (np.pi / 2 if size[0] > size[1] else 0)) for size in shape.half_sizes]
    angles = np.array([(angle + np.pi / 2) % np.pi - np.pi / 2 for angle in angles])
    held = int(np.abs(angles).argmin())
    yaw = yaw - angles[held]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    centres = np.array(shape.centres) @ turn.T
    sizes = np.abs(np.array(shape.half_sizes)[:, :2] @ turn.T)
    half_gap, length = sizes[held]
    places = centres[held, 1] + np.linspace(-length, length, 41)
    free = np.ones(len(places), bool)
    for k in range(len(centres)):
        if k != held:
            low, high = centres[k] - sizes[k], centres[k] + sizes[k]
            for sign in (-1, 1):
                edges = centres[held, 0] + sign * np.array([half_gap, half_gap + FINGER_DEPTH])
                beside = edges.max() > low[0] + 1e-6 and edges.min() < high[0] - 1e-6
                overlap = (places + FINGER_HALF_WIDTH > low[1]) & (
                    places - FINGER_HALF_WIDTH < high[1])
                free &= ~(beside & overlap)
    places = places[free] if free.any() else places
    y = places[np.abs(places).argmin()]  # nearest to the centre of mass
    return np.array([centres[held, 0], y]), yaw, half_gap
