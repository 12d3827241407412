# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The shapes of a robot and how its joints move them, from its URDF.

Only collision geometry of boxes, cylinders, spheres and capsules is read. Each becomes the corners
of a convex polyhedron that just contains it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import product
from typing import NamedTuple
from xml.etree import ElementTree

import cv2
import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped, listing

MOST_CHARACTERS = 2**21
MOST_LINKS = 1000
MOVING = ('revolute', 'continuous', 'prismatic')
_SIDES = 24  # of a circle


class Shape(NamedTuple):
    """A convex part of a link."""

    link: str
    corners: np.ndarray  # (N, 3) m, in the frame of the link


class Joint(NamedTuple):
    """How a link is held by another."""

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray  # (4, 4), of the child in the parent where the joint is at zero
    axis: np.ndarray  # (3,), of length 1
    leader: str  # the joint whose position counts; its own name unless it mimics another
    factor: float  # its position is factor * leader's + offset
    offset: float


@dataclass(frozen=True)
class Robot:
    """A tree of links."""

    root: str
    joints: tuple[Joint, ...]  # parents first
    shapes: tuple[Shape, ...]

    @property
    def positions(self) -> tuple[str, ...]:
        """Names of the joints whose positions are needed."""
        return tuple(dict.fromkeys(
            joint.leader for joint in self.joints if joint.kind in MOVING))

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
            move = np.eye(4)
            if joint.kind in MOVING:
                way = (joint.factor * positions[joint.leader] + joint.offset) * joint.axis
                if joint.kind == 'prismatic':
                    move[:3, 3] = way
                else:
                    move[:3, :3] = cv2.Rodrigues(way)[0]
            poses[joint.child] = poses[joint.parent] @ joint.origin @ move
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
    for joint in joints.values():
        if joint.parent not in links or joint.child not in links:
            raise ConfigError(f'joint {escaped(joint.name)} holds a link that is not there')
        if joint.leader not in joints or joints[joint.leader].leader != joint.leader:
            raise ConfigError(f'joint {escaped(joint.name)} mimics {escaped(joint.leader)}, which '
                              'is no joint, or mimics another')
    holders = {joint.child: joint for joint in joints.values()}
    try:
        order = list(TopologicalSorter(
            {child: [joint.parent] for child, joint in holders.items()}).static_order()) or links
    except CycleError:
        order = []
    if not len(order) == len(links) == len(joints) + 1 == len(holders) + 1:
        raise ConfigError('its links are no tree: expected one root, and one joint that holds '
                          'each other link')
    return Robot(order[0], tuple(holders[link] for link in order[1:]), shapes)


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
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * _numbers(shape, 'size', '', 3)
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
    for axis, angle in zip(np.eye(3), _numbers(origin, 'rpy', '0 0 0', 3)):
        pose[:3, :3] = cv2.Rodrigues(angle * axis)[0] @ pose[:3, :3]
    pose[:3, 3] = _numbers(origin, 'xyz', '0 0 0', 3)
    return pose


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
