# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An arm as data: its joints, what they carry, where it stands, and how it reaches a pose.

ur10e.py and panda.py are one each, from_urdf.py makes others. Another package adds one by the
entry points 'tap_ros.arms'.
Frames: link 0 is the base; link i turns about its own z by joint i and carries link i + 1, and the
last link the flange, at a place (m) that is turned: rolled about x, or by roll, pitch and yaw
(rad).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple
import warnings

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import ACTION_LIMIT, WORKSPACE_HIGH, WORKSPACE_LOW, WORLD_FRAME
from tap_ros.base.errors import ConfigError, KinematicsError
from tap_ros.base.plugins import load_plugin, names

DEFAULT_ARM = 'ur10e'
MOST_JOINTS = 8  # of an arm
BASE_FRAME = 'base'  # of the arm, as its controller has it
TIP_FRAME = 'gripper_tip'  # between the fingertips
Colour = tuple[float, float, float]
Place = tuple[float, float, float]
Turn = float | Place  # roll, or roll, pitch and yaw
DARK: Colour = (0.16, 0.17, 0.18)


@dataclass(frozen=True)
class Mount:
    """
    Where an arm stands upright, and how long its tool is.

    :param position: x, y, z of its base in the world, m.
    :param yaw: of the base about the vertical, rad.
    :param tool: m from the flange to the fingertips, along the flange's z.
    """

    position: Place
    yaw: float
    tool: float

    @property
    def pose(self) -> np.ndarray:
        """Pose (4, 4) of the base in the world."""
        return turned(self.position, 0.0, self.yaw)


class Transform(NamedTuple):
    """The pose of one frame in another, its parent, as tf tells it."""

    parent: str
    child: str
    pose: np.ndarray  # (4, 4), rotation and metres


@dataclass(frozen=True)
class Primitive:
    """A cylinder, or with round ends a capsule, in the frame of a link; metres."""

    link: int
    start: Place
    end: Place
    radius: float
    colour: Colour
    capsule: bool = False


@dataclass(frozen=True, eq=False)
class Arm:
    """
    One kind of arm with J joints; the simulated one is kinematic and bears no load.

    :param name: by which it is asked for.
    :param joints: names of the joints, from the base on.
    :param limits: (J, 2) rad, least and greatest.
    :param speeds: (J,) rad/s, highest.
    :param efforts: (J,) N m, highest.
    :param origins: of the links 1 to J and of the flange in the link before: place, turn.
    :param inverse: returns (J,) joints that bring the flange to a pose (4, 4) in the base, or
        raises KinematicsError with the reason.
    :param shapes: what it looks like.
    :param mount: where it stands at the simulated table.
    :param low: x, y, z of the fingertips that it reaches from there, least; high: greatest, m.
    :param action_limit: m along x, y, z that it can move anywhere there in a control period; its
        experts keep to that.
    """

    name: str
    joints: tuple[str, ...]
    limits: np.ndarray
    speeds: np.ndarray
    efforts: tuple[float, ...]
    origins: tuple[tuple[Place, Turn], ...]
    inverse: Callable[[np.ndarray], np.ndarray]
    shapes: tuple[Primitive, ...]
    mount: Mount
    low: Place = WORKSPACE_LOW
    high: Place = WORKSPACE_HIGH
    action_limit: Place = ACTION_LIMIT
    links: tuple[str, ...] = field(init=False)  # names of the base and the links 1 to J

    def __post_init__(self) -> None:
        names = (BASE_FRAME, *(name.replace('joint', 'link') for name in self.joints))
        object.__setattr__(self, 'links', names)

    def forward(self, joints: ArrayLike) -> np.ndarray:
        """Return the pose (..., 4, 4) of the flange in the base; joints (..., J) rad."""
        return self.chain(joints)[-1]

    def chain(self, joints: ArrayLike) -> list[np.ndarray]:
        """Return the poses (..., 4, 4) of the links 1 to J and of the flange in the base."""
        joints = np.asarray(joints, np.float64)
        found, pose = [], np.eye(4)
        for i in range(len(self.joints)):
            pose = pose @ turned(*self.origins[i], joints[..., i])
            found.append(pose)
        return [*found, pose @ turned(*self.origins[-1], 0.0)]

    def transforms(self, joints: ArrayLike) -> list[Transform]:
        """Return where each link is in the one before, from the base on; joints (J,) rad."""
        return [Transform(parent, child, turned(*origin, angle)) for parent, child, origin, angle
                in zip(self.links, self.links[1:], self.origins, np.asarray(joints, np.float64))]

    @property
    def fixed_transforms(self) -> list[Transform]:
        """Return where the base and the fingertips are, which no joint changes."""
        return [Transform(WORLD_FRAME, BASE_FRAME, self.mount.pose),
                Transform(self.links[-1], TIP_FRAME, self.tip(self.mount))]

    def tip(self, mount: Mount) -> np.ndarray:
        """Return the pose (4, 4) of the fingertips in the last link."""
        pose = turned(*self.origins[-1], 0.0)
        pose[:3, 3] += mount.tool * pose[:3, 2]
        return pose

    def gripper_at(self, joints: ArrayLike, mount: Mount | None = None) -> np.ndarray:
        """
        Return where the fingertips are.

        :param joints: (..., J) rad.
        :param mount: where the arm stands; None: at the simulated table.
        :return: (..., 3) m in the world.
        """
        mount = mount or self.mount
        flange = mount.pose @ self.forward(joints)
        return flange[..., :3, 3] + mount.tool * flange[..., :3, 2]

    def joints_at(self, gripper: ArrayLike, mount: Mount | None = None) -> np.ndarray:
        """
        Return joints that bring the fingertips to a place, the hand pointing straight down.

        :param gripper: (3,) x, y, z of the fingertips in the world, m.
        :param mount: where the arm stands; None: at the simulated table.
        :return: (J,) rad.
        :raises KinematicsError: when the place is out of reach or beyond the joints' limits.
        """
        mount = mount or self.mount
        flange = np.eye(4)
        flange[:3, :3] = np.diag([1, -1, -1])  # the fingers open along the world's x
        flange[:3, 3] = np.asarray(gripper, np.float64)[:3] + [0, 0, mount.tool]
        joints = self.inverse(np.linalg.inv(mount.pose) @ flange)
        middle, half = self.limits.mean(1), np.ptp(self.limits, axis=1) / 2
        self._check(np.abs(joints - middle) / half, 'its limit', np.degrees(joints), 'degrees')
        return joints

    def check_motion(self, before: ArrayLike, after: ArrayLike, seconds: float) -> None:
        """
        Refuse a motion that is too fast for the joints.

        :param before: (J,) rad.
        :param after: (J,) rad, after so many seconds.
        :raises KinematicsError: with the joint's name, its speed and its limit.
        """
        speeds = wrapped(np.subtract(after, before)) / seconds
        self._check(np.abs(speeds) / self.speeds, 'its highest speed', np.degrees(speeds),
                    'degrees/s')

    def _check(self, share: np.ndarray, of: str, values: np.ndarray, unit: str) -> None:
        worst = int(share.argmax())
        if share[worst] > 1:
            raise KinematicsError(f'{self.joints[worst]} would be at {share[worst]:.2f} of {of} '
                                  f'({values[worst]:.0f} {unit})')


