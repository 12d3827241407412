# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The shapes of a robot and how its joints move them, from its URDF, as MuJoCo reads it.

Only collision geometry of boxes, cylinders, spheres and capsules is read. Each becomes the corners
of a convex polyhedron that just contains it.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped, listing

MOST_CHARACTERS = 2**21
MOST_LINKS, MOST_SHAPES = 300, 3000  # more take seconds to read
KINDS = ('revolute', 'continuous', 'prismatic', 'fixed')
SHAPES = ('box', 'cylinder', 'sphere', 'capsule')
# What MuJoCo is given of each element: neither files, nor what masses and limits would need.
_READ = {'robot': ('link', 'joint'), 'link': ('collision',),
         'joint': ('parent', 'child', 'origin', 'axis'), 'collision': ('origin', 'geometry')}
_NUMBERS = ('xyz', 'rpy', 'size', 'radius', 'length', 'multiplier', 'offset')
LINK = 'link '  # before names of links: a root named world would be MuJoCo's own
_SIDES = 24  # of a circle


class Shape(NamedTuple):
    """A convex part of a link."""

    link: str
    corners: np.ndarray  # (N, 3) m, in the frame of the link


class Mimic(NamedTuple):
    """Whose position a joint follows: its own is factor * leader's + offset."""

    leader: str
    factor: float = 1.0
    offset: float = 0.0


