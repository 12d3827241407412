# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An arm of names and numbers: kinematics from a URDF, inverse kinematics by search."""

from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.errors import ConfigError, KinematicsError
from tap_ros.base.text import escaped, listing
from tap_ros.robots.arm import Arm, DARK, MOST_JOINTS, Mount, Place, Primitive, wrapped
from tap_ros.robots.urdf import checked, compiled, LINK, parse, reading

STEPS = 100  # of the search; some ten are usual
DAMPING = 1e-3  # of the squared error
NEAR = 1e-10  # m and rad
LONGEST = 0.5  # rad of one step
RADIUS = 0.05  # m of the capsules between the joints


def arm_from_urdf(name: str, text: str, joints: Sequence[str], flange: str, start: ArrayLike,
                  mount: Mount, **options: Any) -> Arm:
    """
    Return an arm; it is seen as capsules from joint to joint.

    :param name: by which it is asked for.
    :param text: XML of the URDF; meshes, and joints that are not named, do not count.
    :param joints: names of its J revolute joints, from the base on; the base is the link that
        holds the first.
    :param flange: link that carries the tool, along its z.
    :param start: (J,) rad, a pose with the hand pointing down over the middle of the table: the
        search begins there, so that near places have near joints.
    :param mount: where the base stands at the simulated table.
    :param options: fields of Arm, such as low and high.
    :raises ConfigError: for a URDF without these joints, limits, or link.
    """
    with reading(f'arm {name}'):
        robot = parse(text)
        checked(robot)
        numbers = np.array([_limits(robot, joint) for joint in joints])
        for link in robot.iterfind('link'):
            link[:] = []
        origins = _origins(compiled(robot), joints, flange)
        places = np.array([place for place, _ in origins[1:]])  # of what a link carries, in it
        shapes = [Primitive(i + 1, (0, 0, 0), tuple(place), RADIUS, DARK, capsule=True)
                  for i, place in enumerate(places.tolist()) if np.linalg.norm(place) > RADIUS]
        begin = np.asarray(start, np.float64)
        if begin.shape != (len(joints),):
            raise ConfigError(f'start has the shape {begin.shape}; expected a number for each of '
                              f'{len(joints)} joints')
    arm = Arm(name, tuple(joints), limits=numbers[:, :2], speeds=numbers[:, 2],
              efforts=tuple(numbers[:, 3].tolist()), origins=tuple(origins),
              inverse=lambda pose: search(arm, pose, begin), shapes=tuple(shapes), mount=mount,
              **options)
    return arm


