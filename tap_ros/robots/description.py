# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The URDF of an arm at its table, written from the numbers that the simulator uses."""

from xml.etree import ElementTree

import numpy as np
from tap_ros.base.contract import WORLD_FRAME
from tap_ros.robots.arm import Arm, BASE_FRAME, DARK, Mount, TIP_FRAME


def robot_description(arm: Arm, mount: Mount | None = None,
                      hand_radius: float | None = None) -> str:
    """
    Return the URDF.

    A capsule is a cylinder with spheres at its ends.

    :param arm: Arm.
    :param mount: where it stands, and the length of its tool; None: at the simulated table.
    :param hand_radius: m; with a hand, a cylinder around the tool from flange to fingertips; it is
        of the link TIP_FRAME.
    """
    mount = mount or arm.mount
    robot = ElementTree.Element('robot', name=f'{arm.name}_at_table')
    ElementTree.SubElement(robot, 'link', name=WORLD_FRAME)
    for number, name in enumerate(arm.links):
        link = ElementTree.SubElement(robot, 'link', name=name)
        for shape in arm.shapes:
            if shape.link == number:
                _add_cylinder(link, np.array(shape.start), np.array(shape.end), shape.radius,
                              shape.colour, shape.capsule)
    tip = ElementTree.SubElement(robot, 'link', name=TIP_FRAME)
    if hand_radius is not None:
        _add_cylinder(tip, np.array([0, 0, -mount.tool]), np.zeros(3), hand_radius, DARK, False)
    _add_joint(robot, 'world_joint', 'fixed', WORLD_FRAME, BASE_FRAME,
               mount.position, (0, 0, mount.yaw))
    *origins, ((x, y, z), tip_roll) = arm.origins
    for i, (name, (place, roll)) in enumerate(zip(arm.joints, origins)):
        joint = _add_joint(
            robot, name, 'revolute', arm.links[i], arm.links[i + 1], place, (roll, 0, 0))
        ElementTree.SubElement(joint, 'axis', xyz='0 0 1')
        low, high = arm.limits[i]
        ElementTree.SubElement(
            joint, 'limit', lower=_text(low), upper=_text(high),
            velocity=_text(arm.speeds[i]), effort=_text(arm.efforts[i]))
    _add_joint(robot, 'gripper_joint', 'fixed', arm.links[-1], TIP_FRAME,
               (x, y, z + mount.tool), (tip_roll, 0, 0))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, 'unicode', xml_declaration=True)


def _add_joint(robot: ElementTree.Element, name: str, kind: str, parent: str, child: str,
               place: np.ndarray | tuple[float, float, float],
               turn: tuple[float, float, float]) -> ElementTree.Element:
    """Add a joint at a place (3,) in m with roll, pitch, yaw in rad."""
    joint = ElementTree.SubElement(robot, 'joint', name=name, type=kind)
    ElementTree.SubElement(joint, 'parent', link=parent)
    ElementTree.SubElement(joint, 'child', link=child)
    ElementTree.SubElement(joint, 'origin', xyz=_text(*place), rpy=_text(*turn))
    return joint


def _add_cylinder(link: ElementTree.Element, start: np.ndarray, end: np.ndarray, radius: float,
                  colour: tuple[float, float, float], capsule: bool) -> None:
    """Add a cylinder between two points, to be seen and to be bumped into."""
    along = end - start
    length = float(np.linalg.norm(along))
    x, y, z = along / length
    # Roll and pitch that turn z into the cylinder's direction.
    turn = (0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x)))
    for use in ('visual', 'collision'):
        parts = [((start + end) / 2, turn, 'cylinder', {'radius': radius, 'length': length})]
        if capsule:
            parts += [(place, (0.0, 0.0, 0.0), 'sphere', {'radius': radius})
                      for place in (start, end)]
        for place, turned, kind, sizes in parts:
            element = ElementTree.SubElement(link, use)
            ElementTree.SubElement(element, 'origin', xyz=_text(*place), rpy=_text(*turned))
            geometry = ElementTree.SubElement(element, 'geometry')
            ElementTree.SubElement(
                geometry, kind, {name: _text(size) for name, size in sizes.items()})
            if use == 'visual':
                name = '_'.join(f'{round(255 * part):02x}' for part in colour)
                material = ElementTree.SubElement(element, 'material', name=name)
                ElementTree.SubElement(material, 'color', rgba=_text(*colour, 1))


def _text(*numbers: float) -> str:
    """Return numbers as URDF writes them."""
    return ' '.join(repr(float(number)) for number in numbers)
