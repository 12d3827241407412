# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The UR10e: kinematics in closed form, and shapes near the real ones.

Denavit-Hartenberg parameters, joint limits and speeds are those that Universal Robots publishes
for this arm; the base frame is the controller's own ("base" of its URDF).
"""

import numpy as np
from tap_ros.base.errors import KinematicsError
from tap_ros.robots.arm import along_z, Arm, Colour, DARK, Mount, Primitive, wrapped

D1, A2, A3, D4, D5, D6 = 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655  # m
DH = (  # per joint: a (m), alpha (rad), d (m)
    (0.0, np.pi / 2, D1), (A2, 0.0, 0.0), (A3, 0.0, 0.0), (0.0, np.pi / 2, D4),
    (0.0, -np.pi / 2, D5), (0.0, 0.0, D6))
SILVER: Colour = (0.80, 0.81, 0.82)
BLUE: Colour = (0.36, 0.58, 0.74)
UPPER = 0.176  # m from the shoulder's axis to the middle of the upper arm, along joint 2
FORE = 0.039  # m to the middle of the forearm, along joint 3
_MIN_SINE = 1e-6  # of wrist 2; below, wrist 1 and wrist 3 turn about the same axis

SHAPES = (
    along_z(0, -0.1, 0.0, 0.11, DARK),  # pedestal
    along_z(0, 0.0, 0.1, 0.095, DARK),
    along_z(1, 0.1, D1 + 0.085, 0.082, SILVER),
    along_z(2, 0.0, UPPER - 0.088, 0.08, BLUE),
    along_z(2, UPPER - 0.088, UPPER + 0.085, 0.084, SILVER),
    along_z(2, UPPER + 0.085, UPPER + 0.1, 0.078, BLUE),
    Primitive(2, (0, 0, UPPER), (A2, 0, UPPER), 0.062, SILVER, capsule=True),
    Primitive(2, (A2, 0, UPPER - 0.075), (A2, 0, UPPER + 0.075), 0.07, SILVER),
    Primitive(2, (A2, 0, UPPER + 0.075), (A2, 0, UPPER + 0.09), 0.066, BLUE),
    along_z(3, FORE - 0.075, FORE - 0.06, 0.062, BLUE),
    along_z(3, FORE - 0.06, FORE + 0.068, 0.066, SILVER),
    Primitive(3, (0, 0, FORE), (A3, 0, FORE), 0.047, SILVER, capsule=True),
    Primitive(3, (A3, 0, FORE - 0.055), (A3, 0, FORE + 0.055), 0.052, SILVER),
    along_z(4, FORE + 0.055, D4 + 0.05, 0.048, SILVER),
    along_z(4, D4 + 0.05, D4 + 0.062, 0.045, BLUE),
    along_z(5, 0.03, D5 + 0.05, 0.048, SILVER),
    along_z(5, D5 + 0.05, D5 + 0.062, 0.045, BLUE),
    along_z(6, 0.045, D6 - 0.03, 0.047, SILVER),
    along_z(6, D6 - 0.03, D6, 0.046, DARK),
    along_z(6, D6, D6 + 0.05, 0.034, DARK),  # between flange and palm
)


def link_transform(joint: int, angle: float) -> np.ndarray:
    """Return the pose (4, 4) of link `joint` + 1, 1 to 6, in link `joint`; angle in rad."""
    a, alpha, d = DH[joint]
    c, s = np.cos(angle), np.sin(angle)
    ca, sa = np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s],
                     [0, sa, ca, d], [0, 0, 0, 1]])


def inverse(pose: np.ndarray) -> np.ndarray:
    """
    Return joints that bring the flange to a pose in the base.

    Of the eight solutions the one with the elbow up and the shoulder to the left.

    :param pose: (4, 4), rotation and metres.
    :return: (6,) rad in (-pi, pi].
    :raises KinematicsError: when the pose is out of reach, with the reason.
    """
    x, y = pose[:2, 3] - D6 * pose[:2, 2]  # of wrist 3's foot
    radius = np.hypot(x, y)
    if radius <= D4:
        raise KinematicsError(
            f'the arm cannot reach there: {radius:.3f} m from its axis, expected over {D4} m')
    pan = np.arctan2(y, x) + np.arccos(D4 / radius) + np.pi / 2
    c1, s1 = np.cos(pan), np.sin(pan)
    cosine = (pose[0, 3] * s1 - pose[1, 3] * c1 - D4) / D6
    wrist2 = -np.arccos(np.clip(cosine, -1, 1))
    sine = np.sin(wrist2)
    wrist3 = 0.0  # free to choose where wrist 1 and wrist 3 turn about the same axis
    if abs(sine) > _MIN_SINE:
        wrist3 = np.arctan2(
            (pose[1, 1] * c1 - pose[0, 1] * s1) / sine,
            (pose[0, 0] * s1 - pose[1, 0] * c1) / sine)
    hand = link_transform(4, wrist2) @ link_transform(5, wrist3)
    planar = np.linalg.inv(link_transform(0, pan)) @ pose @ np.linalg.inv(hand)  # in link 1
    x, y = planar[:2, 3]
    cosine = (x * x + y * y - A2 * A2 - A3 * A3) / (2 * A2 * A3)
    if abs(cosine) > 1:
        raise KinematicsError(
            f'the arm cannot reach there: its wrist would be {np.hypot(x, y):.3f} m from its '
            f'shoulder, expected {abs(A2 - A3):.3f} to {-A2 - A3:.3f} m')
    bend = np.arccos(cosine)
    lift = np.arctan2(y, x) - np.arctan2(A3 * np.sin(bend), A2 + A3 * np.cos(bend))
    lower = link_transform(1, lift) @ link_transform(2, bend)
    last = np.linalg.inv(lower) @ planar
    wrist1 = np.arctan2(last[1, 0], last[0, 0])
    return wrapped(np.array([pan, lift, bend, wrist1, wrist2, wrist3]))


UR10E = Arm(
    'ur10e', ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint',
              'wrist_2_joint', 'wrist_3_joint'),
    limits=np.array([[-1, 1]]) * np.array([[2], [2], [1], [2], [2], [2]]) * np.pi,
    speeds=np.radians([120, 120, 180, 180, 180, 180]), efforts=(330, 330, 150, 56, 56, 56),
    # Here the joint turns about the z of its own link; Denavit-Hartenberg's about that before.
    origins=(((0.0, 0.0, 0.0), 0.0), *(((a, 0.0, d), alpha) for a, alpha, d in DH)),
    inverse=inverse, shapes=SHAPES,
    # From here, behind the simulated table and a little below it, every command within the
    # contract's limits keeps all joints below their highest speeds.
    mount=Mount((0.0, 0.7, -0.1), -np.pi / 2, 0.206))
