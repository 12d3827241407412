# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The Franka Panda: kinematics in closed form for a hand that points down, and shapes near the real.

Denavit-Hartenberg parameters (Craig's convention), limits, speeds and efforts are those that
Franka publishes for this arm. Of its seven joints the third and the fifth stay at zero, so that
the arm lies in a vertical plane.
"""

import numpy as np
from tap_ros.base.errors import KinematicsError
from tap_ros.robots.arm import along_z, Arm, Colour, DARK, Mount, Primitive, wrapped

D1, D3, D5, A4, A7, FLANGE = 0.333, 0.316, 0.384, 0.0825, 0.088, 0.107  # m
HALF = np.pi / 2
ORIGINS = (
    ((0.0, 0.0, D1), 0.0), ((0.0, 0.0, 0.0), -HALF), ((0.0, -D3, 0.0), HALF),
    ((A4, 0.0, 0.0), HALF), ((-A4, D5, 0.0), -HALF), ((0.0, 0.0, 0.0), HALF),
    ((A7, 0.0, 0.0), HALF), ((0.0, 0.0, FLANGE), 0.0))
UPPER, FORE = np.hypot(D3, A4), np.hypot(D5, A4)  # m: shoulder to elbow, elbow to wrist
UPPER_SLANT, FORE_SLANT = np.arctan2(A4, D3), np.arctan2(A4, D5)  # rad, of the elbow's offset
WHITE: Colour = (0.90, 0.91, 0.92)
GREY: Colour = (0.55, 0.57, 0.60)

SHAPES = (
    Primitive(0, (-0.12, 0, 0.06), (0.0, 0, 0.06), 0.075, WHITE, capsule=True),
    along_z(0, -0.05, 0.08, 0.085, DARK),  # pedestal and foot
    along_z(1, -0.26, -0.05, 0.06, WHITE),
    Primitive(2, (0, 0, -0.06), (0, 0, 0.06), 0.062, WHITE, capsule=True),  # shoulder
    Primitive(3, (0, 0, -0.26), (0, 0, -0.1), 0.058, WHITE, capsule=True),
    Primitive(3, (0, 0, -0.11), (A4, 0, 0), 0.052, WHITE, capsule=True),
    Primitive(4, (0, 0, -0.06), (0, 0, 0.06), 0.06, GREY, capsule=True),  # elbow
    Primitive(4, (0, 0, 0), (-A4, 0.11, 0), 0.052, WHITE, capsule=True),
    Primitive(5, (0, 0, -0.27), (0, 0, -0.2), 0.056, WHITE, capsule=True),
    Primitive(5, (0, 0.07, -0.2), (0, 0.07, -0.05), 0.028, WHITE, capsule=True),
    Primitive(5, (0, 0.02, -0.2), (0, 0, -0.02), 0.045, WHITE, capsule=True),
    Primitive(6, (0, 0, -0.06), (0, 0, 0.02), 0.05, GREY, capsule=True),  # wrist
    Primitive(6, (0, 0, 0), (A7, 0, 0), 0.045, WHITE, capsule=True),
    along_z(7, -0.06, 0.085, 0.045, WHITE),
    along_z(7, 0.085, FLANGE, 0.044, DARK),
    along_z(7, FLANGE, FLANGE + 0.05, 0.034, DARK),  # between flange and palm
)


def inverse(pose: np.ndarray) -> np.ndarray:
    """
    Return joints that bring the flange to a pose in the base, with the elbow up.

    :param pose: (4, 4), rotation and metres; the flange's z points straight down.
    :return: (7,) rad in (-pi, pi].
    :raises KinematicsError: when the pose is out of reach, or another way up.
    """
    if pose[2, 2] > -1 + 1e-9:
        raise KinematicsError('the arm cannot turn its hand there: expected it to point down')
    x, y, z = pose[:3, 3]
    ahead, up = np.hypot(x, y) - A7, z + FLANGE - D1  # of the wrist, from the shoulder
    away = np.hypot(ahead, up)
    if not FORE - UPPER < away < FORE + UPPER:
        raise KinematicsError(
            f'the arm cannot reach there: its wrist would be {away:.3f} m from its shoulder, '
            f'expected {FORE - UPPER:.3f} to {FORE + UPPER:.3f} m')
    # The triangle of shoulder, elbow and wrist, whose sides are known.
    inside = np.arccos((UPPER ** 2 + FORE ** 2 - away ** 2) / (2 * UPPER * FORE))
    above = np.arccos((UPPER ** 2 + away ** 2 - FORE ** 2) / (2 * UPPER * away))
    joints = np.zeros(7)
    joints[0] = np.arctan2(y, x)
    joints[1] = np.arctan2(ahead, up) - above - UPPER_SLANT
    joints[3] = inside - np.pi - UPPER_SLANT - FORE_SLANT
    joints[5] = joints[1] - joints[3]
    last = np.linalg.inv(PANDA.forward(joints)) @ pose
    joints[6] = np.arctan2(last[1, 0], last[0, 0])
    return wrapped(joints)


PANDA = Arm(
    'panda', tuple(f'panda_joint{i}' for i in range(1, 8)),
    limits=np.array([
        [-2.8973, 2.8973], [-1.7628, 1.7628], [-2.8973, 2.8973], [-3.0718, -0.0698],
        [-2.8973, 2.8973], [-0.0175, 3.7525], [-2.8973, 2.8973]]),
    speeds=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    efforts=(87, 87, 87, 87, 12, 12, 12), origins=ORIGINS, inverse=inverse, shapes=SHAPES,
    # It reaches a strip of the table: 0.855 m from its shoulder, and not close to its foot.
    mount=Mount((0.0, 0.46, 0.05), -np.pi / 2, 0.206), low=(-0.4, -0.16, 0.0),
    high=(0.4, 0.16, 0.15), action_limit=(0.07, 0.07, 0.07))