def get_arm(name: str) -> Arm:
    """
    Look up an arm.

    :raises ConfigError: for an unknown name.
    """
    return load_plugin('tap_ros.arms', name)


def known_arms() -> list[Arm]:
    """Return all arms that can be used; looking for those of other packages takes milliseconds."""
    found = []
    for name in names('tap_ros.arms'):
        try:
            found.append(get_arm(name))
        except ConfigError as error:
            warnings.warn(f'{error}; its joints are not looked for', stacklevel=2)
    return found


def find_joints(positions: Mapping[str, float], arms: Sequence[Arm]) -> list[float] | None:
    """
    Find the joints of one of some arms, whatever their names begin with.

    :param positions: rad by the name of the joint.
    :param arms: those that it may be.
    :return: the arm's joints in order; None when there is not one arm, or more than one.
    """
    found = []
    for joints in (arm.joints for arm in arms):
        prefixes = [name.removesuffix(joints[0]) for name in positions if name.endswith(joints[0])]
        found += [[positions[prefix + joint] for joint in joints] for prefix in prefixes
                  if all(prefix + joint in positions for joint in joints)]
    return found[0] if len(found) == 1 else None


def rpy(turn: Turn) -> Place:
    """Return roll, pitch and yaw of a turn."""
    return turn if isinstance(turn, tuple) else (turn, 0.0, 0.0)


def turned(place: Sequence[float], turn: Turn, angle: ArrayLike) -> np.ndarray:
    """Return the pose (..., 4, 4) of a frame at a place, turned, then about its z by an angle."""
    roll, pitch, yaw = rpy(turn)
    c, s, cr, sr = np.cos(angle), np.sin(angle), np.cos(roll), np.sin(roll)
    pose = np.zeros((*np.shape(angle), 4, 4))
    pose[..., 0, 0], pose[..., 0, 1] = c, -s
    pose[..., 1, 0], pose[..., 1, 1], pose[..., 1, 2] = cr * s, cr * c, -sr
    pose[..., 2, 0], pose[..., 2, 1], pose[..., 2, 2] = sr * s, sr * c, cr
    if pitch or yaw:
        c, s, cy, sy = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
        pose[..., :3, :3] = np.array([
            [cy * c, -sy, cy * s], [sy * c, cy, sy * s], [-s, 0, c]]) @ pose[..., :3, :3]
    pose[..., :3, 3], pose[..., 3, 3] = place, 1
    return pose


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Return the same angles in (-pi, pi]."""
    return np.pi - (np.pi - angles) % (2 * np.pi)


def along_z(link: int, low: float, high: float, radius: float, colour: Colour) -> Primitive:
    """Return a cylinder along a link's z."""
    return Primitive(link, (0, 0, low), (0, 0, high), radius, colour)