def search(arm: Arm, pose: np.ndarray, start: np.ndarray) -> np.ndarray:
    """
    Find joints that bring the flange to a pose, by damped least squares (Levenberg-Marquardt).

    :param pose: (4, 4) in the base, rotation and metres.
    :param start: (J,) rad, where the search begins; the same start gives the same joints.
    :return: (J,) rad, within the limits.
    :raises KinematicsError: when it does not come there.
    """
    joints, turn, quaternion = start.copy(), np.zeros(3), np.zeros(4)
    for _ in range(STEPS):
        *links, flange = arm.chain(joints)
        mujoco.mju_mat2Quat(quaternion, (pose[:3, :3] @ flange[:3, :3].T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        error = np.append(pose[:3, 3] - flange[:3, 3], turn)
        if np.abs(error).max() < NEAR:
            return wrapped(joints)
        axes = np.array([link[:3, 2] for link in links])
        arms = flange[:3, 3] - np.array([link[:3, 3] for link in links])
        jacobian = np.vstack([np.cross(axes, arms).T, axes.T])  # (6, J)
        damped = jacobian @ jacobian.T + (DAMPING * error @ error + NEAR) * np.eye(6)
        step = jacobian.T @ np.linalg.solve(damped, error)
        step *= min(1.0, LONGEST / np.abs(step).max())
        joints = np.clip(joints + step, *arm.limits.T)
    raise KinematicsError(
        f'the arm cannot reach there: its flange stays {np.linalg.norm(error[:3]):.3f} m and '
        f'{np.degrees(np.linalg.norm(turn)):.1f} degrees away')


def _limits(robot: ElementTree.Element, name: str) -> tuple[float, float, float, float]:
    """Return least and greatest angle, highest speed and effort of a joint."""
    joint = next((one for one in robot.iterfind('joint') if one.get('name') == name), None)
    if joint is None or joint.get('type') not in ('revolute', 'continuous'):
        turning = [escaped(one.get('name')) for one in robot.iterfind('joint')
                   if one.get('type') in ('revolute', 'continuous')]
        raise ConfigError(f'has no joint {escaped(name)} that turns; it has {listing(turning)}')
    limit = joint.find('limit')
    told = {} if limit is None else limit.attrib
    try:
        low, high = ((-2 * np.pi, 2 * np.pi) if joint.get('type') == 'continuous'
                     else (float(told['lower']), float(told['upper'])))
        found = low, high, float(told['velocity']), float(told['effort'])
    except KeyError as error:
        raise ConfigError(f'joint {escaped(name)} lacks the limit {error}') from error
    if not (np.isfinite(found).all() and low < high and found[2] > 0):
        raise ConfigError(f'joint {escaped(name)} has the limits {listing(found)}; expected the '
                          'lower below the upper one, and a speed')
    return found


def _origins(model: mujoco.MjModel, joints: Sequence[str],
             flange: str) -> list[tuple[Place, Place]]:
    """Return Arm.origins: a frame at each joint, its z the axis, and the flange."""
    if not 1 <= len(joints) <= MOST_JOINTS:
        raise ConfigError(f'{len(joints)} joints are named; expected 1 to {MOST_JOINTS}')
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, LINK + flange)
    if body < 0:
        raise ConfigError(f'has no link {escaped(flange)}')
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frames = [_pose(data.xpos[body], data.xmat[body].reshape(3, 3))]
    found: list[str] = []
    while body:  # up to the root
        if model.body_jntnum[body] and model.joint(model.body_jntadr[body]).name in joints:
            joint, found = model.body_jntadr[body], [
                model.joint(model.body_jntadr[body]).name, *found]
            turn = data.xmat[body].reshape(3, 3)
            frames.insert(0, _pose(data.xanchor[joint], _along(data.xaxis[joint], turn)))
            base = model.body_parentid[body]
        body = model.body_parentid[body]
    if found != [*joints]:
        raise ConfigError(f'link {escaped(flange)} is carried by {listing(found)}; expected '
                          f'{listing(joints)}, in this order')
    frames.insert(0, _pose(data.xpos[base], data.xmat[base].reshape(3, 3)))
    return [origin_of(np.linalg.inv(before) @ after) for before, after in zip(frames, frames[1:])]


def _pose(place: np.ndarray, turn: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def _along(axis: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to `turn` whose z is an axis (3,)."""
    x = turn[:, 0] if abs(turn[:, 0] @ axis) < 0.9 else turn[:, 1]
    x = x - (x @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], 1)


def origin_of(pose: np.ndarray) -> tuple[Place, Place]:
    """Return place and roll, pitch, yaw of a pose (4, 4)."""
    level = float(np.hypot(pose[0, 0], pose[1, 0]))
    pitch = float(np.arctan2(-pose[2, 0], level))
    roll, yaw = (float(np.arctan2(pose[2, 1], pose[2, 2])),
                 float(np.arctan2(pose[1, 0], pose[0, 0])))
    if level < 1e-9:  # then roll and yaw are about one axis
        roll, yaw = float(np.arctan2(-pose[1, 2], pose[1, 1])), 0.0
    x, y, z = pose[:3, 3].tolist()
    return (x, y, z), (roll, pitch, yaw)