class Robot:
    """
    A tree of links.

    :ivar links: their names, the root first.
    :ivar positions: names of the joints whose positions are needed.
    :ivar shapes: of all links.
    """

    def __init__(self, model: mujoco.MjModel, mimics: Mapping[str, Mimic]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._joints = [mimics.get(name, Mimic(name)) for name in (
            model.joint(i).name for i in range(model.njnt))]
        self.links = tuple(model.body(i).name.removeprefix(LINK) for i in range(1, model.nbody))
        self.positions = tuple(dict.fromkeys(joint.leader for joint in self._joints))
        self.shapes = tuple(Shape(self.links[model.geom_bodyid[i] - 1], _corners(model, i))
                            for i in range(model.ngeom))

    def poses(self, positions: Mapping[str, float]) -> dict[str, np.ndarray]:
        """
        Return the pose (4, 4) of each link in the root.

        :param positions: rad or m by the names in `positions`.
        """
        self._data.qpos[:] = [joint.factor * positions[joint.leader] + joint.offset
                              for joint in self._joints]
        mujoco.mj_kinematics(self._model, self._data)
        poses = np.tile(np.eye(4), (len(self.links), 1, 1))
        poses[:, :3, :3] = self._data.xmat[1:].reshape(-1, 3, 3)
        poses[:, :3, 3] = self._data.xpos[1:]
        return dict(zip(self.links, poses))

    def held_by(self, link: str) -> set[str]:
        """
        Return a link and all that it carries.

        :raises ConfigError: when there is no such link.
        """
        if link not in self.links:
            raise ConfigError(f'the robot has no link {escaped(link)}; it has '
                              f'{listing(self.links)}')
        found = {link}
        for name, parent in zip(self.links, self._model.body_parentid[1:]):
            if parent and self.links[parent - 1] in found:
                found.add(name)
        return found


def read_urdf(text: str, source: str) -> Robot:
    """
    Read a URDF.

    :param text: XML.
    :param source: what errors call it.
    :raises ConfigError: when it cannot be used, for example since a shape is a mesh.
    """
    with reading(source):
        robot = parse(text)
        mimics = checked(robot)
        _check_shapes(robot)
        return Robot(compiled(robot), mimics)


@contextmanager
def reading(source: str) -> Iterator[None]:
    """Turn what goes wrong while a URDF is read into a ConfigError that names it."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f'{source}: {error}') from error
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise ConfigError(f'{source}: is no URDF: {escaped(error)}') from error


def parse(text: str) -> ElementTree.Element:
    """Return the root element of XML of a bounded size."""
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f'has {len(text)} characters; at most {MOST_CHARACTERS} are read')
    return ElementTree.fromstring(text.encode('utf-8', 'replace'))  # text may name an encoding


def compiled(robot: ElementTree.Element) -> mujoco.MjModel:
    """Return the links, joints and collision shapes of a checked robot, which is changed."""
    for element in robot.iter():
        element[:] = [child for child in element
                      if child.tag in _READ.get(element.tag, (child.tag,))]
        name = 'name' if element.tag == 'link' else 'link'
        if element.tag in ('link', 'parent', 'child'):
            element.set(name, LINK + element.get(name, ''))
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, 'unicode'))
    spec.compiler.fusestatic = False
    spec.compiler.boundmass = spec.compiler.boundinertia = 1  # nobody asks for the true ones
    return spec.compile()


def checked(robot: ElementTree.Element) -> dict[str, Mimic]:
    """Refuse what MuJoCo takes otherwise than it is meant; return which joints follow others."""
    links = [link.get('name') for link in robot.iterfind('link')]
    if robot.tag != 'robot' or not links:
        raise ConfigError('is no URDF: expected <robot> with <link>s')
    if len(links) > MOST_LINKS:
        raise ConfigError(f'has {len(links)} links; at most {MOST_LINKS} are read')
    for element in robot.iter():
        for name in set(_NUMBERS) & set(element.attrib):
            if not np.isfinite([float(word) for word in element.attrib[name].split()]).all():
                raise ConfigError(f'{name}="{escaped(element.attrib[name], 60)}"; expected '
                                  'numbers')
    return _checked_joints(robot, links)


def _check_shapes(robot: ElementTree.Element) -> None:
    """Refuse shapes that are not read."""
    shapes = [(link.get('name'), next(collision.iterfind('geometry/*'), None)) for link in
              robot.iterfind('link') for collision in link.iterfind('collision')]
    if not 0 < len(shapes) <= MOST_SHAPES:
        raise ConfigError(f'has collision geometries: {len(shapes)}; expected 1 to {MOST_SHAPES}')
    for link, shape in shapes:
        if shape is None or shape.tag not in SHAPES:
            kind = 'shape that is missing' if shape is None else escaped(shape.tag)
            raise ConfigError(f'link {escaped(link)} has a {kind}; expected {", ".join(SHAPES)}: '
                              'replace meshes by such shapes')


def _checked_joints(robot: ElementTree.Element, links: list[str | None]) -> dict[str, Mimic]:
    """Refuse what is no tree; return which joints follow others."""
    children, mimics = [], {}
    joints = {joint.get('name', ''): joint for joint in robot.iterfind('joint')}
    for name, joint in joints.items():
        parent, child, mimic = (joint.find(tag) for tag in ('parent', 'child', 'mimic'))
        if joint.get('type') not in KINDS:
            raise ConfigError(f'joint {escaped(name)} is of the type '
                              f'{escaped(joint.get("type"))!r}; expected one of '
                              f'{", ".join(KINDS)}')
        if parent is None or child is None:
            raise ConfigError(f'joint {escaped(name)} lacks its parent or child')
        if not {parent.get('link'), child.get('link')} <= set(links):
            raise ConfigError(f'joint {escaped(name)} holds a link that is not there')
        children.append(child.get('link'))
        if mimic is not None:
            mimics[name] = Mimic(mimic.get('joint', ''), float(mimic.get('multiplier', 1)),
                                 float(mimic.get('offset', 0)))
    if not len(links) == len(set(links)) == len(set(children)) + 1 == len(children) + 1:
        raise ConfigError('its links are no tree: expected one root, and one joint that holds '
                          'each other link')
    for name, mimic in mimics.items():
        if mimic.leader not in joints or mimic.leader in mimics:
            raise ConfigError(f'joint {escaped(name)} mimics {escaped(mimic.leader)}, which '
                              'is no joint, or mimics another')
    return mimics


def _corners(model: mujoco.MjModel, shape: int) -> np.ndarray:
    """Return (N, 3) corners that contain a shape, in the frame of the link."""
    kind, (radius, half, _) = model.geom_type[shape], model.geom_size[shape]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.array(list(product((-1, 1), repeat=3))) * model.geom_size[shape]
    else:
        angle = np.arange(_SIDES) * 2 * np.pi / _SIDES
        outside = radius / np.cos(np.pi / _SIDES)  # a polygon around a circle
        corners = outside * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        if kind != mujoco.mjtGeom.mjGEOM_CYLINDER:  # rings around a ball
            polar = angle[:_SIDES // 2 + 1, None, None]
            corners = (np.sin(polar) * corners + np.cos(polar) * [0, 0, radius]
                       ).reshape(-1, 3) / np.cos(np.pi / _SIDES)
        corners = np.concatenate([corners - [0, 0, half], corners + [0, 0, half]])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[shape])
    return corners @ turn.reshape(3, 3).T + model.geom_pos[shape]
