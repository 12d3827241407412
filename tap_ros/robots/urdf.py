# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The shapes of a robot and how its joints move them, from its URDF.

Only collision geometry of boxes, cylinders, spheres and capsules is read. Each becomes the corners
of a convex polyhedron that just contains it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.etree import ElementTree

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.text import escaped, listing

MOST_CHARACTERS = 2**21
MOST_LINKS = 1000
MOVING = ('revolute', 'continuous', 'prismatic')
_SIDES = 24  # of a circle


@dataclass(frozen=True)
class Shape:
    """A convex part of a link."""

    link: str
    corners: np.ndarray  # (N, 3) m, in the frame of the link


@dataclass(frozen=True)
class Joint:
    """How a link is held by another."""

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray  # (4, 4), of the child in the parent where the joint is at zero
    axis: np.ndarray  # (3,), of length 1
    leader: str  # the joint whose position counts; its own name unless it mimics another
    factor: float = 1.0  # its position is factor * leader's + offset
    offset: float = 0.0


@dataclass(frozen=True)
class Robot:
    """A tree of links."""

    root: str
    joints: tuple[Joint, ...]  # parents first
    shapes: tuple[Shape, ...]
    positions: tuple[str, ...] = field(init=False)  # names of joints whose positions are needed

    def __post_init__(self) -> None:
        leaders = (joint.leader for joint in self.joints if joint.kind in MOVING)
        object.__setattr__(self, 'positions', tuple(dict.fromkeys(leaders)))

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links, the root first."""
        return self.root, *(joint.child for joint in self.joints)

    def poses(self, positions: Mapping[str, float]) -> dict[str, np.ndarray]:
        """
        Return the pose (4, 4) of each link in the root.

        :param positions: rad or m by the names in `positions`.
        """
        poses = {self.root: np.eye(4)}
        for joint in self.joints:
            pose = poses[joint.parent] @ joint.origin
            if joint.kind in MOVING:
                value = joint.factor * positions[joint.leader] + joint.offset
                move = np.eye(4)
                if joint.kind == 'prismatic':
                    move[:3, 3] = value * joint.axis
                else:
                    move[:3, :3] = _rotation(joint.axis, value)
                pose = pose @ move
            poses[joint.child] = pose
        return poses

    def held_by(self, link: str) -> set[str]:
        """
        Return a link and all that it carries.

        :raises ConfigError: when there is no such link.
        """
        if link not in self.links:
            raise ConfigError(f'the robot has no link {escaped(link)}; it has '
                              f'{listing(self.links)}')
        found = {link}
        for joint in self.joints:
            if joint.parent in found:
                found.add(joint.child)
        return found


def read_urdf(text: str, source: str) -> Robot:
    """
    Read a URDF.

    :param text: XML.
    :param source: what errors call it.
    :raises ConfigError: when it cannot be used, for example since a shape is a mesh.
    """
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f'{source}: has {len(text)} characters; at most {MOST_CHARACTERS} are '
                          'read')
    try:
        # Bytes, since text that declares its encoding is refused.
        robot = ElementTree.fromstring(text.encode('utf-8', 'replace'))
        links = [_name(link) for link in robot.iterfind('link')]
        if robot.tag != 'robot' or not links:
            raise ConfigError('is no URDF: expected <robot> with <link>s')
        if len(links) > MOST_LINKS:
            raise ConfigError(f'has {len(links)} links; at most {MOST_LINKS} are read')
        joints = [_joint(element) for element in robot.iterfind('joint')]
        shapes = tuple(
            Shape(_name(link), _corners(collision, _name(link)))
            for link in robot.iterfind('link') for collision in link.iterfind('collision'))
        if not shapes:
            raise ConfigError('has no collision geometry')
        return _tree(links, {joint.name: joint for joint in joints}, shapes)
    except ConfigError as error:
        raise ConfigError(f'{source}: {error}') from error
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise ConfigError(f'{source}: is no URDF: {escaped(error)}') from error


def _tree(links: list[str], joints: dict[str, Joint], shapes: tuple[Shape, ...]) -> Robot:
    """Put joints in order, parents first."""
    parents = {joint.child: joint for joint in joints.values()}
    children: dict[str, list[Joint]] = {link: [] for link in links}
    for joint in joints.values():
        if joint.parent not in children or joint.child not in children:
            raise ConfigError(f'joint {escaped(joint.name)} holds a link that is not there')
        if joint.leader not in joints or joints[joint.leader].leader != joint.leader:
            raise ConfigError(f'joint {escaped(joint.name)} mimics {escaped(joint.leader)}, which '
                              'is no joint, or mimics another')
        children[joint.parent].append(joint)
    roots = [link for link in links if link not in parents]
    # A link with two parents could be reached for ever; a loop of others is not reached.
    ordered, waiting = [], list(roots) if len(parents) == len(joints) else []
    while waiting:
        held = children[waiting.pop()]
        ordered += held
        waiting += [joint.child for joint in held]
    if len(ordered) != len(joints) or len(set(links)) != len(ordered) + 1:
        raise ConfigError('its links are no tree: expected one root, and one joint that holds '
                          'each other link')
    return Robot(roots[0], tuple(ordered), shapes)


def _joint(element: ElementTree.Element) -> Joint:
    name, kind = _name(element), element.get('type', '')
    if kind not in (*MOVING, 'fixed'):
        raise ConfigError(f'joint {escaped(name)} is of the type {escaped(kind)!r}; expected one '
                          f'of {", ".join((*MOVING, "fixed"))}')
    parent, child, axis, mimic = (
        element.find(tag) for tag in ('parent', 'child', 'axis', 'mimic'))
    if parent is None or child is None:
        raise ConfigError(f'joint {escaped(name)} lacks its parent or child')
    direction = _numbers(axis, 'xyz', '1 0 0', 3)
    length = float(np.linalg.norm(direction))
    if length == 0:
        raise ConfigError(f'joint {escaped(name)} has an axis without direction')
    leader, factor, offset = name, 1.0, 0.0
    if mimic is not None:
        leader = mimic.get('joint', '')
        factor, = _numbers(mimic, 'multiplier', '1', 1)
        offset, = _numbers(mimic, 'offset', '0', 1)
    return Joint(name, kind, parent.get('link', ''), child.get('link', ''), _origin(element),
                 direction / length, leader, float(factor), float(offset))


def _corners(collision: ElementTree.Element, link: str) -> np.ndarray:
    """Return (N, 3) corners that contain a shape, in the frame of the link."""
    geometry = collision.find('geometry')
    shape = geometry[0] if geometry is not None and len(geometry) else None
    kind = '' if shape is None else shape.tag
    if kind == 'box':
        corners = _box(_numbers(shape, 'size', '', 3))
    elif kind in ('sphere', 'cylinder', 'capsule'):
        radius, = _numbers(shape, 'radius', '', 1)
        length, = _numbers(shape, 'length', '', 1) if kind != 'sphere' else [0.0]
        corners = (_circles(radius) if kind == 'cylinder' else _ball(radius)).repeat(2, 0)
        corners[::2, 2] += length / 2
        corners[1::2, 2] -= length / 2
    else:
        raise ConfigError(
            f'link {escaped(link)} has a {escaped(kind) or "shape that is missing"}; expected '
            'box, cylinder, sphere or capsule: replace meshes by such shapes')
    origin = _origin(collision)
    return corners @ origin[:3, :3].T + origin[:3, 3]


def _box(size: np.ndarray) -> np.ndarray:
    return (np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)) * size


def _circles(radius: float) -> np.ndarray:
    """Return a polygon around a circle in the plane z = 0."""
    angle = np.arange(_SIDES) * 2 * np.pi / _SIDES
    x, y = np.cos(angle), np.sin(angle)
    return np.stack([x, y, 0 * x], -1) * radius / np.cos(np.pi / _SIDES)


def _ball(radius: float) -> np.ndarray:
    """Return the corners of a polyhedron around a ball."""
    polar = np.arange(_SIDES // 2 + 1) * 2 * np.pi / _SIDES
    ring = _circles(radius)
    points = np.sin(polar)[:, None, None] * ring
    points[..., 2] = np.cos(polar)[:, None] * radius
    return points.reshape(-1, 3) / np.cos(np.pi / _SIDES)


def _origin(element: ElementTree.Element) -> np.ndarray:
    """Return the pose (4, 4) that <origin> says."""
    origin, pose = element.find('origin'), np.eye(4)
    roll, pitch, yaw = _numbers(origin, 'rpy', '0 0 0', 3)
    x, y, z = np.eye(3)
    pose[:3, :3] = _rotation(z, yaw) @ _rotation(y, pitch) @ _rotation(x, roll)
    pose[:3, 3] = _numbers(origin, 'xyz', '0 0 0', 3)
    return pose


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about an axis (3,) of length 1 by rad."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _numbers(element: ElementTree.Element | None, name: str, default: str,
             count: int) -> np.ndarray:
    """Return the numbers of an attribute."""
    text = default if element is None else element.get(name, default)
    values = np.array([float(word) for word in text.split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ConfigError(f'{name}="{escaped(text, 60)}"; expected numbers: {count}')
    return values


def _name(element: ElementTree.Element) -> str:
    return element.get('name', '')
