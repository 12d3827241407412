# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Kinematics of the UR10e in closed form, and where it stands at the table.

Denavit-Hartenberg parameters, joint limits and speeds are those that Universal Robots publishes
for this arm; the base frame is the controller's own ("base" of its URDF). Only poses are computed
here: the simulated arm is kinematic, it follows the gripper and bears no load.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.errors import KinematicsError

JOINTS = ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint',
          'wrist_1_joint', 'wrist_2_joint', 'wrist_3_joint')
D1, A2, A3, D4, D5, D6 = 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655  # m
DH = (  # per joint: a (m), alpha (rad), d (m)
    (0, np.pi / 2, D1), (A2, 0, 0), (A3, 0, 0), (0, np.pi / 2, D4), (0, -np.pi / 2, D5),
    (0, 0, D6))
JOINT_LIMITS = np.array([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])  # rad, +-
SPEED_LIMITS = np.radians([120, 120, 180, 180, 180, 180])  # rad/s

_MIN_SINE = 1e-6  # of wrist 2; below, wrist 1 and wrist 3 turn about the same axis


@dataclass(frozen=True)
class Mount:
    """
    Where an arm stands, and how long its tool is.

    :param position: x, y, z of its base in the world, m.
    :param yaw: of the base about the vertical, rad.
    :param tool: m from the flange to the fingertips, along the flange's z.
    """

    # From here, behind the simulated table and a little below it, every command within the
    # contract's limits keeps all joints below their highest speeds.
    position: tuple[float, float, float] = (0.0, 0.7, -0.1)
    yaw: float = -np.pi / 2
    tool: float = 0.206

    @property
    def pose(self) -> np.ndarray:
        """Pose (4, 4) of the base in the world."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        pose = np.eye(4)
        pose[:2, :2] = [[c, -s], [s, c]]
        pose[:3, 3] = self.position
        return pose


SIMULATED = Mount()


def link_transform(joint: int, angle: ArrayLike) -> np.ndarray:
    """
    Return the pose of link `joint` + 1 in link `joint`.

    :param joint: 0 to 5.
    :param angle: (...) rad.
    :return: (..., 4, 4), rotation and metres.
    """
    a, alpha, d = DH[joint]
    c, s = np.cos(angle), np.sin(angle)
    ca, sa = np.cos(alpha), np.sin(alpha)
    transform = np.zeros((*np.shape(angle), 4, 4))
    transform[..., 0, 0], transform[..., 0, 1], transform[..., 0, 2] = c, -s * ca, s * sa
    transform[..., 1, 0], transform[..., 1, 1], transform[..., 1, 2] = s, c * ca, -c * sa
    transform[..., 0, 3], transform[..., 1, 3] = a * c, a * s
    transform[..., 2, 1], transform[..., 2, 2], transform[..., 2, 3] = sa, ca, d
    transform[..., 3, 3] = 1
    return transform


def forward(joints: ArrayLike) -> np.ndarray:
    """
    Return the pose of the flange in the base.

    :param joints: (..., 6) rad, in the order of JOINTS.
    :return: (..., 4, 4), rotation and metres.
    """
    joints = np.asarray(joints, np.float64)
    pose = link_transform(0, joints[..., 0])
    for i in range(1, 6):
        pose = pose @ link_transform(i, joints[..., i])
    return pose


def inverse(pose: ArrayLike, branch: Sequence[int] = (1, 1, -1)) -> np.ndarray:
    """
    Return joints that bring the flange to a pose in the base.

    :param pose: (4, 4), rotation and metres.
    :param branch: which of the eight solutions: signs of shoulder, elbow and wrist 2.
    :return: (6,) rad in (-pi, pi].
    :raises KinematicsError: when the pose is out of reach, with the reason.
    """
    pose = np.asarray(pose, np.float64)
    shoulder, elbow, wrist = branch
    x, y = pose[:2, 3] - D6 * pose[:2, 2]  # of wrist 3's foot
    radius = np.hypot(x, y)
    if radius <= D4:
        raise KinematicsError(
            f'the arm cannot reach there: {radius:.3f} m from its axis, expected over {D4} m')
    pan = np.arctan2(y, x) + shoulder * np.arccos(D4 / radius) + np.pi / 2
    c1, s1 = np.cos(pan), np.sin(pan)
    cosine = (pose[0, 3] * s1 - pose[1, 3] * c1 - D4) / D6
    wrist2 = wrist * np.arccos(np.clip(cosine, -1, 1))
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
    bend = elbow * np.arccos(cosine)
    lift = np.arctan2(y, x) - np.arctan2(A3 * np.sin(bend), A2 + A3 * np.cos(bend))
    lower = link_transform(1, lift) @ link_transform(2, bend)
    last = np.linalg.inv(lower) @ planar
    wrist1 = np.arctan2(last[1, 0], last[0, 0])
    return wrapped(np.array([pan, lift, bend, wrist1, wrist2, wrist3]))


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Return the same angles in (-pi, pi]."""
    return np.pi - (np.pi - angles) % (2 * np.pi)


def joints_at(gripper: ArrayLike, mount: Mount = SIMULATED) -> np.ndarray:
    """
    Return joints that bring the fingertips to a place, the hand pointing straight down.

    :param gripper: (3,) x, y, z of the fingertips in the world, m.
    :param mount: Mount.
    :return: (6,) rad.
    :raises KinematicsError: when the place is out of reach or beyond the joints' limits.
    """
    flange = np.eye(4)
    flange[:3, :3] = np.diag([1, -1, -1])  # the fingers open along the world's x
    flange[:3, 3] = np.asarray(gripper, np.float64)[:3] + [0, 0, mount.tool]
    joints = inverse(np.linalg.inv(mount.pose) @ flange)
    _check(np.abs(joints) / JOINT_LIMITS, 'its limit', np.degrees(joints), 'degrees')
    return joints


def gripper_at(joints: ArrayLike, mount: Mount = SIMULATED) -> np.ndarray:
    """
    Return where the fingertips are.

    :param joints: (..., 6) rad.
    :param mount: Mount.
    :return: (..., 3) m in the world.
    """
    flange = mount.pose @ forward(joints)
    return flange[..., :3, 3] + mount.tool * flange[..., :3, 2]


def named_joints(positions: Mapping[str, float]) -> list[float] | None:
    """
    Return the six joints in the order of JOINTS, whatever their names begin with.

    :param positions: by the name of the joint.
    :return: None when there is not one arm, or more than one.
    """
    first = JOINTS[0]
    prefixes = [name.removesuffix(first) for name in positions if name.endswith(first)]
    arms = [prefix for prefix in prefixes if all(prefix + name in positions for name in JOINTS)]
    return [positions[arms[0] + name] for name in JOINTS] if len(arms) == 1 else None


def check_motion(before: ArrayLike, after: ArrayLike, seconds: float) -> None:
    """
    Refuse a motion that is too fast for the joints.

    :param before: (6,) rad.
    :param after: (6,) rad, after so many seconds.
    :raises KinematicsError: with the joint's name, its speed and its limit.
    """
    speeds = wrapped(np.subtract(after, before)) / seconds
    _check(np.abs(speeds) / SPEED_LIMITS, 'its highest speed', np.degrees(speeds), 'degrees/s')


def _check(share: np.ndarray, of: str, values: np.ndarray, unit: str) -> None:
    """Refuse shares of a limit above 1, naming the worst joint."""
    worst = int(share.argmax())
    if share[worst] > 1:
        raise KinematicsError(f'{JOINTS[worst]} would be at {share[worst]:.2f} of {of} '
                              f'({values[worst]:.0f} {unit})')
